"""The figures of a diagnosis, and the page that shows them."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._checks import make_folder
from .._version import __version__
from ..errors import InvalidInputError
from ..plots.steps import outcomes
from ..plots.style import LIGHT, STYLES, svg
from .findings import Finding, percent

if TYPE_CHECKING:
    from .diagnose import Diagnosis

_LIMIT: dict[str, Any] = {"color": "0.35", "linewidth": 0.9, "linestyle": "--"}
_MOST_LINES = 6
# Where logarithmic axes end: of singular values and shares, and of the NIS.
_FLOOR, _LEAST = 1e-4, 1e-2


class _Figure(NamedTuple):
    title: str
    caption: str
    paint: Callable[[Diagnosis, Any], None]


def draw(diagnosis: Diagnosis) -> Any:
    """All figures in one, one above the other."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    parts = _figures(diagnosis)
    with rc_context(LIGHT):
        figure = Figure(figsize=(6.8, 2.8 * len(parts)), layout="constrained")
        places = figure.subplots(len(parts), 1, squeeze=False)[:, 0]
        for axes, one in zip(places, parts, strict=True):
            one.paint(diagnosis, axes)
            axes.set_title(one.title, loc="left", color="0.2", pad=34.0)
    return figure


def write_page(diagnosis: Diagnosis, path: str | Path) -> Path:
    """Write the page; see `Diagnosis.report`."""
    try:
        target = Path(path)
    except TypeError as error:
        raise InvalidInputError(f"path is {path!r}; expected a file's name.") from error
    if target.is_dir() or not target.name:
        raise InvalidInputError(f"path is {str(path)!r}, a folder; expected a file's name.")
    make_folder(target.parent)
    try:
        target.write_text(_page(diagnosis), encoding="utf-8")
    except OSError as error:
        raise InvalidInputError(f"{target} cannot be written: {error}.") from error
    return target


def _figures(diagnosis: Diagnosis) -> list[_Figure]:
    low, high = diagnosis.nis_limits
    found = [
        _Figure(
            "Normalised innovations squared (NIS)",
            "How far each measurement is from its prediction, squared and in units of what the "
            f"covariances say. Of a healthy record, 99 % are between {low:.2g} and {high:.2g}.",
            _nis,
        ),
        _Figure(
            "Innovations by sensor",
            "In their standard deviations; beyond 4, dotted, they count as outliers.",
            _innovations,
        ),
        _Figure(
            "Correlation of the innovations with themselves",
            "White where model and weights are right: 95 % within the dashed lines.",
            _own_correlations,
        ),
        _Figure(
            "Correlation of the innovations with earlier inputs",
            "The strongest over all sensors. The model lacks an effect of what stands out, unless "
            "a controller computes the input from states that are not measured.",
            _input_correlations,
        ),
        _Figure(
            "What each window sees of its first state",
            "Singular values of the windows' Gauss-Newton matrices in deviations of the prior: "
            "above 1 the data say more than the prior, near 0 they see nothing in some direction.",
            _observability,
        ),
        _Figure(
            "How much the prior still matters",
            "Share of the variance of the newest estimate that comes from the prior, for each "
            "horizon; the dotted line is the run's.",
            _prior,
        ),
        _Figure(
            "What happened at each step", "Shares of the samples are in brackets.",
            lambda diagnosis, axes: outcomes(
                diagnosis.run, dt=diagnosis.names.step, time_label=_time(diagnosis), axes=axes
            ),
        ),
    ]
    has_inputs = diagnosis.correlations.inputs.shape[2] > 0
    return [one for one in found if has_inputs or one.paint is not _input_correlations]


def _time(diagnosis: Diagnosis) -> str:
    return f"time ({diagnosis.names.unit})"


def _finish(diagnosis: Diagnosis, axes: Any, x: str, y: str, *, spans: bool = False) -> None:
    """Name the axes, shade where findings are, and put the legend above."""
    for one in diagnosis.findings if spans else ():
        if one.where is not None:
            axes.axvspan(*one.where, color="#E69F00", alpha=0.15, linewidth=0)
    axes.set(xlabel=x, ylabel=y)
    labels = axes.get_legend_handles_labels()[1]
    if labels:
        columns = max(1, min(4, 64 // (6 + max(map(len, labels)))))
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2)


def _nis(diagnosis: Diagnosis, axes: Any) -> None:
    times, nis = diagnosis.names.times, diagnosis.nis
    there, width = np.isfinite(nis), max(5, len(nis) // 25)
    axes.plot(times, np.maximum(nis, _LEAST), ".", markersize=3.0, color=STYLES[1]["color"])
    if there.sum() > 2 * width:
        sums, counts = (
            np.convolve(one, np.ones(width), "same") for one in (np.where(there, nis, 0.0), there)
        )
        mean = np.where(counts > width / 3, sums / np.maximum(counts, 1), np.nan)
        axes.plot(times, mean, color=STYLES[0]["color"], linewidth=1.6,
                  label=f"mean of {width} samples")
    for limit, label in zip(diagnosis.nis_limits, (None, "99 % limits of each"), strict=True):
        axes.axhline(limit, label=label, **_LIMIT)
    top = nis.max(where=there, initial=diagnosis.nis_limits[1])
    axes.set_yscale("log")
    axes.set_ylim(0.7 * _LEAST, 3.0 * top)
    axes.margins(x=0.01)
    _finish(diagnosis, axes, _time(diagnosis), "NIS", spans=True)


def _innovations(diagnosis: Diagnosis, axes: Any) -> None:
    shown = np.clip(diagnosis.innovations, -12.0, 12.0)
    for style, column, name in zip(STYLES, shown.T, diagnosis.names.outputs, strict=False):
        axes.plot(diagnosis.names.times, column, ".", markersize=3.0, color=style["color"],
                  label=name)
    for limit in (-4.0, 4.0):
        axes.axhline(limit, **_LIMIT | {"linestyle": ":"})
    axes.margins(x=0.01)
    _finish(diagnosis, axes, _time(diagnosis), "innovation (sigma)", spans=True)


def _own_correlations(diagnosis: Diagnosis, axes: Any) -> None:
    _correlations(diagnosis, axes, diagnosis.correlations.own.T, diagnosis.names.outputs)


def _input_correlations(diagnosis: Diagnosis, axes: Any) -> None:
    inputs, names = diagnosis.correlations.inputs, diagnosis.names
    labels = [*names.inputs, *(f"change of {one}" for one in names.inputs)]
    sizes = np.abs(inputs).max(axis=0)  # by sensor and input
    order = np.argsort(-sizes.max(axis=0)).tolist()
    sensors = [int(np.argmax(sizes[:, k])) for k in order]
    _correlations(
        diagnosis, axes, [inputs[:, j, k] for j, k in zip(sensors, order, strict=True)],
        [f"{names.outputs[j]}, {labels[k]}" for j, k in zip(sensors, order, strict=True)],
    )


def _correlations(diagnosis: Diagnosis, axes: Any, rows: Any, labels: Any) -> None:
    limit = diagnosis.correlations.limit
    for style, row, label in zip(STYLES, rows, labels, strict=False):
        axes.plot(np.arange(1, len(row)), row[1:], marker="o", markersize=3.0, linewidth=1.0,
                  label=label, **style)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * limit, **_LIMIT)
    reach = max(3.0 * limit, *map(abs, axes.get_ylim()))
    axes.set_ylim(-reach, reach)
    axes.xaxis.get_major_locator().set_params(integer=True)
    _finish(diagnosis, axes, "lag (samples)", "correlation")


def _observability(diagnosis: Diagnosis, axes: Any) -> None:
    values = diagnosis.observability.values
    times = diagnosis.names.times[diagnosis.first :][: len(values)]
    count = values.shape[1]
    shown = range(count) if count <= _MOST_LINES else [0, 1, 2, count - 1]
    for style, k in zip(STYLES, shown, strict=False):
        which = "weakest" if k == 0 else "strongest" if k == count - 1 else f"direction {k + 1}"
        axes.plot(times, np.maximum(values[:, k], _FLOOR), label=which, linewidth=1.3, **style)
    axes.axhline(1.0, **_LIMIT)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.6 * _FLOOR if (values < _FLOOR).any() else None)
    axes.margins(x=0.01)
    _finish(diagnosis, axes, f"start of the window, {_time(diagnosis)}", "data against prior",
            spans=True)


def _prior(diagnosis: Diagnosis, axes: Any) -> None:
    shares, source = diagnosis.prior_shares, diagnosis.run.source
    for style, i in zip(STYLES, np.argsort(-shares.mean(axis=0)), strict=False):
        axes.plot(np.maximum(shares[:, i], 0.5 * _FLOOR), linewidth=1.4,
                  label=diagnosis.names.labels[i], **style)
    if source is not None:
        axes.axvline(source.settings.horizon, **_LIMIT | {"linestyle": ":"})
    axes.axhline(0.1, **_LIMIT)
    axes.set_yscale("log")
    axes.set_ylim(_FLOOR, 1.5)
    axes.margins(x=0.01)
    _finish(diagnosis, axes, "horizon N", "share of the prior")


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Is the estimator healthy?</title>
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; margin: 0 auto;
  max-width: 56rem; padding: 1rem; overflow-wrap: break-word; }}
h1 {{ font-size: 1.5rem; }} h2 {{ font-size: 1.1rem; margin: 2rem 0 0.2rem; }}
.verdict {{ font-size: 1.15rem; }} p {{ margin: 0.3rem 0; }}
ol, ul {{ padding-left: 1.4rem; }} li {{ margin: 0.5rem 0; }}
.remedy, .caption, footer {{ color: #555; }} .warning {{ color: #8a4b00; font-weight: 600; }}
.fault {{ color: #a33a00; font-weight: 600; }}
.figure {{ overflow-x: auto; }} .figure svg {{ width: 100%; max-width: 44rem; height: auto; }}
table {{ border-collapse: collapse; }}
td, th {{ padding: 0.15rem 0.8rem 0.15rem 0; text-align: left; }}
.table {{ overflow-x: auto; }} footer {{ margin-top: 2rem; font-size: 0.85rem; }}
@media (prefers-color-scheme: dark) {{
  body {{ color: #ddd; background: #1c1c1c; }} .remedy, .caption, footer {{ color: #aaa; }}
  .warning {{ color: #e69f00; }} .fault {{ color: #f0803c; }}
  .figure svg {{ filter: invert(0.89) hue-rotate(180deg); }}
}}
</style>
</head>
<body>
<h1>Is the estimator healthy?</h1>
<p class="verdict">{verdict}</p>
<ol>{findings}</ol>
<h2>Worth knowing</h2>
<ul>{notes}</ul>
<h2>Sensors</h2>
<div class="table"><table>
<tr><th>sensor</th><th>missing</th><th>outlying</th><th>stuck</th></tr>{rows}
</table></div>
{figures}
<footer>qpmhe {version}. Innovations are those of an extended Kalman filter with the
estimator's model and weights, from sample {first} on.</footer>
</body>
</html>
"""


def _page(diagnosis: Diagnosis) -> str:
    source = diagnosis.run.source
    assert source is not None  # a diagnosis has checked that
    missing = np.mean(~np.isfinite(source.measurements), axis=0)
    rows = zip(
        diagnosis.names.outputs, missing, diagnosis.outliers, diagnosis.clipped, strict=True
    )
    return _PAGE.format(
        verdict=diagnosis.verdict, findings="".join(map(_item, diagnosis.findings)),
        notes="".join(map(_item, diagnosis.notes)),
        rows="".join(
            f"<tr><td>{escape(name)}</td>"
            + "".join(f"<td>{percent(one) if one else 'none'}</td>" for one in shares) + "</tr>"
            for name, *shares in rows
        ),
        figures="".join(
            f"<section><h2>{escape(one.title)}</h2><p class='caption'>{escape(one.caption)}</p>"
            f"<div class='figure'>{_svg(diagnosis, one, k)}</div></section>"
            for k, one in enumerate(_figures(diagnosis))
        ),
        version=escape(__version__), first=diagnosis.first,
    )


def _item(one: Finding) -> str:
    word = "" if one.severity == "note" else f"<span class='{one.severity}'>{one.severity}:</span> "
    remedy = f" <span class='remedy'>{escape(one.remedy)}</span>" if one.remedy else ""
    return f"<li>{word}{escape(one.text)}{remedy}</li>".replace(" %", "&nbsp;%")


def _svg(diagnosis: Diagnosis, one: _Figure, number: int) -> str:
    """One figure as SVG for the page; the number makes its ids unique."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(LIGHT):
        figure = Figure(figsize=(5.2, 2.6), layout="constrained")
        one.paint(diagnosis, figure.subplots())
    return svg(figure, f"f{number}")
