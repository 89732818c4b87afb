"""The negative log likelihood of an extended Kalman filter's innovations, and its gradient."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from .._checks import Array
from ..codegen.filters import LikelihoodInput, LikelihoodLibrary, first_fault, scalar_model
from ..diagnosis.bank import FilterBank, Hypothesis
from ..errors import CompilationError, QpmheError
from ..estimation.engines import python_only
from ..model.expressions import import_casadi
from ..model.system import System
from .data import Data, Mask
from .structures import Structure
from .weights import Weights

# Step of central differences by numbers without unit: rounding and curvature are balanced.
_STEP = 3e-5
# Gradients that a search takes, roughly, for each component of theta.
_GRADIENTS = 20
# Seconds that a value and its gradient take CasADi's machine for a sample, and for each of the
# step's operations; and a compiler for a library, and for each of the model's operations, roughly.
_SAMPLE, _RUNNING, _LIBRARY, _COMPILING = 5e-6, 1.2e-8, 0.5, 1e-2
# The same of NumPy where steps are implicit, for a value and its differences.
_IMPLICIT_SAMPLE, _IMPLICIT_LIBRARY = 5e-3, 3.0
# A library is compiled where it saves so many times the seconds that it takes.
_PAYS = 3.0
# Samples on which both filters are compared, the difference that is no rounding, and of differences
# over such shares of a covariance.
_COMPARED, _ROUNDING = 40, 1e-6
_SHARE, _OF_DIFFERENCES = 1e-4, 1e-4


class Likelihood:
    r"""The negative log likelihood of records, as a function of what is tuned.

    With the innovations e and their covariances S of the extended Kalman filter, as
    `qpmhe.ExtendedKalman` computes it, and L L' = S,

    .. math::
        \sum_t \tfrac12 |L_t^{-1} e_t|^2 + \log \det L_t,

    over the samples of chosen blocks; outputs that are missing do not enter. With a threshold k,
    components s of :math:`L^{-1} e` beyond k correct the filter as if they were k, and cost
    :math:`k^2 (\tfrac12 + \log |s| / k)`, and all costs are divided by the mean of min(s^2, k^2)
    of a normal s: the least cost is then where Huber's second proposal for a scale has it, right
    for normal noise, and no outlier counts for more than k^2. States are clipped to the bounds
    of X.

    For a traced system, the gradient is exact, from one backward sweep through the filter. For
    others, it consists of central differences; the filter runs for all of them at once.

    `compile` has both sweeps done in C from then on, also where steps are implicit.
    """

    def __init__(
        self, structure: Structure, data: list[Data], make: Callable[[dict[str, float]], System],
        remade: bool, threshold: float | None = None,
    ) -> None:
        self.structure, self.data, self._make = structure, data, make
        self._remade = remade  # a change of parameters makes another system
        self._threshold = threshold  # where weights have none
        #: The samples that tune: those not held out.
        self.tuned = [~one.held for one in data]
        #: What makes another one of the same structure and data.
        self.recipe = structure, data, make, remade, threshold
        self._filters: dict[tuple[float, ...], _Filter] = {}
        #: The first thing that a model has raised far from the start; blank if none did.
        self.failure = ""
        #: Why there is no C where it would have saved time; blank if there is, or none was needed.
        self.not_compiled = ""

    def system(self, weights: Weights) -> System:
        """The system with the parameters of these weights."""
        return self._make(weights.parameters)

    def compile(self, always: bool = False) -> None:
        """Have the filter compiled where that saves more time than it takes."""
        if self._remade:  # another system at each point would be another library
            return
        one = self._filter(self.structure.first)
        if one is None or one.model is None or (python_only() and not always):
            return
        samples = sum(map(len, self.data))
        if always or one.saves(samples * _GRADIENTS * self.structure.seen):
            try:
                one.compile(self.structure.first, self.data[0])
            except CompilationError as error:
                self.not_compiled = str(error)

    @property
    def follow(self) -> Callable[[Array, Array], Array] | None:
        """The compiled model's implicit step, see `LikelihoodLibrary.follow`; None without one."""
        one = None if self._remade else self._filter(self.structure.first)
        return None if one is None else one.follow

    def expected_seconds(self) -> float:
        """How long a search from one start will take, roughly, by the time of one gradient."""
        began = perf_counter()
        self.gradient(self.structure.start)
        return (perf_counter() - began) * _GRADIENTS * self.structure.seen

    @property
    def samples(self) -> int:
        """How many samples tune."""
        return sum(int(mask.sum()) for mask in self.tuned)

    def shortened(self, count: int) -> Likelihood | None:
        """The one of so many samples, those of the first records; None of less than four times."""
        if self.samples < 4 * count:
            return None
        short, left = copy(self), count
        short.data, short.tuned = [], []
        for one, mask in zip(self.data, self.tuned, strict=True):
            if left > 0:
                used = min(len(one), int(np.searchsorted(np.cumsum(mask), left)) + 1)
                short.data.append(one.first(used))
                short.tuned.append(mask[:used])
                left -= int(mask[:used].sum())
        return short

    def value(self, theta: Array, chosen: list[Mask] | None = None) -> float:
        """The value at theta, over each record's chosen samples; infinite where the model fails."""
        return float(self._values([self.structure.weights(theta)], chosen or self.tuned)[0])

    def gradient(self, theta: Array, chosen: list[Mask] | None = None) -> tuple[float, Array]:
        """The value, and the derivative by theta."""
        structure, slope, begin, value = self.structure, np.zeros(len(theta)), 0, np.inf
        chosen = chosen or self.tuned
        weights = structure.weights(theta)
        made = self._filter(weights)
        if made is not None and made.has_adjoint:
            value, slopes, behind = made.adjoint(weights, self.data, chosen)
            begin = structure.covariances if self._remade else structure.seen
            by = np.zeros(len(structure.parameters)) if self._remade else behind
            slope = structure.adjoint(theta, slopes, by)
        if begin < structure.seen:
            moved = _STEP * np.eye(len(theta))[begin : structure.seen]
            points = [theta, *(theta + moved), *(theta - moved)]
            values = self._values([structure.weights(one) for one in points], chosen)
            ahead, behind = np.split(values[1:], 2)
            with np.errstate(invalid="ignore"):
                slope[begin : structure.seen] = (ahead - behind) / (2 * _STEP)
            value = float(values[0])
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return np.inf, np.zeros(len(theta))
        return value, slope

    def _values(self, settings: list[Weights], chosen: list[Mask]) -> Array:
        """The values at several settings; those of one system at once."""
        values = np.full(len(settings), np.inf)
        made = [self._filter(weights) for weights in settings]
        for filter_ in {id(one): one for one in made if one is not None}.values():
            members = [k for k, one in enumerate(made) if one is filter_]
            try:
                values[members] = sum(
                    filter_.costs([settings[k] for k in members], one)[mask].sum(axis=0)
                    for one, mask in zip(self.data, chosen, strict=True)
                )
            except Exception as error:  # whatever a model raises far from the data
                self._note(settings[members[0]], error)
        values[~np.isfinite(values)] = np.inf
        return values

    def _filter(self, weights: Weights) -> _Filter | None:
        key = tuple(weights.parameters.values()) if self._remade else ()
        if key not in self._filters:
            try:
                made = _Filter(self._make(weights.parameters), weights, self._threshold)
            except Exception as error:
                self._note(weights, error)
                return None
            if len(self._filters) > 16:
                self._filters.pop(next(iter(self._filters)))
            self._filters[key] = made
        return self._filters[key]

    def _note(self, weights: Weights, error: Exception) -> None:
        at = ", ".join(f"{name} = {value:.6g}" for name, value in weights.parameters.items())
        said = str(error) if isinstance(error, QpmheError) else f"{type(error).__name__}: {error}"
        self.failure = self.failure or f"{f'at {at}: ' if at else ''}{said}"


class _Filter:
    """The filter of one system, in CasADi where a step is an expression, else in NumPy; or in C."""

    def __init__(self, system: System, weights: Weights, threshold: float | None) -> None:
        self._system = system.evaluated_by(
            system.model(np.sqrt(weights.prior.diagonal().clip(1e-300)))
        )
        self._threshold = threshold if weights.threshold is None else weights.threshold
        self._clip = _bounds(system)
        self._ahead: dict[int, Any] = {}
        self._back: dict[int, Any] = {}
        self._step: Any = None
        self._library: LikelihoodLibrary | None = None
        #: f and h as scalar expressions, of which C can be made; None where there are none.
        self.model = scalar_model(self._system.symbolic)
        residual = system.output_residual
        self._periods = np.zeros(system.p)
        if residual is not None and residual.periods is not None:
            self._periods[list(residual.components)] = residual.periods
        if residual is not None and residual.periods is None:
            self.model = None
        if self.model is not None and not self.model.is_implicit:
            self._step = _symbolic_step(
                self.model, self._periods, self._clip, self._threshold)

    @property
    def has_adjoint(self) -> bool:
        """Whether `adjoint` is there."""
        return self._step is not None or self._library is not None

    @property
    def follow(self) -> Callable[[Array, Array], Array] | None:
        """See `Likelihood.follow`."""
        implicit = self._step is None
        return self._library.follow if implicit and self._library is not None else None

    def _covariances(self, weights: Weights) -> tuple[Array, Array, Array]:
        entering = self._system.state_covariance(weights.disturbance)
        return weights.prior, entering, weights.noise

    def costs(self, settings: list[Weights], one: Data) -> Array:
        """Costs (T, B) of a record at B settings."""
        if self._library is not None:
            given = [self._record(weights, one) for weights in settings]
            return np.stack([self._library.costs(each) for each in given], axis=1)
        if self._step is None:
            return self._run_together(settings, one)
        return np.stack([self._forward(weights, one)[2] for weights in settings], axis=1)

    # In C

    def saves(self, passes: int) -> bool:
        """Whether C saves time where so many samples pass, forwards and back."""
        model = self.model
        assert model is not None
        if self._step is None:
            return passes * _IMPLICIT_SAMPLE > _PAYS * _IMPLICIT_LIBRARY
        within = model.step().n_instructions() + model.h.n_instructions()
        running = passes * (_SAMPLE + self._step.n_instructions() * _RUNNING)
        return bool(running > _PAYS * (_LIBRARY + within * _COMPILING))

    def compile(self, weights: Weights, one: Data) -> None:
        """Compile the filter, and compare it with the present one on a record's first samples."""
        first = one.first(_COMPARED)
        chosen = np.ones(len(first), np.bool_)
        compared = self._compared_with_numpy if self._step is None else self._compared_with_casadi

        def fault(library: LikelihoodLibrary) -> str:
            try:
                return first_fault(lambda share: compared(
                    library, replace(weights, prior=share * weights.prior), first, chosen))
            finally:
                self._library = None

        assert self.model is not None
        self._library = LikelihoodLibrary(self.model, fault)

    def _compared_with_casadi(
        self, library: LikelihoodLibrary, weights: Weights, first: Data, chosen: Mask
    ) -> str:
        """What is wrong with a library; blank if nothing."""
        expected = self._adjoint_in_casadi(weights, first, chosen)
        if not np.isfinite(expected[0]):
            return "the likelihood of the first samples is not finite, and cannot be compared"
        self._library = library
        found = self._adjoint_in_c(weights, first, chosen)
        scales = [_scales(one) for one in self._covariances(weights)]
        for got, true in zip(map(np.asarray, found), map(np.asarray, expected), strict=True):
            if true.ndim == 2:  # of symmetric matrices, in their own units
                scale = scales.pop(0)
                got, true = scale * (got + got.T), scale * (true + true.T)
            if not (abs(got - true) <= _ROUNDING * abs(true).max(initial=0.0)).all():
                return "the likelihood, or its slope, is not the one of CasADi's interpreter"
        return ""

    def _compared_with_numpy(
        self, library: LikelihoodLibrary, weights: Weights, first: Data, chosen: Mask
    ) -> str:
        """The same where steps are implicit: values with NumPy's, the slope with differences."""
        expected = self._run_together([weights], first)[:, 0]
        if not np.isfinite(expected).all():
            return "the likelihood of the first samples is not finite, and cannot be compared"
        self._library, given = library, self._record(weights, first)
        costs = library.costs(given)
        if not (abs(costs - expected) <= _ROUNDING * abs(expected).max(initial=0.0)).all():
            return "the likelihood is not the one of NumPy"
        _, *slopes = self._adjoint_in_c(weights, first, chosen)
        moves = [given.prior, given.disturbance, given.noise]
        moves += [np.eye(len(slopes[3]) + 1)[k] * np.abs(given.inputs[:, k]).mean()
                  for k in range(len(slopes[3]))]
        names = "prior", "disturbance", "noise", *("inputs",) * len(slopes[3])
        found, differences = [], []
        for k, (name, move) in enumerate(zip(names, moves, strict=True)):
            by = slopes[k] if k < 3 else np.append(slopes[3], 0.0)
            found.append(float((by * move).sum()))
            ends = [
                library.costs(given._replace(**{name: getattr(given, name) + part * move})).sum()
                for part in (_SHARE, -_SHARE)
            ]
            differences.append((ends[0] - ends[1]) / (2.0 * _SHARE))
        apart = np.abs(np.subtract(found, differences))
        if not (apart <= _OF_DIFFERENCES * (np.abs(differences) + len(first))).all():
            return "the likelihood's slope is not the one of differences"
        return ""

    def _record(self, weights: Weights, one: Data) -> LikelihoodInput:
        y, u, dt, _ = self._given(weights, one)
        return LikelihoodInput(
            one.start, *self._covariances(weights), y, np.hstack((u, dt)), one.observed,
            *self._clip, self._periods,
            *(() if self._threshold is None
              else (self._threshold, _clipped_variance(self._threshold))),
        )

    # In CasADi

    def _sweep(self, samples: int) -> Any:
        """The filter over so many samples."""
        if samples not in self._ahead:
            self._ahead[samples] = self._step.mapaccum(
                "forward", samples, [0, 1], [0, 1], {"base": 10})
        return self._ahead[samples]

    def _sweep_back(self, samples: int) -> Any:
        """Its adjoint, from the last sample to the first; not made where only values are needed."""
        if samples not in self._back:
            ca, step = import_casadi(), self._step
            back = step.reverse(1)
            symbols = [ca.SX.sym(step.name_in(i), step.sparsity_in(i)) for i in range(step.n_in())]
            z, P, *known = symbols
            seeds = [ca.SX.sym("seed", *z.shape), ca.SX.sym("seed", *P.shape), ca.SX.sym("seed")]
            nothing = [ca.SX(*step.size_out(i)) for i in range(step.n_out())]
            found = back(*symbols, *nothing, *seeds)
            made = ca.Function(
                "back", [*seeds[:2], z, P, *known, seeds[2]],
                [ca.densify(found[0]), ca.densify(found[1]), *map(ca.densify, found[2:])],
            )
            self._back[samples] = made.mapaccum(
                "backward", samples, [0, 1], [0, 1], {"base": 10})
        return self._back[samples]

    def _given(self, weights: Weights, one: Data) -> list[Array]:
        """What the step takes of a record besides z and P, sample below sample."""
        dt = np.full(len(one), self._system.dt or 0.0) if one.dt is None else one.dt
        return [
            np.where(one.observed, one.y, 0.0), one.inputs(self._system, weights.parameters),
            dt[:, None], one.observed.astype(np.float64),
        ]

    def _columns(self, weights: Weights, one: Data) -> list[Any]:
        """What CasADi's step takes besides z and P, sample beside sample."""
        _, q, r = self._covariances(weights)
        return [each.T for each in self._given(weights, one)] + [
            np.tile(q, len(one)), np.tile(r, len(one))]

    def _forward(self, weights: Weights, one: Data) -> tuple[Array, Array, Array]:
        """Z (n, T) and P (n, n T) after each sample, and costs (T,)."""
        z, covariance, cost = map(np.asarray, self._sweep(len(one))(
            one.start, weights.prior, *self._columns(weights, one)
        ))
        return z, covariance, cost[0]

    def _adjoint_in_casadi(
        self, weights: Weights, one: Data, mask: Mask
    ) -> tuple[float, Array, Array, Array, Array]:
        """As `LikelihoodLibrary.adjoint`."""
        n, p = self._system.n, self._system.p
        z, covariance, cost = self._forward(weights, one)
        total = float(cost[mask].sum())
        if not np.isfinite(total):
            return total, np.zeros((n, n)), np.zeros((n, n)), np.zeros((p, p)), np.zeros(0)
        blocks = covariance.reshape(n, len(one), n)
        begun = np.concatenate((weights.prior[:, None], blocks[:, :-1]), axis=1)
        given = self._columns(weights, one)
        found = list(map(np.asarray, self._sweep_back(len(one))(
            np.zeros(n), np.zeros((n, n)),
            np.hstack((one.start[:, None], z[:, :-1]))[:, ::-1],
            begun[:, ::-1].reshape(n, -1), *(each[:, ::-1] for each in given[:4]), *given[4:],
            mask[None, ::-1].astype(np.float64),
        )))
        return (
            total, found[1][:, -n:], found[6].reshape(n, -1, n).sum(axis=1),
            found[7].reshape(p, -1, p).sum(axis=1), found[3].sum(axis=1),
        )

    def _adjoint_in_c(
        self, weights: Weights, one: Data, mask: Mask
    ) -> tuple[float, Array, Array, Array, Array]:
        """As `LikelihoodLibrary.adjoint`."""
        assert self._library is not None
        return self._library.adjoint(self._record(weights, one), mask.astype(np.float64))

    def adjoint(
        self, weights: Weights, data: list[Data], chosen: list[Mask]
    ) -> tuple[float, dict[str, Array], Array]:
        """The value, and its derivatives by the covariances and the parameters among the inputs."""
        system, n, p = self._system, self._system.n, self._system.p
        prior, entering, noise = np.zeros((n, n)), np.zeros((n, n)), np.zeros((p, p))
        total, behind = 0.0, np.zeros(len(weights.parameters))
        of_record = self._adjoint_in_casadi if self._library is None else self._adjoint_in_c
        for one, mask in zip(data, chosen, strict=True):
            value, *by, by_u = of_record(weights, one, mask)
            total += value
            if not np.isfinite(total):
                break
            for sum_, part in zip((prior, entering, noise), by, strict=True):
                sum_ += part
            if behind.size and system.m > one.u.shape[1]:
                behind += by_u[one.u.shape[1] :]
        matrix = system.disturbance_matrix
        by_w = entering if matrix is None else matrix.T @ entering @ matrix
        return total, {"prior": prior, "disturbance": by_w, "noise": noise}, behind

    # In NumPy, several settings at once

    def _run_together(self, settings: list[Weights], one: Data) -> Array:
        bank = FilterBank(self._system, one.dt, loss=self._loss)
        hypotheses = []
        for each in settings:
            prior, entering, noise = self._covariances(each)
            u = one.inputs(self._system, each.parameters)
            hypotheses.append(Hypothesis(one.y, u, noise, entering, one.start, prior))
        with np.errstate(all="ignore"):
            logs = bank.run(hypotheses).logs
        if bank.error is not None:
            raise bank.error
        # They are in units of the first noise.
        return one.observed @ (0.5 * np.log(settings[0].noise.diagonal()))[:, None] - logs

    def _loss(self, white: Array) -> tuple[Array, Array]:
        """Half the squares of rows, or the robust cost of components; and the rows clipped."""
        k = self._threshold
        if k is None:
            return 0.5 * (white * white).sum(axis=-1), white
        size = np.abs(white)
        beyond = k * k * (0.5 + np.log(np.maximum(size, k) / k))
        costs = np.where(size <= k, 0.5 * size * size, beyond).sum(axis=-1)
        return costs / _clipped_variance(k), np.clip(white, -k, k)


def _clipped_variance(k: float) -> float:
    """The mean of min(s^2, k^2) of a standard normal s."""
    beyond = math.erfc(k / math.sqrt(2.0))
    density = math.exp(-0.5 * k * k) / math.sqrt(2.0 * math.pi)
    return 1.0 - beyond - 2.0 * k * density + k * k * beyond


def _scales(covariance: Array) -> Array:
    deviations = np.sqrt(covariance.diagonal())
    return np.multiply.outer(deviations, deviations)


def _bounds(system: System) -> tuple[Array, Array]:
    """The bounds of X on components that are no angles."""
    low, high = np.full(system.n, -np.inf), np.full(system.n, np.inf)
    if system.states is not None:
        low, high = system.states.lower.copy(), system.states.upper.copy()
    if system.state_residual is not None:
        components = np.asarray(system.state_residual.components)
        low[components], high[components] = -np.inf, np.inf
    return low, high


def _symbolic_step(
    model: Any, periods: Array, clip: tuple[Array, Array], threshold: float | None
) -> Any:
    """One step: (z, P, y, u, dt, observed, Q, R) to z and P after it, and cost."""
    ca = import_casadi()
    n, p, m = model.n, model.p, model.m
    z, P = ca.SX.sym("z", n), ca.SX.sym("P", n, n)
    y, u, dt, there = (ca.SX.sym(name, d) for name, d in (("y", p), ("u", m), ("dt", 1), ("k", p)))
    Q, R = ca.SX.sym("Q", n, n), ca.SX.sym("R", p, p)
    following, output = model.step()(z, u, dt), model.h(z, u)
    A, C = ca.jacobian(following, z), ca.mtimes(ca.diag(there), ca.jacobian(output, z))
    e = y - output
    for i in np.flatnonzero(periods).tolist():
        e[i] -= periods[i] * ca.floor(e[i] / periods[i] + 0.5)
    # An output that is missing has the innovation 0 and the variance 1.
    e = ca.if_else(there > 0.0, e, 0.0)
    r = R * ca.mtimes(there, there.T) + ca.diag(1.0 - there)
    S = ca.mtimes([C, P, C.T]) + r
    cross = ca.mtimes([C, P, A.T])
    L = ca.SX(p, p)
    white, W = ca.SX(p, 1), ca.SX(p, n)
    for i in range(p):
        for j in range(i + 1):
            rest = S[i, j] - sum((L[i, k] * L[j, k] for k in range(j)), ca.SX(0))
            L[i, j] = ca.sqrt(rest) if i == j else rest / L[j, j]
        white[i] = (e[i] - sum((L[i, k] * white[k] for k in range(i)), ca.SX(0))) / L[i, i]
        W[i, :] = (cross[i, :] - sum((L[i, k] * W[k, :] for k in range(i)), ca.SX(1, n))) / L[i, i]
    used, size = white, ca.fabs(white)
    losses = 0.5 * white * white
    if threshold is not None:
        used = ca.fmax(ca.fmin(white, threshold), -threshold)
        beyond = threshold**2 * (0.5 + ca.log(ca.fmax(size, threshold) / threshold))
        losses = ca.if_else(size <= threshold, losses, beyond) / _clipped_variance(threshold)
    gain = ca.SX(p, n)  # transposed
    for i in reversed(range(p)):
        rest = W[i, :] - sum((L[k, i] * gain[k, :] for k in range(i + 1, p)), ca.SX(1, n))
        gain[i, :] = rest / L[i, i]
    moved = following + ca.mtimes(W.T, used)
    for bounds, nearest in zip(clip, (ca.fmax, ca.fmin), strict=True):
        for i in np.flatnonzero(np.isfinite(bounds)).tolist():
            moved[i] = nearest(moved[i], bounds[i])
    closed = A - ca.mtimes(gain.T, C)
    covariance = ca.mtimes([closed, P, closed.T]) + ca.mtimes([gain.T, r, gain]) + Q
    cost = ca.sum1(losses) + ca.sum1(ca.log(ca.diag(L)))
    found = (moved, 0.5 * (covariance + covariance.T), cost)
    return ca.Function("step", [z, P, y, u, dt, there, Q, R], [ca.densify(one) for one in found])
