"""Sensors with memory, which look like a wrong Q or R: coloured noise, and a lag."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from .bank import Array, Batch, FilterBank, Hypothesis

# What remains of the noise, or of the lag, after a step.
_KEPT = (0.6, 0.8, 0.9, 0.95, 0.98)
# What is lost in a step is searched closer around the best of them.
_AROUND = (0.6, 0.7, 0.85, 1.2, 1.4, 1.6)
# Variances of the white noise and of the coloured one, as shares of R; the last is a lag's.
_SHARES = ((0.002, 1.0), (0.5, 0.5), (1.0, 1.0), (1.0, 0.0))
# More sensors than this have no memory of their own.
_MOST = 8


class MemoryBank(FilterBank):
    r"""Filters of the state (x, s) with a memory s of each sensor.

    .. math:: s^+ = a s + b h(x, u), \\quad y = c s + d h(x, u)

    The noise is coloured with a = phi, b = 0 and c = d = 1, and the sensor has a lag with
    a = c = phi and b = d = 1 - phi. A sensor without memory has a = b = c = 0 and d = 1. The last
    4 p inputs of a hypothesis are a, b, c and d.
    """

    def __init__(self, bank: FilterBank) -> None:
        super().__init__(bank.system, bank.steps, bank.before)
        self._bank, self.n = bank, bank.system.n + bank.system.p

    def full_inputs(self, inputs: Array, step: float = 1.0) -> Array:
        """The inputs of the model, with a, b, c and d behind."""
        m = self.system.m
        return np.hstack((super().full_inputs(inputs[:, :m], step), inputs[:, m:]))

    def _bounded(self, x: Array) -> Array:
        n = self.system.n
        return np.hstack((super()._bounded(x[:, :n]), x[:, n:]))

    def functions(self) -> tuple[Batch, Batch, Batch, Batch]:
        """Functions f, h and their Jacobians of the state (x, s)."""
        n, p = self.system.n, self.system.p
        f, h, f_jacobian, h_jacobian = self._bank.functions()

        def split(z: Array, v: Array) -> tuple[Array, Array, Array, tuple[Array, ...]]:
            u = v[:, : -4 * p]
            return z[:, :n], z[:, n:], u, tuple(np.split(v[:, -4 * p :], 4, axis=1))

        def following(z: Array, v: Array) -> Array:
            x, s, u, (a, b, _, _) = split(z, v)
            return np.hstack((f(x, u), a * s + b * h(x, u)))

        def outputs(z: Array, v: Array) -> Array:
            x, s, u, (_, _, c, d) = split(z, v)
            return c * s + d * h(x, u)

        def following_jacobian(z: Array, v: Array) -> Array:
            x, _, u, (a, b, _, _) = split(z, v)
            found = np.zeros((len(z), n + p, n + p))
            found[:, :n, :n], found[:, n:, :n] = f_jacobian(x, u), b[..., None] * h_jacobian(x, u)
            found[:, n:, n:] = a[:, None, :] * np.eye(p)
            return found

        def outputs_jacobian(z: Array, v: Array) -> Array:
            x, _, u, (_, _, c, d) = split(z, v)
            return np.dstack((d[..., None] * h_jacobian(x, u), c[:, None, :] * np.eye(p)))

        return following, outputs, following_jacobian, outputs_jacobian

    def gain(self, base: Hypothesis) -> float:
        """How much more likely the record is at most with a memory, as a logarithm."""
        p = self.system.p
        parts = [[j] for j in range(p)] if p <= _MOST else []
        parts += [list(range(p))] if p > 1 else []
        none, best = self.hypothesis(base, [], (0.0, 0.0, 0.0, 1.0), 1.0, 0.0), -np.inf
        tried = list(product(parts, _SHARES, _KEPT))
        for _ in range(2):
            values = self.run([none, *(self._with(base, *one) for one in tried)]).likelihoods
            gains = np.where(np.isfinite(values[1:]), values[1:], -np.inf) - values[0]
            best = max(best, float(gains.max()))
            part, share, kept = tried[int(np.argmax(gains))]
            tried = [(part, share, 1.0 - (1.0 - kept) * change) for change in _AROUND]
        return best

    def _with(
        self, base: Hypothesis, part: list[int], share: tuple[float, float], kept: float
    ) -> Hypothesis:
        """Coloured noise or, without a share of it, a lag."""
        lag = share[1] == 0.0
        memory = (kept, 1.0 - kept, kept, 1.0 - kept) if lag else (kept, 0.0, 1.0, 1.0)
        return self.hypothesis(base, part, memory, *share)

    def hypothesis(
        self, base: Hypothesis, part: list[int], memory: tuple[float, ...], white: float,
        coloured: float,
    ) -> Hypothesis:
        """The record with a, b, c, d of some sensors, and shares of R that are white or not."""
        n, p = self.system.n, self.system.p
        _, h, _, h_jacobian = self._bank.functions()
        first = self._bank.full_inputs(base.inputs[:1], base.step)
        at, along = h(base.start[None], first)[0], h_jacobian(base.start[None], first)[0]
        constants = np.outer((0.0, 0.0, 0.0, 1.0), np.ones(p))
        constants[:, part] = np.array(memory)[:, None]
        lags = (constants[1] > 0.0).astype(np.float64)
        shares = np.zeros(p)
        shares[part] = np.sqrt(coloured)
        own = base.noise * np.outer(shares, shares)
        noise = base.noise.copy()
        noise[part] *= np.sqrt(white)
        noise[:, part] *= np.sqrt(white)
        # A lag has followed the outputs until the start.
        maps = np.vstack((np.eye(n), lags[:, None] * along))
        prior, disturbance = maps @ base.prior @ maps.T, np.zeros((n + p, n + p))
        prior[n:, n:] += own
        disturbance[:n, :n] = base.disturbance
        disturbance[n:, n:] = (1.0 - memory[0] ** 2) * own
        rows = np.tile(constants.ravel(), (len(base.inputs), 1))
        return replace(
            base, inputs=np.hstack((base.inputs, rows)), noise=noise, disturbance=disturbance,
            start=np.append(base.start, lags * at), prior=prior,
        )
