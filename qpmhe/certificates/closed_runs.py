"""Attempts to refute a certificate by closed runs of the estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import cycle, product

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import available

from .._checks import count
from ..errors import InvalidInputError
from ..estimator import MovingHorizonEstimator
from ..run import Run
from .certificate import Certificate, Kind
from .falsification import Attack, inside
from .monitor import Monitor

__all__ = ["NOISES", "ClosedRuns", "attack_estimator"]

Array = NDArray[np.float64]
Generator = np.random.Generator
_RELATIVE, _ABSOLUTE = 1e-9, 1e-12


def _heavy(rng: Generator, steps: int, width: int) -> Array:
    return np.clip(rng.standard_t(2.0, (steps, width)), -30.0, 30.0)


#: Kinds of noise of size about 1, by name: (generator, steps, width) to (steps, width).
NOISES: dict[str, Callable[[Generator, int, int], Array]] = {
    "none": lambda _, steps, width: np.zeros((steps, width)),
    "normal": lambda rng, steps, width: rng.standard_normal((steps, width)),
    "uniform": lambda rng, steps, width: rng.uniform(-1.0, 1.0, (steps, width)),
    "signs": lambda rng, steps, width: rng.choice([-1.0, 1.0], (steps, width)),
    "constant": lambda rng, steps, width: np.tile(rng.choice([-1.0, 1.0], width), (steps, 1)),
    "sine": lambda rng, steps, width: np.sin(
        np.outer(np.arange(steps), rng.uniform(0.1, 3.0, width)) + rng.uniform(0.0, 6.0, width)
    ),
    "ramp": lambda rng, steps, width: np.linspace(0.0, 1.0, steps)[:, None]
    * rng.choice([-1.0, 1.0], width),
    "impulses": lambda rng, steps, width: rng.standard_normal((steps, width))
    * (rng.random((steps, 1)) < 0.1),
    "heavy tails": _heavy,
    "coloured": lambda rng, steps, width: np.cumsum(
        rng.standard_normal((steps, width)), axis=0
    ) / np.sqrt(steps),
}


@dataclass(eq=False)
class ClosedRuns:
    """What became of the attempt, for each kind of bound.

    Parameters
    ----------
    attacks : dict of str to Attack
        By kind of bound; an example's ``run`` names backend, cap and noises.
    lost : int
        Runs in which a hypothesis failed before the end; compared up to there.
    by_backend : dict of str to float
        The largest share of the paper's bound that was reached with each backend.
    """

    attacks: dict[Kind, Attack]
    lost: int = 0
    by_backend: dict[str, float] = field(default_factory=dict)

    @property
    def refuted(self) -> bool:
        """Whether any bound was violated."""
        return any(attack.refuted for attack in self.attacks.values())


@dataclass(eq=False)
class _Trial:
    """What may be changed to make a run worse."""

    start: Array
    estimate: Array
    w: Array
    v: Array
    u: Array
    name: str
    backend: str
    cap: int | None


def attack_estimator(
    certificate: Certificate,
    *,
    horizon: int | None = None,
    trials: int = 60,
    steps: int = 15,
    backends: Sequence[str] | None = None,
    caps: Sequence[int | None] = (0, 1, 2, 5),
    polished: int = 4,
    rounds: int = 10,
    seed: int = 0,
) -> ClosedRuns:
    """Look for a run of the estimator whose error exceeds a bound of the certificate.

    Backends, caps and kinds of noise take turns; sizes are drawn over four decades. The worst
    runs are then made worse: initial states, disturbances and noises are changed at random
    wherever that raises the error's share of the sharpest bound.

    Parameters
    ----------
    certificate : Certificate
        What is to be refuted.
    horizon : int, optional
        N; the only one if left out.
    trials, steps : int
        Number and length of the runs.
    backends : sequence of str, optional
        QP backends; all installed ones if left out.
    caps : sequence of int or None
        QPs per sample.
    polished, rounds : int
        How many runs are made worse, and in how many rounds.
    seed : int
        Of the random numbers.

    Returns
    -------
    ClosedRuns

    Raises
    ------
    InvalidInputError, OptionError
        If an argument does not fit.
    """
    if not isinstance(certificate, Certificate):
        raise InvalidInputError(
            f"certificate is {certificate!r}; expected a Certificate, as certify returns it."
        )
    for name, value, least in (
        ("trials", trials, 1), ("steps", steps, 1), ("polished", polished, 0), ("rounds", rounds, 0)
    ):
        count(name, value, least)
    rng = np.random.default_rng(count("seed", seed, 0))
    N = certificate.of(horizon).paper.horizon
    names = list(available()) if backends is None else list(backends)
    noises = list(product(NOISES, NOISES))
    rng.shuffle(noises)
    turns = zip(cycle(product(names, caps)), cycle(noises), strict=False)
    found = [
        (trial, _played(certificate, trial, N))
        for (backend, cap), kinds in (next(turns) for _ in range(trials))
        for trial in [_drawn(certificate, backend, cap, *kinds, steps, rng)]
    ]
    sharpest = certificate.kinds[-1]
    ranked = sorted(found, key=lambda pair: -pair[1].shares[sharpest].max())
    # A large disturbance reaches its own bound one step later; without any, more can be found.
    silent = [pair for pair in ranked if not pair[0].w.any()]
    worst = ranked[: polished - polished // 2] + silent[: polished // 2]
    for trial, played in worst:
        found += _worse(certificate, trial, played, N, rounds, rng)
    return _collected(certificate, found, names)


@dataclass(eq=False)
class _Played:
    error: Array
    bounds: dict[Kind, Array]
    applied: int
    shares: dict[Kind, Array]


def _drawn(
    certificate: Certificate, backend: str, cap: int | None, of_w: str, of_v: str, steps: int,
    rng: Generator,
) -> _Trial:
    system, region = certificate.system, certificate.region
    n, width = system.n, (region.upper - region.lower)[: system.n]
    points = region.sample(8, rng)
    pick = points[rng.integers(len(points), size=2), :n]
    start = inside(region, pick[0])
    share = 10.0 ** rng.uniform(-3.0, 0.0)
    estimate = inside(region, start + share * (pick[1] - start))
    w = 10.0 ** rng.uniform(-4.0, -0.5) * width * NOISES[of_w](rng, steps, n)
    size = max(1e-3, float(np.abs(system.h.batch(points[:, :n], points[:, n:])).max()))
    v = 10.0 ** rng.uniform(-4.0, -0.5) * size * NOISES[of_v](rng, steps, system.p)
    low, high = region.lower[n:], region.upper[n:]
    u = low + (high - low) * rng.random((steps, system.m))
    return _Trial(start, estimate, w, v, u, f"w {of_w}, v {of_v}", backend, cap)


def _played(certificate: Certificate, trial: _Trial, N: int) -> _Played:
    """The run, and its bounds as far as the monitor lets them apply."""
    system, region = certificate.system, certificate.region
    steps = len(trial.w)
    x, w = np.empty((steps + 1, system.n)), np.empty_like(trial.w)
    x[0] = trial.start
    mhe = MovingHorizonEstimator(
        system, certificate.observer, certificate.cost, horizon=N, initial_state=trial.estimate,
        backend=trial.backend, max_qps=trial.cap,
    )
    watch = Monitor.of(certificate, mhe)
    estimates, applied = [], 0
    for t in range(steps):
        u = trial.u[t]
        y = system.h(x[t], u) + trial.v[t]
        ahead = np.asarray(system.f(x[t], u))
        x[t + 1] = inside(region, ahead + trial.w[t])
        w[t] = x[t + 1] - ahead
        estimates.append(mhe.update(y, u if system.m else None))
        watch.check(estimates[-1], u if system.m else None)
        applied = t + 1 if watch.applies else applied
    run = Run.of(np.array(trial.estimate), estimates)
    error: Array = np.linalg.norm(x - run.states, axis=1)
    error[applied + 1 :] = 0.0
    bounds = {
        kind: certificate.bound(
            run, w, trial.v, initial_error=x[0] - trial.estimate, horizon=N, kind=kind,
            source=watch,
        )
        for kind in certificate.kinds
    }
    later = np.arange(steps + 1) > 0  # the first share is that of the initial error alone
    shares = {
        kind: np.where(later & (error > _ABSOLUTE), error / np.maximum(bound, _ABSOLUTE), 0.0)
        for kind, bound in bounds.items()
    }
    return _Played(error, bounds, applied, shares)


def _worse(
    certificate: Certificate, trial: _Trial, played: _Played, N: int, rounds: int, rng: Generator
) -> list[tuple[_Trial, _Played]]:
    """Change a run at random, and keep what raises its share of the sharpest bound."""
    kind, region = certificate.kinds[-1], certificate.region
    tried: list[tuple[_Trial, _Played]] = []
    best = float(played.shares[kind].max())
    for i in range(rounds):
        size = 10.0 ** (-0.3 - 2.0 * i / max(1, rounds))

        def moved(values: Array, size: float = size) -> Array:
            scale = float(np.abs(values).max(initial=0.0)) or 1e-3
            changed: Array = values + size * scale * rng.standard_normal(values.shape)
            return changed

        other = _Trial(
            inside(region, moved(trial.start)), inside(region, moved(trial.estimate)),
            moved(trial.w) if trial.w.any() else trial.w, moved(trial.v), trial.u,
            f"{trial.name}, made worse", trial.backend, trial.cap,
        )
        other.name = other.name.replace(", made worse, made worse", ", made worse")
        outcome = _played(certificate, other, N)
        tried.append((other, outcome))
        reached = float(outcome.shares[kind].max())
        if reached > best:
            trial, best = other, reached
    return tried


def _collected(
    certificate: Certificate, found: list[tuple[_Trial, _Played]], names: list[str]
) -> ClosedRuns:
    attacks: dict[Kind, Attack] = {}
    for kind in certificate.kinds:
        trial, played = max(found, key=lambda pair: float(pair[1].shares[kind].max()))
        above = sum(
            int((each.error > each.bounds[kind] * (1.0 + _RELATIVE) + _ABSOLUTE).sum())
            for _, each in found
        )
        attacks[kind] = Attack(
            len(found), sum(each.applied + 1 for _, each in found), above,
            float(played.shares[kind].max()),
            {
                "start": trial.start, "estimate": trial.estimate, "disturbances": trial.w,
                "noises": trial.v, "inputs": trial.u, "error": played.error,
                "bound": played.bounds[kind],
            },
            f"{trial.backend}, cap {trial.cap}, {trial.name}",
        )
    by_backend = {
        name: max((
            float(played.shares["paper"].max()) for trial, played in found
            if trial.backend == name
        ), default=0.0)
        for name in names
    }
    lost = sum(played.applied < len(trial.w) for trial, played in found)
    return ClosedRuns(attacks, lost, by_backend)
