"""Sensors with memory, which look like a wrong Q or R: coloured noise, and a lag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..model.expressions import CasadiModel, import_casadi
from .bank import Array, Batch, FilterBank, Hypothesis
from .faults import Evidence, Fault

# What remains of the noise, or of the lag, after a step.
_KEPT = (0.6, 0.85, 0.95, 0.985)
_LAGS = (0.2, 0.5, 0.75, 0.9, 0.96)
# Variances of the white noise and of the coloured one, as shares of R.
_SHARES = ((0.01, 1.0), (0.5, 0.5), (1.0, 1.0), (1.0, 4.0), (0.01, 4.0))
# A memory colours innovations: it is tried where a correlation over so few samples is beyond this,
# in its standard errors, for so many sensors.
_SOON, _LIMIT, _MOST = 5, 2.5, 3
# Up to this length of the state, all sensors have one in the same filters.
_SMALL = 8
# Filters that a search runs of each kind, roughly.
_FILTERS = 60


class MemoryBank(FilterBank):
    r"""Filters of the state (x, s) with a memory s of each of some sensors.

    .. math:: s^+ = a s + b h(x, u), \\quad y = c s + d h(x, u)

    The noise is coloured with a = phi, b = 0 and c = d = 1, and the sensor has a lag with
    a = c = phi and b = d = 1 - phi. A sensor without memory has a = b = c = 0 and d = 1. The last
    inputs of a hypothesis are a, b, c and d of each.
    """

    def __init__(self, bank: FilterBank, sensors: Sequence[int], samples: int = 0) -> None:
        super().__init__(
            bank.system, bank.steps, bank.before, filters=_FILTERS, samples=samples)
        self._bank, self._sensors = bank, list(sensors)
        self.n = bank.system.n + len(self._sensors)
        # In C, a single memory is that of any sensor.
        self.kind = (-1,) if len(self._sensors) == 1 else tuple(self._sensors)

    def full_inputs(self, inputs: Array, step: float = 1.0) -> Array:
        """The inputs of the model, with a, b, c and d behind."""
        m = self.system.m
        return np.hstack((self._bank.full_inputs(inputs[:, :m], step), inputs[:, m:]))

    def _bounded(self, x: Array) -> Array:
        n = self.system.n
        return np.hstack((super()._bounded(x[:, :n]), x[:, n:]))

    def functions(self) -> tuple[Batch, Batch, Batch, Batch]:
        """Functions f, h and their Jacobians of the state (x, s)."""
        n, own, some = self.system.n, self.n, self._sensors
        f, h, f_jacobian, h_jacobian = self._bank.functions()
        eye, last = np.eye(len(some)), 4 * len(some)

        def split(z: Array, v: Array) -> tuple[Array, Array, Array, Array]:
            constants = v[:, -last:].reshape(len(z), 4, -1)
            return z[:, :n], z[:, n:], v[:, :-last], constants.swapaxes(0, 1)

        def following(z: Array, v: Array) -> Array:
            x, s, u, (a, b, _, _) = split(z, v)
            return np.hstack((f(x, u), a * s + b * h(x, u)[:, some]))

        def outputs(z: Array, v: Array) -> Array:
            x, s, u, (_, _, c, d) = split(z, v)
            found = np.array(h(x, u))
            found[:, some] = c * s + d * found[:, some]
            return found

        def following_jacobian(z: Array, v: Array) -> Array:
            x, _, u, (a, b, _, _) = split(z, v)
            found = np.zeros((len(z), own, own))
            found[:, :n, :n] = f_jacobian(x, u)
            found[:, n:, :n] = b[..., None] * h_jacobian(x, u)[:, some]
            found[:, n:, n:] = a[..., None] * eye
            return found

        def outputs_jacobian(z: Array, v: Array) -> Array:
            x, _, u, (_, _, c, d) = split(z, v)
            slopes = np.asarray(h_jacobian(x, u))
            found = np.zeros((len(z), slopes.shape[1], own))
            found[:, :, :n] = slopes
            found[:, some, :n] *= d[..., None]
            found[:, some, n:] = c[..., None] * eye
            return found

        return following, outputs, following_jacobian, outputs_jacobian

    def _model_in_c(self, model: CasadiModel) -> CasadiModel | None:
        """A map of (x, s), with the length of the step behind the inputs, and then a, b, c and d.

        b and c are matrices, and d has a number for each sensor. None where a step is implicit.
        """
        if model.is_implicit:
            return None
        ca, n, m, memories = import_casadi(), model.n, model.m, len(self._sensors)
        which = self._pattern
        z, u, a = ca.SX.sym("z", n + memories), ca.SX.sym("u", m + 1), ca.SX.sym("a", memories)
        b, c, d = ca.SX.sym("b", which.T), ca.SX.sym("c", which), ca.SX.sym("d", model.p)
        x, s, shown = z[:n], z[n:], model.h(z[:n], u[:m])
        inputs = ca.vertcat(u, a, *b.nonzeros(), *c.nonzeros(), d)
        following = ca.vertcat(model.step()(x, u[:m], u[m]), a * s + ca.mtimes(b, shown))
        return CasadiModel(
            ca.Function("f", [z, inputs], [ca.densify(following)]),
            ca.Function("h", [z, inputs], [ca.densify(d * shown + ca.mtimes(c, s))]),
            n + memories, model.p, inputs.numel(),
        )

    @property
    def _pattern(self) -> Any:
        """Where c is not 0: one memory may be that of any sensor."""
        ca, p = import_casadi(), self.system.p
        one = len(self._sensors) == 1
        return ca.Sparsity.dense(p, 1) if one else ca.DM.eye(p)[:, self._sensors].sparsity()

    def _inputs_in_c(self, one: Hypothesis) -> Array:
        some, p = self._sensors, self.system.p
        own = replace(one, inputs=one.inputs[:, : self.system.m])
        shape = len(one.inputs), 4, len(some)
        a, b, c, d = one.inputs[:, self.system.m :].reshape(shape).swapaxes(0, 1)
        if len(some) == 1:
            b, c = (each * np.eye(p)[some] for each in (b, c))
        all_d = np.ones((len(d), p))
        all_d[:, some] = d
        return np.column_stack((self._bank._inputs_in_c(own), a, b, c, all_d, np.zeros(len(d))))

    def hypothesis(
        self, base: Hypothesis, part: Sequence[int], memory: tuple[float, ...], white: float,
        coloured: float,
    ) -> Hypothesis:
        """The record with a, b, c, d of some sensors, and shares of R that are white or not."""
        n, some = self.system.n, self._sensors
        _, h, _, h_jacobian = self._bank.functions()
        first = self._bank.full_inputs(base.inputs[:1], base.step)
        at, along = (one(base.start[None], first)[0][some] for one in (h, h_jacobian))
        chosen = np.isin(some, part)
        constants = np.where(chosen, np.array(memory)[:, None], np.eye(4)[:, 3:])
        lags = (constants[1] > 0.0).astype(np.float64)
        shares = coloured * np.multiply.outer(chosen, chosen)
        own = shares * base.usual_noise[np.ix_(some, some)]
        roots = np.ones(self.system.p)
        roots[part] = np.sqrt(white)
        # A lag has followed the outputs until the start.
        maps = np.vstack((np.eye(n), lags[:, None] * along))
        prior, disturbance = maps @ base.prior @ maps.T, np.zeros((self.n, self.n))
        prior[n:, n:] += own
        disturbance[:n, :n] = base.disturbance
        disturbance[n:, n:] = (1.0 - memory[0] ** 2) * own
        rows = np.tile(constants.ravel(), (len(base.inputs), 1))
        return replace(
            base, inputs=np.hstack((base.inputs, rows)),
            noise=roots[:, None] * base.noise * roots, disturbance=disturbance,
            start=np.append(base.start, lags * at), prior=prior, bank=self,
        )


def _bank(evidence: Evidence, part: Sequence[int]) -> MemoryBank:
    """The filters with a memory of these sensors; of all where the state stays small."""
    p = evidence.bank.system.p
    sensors = tuple(range(p)) if evidence.bank.n + p <= _SMALL else tuple(part)
    kept: dict[tuple[int, ...], MemoryBank] = evidence.shared.setdefault("memories", {})
    if sensors not in kept:
        kept[sensors] = MemoryBank(evidence.bank, sensors, evidence.total)
    return kept[sensors]


def _sensors(evidence: Evidence, part: tuple[int, ...]) -> list[int]:
    return list(part) or list(range(evidence.bank.system.p))


def colours(evidence: Evidence, lags: int) -> Array:
    """The largest correlation of each sensor's innovations over so few samples (p,).

    In its standard errors.
    """
    errors = np.clip(evidence.null.normalised, -4.0, 4.0)
    errors = np.where(np.isfinite(errors), errors - np.nanmean(errors, axis=0), 0.0)
    squares = np.maximum((errors**2).sum(axis=0), 1e-300)
    sizes = np.zeros(errors.shape[1])
    for lag in range(1, min(lags, len(errors) // 4) + 1):
        found = np.abs((errors[lag:] * errors[:-lag]).sum(axis=0)) / squares
        counts = ((errors[lag:] != 0.0) & (errors[:-lag] != 0.0)).sum(axis=0)
        sizes = np.maximum(sizes, found * np.sqrt(counts))
    return sizes


def _suspects(evidence: Evidence) -> list[tuple[int, ...]]:
    """The sensors whose innovations are coloured, the most coloured first, and all together."""
    sizes = colours(evidence, _SOON)
    order = [j for j in np.argsort(-sizes).tolist() if sizes[j] > _LIMIT]
    single = [part for j in order[:_MOST] if (part := (j,)) in evidence.sensors]
    return [*single, *([()] if order and len(sizes) > 1 else [])]


def with_coloured_noise(evidence: Evidence) -> Iterator[Fault]:
    """Noise of a sensor, or of all, part of which is correlated in time."""
    for part in _suspects(evidence):
        for white, share in _SHARES:
            for kept in _KEPT:
                yield coloured(evidence, part, kept, white, share)


def coloured(
    evidence: Evidence, part: tuple[int, ...], kept: float, white: float, share: float
) -> Fault:
    """Noise with variances `white` and `share` of R, of which the second is a Markov process."""
    sensors = _sensors(evidence, part)
    bank = _bank(evidence, sensors)

    def made(constant: float) -> Fault:
        left = float(np.exp(-1.0 / constant))
        changed = bank.hypothesis(evidence.base, sensors, (left, 0.0, 1.0, 1.0), white, share)
        return Fault("coloured", constant, changed, part, again=made, family=(white, share))

    return made(-1.0 / float(np.log(kept)))


def coloured_variances(changed: Hypothesis, kept: float) -> Array:
    """Stationary variances of the coloured noise of such a hypothesis, sensor by sensor."""
    assert changed.bank is not None
    added = changed.disturbance.diagonal()[changed.bank.system.n :]
    return np.asarray(added[added > 0.0] / (1.0 - kept**2))


def with_lag(evidence: Evidence) -> Iterator[Fault]:
    """Sensors that follow what they measure with a lag of the first order."""
    def lagging(part: tuple[int, ...], constant: float) -> Fault:
        kept = float(np.exp(-1.0 / constant))
        memory = kept, 1.0 - kept, kept, 1.0 - kept
        sensors = _sensors(evidence, part)
        changed = _bank(evidence, sensors).hypothesis(evidence.base, sensors, memory, 1.0, 0.0)
        return Fault("lag", constant, changed, part, again=lambda value: lagging(part, value))

    for part in _suspects(evidence):
        for kept in _LAGS:
            yield lagging(part, -1.0 / float(np.log(kept)))
