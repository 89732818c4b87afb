"""Compiled code compared with CasADi's interpreter, before it is used.

A compiler's mistake changes numbers without any sign. What the interpreter itself computes from
arguments that differ in their last digits shows how far rounding alone can go.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost, QuadraticCost, RobustCost
from ..estimation.estimate import Status
from ..estimation.limits import LARGEST
from ..model.evaluation import Buffers, fixed_call
from ..model.expressions import CasadiModel, import_casadi
from ..model.residuals import difference
from ..model.sets import ConvexSet
from ..model.system import System
from ..observers import Sample

if TYPE_CHECKING:
    from .library import EstimatorLibrary

Array = NDArray[np.float64]

# A difference by this share of what a result is made of is rounding.
ROUNDING = 1e-9
# Relative change of the arguments that shows how rounding spreads, and its weight.
_NUDGE, _WEIGHT = 1e-11, 300.0
# States at once: vectorised loops treat remainders in code of their own.
_COUNTS = (1, 2, 3, 4, 5, 8, 11)
# Magnitude of the points, and the least share of it: positive ones first, where most models
# are defined.
_SCALES = (
    (1.0, 0.2), (1.0, -1.0), (10.0, 0.2), (0.1, 0.2), (10.0, -1.0), (100.0, 0.2), (0.01, 0.2),
    (1e3, 0.2), (1e-3, -1.0), (1e5, 0.2), (1e-5, 0.2),
)
_ALL = ("f", "h", "f_jacobian", "h_jacobian")
# Samples that a compiled estimator is tried on, and how many of them by which function.
_SAMPLES, _BY_RUN, _BY_MEMBERS = 22, 7, 2
_MANY_STATES, _FEW_SAMPLES = 40, 12


class Interpreter:
    """A model by CasADi's virtual machine; NaN where it breaks off."""

    def __init__(self, model: CasadiModel) -> None:
        ca, self.model = import_casadi(), model
        n, p, step = model.n, model.p, model.step()
        kind = ca.SX if step.is_a("SXFunction") and model.h.is_a("SXFunction") else ca.MX
        x, u, dt = kind.sym("x", n), kind.sym("u", model.m), kind.sym("dt")
        f, h = step(x, u, dt), model.h(x, u)
        # Transposed: CasADi stores by columns, NumPy by rows.
        values = {
            "f": (f, (n,)), "h": (h, (p,)), "f_jacobian": (ca.jacobian(f, x).T, (n, n)),
            "h_jacobian": (ca.jacobian(h, x).T, (p, n)),
        }
        self._at = np.zeros(n), np.zeros(max(model.m, 1)), np.zeros(1)
        self._calls: dict[str, tuple[Callable[[], bool], Array]] = {}
        for name, (value, shape) in values.items():
            function, result = ca.Function(name, [x, u, dt], [ca.densify(value)]), np.zeros(shape)
            self._calls[name] = fixed_call(function, self._at, (result,)), result
        # Relative changes without a pattern: equal ones would leave differences as they are.
        self._nudge = 1 + _NUDGE * np.random.default_rng(0).uniform(-1.0, 1.0, n)

    def value(self, name: str, x: Array, u: Array, dt: float) -> Array:
        """The map f, h or the Jacobian of either, at one state; good until the next call."""
        at, inputs, step = self._at
        at[:], inputs[: u.size], step[0] = x, u, dt
        call, result = self._calls[name]
        if not call():
            result[...] = np.nan
        return result

    def stages(self, xs: Array, us: Array, steps: Array, jacobians: bool) -> dict[str, Array]:
        """All at many states, and under ``spread_f`` etc. how far rounding may spread."""
        found = {}
        for name in _ALL if jacobians else _ALL[:2]:
            middle, other = (
                np.array([
                    self.value(name, *one).copy() for one in zip(states, us, steps, strict=True)
                ]).reshape(len(xs), *self._calls[name][1].shape)
                for states in (xs, xs * self._nudge)
            )
            found[name] = middle
            found[f"spread_{name}"] = _WEIGHT * np.nan_to_num(abs(other - middle), posinf=0.0)
        return found


# States, inputs, lengths of steps, and what the interpreter makes of them.
Batch = tuple[Array, Array, Array, dict[str, Array]]


def points(interpreter: Interpreter, states: ConvexSet | None, seed: int) -> Iterator[Batch]:
    """Batches of states within bounds, inputs and steps, with all functions' values.

    Each has one magnitude. Where the model is not finite, other magnitudes are tried.
    """
    model, generator = interpreter.model, np.random.default_rng(seed)
    last = 0
    for batch, count in enumerate(_COUNTS):
        best: Batch | None = None
        most = -1
        for trial in range(len(_SCALES)):
            last = (last + (trial > 0)) % len(_SCALES)
            scale, least = _SCALES[last]
            xs = scale * generator.uniform(least, 1.0, (count, model.n))
            if states is not None:
                low, high = states.lower, states.upper
                both = np.isfinite(low) & np.isfinite(high)
                share = generator.uniform(0.2, 0.8, xs.shape)
                xs = np.where(both, low + share * (high - low), np.clip(xs, low, high))
            us = generator.uniform(least, 1.0, (count, model.m))
            steps = np.full(count, model.dt or 0.0)
            if batch % 2:
                steps *= generator.uniform(0.3, 1.0, count)
            found = interpreter.stages(xs, us, steps, True)
            finite = int(sum(
                np.isfinite(value).reshape(count, -1).all(axis=1).sum() for value in found.values()
            ))
            if finite > most:
                best, most = (xs, us, steps, found), finite
            if finite == count * len(found):
                break
        assert best is not None
        yield best
        last = (last + 1) % 5  # of the usual magnitudes


def differs(got: Array, true: Array, allowed: Array) -> bool:
    """Whether numbers differ by more than allowed, or are finite where others are not."""
    finite = np.isfinite(true)
    if (np.isfinite(got) != finite).any():
        return True
    return bool((abs(got - true)[finite] > allowed[finite]).any())


def _allowed(name: str, xs: Array, found: dict[str, Array]) -> Array:
    """By how much a result may differ: components are compared with their own magnitude."""
    true = found[name]
    size = np.where(np.isfinite(true), abs(true), 0.0).max(axis=0)
    if name == "f":
        size = np.maximum(size, abs(xs).max(axis=0))
    elif name.endswith("jacobian"):
        # An entry may vanish by cancellation.
        size = np.broadcast_to(size.max(axis=1, keepdims=True), size.shape).copy()
        if name == "f_jacobian":
            np.fill_diagonal(size, np.maximum(np.diag(size), 1.0))
    allowed: Array = ROUNDING * size + found[f"spread_{name}"]
    return allowed


def model_fault(
    interpreter: Interpreter, maker: Callable[[bool, int, tuple[str, ...]], Buffers],
    batches: Sequence[Batch],
) -> str:
    """Where a model's machine code differs from the interpreter; empty where it does not."""
    for xs, us, steps, found in batches:
        count = len(xs)
        usual = interpreter.model.dt
        timed = usual is not None and bool((steps != usual).any())
        given = np.column_stack((us, steps)) if timed else us
        calls: list[tuple[str, ...]] = [(name,) for name in _ALL]
        if count == 1:  # all at once are asked of single states only
            calls.append(_ALL)
        for names in calls:
            at, inputs, results, evaluate = maker(timed, count, names)
            at[...], inputs[...] = xs, given
            evaluate()
            for name in names:
                got, true = results[name].reshape(found[name].shape), found[name]
                allowed = _allowed(name, xs, found)
                if name.endswith("jacobian"):
                    # Of a Jacobian that is not finite, some entries depend on the order.
                    whole = np.isfinite(true).all(axis=(1, 2))
                    got, true, allowed = got[whole], true[whole], allowed[whole]
                if differs(got, true, allowed):
                    return f"{name} of {count} states at once differs from CasADi's interpreter"
        fault = _residual_fault(maker, timed, xs, given, found)
        if fault:
            return fault
    return ""


def _residual_fault(
    maker: Callable[[bool, int, tuple[str, ...]], Buffers], timed: bool, xs: Array,
    given: Array, found: dict[str, Array],
) -> str:
    count, n = xs.shape
    trajectory = np.vstack((xs, xs[:1]))
    at, inputs, results, evaluate = maker(timed, count, ("residuals",))
    ys = found["h"] * np.linspace(0.5, 2.0, found["h"].size).reshape(found["h"].shape)
    at[...], inputs[...], results["y"][...] = trajectory, given, ys
    evaluate()
    for name, part, target in (("f", slice(None, n), trajectory[1:]), ("h", slice(n, None), ys)):
        size = np.where(np.isfinite(target), abs(target), 0.0)
        if differs(
            results["residuals"][:, part], target - found[name],
            _allowed(name, xs, found) + ROUNDING * size,
        ):
            return f"the residuals of {count} stages differ from those of CasADi's interpreter"
    return ""


def estimator_fault(
    interpreter: Interpreter, library: EstimatorLibrary, system: System, cost: Cost
) -> str:
    """Where a compiled estimator differs from the interpreter; empty where it does not.

    Short records are run through all of its functions. Costs, residuals and the candidate's
    dynamics are recomputed from the trajectories that come out.
    """
    given, other = library.settings.copy(), library.settings.copy()
    given["max_qps"], other["max_qps"] = np.clip(given["max_qps"], 1, 3), 2
    # The candidate's dynamics are recomputed without a projection.
    given["project"] = other["project"] = 0
    other["discount"] = 1.0 if given["discount"] < 1.0 else 0.95
    other["start_at_best"] = not given["start_at_best"]
    other["reinitialize"] = not given["reinitialize"]
    if library.layout.clock:
        given["time_budget"] = other["time_budget"] = 0.0
    return (
        _Rehearsal(interpreter, library, system, cost, given, False).fault()
        or _Rehearsal(interpreter, library, system, cost, other, True).fault()
    )


def _with_settings(
    cost: Cost, settings: NDArray[Any], n: int, p: int, prior: Array | None = None
) -> Cost:
    """A cost with the weights and the discount of a library's settings, and a prior's weight."""
    terms: dict[str, Any] = {
        name: settings[f"{name}_weight"].reshape(size, size)
        for name, size in (("prior", n), ("disturbance", n), ("noise", p))
    }
    if prior is not None:
        terms["prior"] = prior
    discount = float(settings["discount"])
    if not isinstance(cost, RobustCost):
        return QuadraticCost(**terms, discount=discount)
    for name, weight in terms.items():
        terms[name] = copy(getattr(cost, f"{name}_loss"))
        terms[name].weight = weight
    return RobustCost(**terms, discount=discount)


class _Rehearsal:
    """One record run through a compiled estimator.

    Only trials that are accepted can be seen. Of a wild record nearly all are: measurements
    far from what the candidate predicts, with weights on all else that let trials follow them.
    """

    def __init__(
        self, interpreter: Interpreter, library: EstimatorLibrary, system: System, cost: Cost,
        settings: NDArray[Any], is_wild: bool,
    ) -> None:
        n, p = interpreter.model.n, interpreter.model.p
        self._interpreter, self._library, self._settings = interpreter, library, settings
        self._system = system
        self._generator = np.random.default_rng(int(is_wild))
        first, _, _, values = next(points(interpreter, None, int(is_wild)))
        state, output = first[0], values["h"][0]
        noise = settings["noise_weight"].reshape(p, p)
        if is_wild:
            names = ("prior_weight", "disturbance_weight")
            for name in names[int(library.layout.observer_prior) :]:
                small = 1e-2 * output @ noise @ output
                share = small / (state @ settings[name].reshape(n, n) @ state)
                if 1e-100 < share < 1e100:
                    settings[name] *= share
        self._gain = settings["gain"].reshape(n, p)
        self._given_cost = cost
        self._cost = _with_settings(
            cost, settings, n, p, np.eye(n) if library.layout.observer_prior else None
        )
        self._own_noise, self._own_disturbance = 2.0 * noise, 0.5 * self._cost.disturbance
        self._start = state * (1 + 0.1 * self._generator.uniform(-1.0, 1.0, n))
        most = _SAMPLES if n <= _MANY_STATES else _FEW_SAMPLES
        self._make_record(state, min(library.layout.horizon + _BY_RUN + _BY_MEMBERS, most), is_wild)

    def _make_record(self, first: Array, count: int, is_wild: bool) -> None:
        """Measurements, inputs, steps and weights along noisy states that stay near the first."""
        interpreter, model, generator = self._interpreter, self._interpreter.model, self._generator
        n, p = model.n, model.p
        x = first
        self._us = generator.uniform(0.2, 1.0, (count, model.m))
        self._steps = np.full(count, model.dt or 0.0)
        self._ys, self._weights = np.zeros((count, p)), np.zeros((count, n + p, n + p))
        self._own: list[tuple[Array | None, Array | None]] = [(None, None)] * count
        for t in range(count):
            y, special = self._ys[t], t >= _BY_RUN + _BY_MEMBERS and t % 6 == 0
            if special:
                self._steps[t] *= 0.75
            y[:] = interpreter.value("h", x, self._us[t], 0.0) * (
                generator.uniform(-2.0, 2.0, p) if is_wild
                else 1 + 0.1 * generator.standard_normal(p)
            )
            y[~(abs(y) < LARGEST)] = np.nan
            if t % 5 == 3:
                y[t % p] = np.nan
            if t % 11 == 7:
                y[:] = np.nan
            own = (self._own_noise, self._own_disturbance) if special else (None, None)
            self._own[t] = own
            self._weights[t] = self._cost.partial_weight(np.isfinite(y), *own)
            x = interpreter.value("f", x, self._us[t], self._steps[t])
            x = x * (1 + 0.05 * generator.standard_normal(n))
            if not abs(x).max() <= 1e3 * abs(first).max():  # NaN, too
                x = first

    def fault(self) -> str:
        """What is wrong; empty if nothing is."""
        library, usual = self._library, self._interpreter.model.dt or 0.0
        memory, workspace = library.estimators(self._start[None]), library.workspace()
        before, out = np.empty_like(memory), np.zeros(1, library.estimate_type)
        sample = np.zeros(1, library.sample_type)
        library.reset(memory.ctypes.data, self._settings.ctypes.data, self._start.ctypes.data)
        count = min(_BY_RUN, len(self._ys))
        log = library.log((count,))
        library.run(
            memory.ctypes.data, 1, workspace.ctypes.data, count, self._ys.ctypes.data,
            self._us.ctypes.data if self._us.size else None, log.pointers(0),
        )
        record, last = memory[0], count - 1
        stages = self._window(record)
        fault = self._step_fault(
            last, record, np.vstack((stages["z"], record["z_end"])),
            record["trajectory"][: len(stages) + 1], log.costs[last], log.candidate_costs[last],
            Status(int(log.flags[last])),
        )
        for t in range(count, len(self._ys)):
            if fault:
                return fault
            y, u = self._ys[t].ctypes.data, self._us[t].ctypes.data
            if t < _BY_RUN + _BY_MEMBERS:
                library.update_members(
                    memory.ctypes.data, 1, workspace.ctypes.data, y, u, out.ctypes.data
                )
            else:
                sample["y"], sample["u"] = y, u
                sample["step"] = 0.0 if self._steps[t] == usual else self._steps[t]
                sample["noise_weight"] = 0 if t % 6 else self._own_noise.ctypes.data
                sample["disturbance_weight"] = 0 if t % 6 else self._own_disturbance.ctypes.data
                library.update(*(
                    ctypes.c_void_p(one.ctypes.data)
                    for one in (memory, before, workspace, sample, out)
                ))
            if t > count + 4 and t % 3:
                continue
            found = out[0]
            length = int(found["length"])
            fault = self._step_fault(
                t, record, found["candidate"][: length + 1],
                found["trajectory"][: length + 1], found["cost"], found["candidate_cost"],
                Status(int(found["status"])),
                np.hstack((found["disturbances"][:length], found["noises"][:length])),
            )
        return fault

    def _window(self, record: Any) -> Any:
        at = record["first"] + np.arange(int(record["length"]))
        return record["stages"][at % self._library.layout.horizon]

    def _step_fault(
        self, t: int, record: Any, candidate: Array, trajectory: Array, cost: float,
        candidate_cost: float, status: Status, residuals: Array | None = None,
    ) -> str:
        reference = self._judged(t, record, candidate, True)
        best = self._judged(t, record, trajectory, False)
        for name, told, one in (
            ("the estimate", cost, best), ("the candidate", candidate_cost, reference)
        ):
            # NaN and infinity are the same: not a cost.
            if np.isfinite(one.cost):
                # C takes for infinite what has no finite square.
                if np.isinf(told) and not one.has_squares:
                    continue
                if not abs(told - one.cost) <= one.allowed_cost:
                    return f"J of {name} is {told:.6g}, by CasADi's interpreter {one.cost:.6g}"
            elif np.isfinite(told) and not (one is best and (best.xs == reference.xs).all()):
                return f"J of {name} is {told:.6g}, but CasADi's interpreter has no number"
        if np.isfinite(candidate_cost) and not cost <= candidate_cost:
            return f"J of the estimate, {cost:.6g}, is above the candidate's {candidate_cost:.6g}"
        if reference.moved():
            return "the candidate does not follow f + K v of CasADi's interpreter"
        # The candidate's disturbances are L, which is known itself.
        own = best if Status.IMPROVED in status else reference
        if residuals is not None and own.has_squares:
            seen = own.observed
            if differs(residuals[seen], own.residuals[seen], own.allowed[seen]):
                return "the residuals differ from those of CasADi's interpreter"
        if (
            Status.MODEL_FAILED in status and reference.has_squares and best.has_squares
            and self._is_sound(t, candidate, trajectory)
        ):
            return "it says that the model failed where CasADi's interpreter does not"
        return ""

    def _along(self, t: int, xs: Array, jacobians: bool) -> tuple[slice, dict[str, Array]]:
        """The samples of a trajectory that ends at t + 1, and the model's values along it."""
        at = slice(t + 2 - len(xs), t + 1)
        return at, self._interpreter.stages(xs[:-1], self._us[at], self._steps[at], jacobians)

    def _is_sound(self, t: int, *trajectories: Array) -> bool:
        """Whether all values and Jacobians have finite squares, as C asks."""
        return all(
            np.isfinite((one**2).sum())
            for xs in trajectories for one in self._along(t, xs, True)[1].values()
        )

    def _judged(self, t: int, record: Any, xs: Array, is_candidate: bool) -> _Judged:
        at, found = self._along(t, xs, False)
        stages = self._window(record)
        prior = record["smoothed"] if record["has_smoothed"] else stages["z"][0]
        gains, cost = np.broadcast_to(self._gain, (len(stages), *self._gain.shape)), self._cost
        if is_candidate and self._library.layout.observer:
            gains = self._gains(t, stages, xs)
        if self._library.layout.observer_prior:
            weight, _ = self._library.prior_weights(stages["covariance"][0])
            cost = _with_settings(
                self._given_cost, self._settings, xs.shape[1], self._ys.shape[1], weight
            )
        return _Judged(
            xs, found, self._ys[at], self._weights[at], gains, self._system, cost, prior,
            is_candidate,
        )

    def _gains(self, t: int, stages: Any, xs: Array) -> Array:
        """The gains (K, n, p) of the observer at each stage, by Python."""
        at, found = self._along(t, xs, True)
        p, library = self._ys.shape[1], self._library
        gains = np.zeros((len(stages), xs.shape[1], p))
        for k, (u, step, y, own) in enumerate(zip(
            self._us[at], self._steps[at], self._ys[at], self._own[at], strict=True
        )):
            timed = step != (library.system.dt or 0.0)
            sample = Sample(
                library.system.timed if timed else library.system,
                np.append(u, step) if timed else u,
                found["f_jacobian"][k], found["h_jacobian"][k],
                None if np.isfinite(y).all() else np.isfinite(y), own[0],
                disturbance_weight=own[1],
            )
            if library.layout.covariance:
                sample.covariance = stages["covariance"][k]
            v = np.where(np.isfinite(y), y - found["h"][k], 0.0)
            if library.layout.observer == 3:  # a function, as the gain that gives its value
                value, _ = library.observer.correct(xs[k], v, sample)
                gains[k] = np.outer(value, v) / (v @ v or 1.0)
                continue
            try:
                _, posterior = library.observer.correct(xs[k], np.zeros(p), sample)
                if posterior is not None and not np.isfinite(posterior).all():
                    gains[k] = np.nan
                for j in np.flatnonzero(np.isfinite(y)):
                    gains[k, :, j] += library.observer.correct(xs[k], np.eye(p)[j], sample)[0]
            except Exception:  # outside of the model's domain
                gains[k] = np.nan
        return gains


class _Judged:
    """Residuals and J of a trajectory, and how far rounding may move them."""

    def __init__(
        self, xs: Array, found: dict[str, Array], ys: Array, weights: Array, gains: Array,
        system: System, cost: Cost, prior: Array, is_candidate: bool,
    ) -> None:
        n, count, f, h = xs.shape[1], len(ys), found["f"], found["h"]
        self.xs, observed = xs, np.isfinite(ys)
        self.observed = np.hstack((np.ones_like(f, np.bool_), observed))
        self.residuals = np.hstack((xs[1:] - f, ys - h))
        system.wrap(self.residuals, xs[1:], ys)
        offset = difference(system.state_residual, xs[0], prior)
        sizes = np.hstack((abs(xs[1:]) + abs(f), abs(ys) + abs(h)))
        self.allowed = ROUNDING * sizes + np.hstack((found["spread_f"], found["spread_h"]))
        v, allowed_v = (
            np.where(observed, one[:, n:], 0.0) for one in (self.residuals, self.allowed)
        )
        correction = np.einsum("kij,kj->ki", gains, v)
        self._following = f + correction
        allowed_correction = np.einsum("kij,kj->ki", abs(gains), allowed_v + ROUNDING * abs(v))
        self._allowed_following = self.allowed[:, :n] + allowed_correction
        if system.turns is not None:
            self._following = system.turns(self._following)
        if is_candidate:
            self.residuals[:, :n], self.allowed[:, :n] = correction, allowed_correction
            if system.state_residual is not None:
                system.state_residual.wrap(self.residuals[:, :n], self._following)
        # Of a trial, an output that is not finite fails the model, measured or not.
        known = observed if is_candidate else observed | ~np.isfinite(h)
        r = np.hstack((self.residuals[:, :n], np.where(known, self.residuals[:, n:], 0.0)))
        allowed = np.hstack((self.allowed[:, :n], allowed_v))
        age = cost.discount ** np.arange(count, -1, -1.0)
        stages, initial = cost.stage_costs(r, weights), cost.prior_cost(offset, cost.least_prior)
        self.cost = float(age[1:] @ stages + age[0] * initial)
        # |(r + d)' W (r + d) - r' W r| for |d| <= allowed, and the sums' own rounding.
        heavy = abs(weights)
        least, most = (cost.stage_costs(abs(r) + d, heavy) for d in (0.0, allowed))
        if not cost.quadratic:  # a norm that is no square is steep where it is small
            most += cost.stage_costs(allowed, heavy)
        rounding = cost.prior_cost(abs(offset), abs(cost.least_prior))
        self.allowed_cost = float(
            age[1:] @ (most - least + ROUNDING * most) + age[0] * ROUNDING * rounding
        )
        if is_candidate and not np.isfinite(f).all():
            self.cost = np.inf
        # A stage without finite squares fails in C, and the candidate goes on elsewhere.
        self._has_squares = np.isfinite(stages + (f**2 + self._following**2).sum(axis=1))
        self.has_squares = bool(self._has_squares.all() and np.isfinite(initial))

    def moved(self) -> bool:
        """Whether states do not follow f + K v where these are finite."""
        missed = abs(self.xs[1:] - self._following) > self._allowed_following
        return bool(missed[self._has_squares].any())
