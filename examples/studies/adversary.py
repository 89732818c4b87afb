"""Disturbances and noises at their bounds, chosen to make the error of an estimate large."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import qpmhe
from qpmhe.certificates import Region

Array = NDArray[np.float64]


@dataclass
class Signals:
    """What an adversary chooses: the truth's start and its disturbances and noises."""

    start: Array  # (n,)
    w: Array  # (T, n)
    v: Array  # (T, p)


@dataclass
class Setting:
    """A system with inputs at rest, and the largest |w| and |v|."""

    system: qpmhe.System
    region: Region
    gain: Array
    w: float
    v: float

    @property
    def u(self) -> Array:
        """The middle of the inputs' bounds."""
        n = self.system.n
        middle: Array = 0.5 * (self.region.lower + self.region.upper)[n:]
        return middle

    def truth(self, signals: Signals) -> tuple[Array, Array]:
        """States (T + 1, n) and measurements (T, p)."""
        x, y = [signals.start], []
        with np.errstate(all="ignore"):  # far from the region, where nothing counts
            for w, v in zip(signals.w, signals.v, strict=True):
                y.append(np.asarray(self.system.h(x[-1], self.u)) + v)
                x.append(np.asarray(self.system.f(x[-1], self.u)) + w)
        return np.array(x), np.array(y)

    def observed(self, x: Array, y: Array) -> Array:
        """The observer's states (T + 1, n), from the truth's start on."""
        z = [x[0]]
        with np.errstate(all="ignore"):
            for each in y:
                misfit = each - np.asarray(self.system.h(z[-1], self.u))
                z.append(np.asarray(self.system.f(z[-1], self.u)) + self.gain @ misfit)
        return np.array(z)

    @cached_property
    def closed_loop(self) -> Callable[[Array], Array]:
        """The Jacobian of the observer's error at a state; those of f and h are looked up once."""
        f, h = self.system.f_jacobian, self.system.h_jacobian
        return lambda x: np.asarray(f(x, self.u)) - self.gain @ np.asarray(h(x, self.u))

    def largest(self, direction: Array, size: float) -> Array:
        """A vector of this size along a direction."""
        length = float(np.linalg.norm(direction))
        return size / length * direction if length else np.zeros_like(direction)

    def inside(self, *trajectories: Array) -> int:
        """At how many of the first samples all of them are in the region."""
        stays = np.all([self.region.contains(each) for each in trajectories], axis=0)
        return int(np.argmin(np.append(stays, False)))

    def starts(self, count: int, rng: np.random.Generator) -> Array:
        """Points of the region that stay in it for a while without disturbances."""
        points = self.region.sample(20 * count, rng)[:, : self.system.n]
        points = points[0] + 0.7 * (points - points[0])
        calm = [
            point for point in points
            if self.inside(self.truth(self.silent(point, 40))[0]) == 41
        ]
        return np.array(calm[:count] or points[:1])

    def silent(self, start: Array, steps: int) -> Signals:
        """Nothing but the start."""
        return Signals(start, np.zeros((steps, self.system.n)), np.zeros((steps, self.system.p)))


def against_observer(
    setting: Setting, start: Array, direction: Array, steps: int, rounds: int = 6
) -> tuple[float, Signals]:
    """The largest |x - z| after some steps: each signal along its influence on the last error."""
    signals, best = setting.silent(start, steps), (0.0, setting.silent(start, steps))
    for _ in range(rounds):
        x, y = setting.truth(signals)
        z = setting.observed(x, y)
        until = setting.inside(x, z)
        errors = np.linalg.norm((x - z)[:until], axis=1)
        if len(errors) and errors.max() > best[0]:
            best = float(errors.max()), signals
        if until == steps + 1 and errors[-1] > 0.0:
            direction = (x - z)[-1]
        signals = Signals(start, np.zeros_like(signals.w), np.zeros_like(signals.v))
        influence = direction
        for t in range(steps - 1, -1, -1):
            signals.w[t] = setting.largest(influence, setting.w)
            signals.v[t] = setting.largest(-setting.gain.T @ influence, setting.v)
            middle = 0.5 * (x[t] + z[t])
            if t >= until:  # beyond, the derivatives say nothing
                continue
            influence = setting.closed_loop(middle).T @ influence
    return best


Estimates = Callable[[Array, Array], tuple[Array, int]]


def against_estimates(
    setting: Setting, estimates: Estimates, signals: Signals, rounds: int = 2, last: int = 8
) -> tuple[float, Signals]:
    """The largest |x - x_hat|: signs by differences of whole runs, from given signals on.

    ``estimates`` returns from measurements and truth the estimates (T + 1, n), and at how many of
    the first samples they count.
    """

    def error(tried: Signals) -> tuple[float, Array]:
        x, y = setting.truth(tried)
        found, counted = estimates(y, x)
        until = min(setting.inside(x), counted)
        errors = np.linalg.norm(x - found, axis=1)
        return float(errors[:until].max(initial=0.0)), (x - found)[-1]

    most, away = error(signals)
    best = most, signals
    for _ in range(rounds):
        direction = setting.largest(away, 1.0)
        steps = len(signals.w)
        chosen = Signals(signals.start, signals.w.copy(), signals.v.copy())
        for t in range(max(0, steps - last), steps):
            for name, size in (("w", setting.w), ("v", setting.v)):
                slope = np.zeros(getattr(signals, name).shape[1])
                for j in range(slope.size):
                    moved = Signals(signals.start, signals.w.copy(), signals.v.copy())
                    getattr(moved, name)[t, j] += 1e-3 * size
                    slope[j] = (error(moved)[1] - away) @ direction
                getattr(chosen, name)[t] = setting.largest(slope, size)
        signals = chosen
        most, away = error(signals)
        if most > best[0]:
            best = most, signals
    return best


def greedy(setting: Setting, mhe: qpmhe.MovingHorizonEstimator, start: Array, weight: Array,
           steps: int) -> Signals:
    """Signals along P e of the estimates themselves, step by step."""
    signals, x = setting.silent(start, steps), start
    for t in range(steps):
        push = weight @ (x - mhe.state)
        if not push.any():
            push = weight[:, 0]
        signals.w[t] = setting.largest(push, setting.w)
        signals.v[t] = setting.largest(-setting.gain.T @ push, setting.v)
        y = np.asarray(setting.system.h(x, setting.u)) + signals.v[t]
        mhe.update(y, setting.u if setting.system.m else None)
        x = np.asarray(setting.system.f(x, setting.u)) + signals.w[t]
    return signals
