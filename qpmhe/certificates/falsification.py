"""Attempts to refute a claimed bound: random trajectories, and ones made worse on purpose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import cycle, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import available

from .._checks import Array, count, numbers
from ..errors import InvalidInputError, ShapeError
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System
from .certificate import Certificate
from .decay import DecayingSums, decaying_sums
from .horizon_bounds import Kind
from .monitor import Monitor
from .regions import Region, bounded_region

__all__ = [
    "NOISES", "Attack", "ClosedRuns", "attack_detectability", "attack_estimator", "attack_observer",
    "inside",
]

Generator = np.random.Generator

# Of two numbers computed in floating point, one exceeds the other by more than this, or not: of
# the number itself, and of the states that it is a difference of.
_RELATIVE, _OF_STATES = 1e-9, 1e-12


@dataclass(frozen=True, eq=False)
class Attack:
    """Result of an attempt to refute a bound."""

    trials: int
    comparisons: int
    violations: int
    ratio: float
    example: dict[str, Array]
    run: str = ""

    @property
    def refuted(self) -> bool:
        """Whether the bound was violated."""
        return self.violations > 0


def attack_detectability(
    system: System, region: ConvexSet | Region | None, claim: DecayingSums, *, trials: int,
    steps: int = 20, polish: int = 40, seed: int = 0, inputs: Box | None = None,
) -> Attack:
    """Look for two trajectories in the region that violate (eq:eIOSS).

    Disturbances may be anything, so any two sequences of states in the region are two
    trajectories. They are drawn in several ways (noise-free, the same disturbance, small or
    rare ones, anything, differences hidden from the output), and then changed at random
    wherever that raises the error's share of the bound.

    Parameters
    ----------
    system, inputs
        As for `certify`; a region with inputs needs no others.
    region : Box, Polytope, Region or None
        Where both trajectories stay; None for the system's own states.
    claim : DecayingSums
        eta, c_p, c_w and c_v.
    trials, steps : int
        Number of pairs, and their length.
    polish : int
        Rounds of changes.
    seed : int
        Of the random numbers.
    """
    place, rng = _begun(system, region, claim, inputs, trials, steps, polish, seed)
    acting = _inputs(place, trials, steps, rng)
    states = _pairs(system, place, trials, steps, acting, rng)

    def shares(pairs: Array) -> tuple[Array, Array]:
        x1, x2 = pairs[0], pairs[1]
        f1, f2 = (system.f.batch(x[:, :-1], acting) for x in (x1, x2))
        h1, h2 = (system.h.batch(x[:, :-1], acting) for x in (x1, x2))
        apart = np.linalg.norm(x1 - x2, axis=-1)
        w = np.linalg.norm((x1[:, 1:] - f1) - (x2[:, 1:] - f2), axis=-1)
        bound = _bounds(claim, apart[:, 0], w, np.linalg.norm(h1 - h2, axis=-1))
        return apart, bound

    def change(pairs: Array, size: float) -> Array:
        move = size * (place.upper - place.lower)[: place.n] * rng.standard_normal(pairs.shape)
        move *= rng.random((*pairs.shape[:-1], 1)) < 0.3
        return inside(place, pairs + move)

    rounding = _rounding(place)
    states, apart, bound = _polished(states, shares, change, polish, rounding)
    return _verdict(apart, bound, np.ones_like(apart, np.bool_), rounding, {
        "first": states[0], "second": states[1], "inputs": acting,
    })


def attack_observer(
    system: System, region: ConvexSet | Region | None, gain: ArrayLike, claim: DecayingSums, *,
    trials: int, steps: int = 30, polish: int = 40, seed: int = 0, inputs: Box | None = None,
) -> Attack:
    """Look for a run of an observer with constant gain that violates (eq:RGES).

    A run counts as long as the observer's state stays in the region; the true one does
    throughout.

    Parameters
    ----------
    system, region, trials, steps, polish, seed, inputs
        As for `attack_detectability`.
    gain : (n, p) array_like
        The observer's.
    claim : DecayingSums
        rho, C_p, C_w and C_v.
    """
    place, rng = _begun(system, region, claim, inputs, trials, steps, polish, seed)
    K = numbers("gain", gain)
    if K.shape != (system.n, system.p):
        raise ShapeError(f"gain has shape {K.shape}; expected {(system.n, system.p)}.")
    acting = _inputs(place, trials, steps, rng)
    truth = _pairs(system, place, trials, steps, acting, rng)[0]
    scale = _sizes_or_one(system.h.batch(truth[:, 0], acting[:, 0]))
    noises = _sizes(trials, rng) * scale * rng.standard_normal((trials, steps, system.p))
    noises *= rng.random((trials, steps, 1)) < rng.choice([0.0, 0.1, 1.0], (trials, 1, 1))
    starts = inside(place, place.sample(trials, rng)[:, : place.n])
    starts = starts[rng.integers(len(starts), size=trials)]
    near = rng.random((trials, 1)) < 0.5
    starts = np.where(near, inside(place, truth[:, 0] + 0.05 * (starts - truth[:, 0])), starts)
    # One array of all that may be changed: true states, noises, and the observer's start.
    n, p = system.n, system.p
    runs = np.zeros((trials, steps + 1, n + p + n))
    runs[..., :n], runs[:, :-1, n : n + p], runs[:, 0, n + p :] = truth, noises, starts
    widths = np.concatenate((
        (place.upper - place.lower)[:n], np.full(p, scale), (place.upper - place.lower)[:n]
    ))

    def shares(runs: Array) -> tuple[Array, Array]:
        x, v, z = runs[..., :n], runs[:, :-1, n : n + p], runs[:, 0, n + p :]
        y = system.h.batch(x[:, :-1], acting) + v
        w = x[:, 1:] - system.f.batch(x[:, :-1], acting)
        alive = np.ones((len(runs), steps + 1), np.bool_)
        error = np.empty_like(alive, np.float64)
        error[:, 0] = np.linalg.norm(x[:, 0] - z, axis=-1)
        for t in range(steps):
            alive[:, t + 1] = alive[:, t] & place.contains(z)
            held = np.where(alive[:, t + 1, None], z, x[:, t])
            misfit = y[:, t] - system.h.batch(held, acting[:, t])
            z = system.f.batch(held, acting[:, t]) + misfit @ K.T
            error[:, t + 1] = np.linalg.norm(x[:, t + 1] - z, axis=-1)
        bound = _bounds(claim, error[:, 0], np.linalg.norm(w, axis=-1), np.linalg.norm(v, axis=-1))
        return np.where(alive, error, np.nan), bound

    def change(runs: Array, size: float) -> Array:
        move = size * widths * rng.standard_normal(runs.shape)
        move *= rng.random((*runs.shape[:-1], 1)) < 0.3
        moved = runs + move
        for part in (slice(0, n), slice(n + p, None)):
            moved[..., part] = inside(place, moved[..., part])
        return moved

    rounding = _rounding(place)
    runs, error, bound = _polished(runs[None], lambda r: shares(r[0]), change, polish, rounding)
    return _verdict(error, bound, np.isfinite(error), rounding, {
        "states": runs[0][..., :n], "noises": runs[0][:, :-1, n : n + p],
        "start": runs[0][:, 0, n + p :], "inputs": acting,
    })


def _begun(
    system: System, region: ConvexSet | Region | None, claim: DecayingSums, inputs: Box | None,
    trials: int, steps: int, polish: int, seed: int,
) -> tuple[Region, Generator]:
    """Where, and the random numbers, of arguments that fit."""
    if not isinstance(claim, DecayingSums):
        raise InvalidInputError(
            f"claim is {claim!r}; expected DecayingSums(rate, initial, disturbance, noise)."
        )
    for name, value, least in (("trials", trials, 1), ("steps", steps, 1), ("polish", polish, 0)):
        count(name, value, least)
    place = bounded_region(system, region, inputs)
    return place, np.random.default_rng(count("seed", seed, 0))


def inside(region: Region, points: Array) -> Array:
    """Points of the region: those inside as they are, others drawn in."""
    low, high = region.lower[: region.n], region.upper[: region.n]
    drawn: Array = np.clip(points, low, high)
    out = ~region.contains(drawn)
    if out.any():
        centre = region.sample(1, np.random.default_rng(0))[0, : region.n]
        share = np.ones((*out.shape, 1))
        for _ in range(60):
            share[out] *= 0.8
            out = ~region.contains(centre + share * (drawn - centre))
            if not out.any():
                break
        drawn = centre + share * (drawn - centre)
    return drawn


def _inputs(region: Region, trials: int, steps: int, rng: Generator) -> Array:
    low, high = region.lower[region.n :], region.upper[region.n :]
    return low + (high - low) * rng.random((trials, steps, low.size))


def _sizes(trials: int, rng: Generator) -> Array:
    """Sizes of noise from none to large, one a trajectory."""
    sizes: Array = 10.0 ** rng.uniform(-5.0, 0.0, (trials, 1, 1))
    return sizes * (rng.random((trials, 1, 1)) > 0.1)


def _pairs(
    system: System, region: Region, trials: int, steps: int, inputs: Array, rng: Generator
) -> Array:
    """Pairs (2, trials, steps + 1, n) of trajectories in the region, drawn in many ways."""
    n = region.n
    points = region.sample(4 * trials, rng)[:, :n]
    width = (region.upper - region.lower)[:n]

    def any_point() -> Array:
        return points[rng.integers(len(points), size=trials)]

    pairs = np.empty((2, trials, steps + 1, n))
    pairs[:, :, 0] = any_point(), any_point()
    close = rng.random((trials, 1)) < 0.5
    nearby = pairs[0, :, 0] + _sizes(trials, rng)[:, 0] * (pairs[1, :, 0] - pairs[0, :, 0])
    pairs[1, :, 0] = np.where(close, nearby, pairs[1, :, 0])
    kind = rng.integers(5, size=trials)[:, None]
    size = _sizes(trials, rng)[:, 0] * width
    for t in range(steps):
        shared = size * rng.standard_normal((trials, n))
        own = size * rng.standard_normal((trials, n))
        rare = rng.random((trials, 1)) < 0.1
        ahead = [system.f.batch(pairs[i, :, t], inputs[:, t]) for i in (0, 1)]
        pairs[0, :, t + 1] = inside(region, np.where(kind == 0, any_point(), ahead[0] + (
            np.where(kind == 1, 0.0, np.where((kind == 2) & ~rare, 0.0, shared)))))
        second = ahead[1] + np.where(kind == 3, shared, np.where(
            (kind == 1) | ((kind == 2) & ~rare), 0.0, own))
        if t + 1 < steps:
            hidden = _hidden(system, ahead[1], pairs[0, :, t + 1], inputs[:, t + 1])
            second = np.where(kind == 4, hidden, second)
        pairs[1, :, t + 1] = inside(region, np.where(kind == 0, any_point(), second))
    return pairs


def _hidden(system: System, points: Array, like: Array, u: Array) -> Array:
    """Points moved so that, to first order, they have the outputs of others."""
    C = np.broadcast_to(system.h_jacobian.batch(points, u), (len(points), system.p, system.n))
    apart = system.h.batch(like, u) - system.h.batch(points, u)
    moved: Array = points + np.einsum("bnp,bp->bn", np.linalg.pinv(C), apart)
    return np.where(np.isfinite(moved), moved, points)


def _bounds(claim: DecayingSums, start: Array, w: Array, v: Array) -> Array:
    """The claimed bound of many runs at once, (B, T + 1)."""
    decay = claim.rate ** np.arange(w.shape[1] + 1.0)
    sums = decaying_sums(claim.rate, claim.disturbance * w + claim.noise * v)
    return claim.initial * start[:, None] * decay + claim.rate * sums


def _rounding(place: Region) -> float:
    """By how much the norm of a difference of states may be wrong."""
    return _OF_STATES * float(
        np.linalg.norm(np.maximum(np.abs(place.lower), np.abs(place.upper))[: place.n])
    )


def _share(error: Array, bound: Array, rounding: float) -> Array:
    """Errors as shares of their bounds; those within rounding of nothing do not count."""
    shares: Array = np.where(error > rounding, error / np.maximum(bound, rounding), 0.0)
    return np.where(np.isfinite(shares), shares, 0.0)


def _polished(
    states: Array, shares: Callable[[Array], tuple[Array, Array]],
    change: Callable[[Array, float], Array], rounds: int, rounding: float,
) -> tuple[Array, Array, Array]:
    """Change what is drawn at random, and keep what raises the largest share of each."""
    error, bound = shares(states)
    worst = _share(error, bound, rounding).max(axis=1)
    for i in range(rounds):
        other = change(states, 10.0 ** (-0.5 - 3.0 * i / max(1, rounds)))
        other_error, other_bound = shares(other)
        reached = _share(other_error, other_bound, rounding).max(axis=1)
        better = reached > worst
        keep = better.reshape((1, -1) + (1,) * (states.ndim - 2))
        states = np.where(keep, other, states)
        error = np.where(better[:, None], other_error, error)
        bound = np.where(better[:, None], other_bound, bound)
        worst = np.where(better, reached, worst)
    return states, error, bound


def _sizes_or_one(values: Array) -> Array:
    """The largest magnitude of each component of values (count, d), 1 where it is zero."""
    sizes = np.abs(values).max(axis=0)
    return np.where(sizes > 0.0, sizes, 1.0)


def _verdict(
    error: Array, bound: Array, counted: NDArray[np.bool_], rounding: float,
    parts: dict[str, Array],
) -> Attack:
    share = np.where(counted, _share(error, bound, rounding), 0.0)
    worst = int(share.max(axis=1).argmax())
    above = np.greater(error, bound * (1.0 + _RELATIVE) + rounding) & counted
    example = {name: each[worst].copy() for name, each in parts.items()}
    return Attack(
        len(error), int(counted.sum()), int(above.sum()), float(share.max()),
        example | {"error": error[worst], "bound": bound[worst]},
    )


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
    "heavy tails": lambda rng, steps, width: np.clip(
        rng.standard_t(2.0, (steps, width)), -30.0, 30.0
    ),
    "coloured": lambda rng, steps, width: np.cumsum(
        rng.standard_normal((steps, width)), axis=0
    ) / np.sqrt(steps),
}


@dataclass(eq=False)
class ClosedRuns:
    """Results of the attempt, for each kind of bound."""

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
    certificate: Certificate, *, horizon: int | None = None, trials: int = 60, steps: int = 15,
    backends: Sequence[str] | None = None, caps: Sequence[int | None] = (0, 1, 2, 5),
    polished: int = 4, rounds: int = 10, seed: int = 0,
) -> ClosedRuns:
    """Look for a run of the estimator whose error exceeds a bound of the certificate.

    Backends, caps and kinds of noise take turns; sizes are drawn over four decades. The worst
    runs are then made worse: initial states, disturbances and noises are changed at random
    wherever that raises the error's share of the sharpest bound.

    Parameters
    ----------
    certificate : Certificate
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
    size = _sizes_or_one(system.h.batch(points[:, :n], points[:, n:]))
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
    later = np.arange(steps + 1) > 0  # at t = 0 there is the initial error alone
    rounding = _rounding(region)
    shares = {
        kind: np.where(later, _share(error, bound, rounding), 0.0)
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
            return values + size * scale * rng.standard_normal(values.shape)

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
    rounding = _rounding(certificate.region)
    for kind in certificate.kinds:
        trial, played = max(found, key=lambda pair: float(pair[1].shares[kind].max()))
        above = sum(
            int((each.error > each.bounds[kind] * (1.0 + _RELATIVE) + rounding).sum())
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
