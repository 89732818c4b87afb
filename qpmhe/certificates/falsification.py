"""Attempts to refute a claimed bound: random trajectories, and ones made worse on purpose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import count, numbers
from ..errors import InvalidInputError, ShapeError
from ..sets import Box, ConvexSet
from ..system import System
from .decay import DecayingSums
from .regions import Region, bounded_region

__all__ = ["Attack", "attack_detectability", "attack_observer", "inside"]

Array = NDArray[np.float64]
Generator = np.random.Generator
# Of two numbers computed in floating point, one exceeds the other by more than this, or not.
_RELATIVE, _ABSOLUTE = 1e-9, 1e-12


@dataclass(frozen=True, eq=False)
class Attack:
    """What became of an attempt to refute a bound.

    Parameters
    ----------
    trials : int
        Trajectories, or pairs of them, that were tried.
    comparisons : int
        Times at which an error was compared with its bound.
    violations : int
        Comparisons in which the error was above it, by more than rounding.
    ratio : float
        The largest error, as a share of its bound.
    example : dict of str to array
        The trajectories with the largest share.
    run : str
        What they are of, where there are several settings.
    """

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
    system: System,
    region: ConvexSet | Region | None,
    claim: DecayingSums,
    *,
    trials: int,
    steps: int = 20,
    polish: int = 40,
    seed: int = 0,
    inputs: Box | None = None,
) -> Attack:
    """Look for two trajectories in the region that violate (eq:eIOSS).

    Disturbances may be anything, so any two sequences of states in the region are two
    trajectories. They are drawn in several ways (noise-free, the same disturbance, small or
    rare ones, anything, differences hidden from the output), and then changed at random
    wherever that raises the error's share of the bound.

    Parameters
    ----------
    system : System
        The system.
    region : Box, Polytope, Region or None
        Where both trajectories stay; None for the system's own states.
    claim : DecayingSums
        eta, c_p, c_w and c_v.
    trials : int
        Number of pairs.
    steps : int
        Their length.
    polish : int
        Rounds of changes.
    seed : int
        Of the random numbers.
    inputs : Box, optional
        Bounds on the inputs, of a system that has any, unless a region tells them.

    Raises
    ------
    SetError, ModelError, OptionError, InvalidInputError
        If an argument does not fit.
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

    states, apart, bound = _polished(states, shares, change, polish)
    return _verdict(apart, bound, np.ones_like(apart, np.bool_), {
        "first": states[0], "second": states[1], "inputs": acting,
    })


def attack_observer(
    system: System,
    region: ConvexSet | Region | None,
    gain: ArrayLike,
    claim: DecayingSums,
    *,
    trials: int,
    steps: int = 30,
    polish: int = 40,
    seed: int = 0,
    inputs: Box | None = None,
) -> Attack:
    """Look for a run of an observer with constant gain that violates (eq:RGES).

    A run counts as long as the observer's state stays in the region; the true one does
    throughout.

    Parameters
    ----------
    system, region
        As of `attack_detectability`.
    gain : (n, p) array_like
        The observer's.
    claim : DecayingSums
        rho, C_p, C_w and C_v.
    trials, steps, polish, seed, inputs
        As of `attack_detectability`.

    Raises
    ------
    SetError, ModelError, OptionError, InvalidInputError, ShapeError
        If an argument does not fit.
    """
    place, rng = _begun(system, region, claim, inputs, trials, steps, polish, seed)
    K = numbers("gain", gain)
    if K.shape != (system.n, system.p):
        raise ShapeError(f"gain has shape {K.shape}; expected {(system.n, system.p)}.")
    acting = _inputs(place, trials, steps, rng)
    truth = _pairs(system, place, trials, steps, acting, rng)[0]
    scale = np.abs(system.h.batch(truth[:, 0], acting[:, 0])).max() + 1e-3
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
        bound = _bounds(
            claim, error[:, 0], np.linalg.norm(w, axis=-1), np.linalg.norm(v, axis=-1)
        )
        return np.where(alive, error, np.nan), bound

    def change(runs: Array, size: float) -> Array:
        move = size * widths * rng.standard_normal(runs.shape)
        move *= rng.random((*runs.shape[:-1], 1)) < 0.3
        moved = runs + move
        for part in (slice(0, n), slice(n + p, None)):
            moved[..., part] = inside(place, moved[..., part])
        return moved

    runs, error, bound = _polished(runs[None], lambda r: shares(r[0]), change, polish)
    return _verdict(error, bound, np.isfinite(error), {
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
    """Points of the region: those inside as they are, others drawn in.

    Parameters
    ----------
    region : Region
        The region.
    points : (..., n) array
        States.
    """
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
    C = np.broadcast_to(
        system.h_jacobian.batch(points, u), (len(points), system.p, system.n)
    )
    apart = system.h.batch(like, u) - system.h.batch(points, u)
    moved: Array = points + np.einsum("bnp,bp->bn", np.linalg.pinv(C), apart)
    return np.where(np.isfinite(moved), moved, points)


def _bounds(claim: DecayingSums, start: Array, w: Array, v: Array) -> Array:
    """The claimed bound of many runs at once, (B, T + 1)."""
    bound = np.empty((start.size, w.shape[1] + 1))
    bound[:, 0] = claim.initial * start
    entering = claim.disturbance * w + claim.noise * v
    for t in range(w.shape[1]):
        bound[:, t + 1] = claim.rate * (bound[:, t] + entering[:, t])
    return bound


def _share(error: Array, bound: Array) -> Array:
    """Errors as shares of their bounds; those within rounding of nothing do not count."""
    small = np.maximum(bound, _ABSOLUTE)
    shares: Array = np.where(error > _ABSOLUTE, error / small, 0.0)
    return np.where(np.isfinite(shares), shares, 0.0)


def _polished(
    states: Array,
    shares: Callable[[Array], tuple[Array, Array]],
    change: Callable[[Array, float], Array],
    rounds: int,
) -> tuple[Array, Array, Array]:
    """Change what is drawn at random, and keep what raises the largest share of each."""
    error, bound = shares(states)
    worst = _share(error, bound).max(axis=1)
    for i in range(rounds):
        other = change(states, 10.0 ** (-0.5 - 3.0 * i / max(1, rounds)))
        other_error, other_bound = shares(other)
        reached = _share(other_error, other_bound).max(axis=1)
        better = reached > worst
        keep = better.reshape((1, -1) + (1,) * (states.ndim - 2))
        states = np.where(keep, other, states)
        error = np.where(better[:, None], other_error, error)
        bound = np.where(better[:, None], other_bound, bound)
        worst = np.where(better, reached, worst)
    return states, error, bound


def _verdict(
    error: Array, bound: Array, counted: NDArray[np.bool_], parts: dict[str, Array]
) -> Attack:
    share = np.where(counted, _share(error, bound), 0.0)
    worst = int(share.max(axis=1).argmax())
    above = np.greater(error, bound * (1.0 + _RELATIVE) + _ABSOLUTE) & counted
    example = {name: each[worst].copy() for name, each in parts.items()}
    return Attack(
        len(error), int(counted.sum()), int(above.sum()), float(share.max()),
        example | {"error": error[worst], "bound": bound[worst]},
    )
