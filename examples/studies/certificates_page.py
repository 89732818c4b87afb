"""Make docs/certified-systems.md: proved bounds beside the worst errors that an adversary reaches.

It renews the pictures of docs/how-to/certify.md and docs/explanation/guarantees.md, too.

    python examples/studies/certificates_page.py

``make certificates`` does it. Every run is compared with its bounds as well; one that exceeds a
bound stops the script.
"""

from __future__ import annotations

import contextlib
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from adversary import Array, Setting, Signals, against_estimates, against_observer, greedy

import qpmhe
from qpmhe.certificates import Certificate, Design, Sizes, certify, design, synthesise_gain
from qpmhe.certificates.evidence import at_most
from qpmhe.certificates.guard import Guard

DOCS = Path(__file__).parents[2] / "docs"
STEPS = (5, 10, 20, 40, 80)
STARTS, CLIMBS, QPS = 8, 2, 2
SECONDS = 300.0  # for each search; cores may be shared
# More runs for differences would take minutes.
MOST_STATES = 6

PAGE = """# Bounds and true errors

You want to know how far a proved bound is from what can happen. For each system this page has the
bounds for disturbances |w| and noises |v| up to the sizes given, and the largest error that an
adversary found who knows the model, chooses every disturbance and every noise anew, and starts the
observer at the true state. `make certificates` makes it.

| system | region | diameter | \\|w\\|, \\|v\\| | CPU time |
|---|---|---|---|---|
{places}

*CPU time* is that of `certify`, and of finding the gain where it was synthesised (†).

| system | observer: bound | worst | factor | around it: x̂ within | worst | factor \
| guarded x̂ in advance: bound | worst | factor |
|---|---|---|---|---|---|---|---|---|---|
{first}

*Observer*: |x - z| in the limit, from `certificate.observer_bound`. *Around it*: the farthest point
from x̂ of the set around z that holds the true state, at the time of the worst |x - x̂|, from
`certificate.bound(run)`; the estimator has two QPs a sample. *Guarded x̂*: with a guard in
`Monitor`, the bound that is known before any measurement; the worst error is that of hostile
estimates, far beyond the observer's state as seen from the truth, in the same runs. Lengths are
Euclidean, in the units of the states.

| system | Lyapunov: N | bound | worst | paper's theorem: N | bound |
|---|---|---|---|---|---|
{second}

*Lyapunov*: the discounted cost and the horizon of `qpmhe.certificates.design` with the
re-initialised candidate; the bound is a minimiser's, the worst error that with two QPs. *Paper's
theorem*: the constants of the proof, which show stability for each N; beyond the region's diameter,
a bound says nothing.

## The models of the zoo

Reactor, van der Pol's oscillator, CSTR, pendulum, vehicle and battery cell are proved to contract
on the regions that their records fill, with gains made for these;
`examples/studies/certified_ratios.py` has their bounds and those of other systems. The other two:

- **Chain of masses**: proved for one mass within 0.05 m and 0.5 m/s of its rest, for a tenth of the
  scenario's disturbances and noises, with a bound of 0.025 m and 0.23 m/s. The box around a record
  of two masses has states in which both are at the same point: a spring of length 0 has no
  direction, and f no value there.
- **Quadrotor**: on the box around its record, 12 states and 4 inputs, the program for a constant
  gain is infeasible for every rate below 1. Detectability holds at samples only: its proof needs
  more cells than the 2,722 of a minute.

## The adversary

- **Against the observer**: each disturbance and noise points along its influence on the last error,
  which the linearised error dynamics carry backwards; the run is repeated with the new ones, and
  the direction is the last error's. {starts} starts, {directions} directions and windows of
  {steps} steps are tried.
- **Against the estimates**: signals along P(x - x̂), step by step; and from the best of all runs on,
  along the differences of the last error when one component of one sample is changed.
- Runs count as long as truth, observer and estimates are in the region.

{compared} errors were compared with their bounds along the run; none was above.

Measured on {date} with Python {python}, NumPy {numpy}, in {minutes:.0f} minutes, while cores were
shared with other work.
"""


@dataclass
class Case:
    """A system, the set on which it is certified, and sizes of disturbances and noises."""

    name: str
    system: qpmhe.System
    region: qpmhe.Box
    sizes: Sizes
    observer: Any = None  # one is synthesised if it is None
    inputs: qpmhe.Box | None = None
    horizon: int = 10
    cost: Any = None  # one for noises of a third of the sizes if it is None


@dataclass
class Row:
    """What is in the table."""

    case: Case
    certificate: Certificate
    seconds: float  # of the processor
    bound: float
    observed: float = 0.0
    around: float = np.nan
    estimated: float = 0.0
    hostile: float = 0.0
    plan: Design | None = None
    designed: float = 0.0
    compared: int = 0
    attacks: list[Signals] = field(default_factory=list)


def fitzhugh_nagumo(x: Array) -> Array:
    a, b = x[..., 0], x[..., 1]
    return np.stack([a + 0.1 * (a - a**3 / 3 - b + 0.5), b + 0.008 * (a + 0.7 - 0.8 * b)], -1)


def coupled(x: Array) -> Array:
    return 0.8 * x + 0.1 * np.sin(np.roll(x, 1, axis=-1)) + 0.1 * np.roll(x, -1, axis=-1)


def two_tanks(x: Array) -> Array:
    flow = 0.3 * np.sqrt(x)
    return np.stack([0.35 - flow[..., 0], flow[..., 0] - flow[..., 1]], -1) / 0.5


def cases() -> list[Case]:
    """The systems of the table."""
    models = qpmhe.models
    reactor, pendulum = models.batch_reactor(), models.pendulum()
    return [
        Case("batch reactor", reactor.system, qpmhe.Box([0.1, -1.0], [9.0, 9.0]),
             Sizes(0.3, 0.6), reactor.observer, cost=reactor.cost),
        Case("FitzHugh-Nagumo",
             qpmhe.System(fitzhugh_nagumo, lambda x: x[..., :1], n=2, p=1),
             qpmhe.Box([-2.5, -1.0], [2.5, 2.0]), Sizes(0.01, 0.02)),
        Case("van der Pol", models.van_der_pol().system,
             qpmhe.Box([-2.5, -3.0], [2.5, 3.0]), Sizes(0.01, 0.02)),
        Case("four coupled states",
             qpmhe.System(coupled, lambda x: x[..., ::2], n=4, p=2),
             qpmhe.Box(-2.0 * np.ones(4), 2.0 * np.ones(4)), Sizes(0.01, 0.01)),
        Case("two tanks",
             qpmhe.System.from_ode(two_tanks, lambda x: x[..., 1:], dt=0.1, n=2, p=1),
             qpmhe.Box([0.2, 0.2], [2.0, 2.0]), Sizes(0.005, 0.01)),
        Case("pendulum", pendulum.system, qpmhe.Box([-3.0, -10.0], [3.0, 10.0]),
             Sizes(0.01, 0.02), pendulum.observer, cost=pendulum.cost),
    ]


def prepared(case: Case) -> Row:
    """The certificate, with the processor time it took."""
    began, system, sizes = time.process_time(), case.system, case.sizes
    observer = case.observer or synthesise_gain(
        system, case.region, inputs=case.inputs, sizes=(sizes.disturbance, sizes.noise),
        seconds=SECONDS,
    ).observer
    cost = case.cost or qpmhe.QuadraticCost(
        prior=np.eye(system.n) / (10.0 * sizes.disturbance) ** 2,
        disturbance=np.eye(system.n) / (sizes.disturbance / 3.0) ** 2,
        noise=np.eye(system.p) / (sizes.noise / 3.0) ** 2,
    )
    certificate = certify(
        system, observer, cost, horizon=case.horizon, region=case.region, inputs=case.inputs,
        sizes=sizes, seconds=SECONDS,
    )
    seconds = time.process_time() - began
    proved = certificate.observer_bound
    assert proved is not None
    settled = proved.settled
    bound = min(
        float(proved.farthest(settled.radius, np.zeros(system.n))),
        float(np.linalg.norm(settled.box)),
    )
    return Row(case, certificate, seconds, bound)


def attack(row: Row) -> None:
    """Look for large errors of the observer, then of the estimates, and compare all bounds."""
    case, certificate, rng = row.case, row.certificate, np.random.default_rng(0)
    system, proved = case.system, certificate.observer_bound
    assert proved is not None
    setting = Setting(
        system, certificate.region, proved.gain, case.sizes.disturbance, case.sizes.noise
    )
    directions = (*np.eye(system.n), *rng.standard_normal((4, system.n)))
    found = [
        against_observer(setting, start, direction, steps)
        for start in setting.starts(STARTS, rng) for direction in directions for steps in STEPS
    ]
    found.sort(key=lambda one: -one[0])
    row.observed, row.attacks = found[0][0], [signals for _, signals in found[:CLIMBS]]
    compare(np.array([row.observed]), np.array([row.bound]))
    guarded(row, setting)

    def estimator(start: Array, **options: Any) -> qpmhe.MovingHorizonEstimator:
        given = {"horizon": case.horizon, "cost": certificate.cost} | options
        return qpmhe.MovingHorizonEstimator(
            system, certificate.observer, initial_state=start, max_qps=QPS, engine="python",
            **given,
        )

    def played(y: Array, x: Array, **options: Any) -> tuple[Any, Any, int]:
        mhe = estimator(x[0], **options)
        run = mhe.run(y, np.tile(setting.u, (len(y), 1)) if system.m else None)
        return mhe, run, setting.inside(run.states, run.observer_states)

    def climbed(check: Callable[..., float], **options: Any) -> float:
        """The worst error of an estimator, with every run compared with its bounds."""

        def estimates(y: Array, x: Array) -> tuple[Array, int]:
            _, run, until = played(y, x, **options)
            return run.states, until

        seeds = [*row.attacks, *(
            greedy(setting, estimator(signals.start, **options), signals.start, proved.metric, 40)
            for signals in row.attacks
        )]
        worst = 0.0
        for signals in seeds:
            rounds = 2 if system.n <= MOST_STATES else 0
            _, signals = against_estimates(setting, estimates, signals, rounds)
            x, y = setting.truth(signals)
            mhe, run, until = played(y, x, **options)
            until = min(until, setting.inside(x))
            errors = np.linalg.norm(x - run.states, axis=1)[:until]
            worst = max(worst, check(mhe, run, signals, errors))
        return worst

    def with_bound(_: Any, run: Any, signals: Signals, errors: Array) -> float:
        for w, v in ((signals.w, signals.v), (case.sizes.disturbance, case.sizes.noise)):
            known = certificate.bound(run, w, v, initial_error=np.zeros(system.n))
            compare(errors, known[: len(errors)])
            row.compared += len(errors)
        if errors.max() > row.estimated:
            row.estimated, row.around = float(errors.max()), float(known[int(errors.argmax())])
        if certificate.constants:
            lengths = (np.linalg.norm(each, axis=1) for each in (signals.w, signals.v))
            paper = certificate.of().result.bound(0.0, *lengths)
            compare(errors, paper[: len(errors)])
        return float(errors.max())

    climbed(with_bound)
    try:
        row.plan = plan = design(
            system, case.region, sizes=case.sizes, inputs=case.inputs, seconds=SECONDS,
        )
    except qpmhe.errors.QpmheError as error:
        print(f"{case.name}: no design: {error}", flush=True)
        return

    def with_plan(mhe: Any, run: Any, signals: Signals, errors: Array) -> float:
        known = plan.length(plan.along(
            run, mhe, initial_error=np.zeros(system.n), disturbances=signals.w, noises=signals.v,
        ))
        compare(errors, known[: len(errors)])
        row.compared += len(errors)
        return float(errors.max())

    row.designed = climbed(
        with_plan, cost=plan.cost(), horizon=plan.horizon, candidate="reinitialized"
    )


def guarded(row: Row, setting: Setting) -> None:
    """Guard estimates that are as wrong as can be, along the worst runs against the observer."""
    proved = row.certificate.proved
    guard, entering, added = Guard(proved, setting.system), proved.entering(), proved.added()
    for signals in row.attacks:
        x, y = setting.truth(signals)
        z = setting.observed(x, y)
        tube = proved.begun(np.zeros(setting.system.n))
        for t in range(1, setting.inside(x, z)):
            tube = proved.followed(tube, entering, added, projected=False)
            for far in (0.0, 1.0, 1e3):
                moved = guard(z[t] - far * (x[t] - z[t]), z[t], tube)
                if moved.reason:
                    raise SystemExit(f"{row.case.name}: {moved.reason}")
                error, e = float(np.linalg.norm(x[t] - moved.point)), x[t] - moved.point
                compare(np.append(np.abs(e), proved.length(e)),
                        2.0 * np.append(tube.box, tube.radius))
                row.compared += 1
                row.hostile = max(row.hostile, error)
    compare(np.array([row.hostile]), np.array([2.0 * row.bound]))


def compare(errors: Array, bound: Array) -> None:
    """Stop where an error is above its bound."""
    above = errors > bound * (1.0 + 1e-9) + 1e-12
    if above.any():
        raise SystemExit(f"an error of {errors[above][0]} is above its bound {bound[above][0]}")


def renew_picture(page: str, drawn: str, picture: str) -> None:
    """Run a page's blocks, and take the picture that they draw."""
    text = (DOCS / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec("\n".join(blocks), {"__name__": page})
        shutil.copy(drawn, DOCS / "img" / picture)


def short(value: float, *, bound: bool = False) -> str:
    """Two digits, of a bound rounded up; a dash for what is not bounded."""
    if not np.isfinite(value):
        return "-"
    text = at_most(value, 2) if bound else f"{value:.2g}"
    return f"{float(text):,.0f}" if value >= 100 else text


def place_line(row: Row) -> str:
    case, sizes = row.case, row.case.sizes
    sides = " x ".join(
        f"[{low:g}, {high:g}]"
        for low, high in zip(case.region.lower, case.region.upper, strict=True)
    )
    if case.system.n > 2 and np.ptp(case.region.lower) == np.ptp(case.region.upper) == 0.0:
        sides = f"[{case.region.lower[0]:g}, {case.region.upper[0]:g}]{superscript(case.system.n)}"
    own = "" if case.observer is not None else " †"
    return (
        f"| {case.name}{own} | {sides} | {row.certificate.diameter:.3g} "
        f"| {sizes.disturbance:g}, {sizes.noise:g} | {row.seconds:.1f} s |"
    )


def first_line(row: Row) -> str:
    return (
        f"| {row.case.name} | {short(row.bound, bound=True)} | {short(row.observed)} "
        f"| **{row.bound / row.observed:.1f}** | {short(row.around, bound=True)} "
        f"| {short(row.estimated)} | **{row.around / row.estimated:.1f}** "
        f"| {short(2.0 * row.bound, bound=True)} | {short(row.hostile)} "
        f"| **{2.0 * row.bound / row.hostile:.1f}** |"
    )


def second_line(row: Row) -> str:
    plan, certificate = row.plan, row.certificate
    cells = ["-"] * 3
    if plan is not None:
        limit = float(plan.length(plan.limit()))
        cells = [str(plan.horizon), short(limit, bound=True), short(row.designed)]
    paper = ["-", "-"]
    if certificate.constants:
        limit = certificate.of().result.limit(*certificate.sizes.largest)
        paper = [str(row.case.horizon), short(limit, bound=True)]
    return f"| {row.case.name} | {' | '.join((*cells, *paper))} |"


def superscript(number: int) -> str:
    return "".join("⁰¹²³⁴⁵⁶⁷⁸⁹"[int(digit)] for digit in str(number))


def main() -> None:
    began, rows = time.perf_counter(), []
    for case in cases():
        row = prepared(case)
        attack(row)
        rows.append(row)
        print(*(line(row) for line in (place_line, first_line, second_line)), sep="\n", flush=True)
    (DOCS / "certified-systems.md").write_text(PAGE.format(
        places="\n".join(map(place_line, rows)),
        first="\n".join(map(first_line, rows)), second="\n".join(map(second_line, rows)),
        starts=STARTS, directions="n + 4", steps=", ".join(map(str, STEPS)),
        compared=f"{sum(row.compared for row in rows):,}",
        date=datetime.now(UTC).date(), python=platform.python_version(), numpy=np.__version__,
        minutes=max(1.0, (time.perf_counter() - began) / 60),
    ), encoding="utf-8")
    renew_picture("how-to/certify.md", "certified.png", "certify-band.png")
    renew_picture("explanation/guarantees.md", "certificate.png", "guarantees-reactor.png")
    print(f"wrote {DOCS / 'certified-systems.md'} and two pictures")


if __name__ == "__main__":
    main()
