"""The conditions of a sample: weights, bounds, sensors and parameters, which may change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import positive_definite, vector
from ..costs import Cost
from ..errors import InvalidInputError, OptionError, SetError, ShapeError
from ..memory.snapshot import checked_array, mismatch
from ..model.sets import ConvexSet
from ..model.system import System
from ..model.system_arguments import checked_set
from .description import SET_NAMES
from .settings import Settings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SIDES = ("lower", "upper", "row_lower", "row_upper")


class Conditions(NamedTuple):
    """The conditions of a sample, or the usual ones; None where nothing differs from usual.

    Attributes
    ----------
    noise_weight, disturbance_weight : array or None
        As in `MovingHorizonEstimator.update`.
    states, disturbances, noises : ConvexSet or None
        X, W and V: the rows of the system's sets with other sides.
    sampled : (p,) bool array or None
        The components of y that were sampled; None for all. The others are not missing.
    parameters : (k,) array or None
        The last inputs, only in the usual conditions; a sample has them among its inputs.
    """

    noise_weight: Array | None = None
    disturbance_weight: Array | None = None
    states: ConvexSet | None = None
    disturbances: ConvexSet | None = None
    noises: ConvexSet | None = None
    sampled: Mask | None = None
    parameters: Array | None = None

    @property
    def has_bounds(self) -> bool:
        """Whether a set has other sides."""
        return not all(one is None for one in (self.states, self.disturbances, self.noises))

    def over(self, usual: Conditions) -> Conditions:
        """These conditions, with the usual ones where these are None."""
        pairs: Any = zip(self, usual, strict=True)
        return Conditions(*(b if a is None else a for a, b in pairs))

    def without(self, others: Conditions) -> Conditions:
        """These conditions, only where the others are None."""
        pairs: Any = zip(self, others, strict=True)
        return Conditions(*(a if b is None else None for a, b in pairs))

    def applied(self, system: System, cost: Cost) -> tuple[System, Cost]:
        """The system with these sets and the cost with these weights, where they are not None."""
        if self.has_bounds:
            sets = {name: getattr(self, name) for name in SET_NAMES}
            system = system.with_sets({n: one for n, one in sets.items() if one is not None})
        if self.noise_weight is not None or self.disturbance_weight is not None:
            cost = cost.with_weights(self.noise_weight, self.disturbance_weight)
        return system, cost

    def state_dict(self) -> dict[str, Any]:
        """Copies of all that is not None, as plain arrays."""
        return {
            name: {side: getattr(value, side).copy() for side in _SIDES}
            if isinstance(value, ConvexSet) else value.copy()
            for name, value in self._asdict().items() if value is not None
        }


USUAL = Conditions()


class ConditionReader:
    """Validates the arguments of a sample.

    Parameters
    ----------
    system, cost : System and Cost
        Those that the estimator was made with.
    """

    def __init__(self, system: System, cost: Cost) -> None:
        self._system, self._cost = system, cost
        # The last set of each kind and what was made of it: the same object for equal sides.
        self._last: dict[str, tuple[tuple[bytes, ...], ConvexSet]] = {}
        self._sensors: dict[Any, tuple[NDArray[np.intp], Conditions | None]] = {}

    def read(
        self, usual: Conditions, *, noise_weight: ArrayLike | None = None,
        disturbance_weight: ArrayLike | None = None,
        bounds: Mapping[str, ConvexSet] | None = None, drop_usual: bool = True,
    ) -> Conditions:
        """Validated weights and bounds; without bounds that are equal to the usual ones."""
        cost, noise, disturbance = self._cost, None, None
        if noise_weight is not None:
            noise = positive_definite("noise_weight", noise_weight, len(cost.noise))
        if disturbance_weight is not None:
            disturbance = positive_definite("disturbance_weight", disturbance_weight, cost.r)
            if cost.disturbance_factor is not None:
                raise OptionError(
                    "disturbance_weight was given, but the cost has a singular covariance of the "
                    "disturbance, which no weight can replace; give the system a "
                    "disturbance_matrix in place of the singular covariance."
                )
        cost.check_weights(noise, disturbance)
        found: dict[str, Any] = {"noise_weight": noise, "disturbance_weight": disturbance}
        if bounds is None:
            return Conditions(**found)
        if not isinstance(bounds, Mapping):
            raise OptionError(
                f"bounds is {shown(bounds)}; expected a dictionary, such as "
                "{'states': qpmhe.Box(lower, upper)}."
            )
        for name in bounds:
            if name not in SET_NAMES:
                raise OptionError(
                    f"bounds has the key {shown(name)}; expected one of "
                    f"{', '.join(map(repr, SET_NAMES))}."
                )
        for name, given in bounds.items():
            before = getattr(usual, name) or self._system.set_of(name)
            one = self._with_sides(name, given, before)
            if not (drop_usual and before is not None and _alike(one, before)):
                found[name] = one
        return Conditions(**found)

    def _with_sides(self, name: str, given: Any, usual: Any) -> ConvexSet:
        """The rows of the system's set with the sides of another."""
        built = self._system.set_of(name)
        if built is None:
            raise OptionError(
                f"bounds has {name!r}, but the system has no set of {name}; create it with "
                f"System(..., {name}=...), as wide as it will ever be, and narrow it here."
            )
        if not isinstance(given, ConvexSet):
            raise SetError(
                f"bounds[{name!r}] is {shown(given)}; expected a qpmhe.Box or a qpmhe.Polytope "
                "(a soft set keeps its penalties). Leave it out for the usual bounds."
            )
        checked_set(f"bounds[{name!r}]", given, built.dimension)
        key = tuple(
            np.ascontiguousarray(getattr(one, side)).tobytes()
            for one, sides in ((given, (*_SIDES, "matrix")), (usual, _SIDES)) for side in sides
        )
        if name in self._last and self._last[name][0] == key:
            found = self._last[name][1]
        else:
            self._check_rows(name, given, built)
            # A set without bounds of components, or without other rows, leaves these as they are.
            bounds = given if given.bounded_components.size or not given.matrix.size else usual
            rows = given if given.matrix.size else usual
            lower, upper = bounds.lower, bounds.upper
            if name == "states" and self._system.turns is not None:
                lower, upper = self._system.turns.sides(lower, upper)
            found = usual.with_sides(lower, upper, rows.row_lower, rows.row_upper)
        self._last[name] = key, found
        return found

    def _check_rows(self, name: str, given: ConvexSet, built: ConvexSet) -> None:
        """Check that only sides differ from those of the system's set."""
        what = f"bounds[{name!r}] is {given!r}"
        new = np.setdiff1d(given.bounded_components, built.bounded_components)
        if new.size:
            raise OptionError(
                f"{what}, which bounds component {int(new[0])}; the system's set of {name} does "
                "not. Bound that component in the system, as wide as it will ever be, and narrow "
                "it here."
            )
        if given.matrix.shape[0] and not np.array_equal(given.matrix, built.matrix):
            raise OptionError(
                f"{what}, whose general inequalities differ from the system's set of {name}; only "
                "their sides may change. Use the same matrix, with its rows in the same order."
            )
        if name == "disturbances" and name not in self._system.soft:
            fixed = np.zeros(built.dimension, np.bool_)
            fixed[built.fixed_components] = True
            same = (given.lower == built.lower) & (given.upper == built.upper)
            changed = np.where(fixed, ~same, given.lower == given.upper)
            if given.bounded_components.size and changed.any():
                j = int(np.argmax(changed))
                raise OptionError(
                    f"{what}, which "
                    + ("frees component" if fixed[j] else "fixes component")
                    + f" {j}; only the system can fix components of the "
                    "disturbance. Create another "
                    "estimator, or leave this component as it is."
                )

    def sensors(self, sensors: Any) -> tuple[NDArray[np.intp], Conditions | None]:
        """Indices of the sensors in the given order, and conditions; None if all are sampled."""
        key: Any = None
        if type(sensors) is list:
            key = *sensors, *map(type, sensors)  # True is 1 otherwise
        elif type(sensors) is np.ndarray:
            key = sensors.tobytes(), sensors.dtype, sensors.shape
        try:
            found = self._sensors.get(key)
        except TypeError:  # a list of what has no hash
            key = found = None
        if found is None:
            index, mask = self._checked_mask(sensors)
            found = index, None if mask.all() else Conditions(sampled=mask)
            if len(self._sensors) >= _MOST_SENSORS:
                self._sensors.clear()
            if key is not None:
                self._sensors[key] = found
        return found

    def _checked_mask(self, sensors: Any) -> tuple[NDArray[np.intp], Mask]:
        p = self._system.p
        try:
            array = np.atleast_1d(np.asarray(sensors))
        except ValueError:  # lists of different lengths
            array = np.empty((0, 0))
        if array.dtype == np.bool_:
            if array.shape != (p,):
                raise ShapeError(
                    f"sensors has shape {array.shape}; expected ({p},), True for each output that "
                    "was sampled, or a list of indices."
                )
            array = np.flatnonzero(array)
        whole = array.dtype.kind in "iu" and array.ndim == 1
        if not (whole and array.size and array.min() >= 0 and array.max() < p):
            raise InvalidInputError(
                f"sensors is {shown(sensors)}; expected indices of outputs from 0 to {p - 1}, at "
                "least one. For a sample without measurements, call update(None)."
            )
        mask = np.zeros(p, np.bool_)
        mask[array] = True
        if mask.sum() != array.size:
            raise InvalidInputError(
                f"sensors is {shown(sensors)}; expected each output at most once. For a second "
                "measurement of one, make it a separate output."
            )
        return array.astype(np.intp), mask

    def parameters(self, given: ArrayLike, usual: Conditions) -> Array:
        """Validated values of the parameters."""
        if usual.parameters is None:
            raise InvalidInputError(
                f"parameters is {shown(given)}, but the estimator has none; give their usual "
                "values at construction: MovingHorizonEstimator(..., parameters=...)."
            )
        return vector("parameters", given, usual.parameters.size)

    def load(self, saved: dict[str, Any], usual: Conditions) -> Conditions:
        """The conditions from `Conditions.state_dict`; raises any exception if damaged."""
        if not isinstance(saved, dict):
            raise TypeError(f"conditions are {saved!r}")
        p, values, found = self._system.p, dict(saved), dict[str, Any]()
        for name in SET_NAMES:
            if name in values:
                built = self._system.set_of(name)
                if built is None:
                    raise mismatch(f"set of {name}")
                given, shapes = values.pop(name), [getattr(built, side).shape for side in _SIDES]
                found[name] = built.with_sides(*(
                    checked_array(name, given[side], shape, finite=False)
                    for side, shape in zip(_SIDES, shapes, strict=True)
                ))
                self._check_rows(name, found[name], built)
        if "sampled" in values:
            found["sampled"] = checked_array("sampled", values.pop("sampled"), (p,), np.bool_)
        if "parameters" in values:
            found["parameters"] = self.parameters(values.pop("parameters"), usual)
        for name, value in values.items():
            checked_array(name, value, np.shape(value))
        return self.read(usual, bounds=None, **values)._replace(**found)


def usual_conditions(settings: Settings) -> Conditions:
    """The usual conditions of a new estimator."""
    if not settings.parameters:
        return USUAL
    return Conditions(parameters=np.array(settings.parameters))


# So many combinations of sensors are remembered.
_MOST_SENSORS = 1000


def _alike(one: ConvexSet, other: ConvexSet) -> bool:
    return all(np.array_equal(getattr(one, side), getattr(other, side)) for side in _SIDES)
