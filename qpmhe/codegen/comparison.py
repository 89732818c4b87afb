"""Compiled code compared with CasADi's interpreter, before it is used.

A compiler's mistake changes numbers without any sign. What the interpreter itself computes from
arguments that differ in their last digits shows how far rounding alone can go.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..estimation.estimate import Status
from ..estimation.limits import LARGEST
from ..model.sets import ConvexSet
from .evaluation import fixed_call
from .expressions import CasadiModel

if TYPE_CHECKING:
    from .library import EstimatorLibrary

__all__ = ["Batch", "Buffers", "Interpreter", "differs", "estimator_fault", "model_fault", "points"]

Array = NDArray[np.float64]
# Fixed arrays for states, inputs and results, and what computes these from those.
Buffers = tuple[Array, Array, dict[str, Array], Callable[[], object]]

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
        self.model, n = model, model.n
        self._x, self._u, self._dt = np.zeros(n), np.zeros(max(model.m, 1)), np.zeros(1)
        self._input = self._u[: model.m]
        values = {"f": np.zeros(n), "h": np.zeros(model.p)}
        self._values = {
            "f": fixed_call(model.step(), (self._x, self._u, self._dt), (values["f"],)),
            "h": fixed_call(model.h, (self._x, self._u), (values["h"],)),
        }
        self._found = values
        self._slopes: dict[str, tuple[Callable[[], bool], Array, Array, Array, Array]] = {}
        for which, value in values.items():
            function, places = model.with_jacobian(which)
            value, nonzeros = np.zeros(len(value)), np.zeros(max(len(places), 1))
            self._slopes[which] = (
                fixed_call(function, (self._x, self._u), (value, nonzeros)), value,
                nonzeros[: len(places)], np.array(places, np.intp), np.zeros((len(value), n)),
            )
        # Relative changes without a pattern: equal ones would leave differences as they are.
        self._nudge = 1 + _NUDGE * np.random.default_rng(0).uniform(-1.0, 1.0, n)

    def _value(self, which: str, x: Array, u: Array, out: Array) -> None:
        self._x[:], self._input[:] = x, u
        out[:] = self._found[which] if self._values[which]() else np.nan

    def _slope(self, which: str, x: Array, u: Array) -> tuple[Array, Array]:
        self._x[:], self._input[:] = x, u
        call, value, nonzeros, places, dense = self._slopes[which]
        if not call():
            return np.full_like(value, np.nan), np.full_like(dense, np.nan)
        dense.reshape(-1)[places] = nonzeros
        return value.copy(), dense.copy()

    def f(self, x: Array, u: Array, dt: float, out: Array) -> None:
        """The discrete-time map at one state."""
        self._dt[0] = dt
        self._value("f", x, u, out)

    def h(self, x: Array, u: Array, out: Array) -> None:
        """The outputs at one state."""
        self._value("h", x, u, out)

    def f_jacobian(self, x: Array, u: Array, dt: float) -> Array:
        """The Jacobian of `f`."""
        method, one = self.model.method, np.eye(self.model.n)
        k, first = self._slope("f", x, u)
        if method is None:
            return first
        if method == "euler":
            return one + dt * first
        slopes = [first]
        for step in (dt / 2, dt / 2, dt):
            k, slope = self._slope("f", x + step * k, u)
            slopes.append(slope @ (one + step * slopes[-1]))
        return one + dt / 6 * (slopes[0] + 2 * (slopes[1] + slopes[2]) + slopes[3])

    def h_jacobian(self, x: Array, u: Array) -> Array:
        """The Jacobian of `h`."""
        return self._slope("h", x, u)[1]

    def stages(self, xs: Array, us: Array, steps: Array, jacobians: bool) -> dict[str, Array]:
        """All at many states, and under ``spread_f`` etc. how far rounding may spread."""
        count, n, p = len(xs), self.model.n, self.model.p
        shapes = {"f": (n,), "h": (p,), "f_jacobian": (n, n), "h_jacobian": (p, n)}
        names = _ALL if jacobians else _ALL[:2]
        near = xs, xs * self._nudge
        values = {name: np.zeros((len(near), count, *shapes[name])) for name in names}
        for i, states in enumerate(near):
            for k, (x, u, dt) in enumerate(zip(states, us, steps, strict=True)):
                self.f(x, u, dt, values["f"][i, k])
                self.h(x, u, values["h"][i, k])
                if jacobians:
                    values["f_jacobian"][i, k] = self.f_jacobian(x, u, dt)
                    values["h_jacobian"][i, k] = self.h_jacobian(x, u)
        found = {name: value[0] for name, value in values.items()}
        for name, (middle, other) in values.items():
            spread = abs(other - middle)
            found[f"spread_{name}"] = _WEIGHT * np.nan_to_num(spread, posinf=0.0)
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
    interpreter: Interpreter, library: EstimatorLibrary, states: ConvexSet | None
) -> str:
    """Where a compiled estimator differs from the interpreter; empty where it does not.

    Short records are run through all of its functions. Costs, residuals and the candidate's
    dynamics are recomputed from the trajectories that come out.
    """
    given, other = library.settings.copy(), library.settings.copy()
    given["max_qps"], other["max_qps"] = np.clip(given["max_qps"], 1, 3), 2
    other["discount"] = 1.0 if given["discount"] < 1.0 else 0.95
    other["start_at_best"] = not given["start_at_best"]
    other["reinitialize"] = not given["reinitialize"]
    for is_wild, settings in ((False, given), (True, other)):
        fault = _Rehearsal(interpreter, library, settings, states, is_wild).fault()
        if fault:
            return fault
    return ""


class _Rehearsal:
    """One record run through a compiled estimator.

    Only trials that are accepted can be seen. Of a wild record nearly all are: measurements
    far from what the candidate predicts, with weights on all else that let trials follow them.
    """

    def __init__(
        self, interpreter: Interpreter, library: EstimatorLibrary, settings: NDArray[Any],
        states: ConvexSet | None, is_wild: bool,
    ) -> None:
        model = interpreter.model
        n, p = model.n, model.p
        generator = np.random.default_rng(int(is_wild))
        first, _, _, values = next(points(interpreter, states, int(is_wild)))
        first, output = first[0], values["h"][0]
        if is_wild:
            for name in ("prior_weight", "disturbance_weight"):
                small = 1e-2 * output @ settings["noise_weight"].reshape(p, p) @ output
                share = small / (first @ settings[name].reshape(n, n) @ first)
                if share > 0 and np.isfinite(share):
                    settings[name] *= share
        self._interpreter, self._library, self._settings = interpreter, library, settings
        self._gain = settings["gain"].reshape(n, p)
        self._prior = settings["prior_weight"].reshape(n, n)
        self._disturbance = settings["disturbance_weight"].reshape(n, n)
        noise = settings["noise_weight"].reshape(p, p)
        most = _SAMPLES if n <= _MANY_STATES else _FEW_SAMPLES
        count = min(library.layout.horizon + _BY_RUN + _BY_MEMBERS, most)
        self._start = _within(states, first * (1 + 0.1 * generator.uniform(-1.0, 1.0, n)))
        x, scale, following = first, abs(first).max(), np.zeros(n)
        self._us = generator.uniform(0.2, 1.0, (count, model.m))
        self._steps = np.full(count, model.dt or 0.0)
        self._ys, self._weights = np.zeros((count, p)), np.zeros((count, p, p))
        for t in range(count):
            special = t >= _BY_RUN + _BY_MEMBERS and t % 6 == 0
            if special:
                self._steps[t] *= 0.75
            interpreter.h(x, self._us[t], self._ys[t])
            self._ys[t] *= (
                generator.uniform(-2.0, 2.0, p) if is_wild
                else 1 + 0.1 * generator.standard_normal(p)
            )
            self._ys[t, ~(abs(self._ys[t]) < LARGEST)] = np.nan
            if t % 5 == 3:
                self._ys[t, t % p] = np.nan
            if t % 11 == 7:
                self._ys[t] = np.nan
            self._weights[t] = _observed_weight(
                2.0 * noise if special else noise, np.isfinite(self._ys[t])
            )
            interpreter.f(x, self._us[t], self._steps[t], following)
            x = following * (1 + 0.05 * generator.standard_normal(n))
            x = _within(states, x)
            if not abs(x).max() <= 1e3 * scale:  # NaN, too
                x = first
        self._own_noise = 2.0 * noise

    def fault(self) -> str:
        """What is wrong; empty if nothing is."""
        library, n = self._library, self._interpreter.model.n
        memory = library.estimators(self._start[None])
        before = np.empty_like(memory)
        workspace, out = library.workspace(), np.zeros(1, library.estimate_type)
        library.reset(memory.ctypes.data, self._settings.ctypes.data, self._start.ctypes.data)
        ys, us = np.ascontiguousarray(self._ys), np.ascontiguousarray(self._us)
        numbers, flags = np.zeros((3 * n + 2, _BY_RUN)), np.zeros((3, _BY_RUN), np.int32)
        log = (ctypes.c_void_p * 8)(
            *(numbers[i * n :].ctypes.data for i in range(3)),
            *(numbers[3 * n + i :].ctypes.data for i in range(2)),
            *(row.ctypes.data for row in flags),
        )
        count = min(_BY_RUN, len(ys))
        library.run(memory.ctypes.data, 1, workspace.ctypes.data, count, ys.ctypes.data,
                    us.ctypes.data if us.size else None, log)
        stages = self._window(memory[0])
        fault = self._step_fault(
            count - 1, memory[0], np.vstack((stages["z"], memory[0]["z_end"])),
            memory[0]["trajectory"][: len(stages) + 1],
            numbers[3 * n, count - 1], numbers[3 * n + 1, count - 1], int(flags[0, count - 1]),
        )
        for t in range(count, len(ys)):
            if fault:
                return fault
            y, u = ys[t : t + 1], us[t : t + 1]
            at = [
                ctypes.c_void_p(one.ctypes.data) for one in (memory, before, workspace, y, u, out)
            ]
            usual = self._steps[t] == (self._interpreter.model.dt or 0.0)
            if t < _BY_RUN + _BY_MEMBERS:
                library.update_members(at[0], 1, *at[2:])
            else:
                weight = None if t % 6 else ctypes.c_void_p(self._own_noise.ctypes.data)
                step = ctypes.c_double(0.0 if usual else self._steps[t])
                library.update(*at[:5], step, weight, at[5])
            if t > count + 4 and t % 3:
                continue
            found = out[0]
            length = int(found["length"])
            fault = self._step_fault(
                t, memory[0], found["candidate"][: length + 1],
                found["trajectory"][: length + 1], found["cost"], found["candidate_cost"],
                int(found["status"]), found["disturbances"][:length], found["noises"][:length],
            )
        return fault

    def _window(self, record: Any) -> Any:
        length = int(record["length"])
        return record["stages"][
            (record["first"] + np.arange(length)) % self._library.layout.horizon
        ]

    def _step_fault(
        self, t: int, record: Any, candidate: Array, trajectory: Array, cost: float,
        candidate_cost: float, status: int, w: Array | None = None, v: Array | None = None,
    ) -> str:
        projected = bool(status & Status.CANDIDATE_OUTSIDE.value)
        prior = self._window(record)["z"][0]
        reference = self._judge(t, candidate, prior, not projected)
        best = self._judge(t, trajectory, prior, False)
        judged = [("the estimate", cost, best)]
        if not (projected and w is None):  # whole records do not say where it was projected to
            judged.append(("the candidate", candidate_cost, reference))
        for name, told, one in judged:
            # NaN and infinity are the same: not a cost.
            if np.isfinite(one.cost):
                # C takes for infinite what has no finite square.
                if np.isinf(told) and not one.has_squares:
                    continue
                if not abs(told - one.cost) <= one.allowed:
                    return f"J of {name} is {told:.6g}, by CasADi's interpreter {one.cost:.6g}"
            elif np.isfinite(told) and not (one is best and best.same(reference)):
                return f"J of {name} is {told:.6g}, but CasADi's interpreter has no number"
        if np.isfinite(candidate_cost) and not cost <= candidate_cost:
            return f"J of the estimate, {cost:.6g}, is above the candidate's {candidate_cost:.6g}"
        if not projected and reference.moved(candidate):
            return "the candidate does not follow f + K v of CasADi's interpreter"
        # The candidate's disturbances are L, which is known itself.
        own = best if projected or status & Status.IMPROVED.value else reference
        if w is not None and v is not None and own.has_squares and (
            differs(w, own.w, own.allowed_w)
            or differs(v[own.observed], own.v[own.observed], own.allowed_v[own.observed])
        ):
            return "the residuals differ from those of CasADi's interpreter"
        if (
            status & Status.MODEL_FAILED.value and not projected and reference.has_squares
            and best.has_squares and self._is_sound(t, candidate, trajectory)
        ):
            return "it says that the model failed where CasADi's interpreter does not"
        return ""

    def _is_sound(self, t: int, *trajectories: Array) -> bool:
        for xs in trajectories:
            window = slice(t + 2 - len(xs), t + 1)
            found = self._interpreter.stages(
                xs[:-1], self._us[window], self._steps[window], True
            )
            # As in C, by the sum of squares.
            if not all(np.isfinite((one**2).sum()) for one in found.values()):
                return False
        return True

    def _judge(self, t: int, xs: Array, prior: Array, is_candidate: bool) -> _Judged:
        window = slice(t + 2 - len(xs), t + 1)
        found = self._interpreter.stages(xs[:-1], self._us[window], self._steps[window], False)
        return _Judged(
            xs, found, self._ys[window], self._weights[window], self._gain, self._disturbance,
            self._prior, prior, float(self._settings["discount"]), is_candidate,
        )


class _Judged:
    """Residuals and J of a trajectory in NumPy, and how far rounding may move them."""

    def __init__(
        self, xs: Array, found: dict[str, Array], ys: Array, weights: Array, gain: Array,
        disturbance: Array, prior_weight: Array, prior: Array, discount: float, is_candidate: bool,
    ) -> None:
        self.xs, self._f, self.observed = xs, found["f"], np.isfinite(ys)
        count = len(ys)
        self._allowed_f = ROUNDING * (abs(xs[1:]) + abs(self._f)) + found["spread_f"]
        self.v = ys - found["h"]
        self.allowed_v = ROUNDING * (abs(ys) + abs(found["h"])) + found["spread_h"]
        self.w, self.allowed_w = xs[1:] - self._f, self._allowed_f
        v, allowed_v = self.v.copy(), self.allowed_v.copy()
        v[~self.observed] = allowed_v[~self.observed] = 0.0
        self._correction = v @ gain.T
        self._allowed_correction = (allowed_v + ROUNDING * abs(v)) @ abs(gain).T
        if is_candidate:
            self.w, self.allowed_w = self._correction, self._allowed_correction
        else:  # an output that is not finite fails the model, measured or not
            v[~np.isfinite(found["h"])] = np.nan
        age = discount ** np.arange(count - 1, -1, -1.0)
        self.cost = self.allowed = 0.0
        squares = (self._f**2).sum(axis=1)
        for rows, allowed, factors, weight in (
            ((xs[0] - prior)[None], np.zeros((1, len(prior))), np.array([discount**count]),
             prior_weight[None]),
            (self.w, self.allowed_w, age, disturbance[None]),
            (v, allowed_v, age, weights),
        ):
            heavy = abs(weight)
            weighted = np.matmul(weight, rows[:, :, None])[:, :, 0]
            each = (rows * weighted).sum(axis=1)
            squares = squares + each
            self.cost += float(factors @ each)
            # |(r + d)' W (r + d) - r' W r| for |d| <= allowed, and the sums' own rounding.
            most = abs(rows) + allowed
            spread = np.matmul(heavy, allowed[:, :, None])[:, :, 0]
            whole = np.matmul(heavy, most[:, :, None])[:, :, 0]
            self.allowed += float(factors @ (
                2 * abs(weighted) * allowed + allowed * spread + ROUNDING * most * whole
            ).sum(axis=1))
        # A stage without these fails in C, and the candidate goes on elsewhere.
        following = self._f + self._correction
        self._has_squares = np.isfinite(squares + (following**2).sum(axis=1))
        self.has_squares = bool(self._has_squares.all())
        if is_candidate and not np.isfinite(self._f).all():
            self.cost = np.inf

    def same(self, other: _Judged) -> bool:
        """Whether this is the other's trajectory."""
        return bool((self.xs == other.xs).all())

    def moved(self, candidate: Array) -> bool:
        """Whether states do not follow f + K v where these are finite."""
        following = self._f + self._correction
        finite = self._has_squares
        allowed = self._allowed_f + self._allowed_correction
        return bool((abs(candidate[1:] - following)[finite] > allowed[finite]).any())


def _within(states: ConvexSet | None, x: Array) -> Array:
    return x if states is None else np.clip(x, states.lower, states.upper)


def _observed_weight(weight: Array, observed: NDArray[np.bool_]) -> Array:
    """The inverse of the covariance's block of what was observed, zero elsewhere."""
    full = np.zeros_like(weight)
    if observed.any():
        inside = np.ix_(observed, observed)
        missing = ~observed
        full[inside] = weight[inside]
        if missing.any():
            across = weight[np.ix_(observed, missing)]
            full[inside] -= across @ np.linalg.solve(weight[np.ix_(missing, missing)], across.T)
    return full
