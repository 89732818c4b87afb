"""Extended Kalman filters side by side, each with its own interpretation of a record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..codegen.filters import HypothesisInput, HypothesisLibrary, scalar_model
from ..errors import CompilationError
from ..estimation.engines import python_only
from ..model.expressions import CasadiModel
from ..model.system import System

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Batch = Callable[[Array, Array], Array]
Loss = Callable[[Array], tuple[Array, Array]]

# Outliers have a Cauchy distribution, as they may be anything: their share, and its width.
_SHARE, _WIDTH = 0.02, 8.0
# Logarithms of densities: of one, beside the normal distribution's own, and of no outlier.
_EXTREME = float(np.log(_SHARE / _WIDTH * np.sqrt(2.0 / np.pi)))
_INLYING = float(np.log1p(-_SHARE))
# Beyond this an innovation in its own deviations is an outlier rather than noise.
_OUTLIER = 4.0
# Of a sensor's samples, those that can be outliers at most.
_MOST_OUTLIERS = 0.5
# Samples without any measurement that make a gap, and measured ones after it that are no evidence.
_GAP = 10
# Seconds that NumPy takes for a sample of a filter, and for each entry of its covariance, and a
# compiler for a library and for each of the model's operations, roughly; a library is compiled
# where it saves so many times as much.
_RUNNING, _ENTRY, _LIBRARY, _COMPILING, _PAYS = 8e-6, 1e-7, 0.5, 4e-3, 3.0
# The first and the third where steps are implicit.
_IMPLICIT_RUNNING, _IMPLICIT_LIBRARY = 2e-4, 3.0
# Samples on which both filters are compared, and the difference that is no rounding.
_COMPARED, _ROUNDING = 40, 1e-6
# Of systems that were asked for one, by the filters' kind; None where it was not to be had.
_libraries: WeakKeyDictionary[
    System, dict[tuple[int, ...], HypothesisLibrary | None]
] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """How one filter interprets the record."""

    measurements: Array  # (T, p), NaN where missing
    inputs: Array  # (T, m)
    noise: Array  # R (p, p), or (T, p, p) where it changes
    disturbance: Array  # Q of what the disturbance adds to the state
    start: Array  # the first estimate, and its covariance
    prior: Array
    step: float = 1.0  # length of each, as a multiple of what the record says
    outliers: bool = False  # whether single measurements may be such, which it then leaves out
    gains: Array | None = None  # (p,): what the record's numbers were divided by to make y
    repeats: Array | None = None  # (T,): how many steps of the model lie behind each sample
    bank: FilterBank | None = None  # the filters of another model, where it has one

    @property
    def usual_noise(self) -> Array:
        """R, or its mean where it changes."""
        return self.noise if self.noise.ndim == 2 else np.asarray(self.noise.mean(axis=0))

    def first(self, count: int) -> Hypothesis:
        """The same of the first samples alone."""
        return replace(
            self, measurements=self.measurements[:count], inputs=self.inputs[:count],
            noise=self.noise if self.noise.ndim == 2 else self.noise[:count],
            repeats=None if self.repeats is None else self.repeats[:count],
        )


@dataclass(frozen=True, eq=False)
class Filtered:
    """Results of the filters: all but `logs` are those of the first filter.

    `logs` are log likelihoods, for as many measurements as the first has; -infinity in all
    samples where the filter failed.
    """

    logs: Array  # (T, H)
    states: Array  # (T, n), before and after each measurement
    corrected: Array
    innovations: Array  # (T, p), NaN where missing or left out
    spreads: Array  # (T, p, p), their covariances, and the inverses
    weights: Array
    covariances: Array  # (T, n, n), after each measurement
    transitions: Array  # A
    outputs: Array  # C
    gains: Array  # K of the measurement update

    @property
    def likelihoods(self) -> Array:
        """Log likelihood of the record under each hypothesis (H,)."""
        return np.asarray(self.logs.sum(axis=0))

    @property
    def normalised(self) -> Array:
        """Innovations in their standard deviations."""
        spread = np.diagonal(self.spreads, axis1=1, axis2=2)
        return np.asarray(self.innovations / np.sqrt(spread))


class FilterBank:
    """Runs filters over one record, with steps (T,) or the usual one, and samples before it.

    With a `loss`, of whitened innovations to their costs and to what corrects the filter, they are
    as `qpmhe.ExtendedKalman` is: linearised at the predictions alone; all samples are evidence.
    Where so many filters are expected, of so many samples at least, that C pays, they are compiled.
    """

    def __init__(
        self, system: System, steps: Array | None, before: int = 0, *, loss: Loss | None = None,
        filters: int = 1, samples: int = 0,
    ) -> None:
        self.system, self.before, self.steps, self._loss = system, before, steps, loss
        self._filters, self._samples = filters, samples
        #: Which filters of the system's they are: those of a kind have one library.
        self.kind: tuple[int, ...] = ()
        #: Length of the state that is filtered.
        self.n = system.n
        #: The first thing that the model has raised.
        self.error: Exception | None = None
        #: Takes the length of the step as its last input where it can.
        own = system.evaluated_by(system.model())
        self.model = own.timed if system.has_timed else own
        self._is_timed = system.has_timed
        if self._is_timed and steps is None:
            self.steps = np.array([float(system.dt or 1.0)])
        self._tried = False

    def _try_batched(self, start: Array, prior: Array, inputs: Array) -> None:
        """Let functions that no trace has proved to take many states do so if it looks like it."""
        self._tried = True
        if "looped" not in (self.model.f.mode, self.model.h.mode):
            return
        generator, count = np.random.default_rng(0), 2 * self.system.n + 7
        spread = 0.1 * np.sqrt(prior.diagonal())
        x = self._bounded(start + spread * generator.standard_normal((count, self.system.n)))
        found = self.model.evaluation.batched_at(x, inputs[np.arange(count) % len(inputs)])
        self.model = self.model.evaluated_by(found)

    def _bounded(self, x: Array) -> Array:
        states = self.system.states
        if states is None:
            return x
        turned = x if self.system.turns is None else self.system.turns(x)
        return np.clip(turned, states.lower, states.upper)

    def functions(self) -> tuple[Batch, Batch, Batch, Batch]:
        """Functions f, h and their Jacobians, of many states at once."""
        model = self.model
        return model.f.batch, model.h.batch, model.f_jacobian.batch, model.h_jacobian.batch

    def full_inputs(self, inputs: Array, step: float = 1.0) -> Array:
        """The inputs of `model`, followed by the length of the step if it takes one."""
        if not self._is_timed or self.steps is None:
            return inputs
        lengths = np.broadcast_to(step * self.steps[: len(inputs)], (len(inputs),))
        return np.column_stack((inputs, lengths))

    def errors(self, measured: Array, expected: Array) -> Array:
        """Measured minus expected outputs, the shorter way round where they are angles.

        NaN where a residual function of the user's raises.
        """
        found, residual = measured - expected, self.system.output_residual
        if residual is not None:
            try:
                residual.wrap(found, measured)
            except Exception:
                for error, y in zip(found, np.broadcast_to(measured, found.shape), strict=True):
                    try:
                        residual.wrap(error, y)
                    except Exception as raised:
                        self.error, error[...] = self.error or raised, np.nan
        return found

    def expected(self, states: Array, inputs: Array) -> Array:
        """Outputs (T, p) at states (T, n); NaN where the model raises."""
        return self._values(self.model.h.batch, states, inputs, (self.system.p,))

    def following(self, states: Array, inputs: Array) -> Array:
        """States (T, n) after a step from states (T, n); NaN where the model raises."""
        return self._values(self.model.f.batch, states, inputs, (self.system.n,))

    def bounded_prior(self, one: Hypothesis, most: float) -> Array:
        """The prior, smaller in states by which outputs would vary by too much.

        That is by more than a multiple of the noise, in one of the first n samples.
        """
        x, u = one.start[None], self.full_inputs(one.inputs[:1], one.step)
        _, _, f_jacobian, h_jacobian = self.functions()
        a = self._values(f_jacobian, x, u, (self.n, self.n))[0]
        slope = self._values(h_jacobian, x, u, (self.system.p, self.n))[0]
        shown = np.zeros(self.n)
        for _ in range(self.n):
            ahead = slope**2 / one.usual_noise.diagonal()[:, None]
            shown = np.fmax(shown, ahead.max(axis=0) * one.prior.diagonal())
            slope = slope @ a
        bound = np.sqrt(most / np.where(np.isfinite(shown), np.maximum(shown, most), most))
        return bound[:, None] * one.prior * bound

    def moves(self, states: Array, inputs: Array) -> tuple[Array, Array]:
        """Expected outputs (T, p) at states (T, n), and how far they move within a step."""
        expected = self.expected(states, inputs)
        later = self.expected(self.following(states, inputs), inputs)
        return expected, self.errors(later, expected)

    def _values(self, function: Batch, x: Array, u: Array, shape: tuple[int, ...]) -> Array:
        """A model function's values at all states; NaN where it raises."""
        try:
            return np.asarray(function(x, u))
        except Exception:
            found = np.full((len(x), *shape), np.nan)
            for i in range(len(x)):
                try:
                    found[i] = function(x[i : i + 1], u[i : i + 1])[0]
                except Exception as error:
                    self.error = self.error or error
            return found

    def run(self, hypotheses: Sequence[Hypothesis]) -> Filtered:
        """Filter the record under all hypotheses, those of one model at once."""
        banks = {id(one.bank or self): one.bank or self for one in hypotheses}
        if banks.keys() == {id(self)}:
            return self._run(hypotheses, hypotheses[0])
        members = {
            key: [k for k, one in enumerate(hypotheses) if (one.bank or self) is bank]
            for key, bank in banks.items()
        }
        found = {
            key: banks[key]._run([hypotheses[k] for k in some], hypotheses[0])
            for key, some in members.items()
        }
        logs = np.empty((len(hypotheses[0].measurements), len(hypotheses)))
        for key, some in members.items():
            logs[:, some] = found[key].logs
        return replace(found[id(hypotheses[0].bank or self)], logs=logs)

    def _run(self, hypotheses: Sequence[Hypothesis], usual: Hypothesis) -> Filtered:
        """Filter the record under hypotheses of this model, with units and evidence of `usual`."""
        library = self._compiled(hypotheses[0])
        found = None if library is None else self._run_in_c(library, hypotheses, usual)
        return self._run_in_numpy(hypotheses, usual) if found is None else found

    def _run_in_numpy(
        self, hypotheses: Sequence[Hypothesis], usual: Hypothesis
    ) -> Filtered:
        y = np.array([one.measurements for one in hypotheses])
        u = np.array([self.full_inputs(one.inputs, one.step) for one in hypotheses])
        start = np.array([one.start for one in hypotheses])
        prior = np.array([one.prior for one in hypotheses])
        if not self._tried and self.n == self.system.n:
            self._try_batched(start[0], prior[0], u[0])
        (count, total, p), n = y.shape, self.n
        f, h, f_jacobian, h_jacobian = self.functions()
        there = np.isfinite(y)
        y = np.where(there, y, 0.0)
        disturbance = np.array([one.disturbance for one in hypotheses])
        outliers = np.array([one.outliers for one in hypotheses])
        scale = np.array([1.0 if self._is_timed else one.step for one in hypotheses])[:, None]
        # Outputs count in deviations of the usual noise, whatever their units.
        unit = np.sqrt(usual.usual_noise.diagonal())
        units = np.multiply.outer(unit, unit)
        noise = np.array([one.usual_noise for one in hypotheses]) / units
        changing = {k: one.noise / units for k, one in enumerate(hypotheses) if one.noise.ndim > 2}
        repeats = None if all(one.repeats is None for one in hypotheses) else np.array([
            np.ones(total, np.intp) if one.repeats is None else one.repeats for one in hypotheses
        ])
        eye_n, eye_p = np.eye(n), np.eye(p)
        x, covariance = start.copy(), prior.copy()
        alive, first = np.ones(count, np.bool_), _results(total, count, n, p)
        logs, any_outliers = first.logs, outliers.any()
        left_out = np.zeros((count, p))
        for t in range(total):
            now, seen = u[:, t], there[:, t]
            for k, varying in changing.items():
                noise[k] = varying[t]
            c = self._values(h_jacobian, x, now, (p, n)) / unit[:, None]
            e = self.errors(y[:, t], self._values(h, x, now, (p,))) / unit
            transposed = covariance @ c.transpose(0, 2, 1)
            spread = c @ transposed
            if any_outliers:
                own = np.einsum("hii->hi", spread + noise)
                far = outliers[:, None] & seen & (e * e > _OUTLIER**2 * own)
                tail = np.log1p(e * e / own / _WIDTH**2) + 0.5 * np.log(own)
                seen, left_out = seen & ~far, left_out + far
                logs[t] += np.where(far, _EXTREME - tail, 0.0).sum(axis=1)
                logs[t] += _INLYING * (outliers * seen.sum(axis=1))
            spread = spread + noise
            if not seen.all():
                spread = np.where(seen[:, :, None] & seen[:, None, :], spread, eye_p)
                c, e = np.where(seen[:, :, None], c, 0.0), np.where(seen, e, 0.0)
                transposed = np.where(seen[:, None, :], transposed, 0.0)
            good = alive & np.isfinite(x).all(axis=1) & np.isfinite(e).all(axis=1)
            good &= np.isfinite(spread).all(axis=(1, 2)) & np.isfinite(c).all(axis=(1, 2))
            if not good.all():
                alive = good
                x[~good], covariance[~good] = start[~good], prior[~good]
                e[~good], c[~good], spread[~good], transposed[~good] = 0.0, 0.0, eye_p, 0.0
            factor = _each(np.linalg.cholesky, spread, alive)
            inverse = _each(np.linalg.inv, spread, alive)
            gain = transposed @ inverse
            if self._loss is None:
                cost = 0.5 * np.einsum("hi,hij,hj->h", e, inverse, e)
                move = np.einsum("hij,hj->hi", gain, e)
            else:
                cost, used = self._loss(np.asarray(np.linalg.solve(factor, e[..., None]))[..., 0])
                move = np.einsum("hij,hjk,hk->hi", gain, factor, used)
            logs[t] -= cost + np.log(np.einsum("hii->hi", factor)).sum(axis=1)
            first.states[t], first.outputs[t], first.gains[t] = x[0], c[0], gain[0]
            first.innovations[t] = np.where(seen[0] & alive[0], e[0], np.nan)
            first.spreads[t], first.weights[t] = spread[0], inverse[0]
            if self._loss is None:
                x = self._bounded(x + move)
            closed = eye_n - gain @ c
            covariance = closed @ covariance @ closed.transpose(0, 2, 1)
            covariance += gain @ noise @ gain.transpose(0, 2, 1)
            first.corrected[t], first.covariances[t] = x[0], covariance[0]
            a = self._values(f_jacobian, x, now, (n, n))
            following = self._values(f, x, now, (n,))
            if self._loss is not None:
                following = self._bounded(following + np.einsum("hij,hj->hi", a, move))
            if (scale != 1.0).any():
                following = x + scale * (following - x)
                a = eye_n + scale[:, :, None] * (a - eye_n)
            before, x, former = x, following, covariance
            covariance = a @ covariance @ a.transpose(0, 2, 1) + disturbance
            if repeats is not None and (repeats[:, t] != 1).any():
                held = repeats[:, t] == 0
                x[held], covariance[held], a[held] = before[held], former[held], eye_n
                for further in range(1, int(repeats[:, t].max())):
                    some = np.flatnonzero(repeats[:, t] > further)
                    slope = self._values(f_jacobian, x[some], now[some], (n, n))
                    x[some] = self._values(f, x[some], now[some], (n,))
                    covariance[some] = slope @ covariance[some] @ slope.transpose(0, 2, 1)
                    covariance[some] += disturbance[some]
                    a[some] = slope @ a[some]
            first.transitions[t] = a[0]
        self._judge(hypotheses, usual, logs, there, left_out)
        if self._loss is None:
            first.innovations[_recovering_of(usual)] = np.nan
        logs[:, ~alive] = -np.inf
        _in_outputs(first, unit)
        return first

    def _run_in_c(
        self, library: HypothesisLibrary, hypotheses: Sequence[Hypothesis], usual: Hypothesis
    ) -> Filtered | None:
        """As `_run_in_numpy`; None where the first filter fails."""
        (total, p), n = usual.measurements.shape, self.n
        unit = np.sqrt(usual.usual_noise.diagonal())
        first = _results(total, len(hypotheses), n, p)
        there = np.array([np.isfinite(one.measurements) for one in hypotheses])
        left_out, failed = np.zeros((len(hypotheses), p)), []
        for k, one in enumerate(hypotheses):
            found = library.run(
                self._in_c(one, unit), [] if k else list(vars(first).values())[1:])
            if found is None:
                failed.append(k)
            else:
                first.logs[:, k], left_out[k] = found
        if 0 in failed:
            return None
        self._judge(hypotheses, usual, first.logs, there, left_out)
        first.logs[:, failed] = -np.inf
        first.innovations[_recovering_of(usual)] = np.nan
        _in_outputs(first, unit)
        return first

    def _in_c(self, one: Hypothesis, unit: Array) -> HypothesisInput:
        system, (total, p) = self.system, one.measurements.shape
        low, high = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        residual, periods = system.output_residual, np.zeros(p)
        if system.states is not None:
            low[: system.n], high[: system.n] = system.states.lower, system.states.upper
        if residual is not None:
            periods[list(residual.components)] = residual.periods
        return HypothesisInput(
            one.start, one.prior, one.disturbance, one.noise / np.multiply.outer(unit, unit),
            np.where(np.isfinite(one.measurements), one.measurements, 0.0),
            self._inputs_in_c(one), np.isfinite(one.measurements), unit, low, high, periods,
            np.ones(total, np.int64) if one.repeats is None else one.repeats.astype(np.int64),
            int(one.noise.ndim > 2), int(one.outliers), 1.0 if self._is_timed else one.step,
            _OUTLIER, _WIDTH, _EXTREME, _INLYING,
        )

    def _inputs_in_c(self, one: Hypothesis) -> Array:
        """The inputs of `_model_in_c`, and the length of each step."""
        inputs = self.full_inputs(one.inputs, one.step)
        lengths = [] if self._is_timed else [np.full(len(inputs), self.system.dt or 0.0)]
        return np.column_stack((inputs, *lengths))

    def _model_in_c(self, model: CasadiModel) -> CasadiModel | None:
        """What is compiled of the system's model; None if nothing."""
        return model

    def _compiled(self, one: Hypothesis) -> HypothesisLibrary | None:
        """The library of this model, if it saves more time than it takes to compile it."""
        system, residual = self.system, self.system.output_residual
        if (
            self._loss is not None or python_only()
            or (residual is not None and residual.periods is None)
            or (system.states is not None and system.turns is not None)
        ):
            return None
        libraries = _libraries.setdefault(system, {})
        if self.kind in libraries:
            return libraries[self.kind]
        model = scalar_model(system.evaluated_by(system.model()).symbolic)
        if model is None:
            return None
        implicit = model.is_implicit
        found = self._model_in_c(model)
        if found is None:
            return None
        model = found
        step = model.f if implicit else model.step()
        operations = step.n_instructions() + model.h.n_instructions()
        running = (_IMPLICIT_RUNNING if implicit else _RUNNING) + _ENTRY * self.n**2
        library = (_IMPLICIT_LIBRARY if implicit else _LIBRARY) + operations * _COMPILING
        samples = max(self._samples, len(one.measurements))
        if self._filters * samples * running < _PAYS * library:
            return None
        part = one.first(_COMPARED)

        def fault(library: HypothesisLibrary) -> str:
            filtered = self._run_in_c(library, [part], part)
            if filtered is None:
                return "the filter fails"
            expected = self._run_in_numpy([part], part)
            for got, true in zip(vars(filtered).values(), vars(expected).values(), strict=True):
                size = np.abs(np.nan_to_num(true)).max(axis=0)
                if not (np.abs(np.nan_to_num(got - true)) <= _ROUNDING * size).all():
                    return "the filter is not the one of NumPy"
            return ""

        try:
            libraries[self.kind] = HypothesisLibrary(model, fault)
        except CompilationError:
            libraries[self.kind] = None
        return libraries[self.kind]

    def _judge(
        self, hypotheses: Sequence[Hypothesis], usual: Hypothesis, logs: Array, there: Mask,
        left_out: Array,
    ) -> None:
        """Log likelihoods of as many measurements as the usual one has, in its units."""
        for k, one in enumerate(hypotheses):  # the density of the record's own numbers
            if one.gains is not None:
                logs[:, k] -= there[k] @ np.log(one.gains)
        # A shifted record lacks some samples, which must make no difference.
        counts, evidence = there.sum(axis=(1, 2)), np.isfinite(usual.measurements)
        logs *= evidence.sum() / np.maximum(counts, 1)
        if self._loss is None:
            logs[_recovering_of(usual)] = 0.0
        # What leaves out most of a sensor does not explain it.
        explains = (left_out <= _MOST_OUTLIERS * there.sum(axis=1)).all(axis=1)
        logs[:, ~explains | ~np.isfinite(logs).all(axis=0)] = -np.inf


def _results(total: int, count: int, n: int, p: int) -> Filtered:
    shapes = (n,), (n,), (p,), (p, p), (p, p), (n, n), (n, n), (p, n), (n, p)
    return Filtered(
        np.zeros((total, count)), *(np.empty((total, *shape)) for shape in shapes))


def _in_outputs(first: Filtered, unit: Array) -> None:
    """Take results from units of the noise to those of the outputs."""
    first.innovations[...] *= unit
    first.spreads[...] *= np.multiply.outer(unit, unit)
    first.weights[...] /= np.multiply.outer(unit, unit)
    first.outputs[...] *= unit[:, None]
    first.gains[...] /= unit


def _recovering_of(usual: Hypothesis) -> Mask:
    return _recovering(np.asarray(np.isfinite(usual.measurements).any(axis=1)))


def _recovering(seen: Mask) -> Mask:
    """Samples soon after a long gap: a linearised filter is as uncertain there as at the start."""
    found, missing, left = np.zeros(len(seen), np.bool_), 0, 0
    for t, there in enumerate(seen):
        if there and missing >= _GAP:
            left = _GAP
        missing = 0 if there else missing + 1
        found[t] = left > 0
        left -= int(there and left > 0)
    # Where measurements are always that rare, they are the evidence.
    usual = 2 * (found & seen).sum() <= seen.sum()
    return found if usual else np.zeros_like(found)


def _each(function: Callable[[Array], Any], matrices: Array, alive: Mask) -> Array:
    """The inverses or factors; the filter of a matrix without one is dead, and has the identity."""
    try:
        return np.asarray(function(matrices), np.float64)
    except np.linalg.LinAlgError:
        for k, one in enumerate(matrices):
            try:
                function(one)
            except np.linalg.LinAlgError:
                alive[k], matrices[k] = False, np.eye(len(one))
        return np.asarray(function(matrices), np.float64)
