"""The memory of the Python engine: one record of arrays along which the window slides."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .fields import FIELDS, Field, MemorySizes
from .snapshot import check_size, checked_array, mismatch

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Slot(Protocol):
    """A part of the memory whose content only its owner knows; ``state`` is replaced as a whole."""

    state: Any

    def state_dict(self) -> Any:
        """A copy of the state, of arrays, numbers and names."""

    def checked(self, saved: Any) -> Any:
        """The state that `state_dict` saved; raises any exception if it is damaged."""


class MemoryRecord:
    """Samples and what is computed from them: a record of contiguous arrays.

    The arrays are longer than the window, which slides along them; at the end its stages
    move back to the front. Thus every window is a plain slice. Row k of an array belongs to
    stage k, or to the state before it; the window consists of the stages ``start`` to ``end - 1``.
    Each field of `FIELDS` is an attribute of its name: an array with a row for each stage or
    state, or a single value.

    A stage is *special* if its weight is not the usual one, *irregular* if its step length is not,
    and *unusual* if either holds. Its conditions are stored by its time.

    Parameters
    ----------
    sizes : MemorySizes
        Dimensions and features.
    initial_state, covariance : (n,) and (n, n) array
        Where the observer starts; no covariance for an observer without one.
    step : float
        Length of usual steps.
    usual_weight : (n + p, n + p) array or None
        The weight of usual stages; None for a record of what both engines have.
    """

    z: Array
    history: Array
    y: Array
    u: Array
    is_irregular: Flags
    is_observed: Flags
    is_special: Flags
    weight: Array
    cost: Array
    linear: Array
    panel: Array
    gradient: Array
    next_gradient: Array
    time: int  # number of samples pushed: the window ends at x(time)
    watched: tuple[int, int]
    damping: float
    restarted: int
    trajectory: Array | None
    smoothed_prior: Array | None  # in place of z(t-N), with ``arrival="smoothed"``
    trusted: Array | None  # values of held parameters (2, k): of this window, and of the next
    last_good_covariance: Array | None

    def __init__(
        self, sizes: MemorySizes, initial_state: Array, covariance: Array | None, step: float,
        usual_weight: Array | None = None,
    ) -> None:
        self.sizes, self._engine = sizes, "both" if usual_weight is None else "python"
        self.horizon = horizon = sizes.dimensions["N"]
        self.room = room = horizon + max(horizon // 4, 32)
        self._usual_weight, self._step = usual_weight, step
        self.rows: dict[str, Array]
        self.block, self.rows = sizes.arrays(self._engine, room)
        self.covariance: Array | None
        self.rejections: NDArray[np.int64] | None
        self.root: Array | None
        self.is_vague: Flags = np.zeros(room + 1, np.bool_)
        self.memory: Array | None  # of a user's observer
        for name in ("covariance", "rejections", "root", "memory"):
            setattr(self, name, self.rows.get(name))
        for name, array in self.rows.items():
            setattr(self, name, array)
        if usual_weight is not None:
            # Weights of the quadratic form that majorises the cost at the candidate.
            self.majorising_weight: Array = self.rows.get("majorising_weight", self.weight)
        #: Conditions of the samples taken with other than the usual, by time.
        self.own: dict[int, Any] = {}
        #: Parts whose content only their owners know.
        self.slots: dict[str, Slot] = {}
        #: Whether any stage may be unusual; those from ``end`` on never are.
        self.unusual: bool = False
        self.start = self.end = 0
        for field in FIELDS:
            if field.rows == "once" and field.engine == "both":
                setattr(self, field.name, sizes.first_value(field))
        self.last_good = initial_state.copy()
        self.last_good_covariance = None if covariance is None else covariance.copy()
        self._single = tuple(one.name for one in sizes.fields("both", "once"))
        self._undone = ("start", "end", "unusual", *self._single)
        self._values = attrgetter(*self._undone)
        self.z[0] = self.history[0] = initial_state
        if self.covariance is not None:
            self.covariance[0] = covariance
        self._make_usual(0)

    @property
    def length(self) -> int:
        """N_t, the number of stages in the window."""
        return self.end - self.start

    def _make_usual(self, first: int) -> None:
        """Reset the stages from ``first`` on to usual ones."""
        self.is_observed[first:], self.is_irregular[first:] = True, False
        self.u[first:, -1] = self._step
        if self._usual_weight is not None:
            self.is_special[first:], self.weight[first:] = False, self._usual_weight

    def last_good_before(self, before: int) -> tuple[Array, Array | None]:
        """State and covariance of the last stage before this one at which the model worked."""
        for k in range(before - 1, -1, -1):
            if math.isfinite(self.cost[k]):
                return self.z[k], None if self.covariance is None else self.covariance[k]
        return self.last_good, self.last_good_covariance

    def make_room(self) -> None:
        """Move the window to the front if the arrays are full."""
        if self.end < self.room:
            return
        state, covariance = self.last_good_before(self.start)
        good = state.copy(), None if covariance is None else covariance.copy()
        kept = self.copies()
        try:
            self._move_to_front(kept, good)
        except BaseException:  # an interrupt: finish the move, half of it is no window
            self._move_to_front(kept, good)
            raise

    def _move_to_front(self, kept: dict[str, Array], good: tuple[Array, Array | None]) -> None:
        self.last_good, self.last_good_covariance = good
        keep = len(kept["y"])
        self._write(kept, 0)
        if self.unusual:
            self._make_usual(keep)
            self.unusual = bool(self.is_special[:keep].any() or self.is_irregular[:keep].any())
        self.start, self.end = 0, keep

    def copies(self) -> dict[str, Array]:
        """Copies of the window's rows."""
        start, end, room = self.start, self.end, self.room
        return {
            name: array[start : end + len(array) - room].copy()
            for name, array in self.rows.items()
        }

    def _write(self, kept: dict[str, Array], first: int) -> None:
        """Write what `copies` returned to the stages from ``first`` on."""
        for name, array in self.rows.items():
            array[first : first + len(kept[name])] = kept[name]

    def undo_point(self, whole: bool) -> Callable[[], None]:
        """What undoes all changes from now on; those of older stages only if ``whole``.

        It works until the next `make_room`.
        """
        return partial(
            self._restore,
            self._values(self),
            self.own.copy() if self.own else {},
            tuple([slot.state for slot in self.slots.values()]) if self.slots else (),
            self.copies() if whole else None,
            # A step that finds the newest covariance vague begins with writing its root.
            None if self.root is None else (self.is_vague[self.end], self.root[self.end].copy()),
        )

    def _restore(
        self, values: tuple[Any, ...], own: dict[int, Any], states: tuple[Any, ...],
        rows: dict[str, Array] | None, newest: tuple[bool, Array] | None,
    ) -> None:
        """Undo all changes since an undo point, which has saved this."""
        unusual = self.unusual
        for name, value in zip(self._undone, values, strict=True):
            setattr(self, name, value)
        self.own = own
        for slot, state in zip(self.slots.values(), states, strict=True):
            slot.state = state
        if rows is not None:
            self._write(rows, self.start)
        if newest is not None and self.root is not None:
            self.is_vague[self.end], self.root[self.end] = newest
        if unusual:
            self._make_usual(self.end)

    def copy_from(self, other: MemoryRecord) -> None:
        """Take over what both engines have from another record, which is not shared with it."""
        length = other.length
        for field in self.sizes.fields("both", "stage", "state"):
            if field.name in other.rows:
                rows, first = length + (field.rows == "state"), other.start
                self.rows[field.name][:rows] = other.rows[field.name][first : first + rows]
            elif field.rows == "state":  # of no use there: as at the start
                self.rows[field.name][1 : length + 1] = self.rows[field.name][0]
        self.take_single(other)
        self.own, self.start, self.end, self.unusual = other.own, 0, length, True

    def take_single(self, other: MemoryRecord) -> None:
        """Take over the values of which there is one from another record."""
        for name in self._single:
            if name in other._single:
                setattr(self, name, getattr(other, name))
        self.last_good, covariance = other.last_good_before(other.start)
        if covariance is not None:
            self.last_good_covariance = covariance

    def state_dict(self) -> dict[str, Any]:
        """Copies of all data."""
        good = dict(zip(
            ("last_good", "last_good_covariance"), self.last_good_before(self.start), strict=True
        ))
        single = {name: good.get(name, getattr(self, name)) for name in self._single}
        return {
            **self.copies(),
            **{
                name: value.copy() if isinstance(value, np.ndarray) else value
                for name, value in single.items()
            },
            "own": [(time, own.state_dict()) for time, own in self.own.items()],
            **{name: slot.state_dict() for name, slot in self.slots.items()},
        }

    def load_state_dict(
        self, state: dict[str, Any], read: Callable[[dict[str, Any]], Any], *,
        may_be_irregular: bool, is_smoothed: bool, ends_alike: bool,
    ) -> None:
        """Load what `state_dict` of an equal record returned into a new record.

        Steps may be of other lengths, there is a smoothed prior once the window moves on, and the
        last estimate is the end of the trajectory, if the arguments say so. Raises any exception on
        a damaged state; the record is unusable then.
        """
        time = check_size("time", state["time"], lambda found: 0 <= found < 2**62)
        length = min(time, self.horizon)
        for name, what in (
            ("covariance", "observer"), ("root", "observer"), ("rejections", "observer"),
            ("memory", "observer"), ("majorising_weight", "cost"),
        ):
            if (name in self.rows) != (name in state):
                raise mismatch(what)
        for field in self.sizes.fields(self._engine, "stage", "state"):
            array = self.rows[field.name]
            rows = length + len(array) - self.room
            array[:rows] = checked_array(
                field.name, state[field.name], (rows, *array.shape[1:]), array.dtype,
                field.is_finite,
            )
        self._load_single(state, time, length)
        if self.rejections is not None and (self.rejections[: length + 1] < 0).any():
            raise ValueError("a sensor's failures are fewer than none")
        if not (self.cost[:length] >= 0.0).all():
            raise ValueError("a stage's cost is not a number >= 0")
        steps, irregular = self.u[:length, -1], self.is_irregular[:length]
        if (steps[~irregular] != self._step).any() or (irregular.any() and not (
            may_be_irregular and np.isfinite(steps).all() and (steps > 0.0).all()
        )):
            raise ValueError("a step's length is impossible")
        if not isinstance(state["own"], list):
            raise TypeError(f"own is {state['own']!r}")
        for when, own in state["own"]:
            when = check_size("a sample's time", when, lambda t: time - length <= t < time)
            self.own[when] = read(own)
        for name, slot in self.slots.items():
            slot.state = slot.checked(state[name])
        if (self.smoothed_prior is None) == (is_smoothed and time > self.horizon):
            raise ValueError("there must be a smoothed prior once the window has moved on")
        trajectory = self.trajectory if ends_alike else None
        if trajectory is not None and not np.array_equal(trajectory[-1], self.history[length]):
            raise ValueError("history does not end where the trajectory does")
        self.start, self.end, self.time, self.unusual = 0, length, time, True

    def _load_single(self, state: dict[str, Any], time: int, length: int) -> None:
        """Load the fields of which there is one."""
        if (state["trajectory"] is None) != (time == 0):
            raise TypeError("there must be a trajectory if and only if there was a measurement")
        for field in self.sizes.fields("both", "once"):
            setattr(self, field.name, self._checked(field, state[field.name], time, length))

    def _checked(self, field: Field, value: Any, time: int, length: int) -> Any:
        """A single value from a saved state; counts and times are no more than the samples."""
        shape = self.sizes.shape(field)
        if value is None and field.may_be_missing:
            return None
        if field.kind in ("count", "time"):
            found = [
                check_size(field.name, one, lambda size: 0 <= size <= time)
                for one in (value if shape else [value])
            ]
            if len(found) != math.prod(shape):
                raise ValueError(f"{field.name} is {value!r}")
            return tuple(found) if shape else found[0]
        if shape:
            return checked_array(
                field.name, value, (length + 1, *shape[1:]) if field.of_window else shape
            )
        number = float(value)
        if not 0.0 <= number < math.inf:
            raise ValueError(f"{field.name} is {number!r}")
        return number
