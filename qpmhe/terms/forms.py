"""How the matrices of a stage are held: whole, or by the entries that may be other than 0."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import QP, band_of
from qpmhe_solvers.sparse_qp import SparseQP

from ..costs import Cost
from ..model.evaluation import Places
from .entries import Entries, StageProducts, StageWeights, is_sparse
from .information import window_information
from .linearization import SparseStageTerms, StageTerms

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Freed(NamedTuple):
    """What a damping's metric needs of stages whose disturbances are free.

    Attributes
    ----------
    spread : callable
        Of a stage and a force (n,) to the force times the disturbances' covariance there.
    information : (n,) array
        The diagonal of what the data say about the first state; NaN where that is lost.
    """

    spread: Callable[[int, Array], Array]
    information: Array


class WholeForm:
    """Matrices as such: [r, -G] (q, 1 + n), weights (q, q), and panels (n, 2n).

    Parameters
    ----------
    n, p : int
        Numbers of states and outputs; q is their sum.

    Attributes
    ----------
    shapes : mapping
        Shapes of the fields of the memory that are others than there.
    places : mapping
        Where entries stand in their matrices, whose shape is made flat; empty of whole ones.
    minus_stand_in : array
        -G where the model has no Jacobians, as `StageTerms.slopes`.
    by_entries : bool
        Whether Jacobians are those of `Model.entries`.
    is_narrow : bool
        Whether the band of a QP is so narrow that the C step, which takes whole blocks, is slower.
    """

    by_entries = False
    is_narrow = False
    shapes: Mapping[str, tuple[int, ...]] = {}
    places: Mapping[str, NDArray[np.intp]] = {}

    def __init__(self, n: int, p: int) -> None:
        self.n, self.p = n, p
        self.minus_stand_in: Array = -np.eye(n + p, n)

    # Arrays

    def terms(self, stages: int, *arrays: Array) -> StageTerms:
        """`StageTerms` with these arrays or its own."""
        return StageTerms(stages, self.n, self.p, *arrays)

    def qp(self, stages: int, rows: int) -> QP:
        """A QP of so many stages, with so many rows each."""
        return QP(stages, self.n, rows)

    def fits(self, noise: Array | None, disturbance: Array | None) -> bool:
        """Whether these weights of a sample, None for usual ones, have this form."""
        return True

    def readable(
        self, rows: Mapping[str, Any], places: Mapping[str, NDArray[np.intp]]
    ) -> Mapping[str, Any]:
        """The rows of a memory with entries in these places: in this form or whole."""
        own = self.places
        if not places or (own and all(np.array_equal(own[name], places[name]) for name in own)):
            return rows
        n, q = self.n, self.n + self.p
        linear, found = np.asarray(rows["linear"]), dict(rows)
        for name, shape in (("linear", (q, n)), ("weight", (q, q)), ("panel", (n, 2 * n))):
            entries = linear[:, q:] if name == "linear" else np.asarray(rows[name])
            whole = np.zeros((len(entries), shape[0] * shape[1]))
            whole[:, places[name]] = entries
            found[name] = whole.reshape(-1, *shape)
        found["linear"] = np.concatenate((linear[:, :q, None], found["linear"]), axis=2)
        return found

    def holds(self, rows: Mapping[str, Any]) -> bool:
        """Whether the rows of a memory, in this form or whole, have this form."""
        return True

    def taken(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """The rows of a memory, in this form or whole, in this form."""
        return dict(rows)

    # Jacobians

    def jacobian(self, which: str, found: Array) -> Array:
        """A Jacobian of f or h as it stands among the slopes."""
        return found

    def whole_slopes(self, slopes: Array) -> Array:
        """Slopes as matrices (..., q, n)."""
        return slopes

    def times_minus_a(self, slopes: Array, states: Array) -> Array:
        """-A x of states (..., n)."""
        found: Array = np.matmul(slopes[..., : self.n, :], states[..., None])[..., 0]
        return found

    def minus_a_transposed(self, slopes: Array, forces: Array) -> Array:
        """-A' f of forces (..., n)."""
        found: Array = np.matmul(forces[..., None, :], slopes[..., : self.n, :])[..., 0, :]
        return found

    def freed(self, slopes: Array, weights: Array, basis: Callable[[], Array]) -> Freed:
        """What is free where the disturbances are, in the directions that ``basis`` makes."""
        n, count, free = self.n, len(slopes), basis()
        weights = np.broadcast_to(weights, (count, *weights.shape[-2:]))
        a, c, q = -slopes[:, :n], slopes[:, n:], weights[:, :n, :n]
        spread, information = np.full((count, n, n), np.nan), np.full(n, np.nan)
        with suppress(np.linalg.LinAlgError):
            eyes = np.broadcast_to(free.T, (count, *free.T.shape))
            spread = free @ np.linalg.solve(free.T @ q @ free, eyes)
            seen = c.transpose(0, 2, 1) @ weights[:, n:, n:] @ c
            information = window_information(a, seen, spread).diagonal()
        return Freed(lambda i, force: np.asarray(spread[i] @ force), information)

    # Weights

    def usual_weight(self, cost: Cost) -> Array:
        """The usual weight of (w, v)."""
        return cost.stage_weight

    def weight(self, cost: Cost, noise: Array | None, disturbance: Array | None) -> Array:
        """The weight of (w, v) at a sample that brings its own; None stands for a usual one."""
        return cost.joint_weight(noise, disturbance)

    def partial_weight(
        self, cost: Cost, observed: Mask, noise: Array | None, disturbance: Array | None
    ) -> Array:
        """See `Cost.partial_weight`."""
        return cost.partial_weight(observed, noise, disturbance)

    def is_single(self, weights: Array) -> bool:
        """Whether these weights are one for all stages."""
        return weights.ndim == 2

    def whole(self, weights: Array) -> Array:
        """Weights as matrices (..., q, q)."""
        return weights

    def disturbance_square(self, weights: Array, disturbances: Array) -> float:
        """The sum of w'Qw of disturbances (K, n), for weights of (w, v)."""
        weighted = self.times(
            np.concatenate((disturbances, np.zeros((len(disturbances), self.p))), axis=1), weights
        )
        return float(np.vdot(disturbances, weighted[:, : self.n]))

    def per_stage(self, factors: Array) -> Array:
        """Numbers of the stages, as factors of weights and panels."""
        return factors[:, None, None]

    def times(self, residuals: Array, weights: Array) -> Array:
        """W r of residuals (K, q)."""
        if weights.ndim == 2:
            weighted: Array = residuals.dot(weights)
            return weighted
        return np.asarray(np.matmul(residuals[:, None, :], weights)[:, 0])

    def diagonal(self, weights: Array) -> Array:
        """The diagonals (..., q) of weights."""
        return np.asarray(np.diagonal(weights, axis1=-2, axis2=-1))

    # Panels

    def band(self, matrix: Array) -> Array:
        """The panel of a symmetric matrix (..., n, n), or of columns (..., 2n, n)."""
        return band_of(matrix)

    def disturbance_band(self, weights: Array) -> Array:
        """The panels of the weights of w among those of (w, v)."""
        return band_of(weights[..., : self.n, : self.n])

    def diagonal_of(self, bands: Array) -> Array:
        """The diagonals (..., n) of panels, a view."""
        found: Array = bands[..., 0]
        return found

    def damping(self, slopes: Array, weights: Array) -> Array:
        """The panels (K + 1, ...) of the sum of |d(i+1) - A d(i)|^2 in the weights of w."""
        n, count = self.n, len(slopes)
        a, q = -slopes[:, :n], np.broadcast_to(weights[..., :n, :n], (count, n, n))
        weighted = q @ a
        columns = np.concatenate((a.transpose(0, 2, 1) @ weighted, -weighted), axis=1)
        band = np.zeros((count + 1, n, 2 * n))
        band[:-1] = band_of(columns)
        band[1:] += band_of(q)
        return band

    def symmetric(self, matrix: Array) -> Any:
        """A constant symmetric matrix (n, n), of which there are products."""
        return matrix

    def matrix(self, symmetric: Any) -> Array:
        """What `symmetric` has made, as a matrix (n, n)."""
        found: Array = symmetric
        return found


class SparseForm(WholeForm):
    """Matrices by their entries in patterns that are known before the first sample.

    Of [r, -G], r and then the entries of -G, by rows. Products are sums of products of entries,
    whose places are found once. Nothing here has a size of n^2, unless a pattern has.

    Parameters
    ----------
    n, p : int
        Numbers of states and outputs.
    products : StageProducts
        The patterns, and what is computed of them.
    """

    by_entries = True

    def __init__(self, n: int, p: int, products: StageProducts) -> None:
        self.n, self.p = n, p
        self._products, self._weights = products, products.weights
        self._pattern, slopes = products.pattern, products.slopes
        self._slopes, self._of_a = slopes, int(slopes.starts[n])
        self.minus_stand_in = -(slopes.rows == slopes.columns).astype(np.float64)
        self.shapes = {
            "linear": (n + p + slopes.size,), "weight": (products.weights.entries.size,),
            "panel": (self._pattern.places.size,),
        }
        of = products.weights.entries
        self.places = {
            "linear": slopes.rows * n + slopes.columns, "weight": of.rows * (n + p) + of.columns,
            "panel": self._pattern.places,
        }

    @classmethod
    def of(cls, places: Places, cost: Cost, stages: int) -> SparseForm | None:
        """The form for these places of [A; C]; None where it is of no use for so many stages."""
        n, p = len(cost.disturbance), len(cost.noise)
        q = n + p
        given = int(np.count_nonzero(cost.disturbance) + np.count_nonzero(cost.noise))
        if not (is_sparse(places[0].size, (q, n)) and is_sparse(given, (q, q))):
            return None
        weights, slopes = StageWeights(cost.disturbance, cost.noise), Entries(*places, q)
        if not is_sparse(weights.entries.size, (q, q)):
            return None
        if StageProducts.work(slopes, weights) > n * q:
            return None
        products = StageProducts(n, slopes, weights, cost.initial_weight(None))
        order = products.pattern.order(stages)
        if order is None or not is_sparse(products.pattern.places.size, (n, 2 * n)):
            return None
        found = cls(n, p, products)
        found.is_narrow = order.width < n
        return found

    # Arrays

    def terms(self, stages: int, *arrays: Array) -> StageTerms:
        """See `WholeForm.terms`."""
        return SparseStageTerms(stages, self._products, *arrays)

    def qp(self, stages: int, rows: int) -> QP:
        """See `WholeForm.qp`; without rows."""
        order = self._pattern.order(stages)
        assert order is not None
        return SparseQP(stages, self._pattern, order)

    def fits(self, noise: Array | None, disturbance: Array | None) -> bool:
        """See `WholeForm.fits`."""
        return self._weights.fit(disturbance, noise)

    def holds(self, rows: Mapping[str, Any]) -> bool:
        """See `WholeForm.holds`."""
        if np.ndim(rows["linear"]) < 3:
            return True
        found = self.taken(rows)
        found["linear"] = found["linear"][:, self.n + self.p :]
        given = {**rows, "linear": np.asarray(rows["linear"])[:, :, 1:]}
        return all(
            np.count_nonzero(found[name]) == np.count_nonzero(given[name]) for name in self.shapes
        )

    def taken(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """See `WholeForm.taken`."""
        if np.ndim(rows["linear"]) < 3:
            return dict(rows)
        linear, weight, panel = (np.asarray(rows[name]) for name in ("linear", "weight", "panel"))
        slopes, weights = self._slopes, self._weights.entries
        entries = linear[:, slopes.rows, 1 + slopes.columns]
        return {
            **rows, "linear": np.concatenate((linear[:, :, 0], entries), axis=1),
            "weight": weight[:, weights.rows, weights.columns],
            "panel": panel.reshape(len(panel), -1)[:, self._pattern.places],
        }

    # Jacobians

    def jacobian(self, which: str, found: Array) -> Array:
        """See `WholeForm.jacobian`."""
        is_f = which == "f"
        part = slice(self._of_a) if is_f else slice(self._of_a, None)
        rows, columns = self._slopes.rows[part], self._slopes.columns[part]
        return found[rows if is_f else rows - self.n, columns]

    def whole_slopes(self, slopes: Array) -> Array:
        """See `WholeForm.whole_slopes`."""
        found = np.zeros((*slopes.shape[:-1], self.n + self.p, self.n))
        found[..., self._slopes.rows, self._slopes.columns] = slopes
        return found

    def times_minus_a(self, slopes: Array, states: Array) -> Array:
        """See `WholeForm.times_minus_a`."""
        return self._products.times_minus_a(slopes, states)

    def minus_a_transposed(self, slopes: Array, forces: Array) -> Array:
        """See `WholeForm.minus_a_transposed`."""
        return self._products.minus_a_transposed(slopes, forces)

    def freed(self, slopes: Array, weights: Array, basis: Callable[[], Array]) -> Freed:
        """See `WholeForm.freed`; all directions are free."""
        information = np.full(self.n, np.nan)
        with suppress(np.linalg.LinAlgError):
            information = self._products.information(slopes, weights)
        return Freed(self._weights.spread(weights), information)

    # Weights

    def usual_weight(self, cost: Cost) -> Array:
        """See `WholeForm.usual_weight`."""
        return self._weights.of(cost.disturbance, cost.noise)

    def weight(self, cost: Cost, noise: Array | None, disturbance: Array | None) -> Array:
        """See `WholeForm.weight`."""
        return self._weights.of(
            cost.disturbance if disturbance is None else disturbance,
            cost.noise if noise is None else noise,
        )

    def partial_weight(
        self, cost: Cost, observed: Mask, noise: Array | None, disturbance: Array | None
    ) -> Array:
        """See `WholeForm.partial_weight`."""
        return self._weights.partial(
            cost.disturbance if disturbance is None else disturbance,
            cost.noise if noise is None else noise, observed,
        )

    def is_single(self, weights: Array) -> bool:
        """See `WholeForm.is_single`."""
        return weights.ndim == 1

    def whole(self, weights: Array) -> Array:
        """See `WholeForm.whole`."""
        q, entries = self.n + self.p, self._weights.entries
        found = np.zeros((*weights.shape[:-1], q, q))
        found[..., entries.rows, entries.columns] = weights
        return found

    def per_stage(self, factors: Array) -> Array:
        """See `WholeForm.per_stage`."""
        return factors[:, None]

    def times(self, residuals: Array, weights: Array) -> Array:
        """See `WholeForm.times`."""
        return self._weights.times(residuals, weights)

    def diagonal(self, weights: Array) -> Array:
        """See `WholeForm.diagonal`."""
        return weights[..., self._weights.diagonal]

    # Panels

    def band(self, matrix: Array) -> Array:
        """See `WholeForm.band`."""
        return self._pattern.of(matrix)

    def disturbance_band(self, weights: Array) -> Array:
        """See `WholeForm.disturbance_band`."""
        return self._products.disturbance_band(weights)

    def diagonal_of(self, bands: Array) -> Array:
        """See `WholeForm.diagonal_of`."""
        return bands[..., : self.n]

    def damping(self, slopes: Array, weights: Array) -> Array:
        """See `WholeForm.damping`."""
        return self._products.damping(slopes, weights)

    def symmetric(self, matrix: Array) -> Any:
        """See `WholeForm.symmetric`."""
        from scipy.sparse import csr_array  # late: few models need it

        return csr_array(matrix)

    def matrix(self, symmetric: Any) -> Array:
        """See `WholeForm.matrix`."""
        found: Array = symmetric.toarray()
        return found
