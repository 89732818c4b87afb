"""Gauss-Newton terms of the stages of all members."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["Special", "Terms", "weigh"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Members whose stage has a weight of its own, and these weights (s, q, q).
Special = tuple[Index, Array]


class Terms:
    r"""What each stage adds to the QPs, members last; see `qpmhe.estimation.linearization.StageTerms`.

    With the Jacobian G of (f, h), the joint weight W and the residual r = (w, v):
    ``square`` is :math:`G^\top W G`, ``below`` the coupling block :math:`-Q A`, ``own``
    the gradient :math:`-G^\top W r` and ``following`` the next stage's, :math:`Q w`.

    Parameters
    ----------
    stages : int
        How many stages there is room for.
    n, q : int
        Numbers of states, and of states and outputs together.
    members : int
        How many members there is room for.
    """

    def __init__(self, stages: int, n: int, q: int, members: int) -> None:
        self._stages, self._n, self._q = stages, n, q
        self._blocks = [np.zeros(stages * n * n * members) for _ in range(2)]
        self._vectors = [np.zeros(stages * n * members) for _ in range(2)]
        self._work = np.empty(q * n * members)
        self.hold(members)

    def hold(self, members: int) -> None:
        """Take so many members from now on, at most those that there is room for.

        Parameters
        ----------
        members : int
            How many; what was there is lost.
        """
        stages, n = self._stages, self._n
        self.members = members
        size = stages * n * members
        self.square, self.below = (
            flat[: size * n].reshape(stages, n, n, members) for flat in self._blocks
        )
        self.own, self.following = (
            flat[:size].reshape(stages, n, members) for flat in self._vectors
        )
        self._weighted = self._work[: self._q * n * members].reshape(self._q, n, members)

    def arrays(self) -> tuple[Array, ...]:
        """The arrays, each with one entry a slot."""
        return self.square, self.below, self.own, self.following

    def set_stage(
        self, slot: int, weight: Array, special: Special | None, jacobian: Array, weighted: Array
    ) -> None:
        """Compute the terms of one stage.

        Parameters
        ----------
        slot : int
            Where to put them.
        weight : (q, q) array
            W.
        special : Special or None
            Weights of members that have their own.
        jacobian : (q, n, K) array
            G, contiguous.
        weighted : (q, K) array
            W r.
        """
        n, work = self._n, self._weighted
        weigh(weight, special, jacobian, work)
        np.einsum("qak,qbk->abk", jacobian, work, out=self.square[slot])
        np.negative(work[:n], out=self.below[slot])
        own = self.own[slot]
        np.einsum("qk,qak->ak", weighted, jacobian, out=own)
        np.negative(own, out=own)
        self.following[slot] = weighted[:n]

    def take(self, terms: Terms, slots: Sequence[int], members: Index) -> None:
        """Take over the stages of some members of other terms, in the order of the slots.

        Parameters
        ----------
        terms : Terms
            Those of all members.
        slots : sequence of int
            Where the stages are there.
        members : (k,) int array
            Whose.
        """
        self.hold(members.size)
        for i, slot in enumerate(slots):
            for mine, other in zip(self.arrays(), terms.arrays(), strict=True):
                np.take(other[slot], members, axis=-1, out=mine[i])


def weigh(weight: Array, special: Special | None, values: Array, out: Array) -> None:
    """Multiply one stage's values of all members by the weight, or by their own.

    Parameters
    ----------
    weight : (q, q) array
        The weight of those that have no other.
    special : Special or None
        The others.
    values, out : (q, ..., K) array
        Values, and where to put the products; contiguous.
    """
    q = weight.shape[0]
    np.matmul(weight, values.reshape(q, -1), out=out.reshape(q, -1))
    if special is not None:
        members, weights = special
        out[..., members] = np.einsum("sij,j...s->i...s", weights, values[..., members])
