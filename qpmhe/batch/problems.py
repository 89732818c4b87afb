"""The true cost of trajectories of all members, and its terms around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..costs import QuadraticCost
from .terms import Special, Terms
from .windows import Windows

__all__ = ["Problems"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Problems:
    """P_t of every member, without sets; see `qpmhe.estimation.problem.Problem`.

    Parameters
    ----------
    windows : Windows
        The windows.
    cost : QuadraticCost
        The cost.
    """

    def __init__(self, windows: Windows, cost: QuadraticCost) -> None:
        self._windows, self._weight = windows, cost.stage_weight
        self._prior: Array = np.asarray(cost.prior, np.float64)
        self._n, self._q = cost.n, cost.n + cost.p
        size = windows.horizon * self._q * windows.members
        # Of all members' trials; trials of some come in between and have arrays of their own.
        self._residuals, self._weighted = np.empty(size), np.empty(size)

    def evaluate(self, trajectory: Array, members: Index) -> tuple[Array, Array]:
        """Judge trajectories by the true model.

        Never raises on account of the model.

        Parameters
        ----------
        trajectory : (N_t + 1, k, n) array
            Trajectories of the members, contiguous.
        members : (k,) int array
            Whose they are, in rising order.

        Returns
        -------
        cost : (k,) array
            J; infinite where the model cannot be evaluated.
        weighted : (N_t, n + p, k) array
            Residuals (w, v) along the trajectories, times their weights; of all members, in
            a workspace until the next evaluation of all.
        """
        windows, n = self._windows, self._n
        count, k = trajectory.shape[0] - 1, members.size
        shape = (count, self._q, k)
        if k == windows.members:
            size = count * self._q * k
            residuals = self._residuals[:size].reshape(shape)
            weighted = self._weighted[:size].reshape(shape)
        else:
            residuals, weighted = np.empty(shape), np.empty(shape)
        states, inputs = trajectory[:-1], self._of(windows.inputs, members, 1)
        ahead = windows.calls.f.along(states, inputs)
        np.subtract(trajectory[1:].transpose(0, 2, 1), ahead.transpose(0, 2, 1),
                    out=residuals[:, :n])
        fitted = windows.calls.h.along(states, inputs)
        np.subtract(self._of(windows.measurements, members, 2), fitted.transpose(0, 2, 1),
                    out=residuals[:, n:])
        np.matmul(self._weight, residuals, out=weighted)
        for i, special in enumerate(self.specials(members)):
            if special is not None:
                some, weights = special
                weighted[i][:, some] = np.einsum("sij,js->is", weights, residuals[i][:, some])
        offset = self.offset(trajectory, members)
        cost: Array = np.einsum("kn,kn->k", offset @ self._prior, offset)
        discounts = windows.discounts
        if discounts is None:
            cost += np.einsum("iqk,iqk->k", weighted, residuals)
        else:
            cost *= discounts[0]
            cost += discounts[1:] @ np.einsum("iqk,iqk->ik", weighted, residuals)
        cost[~np.isfinite(cost)] = np.inf
        return cost, weighted

    def offset(self, trajectory: Array, members: Index) -> Array:
        """How far first states are from their priors, (k, n).

        Parameters
        ----------
        trajectory, members
            As for `evaluate`.
        """
        return np.asarray(trajectory[0] - self._of(self._windows.candidate[0], members, 0))

    def prior_gradient(self, trajectory: Array, members: Index) -> Array:
        """Gradient (n, k) of half the prior's term at trajectories.

        Parameters
        ----------
        trajectory, members
            As for `evaluate`.
        """
        discounts = self._windows.discounts
        gradient = self._prior @ self.offset(trajectory, members).T
        return np.asarray(gradient if discounts is None else discounts[0] * gradient)

    def linearize(
        self, trajectory: Array, members: Index, weighted: Array, terms: Terms
    ) -> Mask:
        """Compute the terms around trajectories.

        Parameters
        ----------
        trajectory, members
            As for `evaluate`.
        weighted : (N_t, n + p, k) array
            What `evaluate` gave of them.
        terms : Terms
            Where to put those of the members that have finite Jacobians, stage by stage.

        Returns
        -------
        (k,) bool array
            Which have.
        """
        windows, n = self._windows, self._n
        count = trajectory.shape[0] - 1
        states, inputs = trajectory[:-1], self._of(windows.inputs, members, 1)
        jacobian = np.empty((count, self._q, n, members.size))
        jacobian[:, :n] = windows.calls.f_jacobian.along(states, inputs).transpose(0, 2, 3, 1)
        jacobian[:, n:] = windows.calls.h_jacobian.along(states, inputs).transpose(0, 2, 3, 1)
        finite = np.isfinite(jacobian).all(axis=(0, 1, 2))
        if not finite.all():
            jacobian, weighted = jacobian[..., finite], weighted[..., finite]
            members = members[finite]
        terms.hold(members.size)
        if not members.size:
            return np.asarray(finite)
        for i, special in enumerate(self.specials(members)):
            terms.set_stage(i, self._weight, special, np.ascontiguousarray(jacobian[i]),
                            weighted[i])
        return np.asarray(finite)

    def specials(self, members: Index) -> list[Special | None]:
        """Weights of the window's stages that are not the cost's own, oldest stage first.

        Parameters
        ----------
        members : (k,) int array
            Among whom; the members told of are places in it.
        """
        windows = self._windows
        stages = [windows.special[slot] for slot in windows.slots]
        if members.size == windows.members:
            return stages
        found: list[Special | None] = []
        for special in stages:
            if special is not None:
                some, weights = special
                place = np.minimum(np.searchsorted(members, some), members.size - 1)
                here = members[place] == some
                special = (place[here], weights[here]) if here.any() else None
            found.append(special)
        return found

    def _of(self, values: Array, members: Index, axis: int) -> Array:
        if members.size == self._windows.members:
            return values
        return np.asarray(np.take(values, members, axis=axis))
