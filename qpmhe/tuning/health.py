"""The figures of a diagnosis, and the page that shows them."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._checks import make_folder
from .._version import __version__
from ..errors import InvalidInputError
from ..plots.steps import outcomes
from ..plots.style import LIGHT, STYLES
from .findings import Finding, percent

if TYPE_CHECKING:
    from .diagnosis import Diagnosis

_LIMIT: dict[str, Any] = {"color": "0.35", "linewidth": 0.9, "linestyle": "--"}
_MOST_LINES = 6
# Where logarithmic axes end: of singular values and shares, and of the NIS.
_FLOOR, _LEAST = 1e-4, 1e-2


def draw(diagnosis: Diagnosis) -> Any:
    """All figures in one, one above the other."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    parts = _parts(diagnosis)
    with rc_context(LIGHT):
        figure = Figure(figsize=(6.8, 2.8 * len(parts)), layout="constrained")
        for axes, (title, _, paint) in zip(
            figure.subplots(len(parts), 1, squeeze=False)[:, 0], parts, strict=True
        ):
            paint(diagnosis, axes)
            axes.set_title(title, loc="left", color="0.2", pad=34.0)
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


def _parts(diagnosis: Diagnosis) -> list[tuple[str, str, Callable[[Diagnosis, Any], None]]]:
    """Title, caption and painter of each figure."""
    low, high = diagnosis.nis_limits
    parts: list[tuple[str, str, Callable[[Diagnosis, Any], None]]] = [
        (
            "Normalised innovations squared (NIS)",
            "How far each measurement is from its prediction, squared and in units of what the "
            f"covariances say. Of a healthy record, 99 % are between {low:.2g} and {high:.2g}.",
            _nis,
        ),
        (
            "Innovations by sensor",
            "In their standard deviations; beyond 4, dotted, they count as outliers.",
            _innovations,
        ),
        (
            "Correlation of the innovations with themselves",
            "White where model and weights are right: 95 % within the dashed lines.",
            _own_correlations,
        ),
    ]
    if diagnosis.correlations.inputs.shape[2]:
        parts.append((
            "Correlation of the innovations with earlier inputs",
            "The strongest over all sensors. The model lacks an effect of what stands out, unless "
            "a controller computes the input from states that are not measured.",
            _input_correlations,
        ))
    parts += [
        (
            "What each window sees of its first state",
            "Singular values of the windows' Gauss-Newton matrices in deviations of the prior: "
            "above 1 the data say more than the prior, near 0 they see nothing in some direction.",
            _observability,
        ),
        (
            "How much the prior still matters",
            "Share of the variance of the newest estimate that comes from the prior, for each "
            "horizon; the dotted line is the run's.",
            _prior,
        ),
        ("What happened at each step", "Shares of the samples are in brackets.", _outcomes),
    ]
    return parts


def _times(diagnosis: Diagnosis) -> Any:
    return np.asarray(diagnosis.names.times)


def _time_label(diagnosis: Diagnosis) -> str:
    return f"time ({diagnosis.names.unit})"


def _spans(diagnosis: Diagnosis, axes: Any) -> None:
    """Shade where findings are."""
    for one in diagnosis.findings:
        if one.where is not None:
            axes.axvspan(*one.where, color="#E69F00", alpha=0.15, linewidth=0)


def _nis(diagnosis: Diagnosis, axes: Any) -> None:
    times, nis = _times(diagnosis), diagnosis.nis
    positive = nis[np.isfinite(nis) & (nis > 0.0)]
    _spans(diagnosis, axes)
    axes.plot(times, np.maximum(nis, _LEAST), ".", markersize=3.0, color=STYLES[1]["color"])
    width = max(5, len(nis) // 25)
    if np.isfinite(nis).sum() > 2 * width:
        there = np.isfinite(nis)
        kernel = np.ones(width)
        sums = np.convolve(np.where(there, nis, 0.0), kernel, "same")
        counts = np.convolve(there, kernel, "same")
        mean = np.where(counts > width / 3, sums / np.maximum(counts, 1), np.nan)
        axes.plot(times, mean, color=STYLES[0]["color"], linewidth=1.6,
                  label=f"mean of {width} samples")
    for limit in diagnosis.nis_limits:
        axes.axhline(limit, **_LIMIT)
    axes.plot([], [], label="99 % limits of each", **_LIMIT)
    axes.set_yscale("log")
    top = positive.max() if positive.size else 1.0
    axes.set_ylim(0.7 * _LEAST, 3.0 * max(top, diagnosis.nis_limits[1]))
    axes.set(xlabel=_time_label(diagnosis), ylabel="NIS")
    axes.margins(x=0.01)
    _legend(axes)


def _innovations(diagnosis: Diagnosis, axes: Any) -> None:
    times, values = _times(diagnosis), diagnosis.innovations
    _spans(diagnosis, axes)
    for style, j in zip(STYLES, range(values.shape[1]), strict=False):
        shown = np.clip(values[:, j], -12.0, 12.0)
        axes.plot(times, shown, ".", markersize=3.0, color=style["color"],
                  label=diagnosis.names.outputs[j])
    for limit in (-4.0, 4.0):
        axes.axhline(limit, **_LIMIT | {"linestyle": ":"})
    axes.set(xlabel=_time_label(diagnosis), ylabel="innovation (sigma)")
    axes.margins(x=0.01)
    _legend(axes)


def _own_correlations(diagnosis: Diagnosis, axes: Any) -> None:
    own = diagnosis.correlations.own
    for style, j in zip(STYLES, range(own.shape[1]), strict=False):
        axes.plot(np.arange(1, len(own)), own[1:, j], marker="o", markersize=3.0, linewidth=1.0,
                  label=diagnosis.names.outputs[j], **style)
    _limits(diagnosis, axes)
    axes.set(xlabel="lag (samples)", ylabel="correlation")
    _legend(axes)


def _input_correlations(diagnosis: Diagnosis, axes: Any) -> None:
    inputs, names = diagnosis.correlations.inputs, diagnosis.names.inputs
    labels = [*names, *(f"change of {one}" for one in names)]
    strongest = np.abs(inputs).max(axis=(0, 1))
    for style, k in zip(STYLES, np.argsort(-strongest), strict=False):
        j = int(np.argmax(np.abs(inputs[:, :, k]).max(axis=0)))
        axes.plot(np.arange(1, len(inputs)), inputs[1:, j, k], marker="o", markersize=3.0,
                  linewidth=1.0, label=f"{diagnosis.names.outputs[j]}, {labels[k]}", **style)
    _limits(diagnosis, axes)
    axes.set(xlabel="lag (samples)", ylabel="correlation")
    _legend(axes)


def _limits(diagnosis: Diagnosis, axes: Any) -> None:
    for sign in (-1.0, 1.0):
        axes.axhline(sign * diagnosis.correlations.limit, **_LIMIT)
    low, high = axes.get_ylim()
    reach = max(3.0 * diagnosis.correlations.limit, abs(low), abs(high))
    axes.set_ylim(-reach, reach)
    axes.xaxis.get_major_locator().set_params(integer=True)


def _observability(diagnosis: Diagnosis, axes: Any) -> None:
    view = diagnosis.observability
    times = _times(diagnosis)[diagnosis.first :][: len(view.values)]
    _spans(diagnosis, axes)
    count = view.values.shape[1]
    shown = range(count) if count <= _MOST_LINES else [0, 1, 2, count - 1]
    for style, k in zip(STYLES, shown, strict=False):
        which = "weakest" if k == 0 else "strongest" if k == count - 1 else f"direction {k + 1}"
        axes.plot(times, np.maximum(view.values[:, k], _FLOOR), label=which, linewidth=1.3, **style)
    axes.axhline(1.0, **_LIMIT)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.6 * _FLOOR if (view.values < _FLOOR).any() else None)
    axes.set(xlabel=f"begin of the window, {_time_label(diagnosis)}", ylabel="data against prior")
    axes.margins(x=0.01)
    _legend(axes)


def _prior(diagnosis: Diagnosis, axes: Any) -> None:
    shares, horizon = diagnosis.prior_shares, diagnosis.run.source
    for style, i in zip(STYLES, np.argsort(-shares.mean(axis=0)), strict=False):
        axes.plot(np.maximum(shares[:, i], 0.5 * _FLOOR), linewidth=1.4,
                  label=diagnosis.names.labels[i], **style)
    if horizon is not None:
        axes.axvline(horizon.settings.horizon, **_LIMIT | {"linestyle": ":"})
    axes.axhline(0.1, **_LIMIT)
    axes.set_yscale("log")
    axes.set_ylim(_FLOOR, 1.5)
    axes.set(xlabel="horizon N", ylabel="share of the prior")
    axes.margins(x=0.01)
    _legend(axes)


def _outcomes(diagnosis: Diagnosis, axes: Any) -> None:
    outcomes(diagnosis.run, dt=diagnosis.names.step, time_label=_time_label(diagnosis), axes=axes)


def _legend(axes: Any) -> None:
    labels = axes.get_legend_handles_labels()[1]
    if labels:
        columns = max(1, min(4, 64 // (6 + max(map(len, labels)))))
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2)


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; margin: 0 auto;
  max-width: 56rem; padding: 1rem; overflow-wrap: break-word; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin: 2rem 0 0.2rem; }
.verdict { font-size: 1.15rem; } p { margin: 0.3rem 0; }
ol, ul { padding-left: 1.4rem; } li { margin: 0.5rem 0; }
.remedy, .caption, footer { color: #555; } .warning { color: #8a4b00; font-weight: 600; }
.fault { color: #a33a00; font-weight: 600; }
.figure { overflow-x: auto; } .figure svg { width: 100%; max-width: 44rem; height: auto; }
table { border-collapse: collapse; } td, th { padding: 0.15rem 0.8rem 0.15rem 0; text-align: left; }
.table { overflow-x: auto; } footer { margin-top: 2rem; font-size: 0.85rem; }
"""


def _page(diagnosis: Diagnosis) -> str:
    count = len(diagnosis.findings)
    verdict = (
        f"{count} finding{'s' * (count != 1)} in {len(diagnosis.run)} samples." if count
        else f"No fault was found in {len(diagnosis.run)} samples."
    )
    listed = "".join(_item(one) for one in diagnosis.findings)
    notes = "".join(_item(one) for one in diagnosis.notes)
    names = diagnosis.names
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{percent_of(missing)}</td><td>{percent_of(far)}</td>"
        f"<td>{percent_of(stuck)}</td></tr>"
        for name, missing, far, stuck in zip(
            names.outputs, _missing(diagnosis), diagnosis.outliers, diagnosis.clipped, strict=True
        )
    )
    figures = "".join(
        f"<section><h2>{escape(title)}</h2><p class='caption'>{escape(caption)}</p>"
        f"<div class='figure'>{_svg(diagnosis, paint, k)}</div></section>"
        for k, (title, caption, paint) in enumerate(_parts(diagnosis))
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Is the estimator healthy?</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>Is the estimator healthy?</h1>
<p class="verdict">{escape(verdict)}</p>
<ol>{listed}</ol>
<h2>Worth knowing</h2>
<ul>{notes}</ul>
<h2>Sensors</h2>
<div class="table"><table>
<tr><th>sensor</th><th>missing</th><th>outlying</th><th>stuck</th></tr>{rows}
</table></div>
{figures}
<footer>qpmhe {escape(__version__)}. Innovations are those of an extended Kalman filter with the
estimator's model and weights, from sample {diagnosis.first} on.</footer>
</body>
</html>
"""


def _item(one: Finding) -> str:
    word = "" if one.severity == "note" else f"<span class='{one.severity}'>{one.severity}:</span> "
    remedy = f" <span class='remedy'>{escape(one.remedy)}</span>" if one.remedy else ""
    return f"<li>{word}{escape(one.text)}{remedy}</li>".replace(" %", "&nbsp;%")


def percent_of(share: float) -> str:
    """A share in per cent; a dash for none."""
    return "none" if share == 0.0 else percent(share)


def _missing(diagnosis: Diagnosis) -> Any:
    source = diagnosis.run.source
    if source is None:
        return np.zeros(len(diagnosis.names.outputs))
    return np.mean(~np.isfinite(source.measurements), axis=0)


def _svg(diagnosis: Diagnosis, paint: Callable[[Diagnosis, Any], None], number: int) -> str:
    """One figure as SVG for a page, with text as text, and names of its own for its parts."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(LIGHT):
        figure = Figure(figsize=(5.2, 2.6), layout="constrained")
        paint(diagnosis, figure.subplots())
        written = io.StringIO()
        figure.savefig(written, format="svg", metadata={"Date": None})
    text = written.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    return re.sub(r'(id="|url\(#|href="#)', rf"\g<1>f{number}-", text)
