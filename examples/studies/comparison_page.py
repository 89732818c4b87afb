"""Make docs/comparison.md, with its pictures, of a study's store and its report.

    qpmhe compare --store results/comparison.sqlite --out results/comparison
    qpmhe compare --store results/filters.sqlite --backend banded --qps 0,2 --estimator EKF=ekf ...
    python examples/studies/comparison_page.py results/comparison.sqlite results/comparison \
        results/filters.sqlite

``make comparison`` does all three.
"""

from __future__ import annotations

import argparse
import io
import shutil
from datetime import datetime
from pathlib import Path

from pandas import DataFrame
from rich.console import Console

from qpmhe.cli.report import show
from qpmhe.studies import Store, summarise

DOCS = Path(__file__).parents[2] / "docs"
CASE = "batch-reactor-N-10"

PAGE = """# A comparison

You want to know what `qpmhe compare` finds, or which backend to take for a small problem without
inequalities. This page is made of a run of that command, with all backends that were installed, by
`make comparison`.

{cells} runs, {failed} of them failed: {seeds} seeds of {steps} samples of the paper's reactor
(n = 2, N = 10). {minutes:.1f} minutes on {cores} cores.

```text
{table}
```

![Error against time per step]({prefix}-accuracy-time.png)

One QP brings the error from the observer's to within a few per cent of the converged one, two QPs
to within what the seeds can tell. Without inequalities nearly all backends come to the same RMSE,
so that they differ in time, and in how much a cap costs.

![Error and cost against the cap]({prefix}-anytime.png)

First-order methods (osqp, scs) need a few iterations before they come near the converged cost, ecos
about five before it brings anything of use, and qpalm brings nothing at a cap of one. Until then
the true cost rejects the iterates, so that J is never above the observer's, the dashed line. The
error has no such bound: an iterate can lower J and estimate worse. The answers above name
configurations whose error is larger than the observer's.

![Time per step]({prefix}-step-times.png)

## Beside other filters

The same records and covariances for the filters of [`qpmhe.baselines`](reference/baselines.md), in
a run of its own:

```text
{filters}
```

On this mild problem they are as accurate as two QPs.

## Times

Read ratios, not microseconds: these are times of whole updates in Python, while cores were shared.
A problem with inequalities, or of another size, has another order; run the command on yours, as
[Compare backends and settings](how-to/compare.md) describes.

Measured on {date} with {cpu}, {versions}.
"""


def shown(frame: DataFrame) -> str:
    """The answers and the table, as a terminal has them."""
    text = io.StringIO()
    show(Console(file=text, width=96, color_system=None), summarise(frame))
    return "\n".join(line.rstrip() for line in text.getvalue().strip().splitlines())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path, help="the study's results")
    parser.add_argument("report", type=Path, help="folder of its report")
    parser.add_argument("filters", type=Path, help="the results of other filters")
    arguments = parser.parse_args()

    store = Store(arguments.store)
    frame, environment = store.frame(), store.meta()["environments"][-1]
    times = [datetime.fromisoformat(time) for time in frame["finished"]]
    for name in ("accuracy-time", "anytime", "step-times"):
        source = arguments.report / f"{CASE}-{name}.png"
        shutil.copy(source, DOCS / "img" / f"comparison-{name}.png")
    versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
    (DOCS / "comparison.md").write_text(PAGE.format(
        cells=len(frame), seeds=frame["seed"].nunique(), steps=frame["steps"].max(),
        failed=(frame["outcome"] == "failed").sum(), table=shown(frame),
        filters=shown(Store(arguments.filters).frame()), prefix="img/comparison",
        minutes=(max(times) - min(times)).total_seconds() / 60, cores=environment["cores"],
        date=max(times).date(), cpu=environment["cpu"], versions=versions,
    ), encoding="utf-8")
    print(f"wrote {DOCS / 'comparison.md'} and its pictures")


if __name__ == "__main__":
    main()
