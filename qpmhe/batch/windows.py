"""The last N samples of all members, their observers, and what was computed on them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.system import System
from ..observers import Luenberger
from .calls import Calls, MemberFunction
from .terms import Special, Terms

__all__ = ["Windows"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# A measurement beyond this has no finite square: it is as good as missing (see `qpmhe.estimation.window`).
_LARGEST = 1e150

# Every so many samples it is made sure that the model may be called on many states at once.
_CHECK_EVERY = 16


class Windows:
    """The windows of all members, which slide together; see `qpmhe.estimation.window.Window`.

    States and inputs are kept as (stages, members, components), as the model takes them;
    all else has the members last. States, samples and costs slide along arrays longer than
    the window; the terms, which are large, lie in a ring of N stages.

    Parameters
    ----------
    system, observer, cost
        The problem: a constant gain, and a quadratic cost with a constant prior weight.
    horizon : int
        N.
    initial_states : (K, n) array
        z(0).
    linearized : bool
        Whether the terms are wanted at all.

    Attributes
    ----------
    missing, held, flat : (K,) bool array or None
        Of the newest stage: whose measurement lacks a component, whose model failed, and
        whose Jacobians did; None stands for nobody.
    """

    def __init__(
        self,
        system: System,
        observer: Luenberger,
        cost: Cost,
        horizon: int,
        initial_states: Array,
        linearized: bool,
    ) -> None:
        self._n, self._p, q = system.n, system.p, system.n + system.p
        self._gain, self._cost, self._linearized = observer.gain, cost, linearized
        self.horizon, self.calls = horizon, Calls(system)
        members, n = initial_states.shape
        self.members = members
        self._room = room = 2 * horizon
        self._z = np.zeros((room + 1, members, n))
        self._u = np.zeros((room, members, system.m))
        self._y = np.zeros((room, self._p, members))
        self._stage_cost = np.zeros((room, members))
        #: Gauss-Newton terms of stage t, in the slot t modulo N.
        self.terms = Terms(horizon, n, q, members if linearized else 0)
        #: Weights of the stage in each slot that are not the cost's own.
        self.special: list[Special | None] = [None] * horizon
        # z of the last stage at which the model worked.
        self._good = np.empty((members, n))
        self._ahead, self._fitted = np.empty((members, n)), np.empty((self._p, members))
        self._residual, self._weighted = np.empty((q, members)), np.empty((q, members))
        self._jacobian = np.empty((q, n, members))
        self._ages = cost.discount ** np.arange(horizon, -1, -1.0) if cost.discount < 1 else None
        self.missing: Mask | None = None
        self.held: Mask | None = None
        self.flat: Mask | None = None
        self.time = self._start = self._end = 0
        self._good[...] = initial_states
        self.reset(initial_states)

    def reset(self, initial_states: Array) -> None:
        """Forget all samples.

        Parameters
        ----------
        initial_states : (K, n) array
            z(0).
        """
        first, good, counters = self._z[0].copy(), self._good.copy(), self._counters()
        try:
            self._z[0] = self._good[...] = initial_states
            self.time = self._start = self._end = 0
            self.missing = self.held = self.flat = None
        except BaseException:  # an interrupt: whole or not at all
            self._z[0], self._good[...] = first, good
            self.time, self._start, self._end, self.missing, self.held, self.flat = counters
            raise

    def _counters(self) -> tuple[Any, ...]:
        return self.time, self._start, self._end, self.missing, self.held, self.flat

    def mark(self) -> tuple[Any, ...]:
        """What `roll_back` needs, when there is room for a stage."""
        slot = self.time % self.horizon
        terms = [array[slot].copy() for array in self.terms.arrays()]
        return (
            self._counters(), self.special[slot], terms, self._good.copy(), self.calls.apart()
        )

    def roll_back(self, mark: tuple[Any, ...]) -> None:
        """Undo the sample that was pushed since a mark.

        Parameters
        ----------
        mark : tuple
            What `mark` gave.
        """
        counters, special, terms, good, apart = mark
        self.time, self._start, self._end, self.missing, self.held, self.flat = counters
        slot = self.time % self.horizon
        self.special[slot], self._good[...] = special, good
        for array, part in zip(self.terms.arrays(), terms, strict=True):
            array[slot] = part
        self.calls.set_apart(apart)

    def push(self, y: Array, u: Array) -> None:
        """Take a sample of each member in, and advance the observers.

        Parameters
        ----------
        y : (K, p) array
            y(t), not finite where it is missing.
        u : (K, m) array
            u(t).
        """
        k, slot = self._end, self.time % self.horizon
        self._y[k], self._u[k] = y.T, u
        self.special[slot] = None
        self.missing = self.held = self.flat = None
        cost, bad = self._advance(k, slot)
        if bad.any():
            self.held = bad
            self._hold(k, bad)
            cost[bad] = np.inf
            np.copyto(self._good, self._z[k], where=~bad[:, None])
        else:
            self._good[...] = self._z[k]
        self._stage_cost[k] = cost
        if self._linearized:
            self._linearize(k, slot)
        self._end = k + 1
        self.time += 1
        if self._end - self._start > self.horizon:
            self._start += 1

    def make_room(self) -> None:
        """Move the stages to the front where there is no place for another one."""
        if self._end < self._room:
            return
        states = self._z[self._start : self._end + 1].copy()
        try:
            self._move_to_front(states)
        except BaseException:  # an interrupt: of half a move nothing could be told
            self._move_to_front(states)
            raise

    def _move_to_front(self, states: Array) -> None:
        keep = len(states) - 1
        for array in (self._y, self._u, self._stage_cost):
            array[:keep] = array[self._room - keep :]
        self._z[: keep + 1] = states
        self._start, self._end = 0, keep

    def _advance(self, k: int, slot: int) -> tuple[Array, Mask]:
        """Evaluate stage k at z(k) and step the observers; its costs, and where that failed."""
        n, z, u, following = self._n, self._z[k], self._u[k], self._z[k + 1]
        ahead, fitted, residual, weighted = (
            self._ahead, self._fitted, self._residual, self._weighted
        )
        ahead[...] = self._called(self.calls.f, z, u)
        fitted[...] = self._called(self.calls.h, z, u).T
        np.subtract(self._y[k], fitted, out=residual[n:])
        np.matmul(self._gain, residual[n:], out=residual[:n])
        np.add(ahead, residual[:n].T, out=following)
        np.matmul(self._cost.stage_weight, residual, out=weighted)
        cost: Array = np.einsum("qk,qk->k", weighted, residual)
        bad = ~(np.isfinite(cost) & np.isfinite(np.einsum("kn,kn->k", following, following)))
        if bad.any():
            self._without_missing(k, slot, cost, bad)
        return cost, bad

    def _called(self, function: MemberFunction, z: Array, u: Array) -> Array:
        """The values of a function of the model, which now and then prove themselves."""
        value = function.at(z, u)
        if self.time < self.horizon or (self.time + 1) % _CHECK_EVERY == 0:
            # States on both sides of a branch are likeliest among the extremes.
            some = np.unique([*z.argmin(axis=0), *z.argmax(axis=0)])
            value = value.copy()  # a function may return one array every time
            if not function.agrees(z, u, value, some):
                value = function.at(z, u)
        return value

    def _without_missing(self, k: int, slot: int, cost: Array, bad: Mask) -> None:
        """Leave missing components out where they spoilt the stage; those cured are not bad."""
        n = self._n
        members = np.flatnonzero(bad)
        there = np.abs(self._y[k][:, members]) < _LARGEST  # false for NaN, too
        lacking = ~there.all(axis=0)
        if not lacking.any():
            return
        members, there = members[lacking], there[:, lacking]
        self.missing = np.zeros(self.members, np.bool_)
        self.missing[members] = True
        y = np.where(there, self._y[k][:, members], 0.0)  # any number: its weight is zero
        self._y[k][:, members] = y
        error = np.where(there, y - self._fitted[:, members], 0.0)
        patterns, which = np.unique(there, axis=1, return_inverse=True)
        weights = np.array(
            [self._cost.partial_weight(np.ascontiguousarray(one)) for one in patterns.T]
        )[which.ravel()]
        self.special[slot] = members, weights
        residual = np.concatenate((self._gain @ error, error))
        following = self._ahead[members] + residual[:n].T
        weighted = np.einsum("sij,js->is", weights, residual)
        self._residual[:, members], self._weighted[:, members] = residual, weighted
        self._z[k + 1, members] = following
        cost[members] = np.einsum("qs,qs->s", weighted, residual)
        squares = np.einsum("sn,sn->s", following, following)
        bad[members] = ~(np.isfinite(cost[members]) & np.isfinite(squares))

    def _hold(self, k: int, held: Mask) -> None:
        """Fill a stage where the model cannot be evaluated; see `qpmhe.estimation.window.Window`."""
        self._z[k + 1, held] = self._good[held]
        self._residual[:, held] = self._weighted[:, held] = 0.0

    def _linearize(self, k: int, slot: int) -> None:
        n, jacobian, eye = self._n, self._jacobian, np.eye(*self._jacobian.shape[:2])
        z, u = self._z[k], self._u[k]
        if self.held is None:
            jacobian[:n] = self._called(self.calls.f_jacobian, z, u).transpose(1, 2, 0)
            jacobian[n:] = self._called(self.calls.h_jacobian, z, u).transpose(1, 2, 0)
        else:
            members = np.flatnonzero(~self.held)
            z, u = z[members], u[members]
            jacobian[...] = eye[:, :, None]
            if members.size:
                jacobian[:n, :, members] = self.calls.f_jacobian.at(z, u).transpose(1, 2, 0)
                jacobian[n:, :, members] = self.calls.h_jacobian.at(z, u).transpose(1, 2, 0)
        flat = ~np.isfinite(np.einsum("qak,qak->k", jacobian, jacobian))
        if flat.any():
            self.flat = flat
            jacobian[:, :, flat] = eye[:, :, None]
        self.terms.set_stage(
            slot, self._cost.stage_weight, self.special[slot], jacobian, self._weighted
        )

    def restart(self, members: Index, states: Array) -> None:
        """Let the observers of these members go on from other states.

        Parameters
        ----------
        members : (k,) int array
            Whose.
        states : (k, n) array
            Where.
        """
        self._z[self._end, members] = states

    @property
    def length(self) -> int:
        """N_t, the number of stages in the windows."""
        return self._end - self._start

    @property
    def slots(self) -> list[int]:
        """Where the stages of the windows are in the ring, oldest first."""
        return [time % self.horizon for time in range(self.time - self.length, self.time)]

    @property
    def candidate(self) -> Array:
        """Candidate trajectories z(t-N), ..., z(t), (N_t + 1, K, n): a view."""
        return self._z[self._start : self._end + 1]

    @property
    def candidate_cost(self) -> Array:
        """J of the candidates (K,); infinite where a stage was held."""
        costs = self._stage_cost[self._start : self._end]
        discounts = self.discounts
        if discounts is None:
            return np.asarray(np.add.reduce(costs))
        total = np.asarray(discounts[1:] @ costs)
        # A failed stage whose factor has underflowed makes 0 times infinity of it.
        return np.where(np.isnan(total), np.inf, total)

    @property
    def discounts(self) -> Array | None:
        """Factors of the prior, in front, and of the stages' costs; None for ones."""
        return None if self._ages is None else self._ages[self.horizon - self.length :]

    @property
    def inputs(self) -> Array:
        """u, (N_t, K, m): a view."""
        return self._u[self._start : self._end]

    @property
    def measurements(self) -> Array:
        """y, (N_t, p, K), with a number of no weight where it is missing: a view."""
        return self._y[self._start : self._end]
