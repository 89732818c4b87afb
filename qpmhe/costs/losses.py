"""Losses of one residual: a disturbance, a noise or an initial error."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, flag, positive, positive_definite, representation
from ..errors import InvalidInputError, OptionError, WeightError
from .base import LossForm, quadratic_form

# Of central differences of rho'.
_STEP = float(np.finfo(np.float64).eps) ** (1 / 3)


class Loss(ABC):
    r"""An increasing function :math:`\rho(q)` of the form :math:`q = s^\top W s`.

    A loss of your own has `value` and `slope`. The form q has no unit: it counts variances.

    Parameters
    ----------
    weight : (d, d) array_like
        W, the inverse of a covariance, symmetric positive definite.
    per_component : bool
        Apply the function to each component's :math:`W_{jj} s_j^2` and sum, instead of to the whole
        form; requires a diagonal W.

    Raises
    ------
    WeightError, ShapeError
        If the weight is not symmetric positive definite, or not diagonal with ``per_component``.
    """

    def __init__(self, weight: ArrayLike, per_component: bool = False) -> None:
        self.weight = positive_definite("weight", weight)
        self.dimension = self.weight.shape[0]
        self.per_component = flag("per_component", per_component)
        self.check_weight(self.weight)

    def __repr__(self) -> str:
        return representation(self)

    def check_weight(self, weight: Array) -> None:
        """Raise a `WeightError` unless the weight is diagonal, where the loss is per component."""
        if self.per_component and (weight - np.diag(np.diag(weight))).any():
            raise WeightError(
                f"weight is {weight.tolist()}; a loss per component needs a diagonal weight. "
                "Transform the outputs so that their noises are independent."
            )

    #: By which factor the loss is widened while the first window fills; see `Barron`.
    graduation: float = 1.0

    # The square of the factor by which this loss is widened, see `widened`.
    _widening: float = 1.0

    #: The exponent a with c |s|^a <= loss(s) <= C |s|^a, None if there is none.
    exponent: float | None = None

    @property
    def c_form(self) -> LossForm | None:
        """What the step in C needs of the loss; None if a subclass overrides `cost`."""
        names = ("cost", "majorise")
        if any(getattr(type(self), name) is not getattr(Loss, name) for name in names) or any(
            name in vars(self) for name in names
        ):
            return None
        return LossForm("own", 0.0, self.per_component, self._value_and_slope, self.graduation)

    def _value_and_slope(self, q: Array) -> Array:
        return np.stack((self.value(q), self.slope(q)))

    @abstractmethod
    def value(self, q: Array) -> Array:
        r""":math:`\rho(q) \ge 0` for an array of forms q of any shape, entry by entry."""

    @abstractmethod
    def slope(self, q: Array) -> Array:
        r""":math:`\rho'(q) \ge 0`, likewise: it turns W into the weight of the majorising form."""

    def cost(self, s: Array, weight: Array) -> Array:
        """The loss of each row of s, (K, d), for one weight of all or of each.

        The weight is the one of the loss, reduced to the observed components where some are
        missing.
        """
        if self._widening != 1.0:
            weight = weight / self._widening
        if self.per_component:
            diagonal = np.diagonal(weight, axis1=-2, axis2=-1)
            value: Array = np.sum(self.value(diagonal * s * s), axis=-1)
        else:
            value = self.value(quadratic_form(s, weight))
        return value if self._widening == 1.0 else self._widening * value

    def majorise(self, s: Array, weight: Array) -> Array:
        """Weights (K, d, d) of quadratic forms that touch the loss at each row s; see `cost`."""
        if self.per_component:
            diagonal = np.diagonal(weight, axis1=-2, axis2=-1)
            scaled = diagonal * self.slope(diagonal * s * s / self._widening)
            return scaled[:, :, None] * np.eye(s.shape[1])
        slope = self.slope(quadratic_form(s, weight) / self._widening)
        return slope[:, None, None] * weight

    def widened(self, factor: float) -> Loss:
        r"""The loss :math:`\mu \rho(q / \mu)`, whose thresholds are ``factor`` times as large.

        :math:`\mu` is the square of the factor. Near zero it is the loss itself.
        """
        if factor == 1.0:
            return self
        found = copy(self)
        found._widening = factor * factor
        return found

    def hessian(self, s: Array, weight: Array) -> Array:
        """Second derivatives (K, d, d) of the loss at each row s; see `cost`."""
        slope, curvature, weighted = self._derivatives(s, weight)
        if self.per_component:
            diagonal = np.diagonal(weight, axis1=-2, axis2=-1)
            second = 2.0 * diagonal * slope + 4.0 * curvature * weighted * weighted
            return second[:, :, None] * np.eye(s.shape[1])
        products = weighted[:, :, None] * weighted[:, None, :]
        bent: Array = 2.0 * slope[:, None, None] * weight
        return bent + 4.0 * curvature[:, None, None] * products

    def weight_gradient(self, s: Array, directions: Array, weight: Array) -> Array:
        """Derivatives by a symmetric weight of the loss's slope at s (K, d) in some directions.

        Directions are (..., K, d), and the derivatives symmetric matrices (..., K, d, d).
        """
        slope, curvature, weighted = self._derivatives(s, weight)
        if self.per_component:
            found = 2.0 * directions * s * (slope + curvature * weighted * s)
            return np.asarray(found[..., None] * np.eye(s.shape[1]))
        half = slope[:, None, None] * directions[..., :, None] * s[:, None, :]
        along = 2.0 * curvature * np.einsum("...ki,ki->...k", directions, weighted)
        outer = s[:, :, None] * s[:, None, :]
        return np.asarray(half + np.swapaxes(half, -1, -2) + along[..., None, None] * outer)

    def _derivatives(self, s: Array, weight: Array) -> tuple[Array, Array, Array]:
        """Rho' and rho'' at each row s, or each of its components, and W s."""
        if any(
            getattr(type(self), name) is not getattr(Loss, name) for name in ("cost", "majorise")
        ):
            raise InvalidInputError(
                f"{type(self).__name__} overrides its cost, so its second derivatives are not "
                "known; write it as a function of the quadratic form, with value and slope, or "
                "use qpmhe.Huber or qpmhe.Power."
            )
        weighted = np.matmul(weight, s[:, :, None])[:, :, 0]
        form = s * weighted if self.per_component else np.einsum("ki,ki->k", s, weighted)
        return self.slope(form), self.curvature(form), weighted

    def curvature(self, q: Array) -> Array:
        r""":math:`\rho''(q)`, likewise; by differences of `slope` unless a loss knows better."""
        step = _STEP * np.maximum(q, 1.0)
        below = np.maximum(q - step, 0.0)
        return np.asarray((self.slope(q + step) - self.slope(below)) / (q + step - below))

    def constants(self) -> tuple[float, float] | None:
        """Constants c, C with c |s|^a <= loss(s) <= C |s|^a; None if there are none."""
        if self.exponent is None:
            return None
        values = np.linalg.eigvalsh(self.weight)
        low, high = (float(v) ** (self.exponent / 2) for v in (values[0], values[-1]))
        if self.per_component:
            # Between the a-norm and the Euclidean norm of d components.
            spread = float(self.dimension) ** (1.0 - self.exponent / 2)
            low, high = low * min(1.0, spread), high * max(1.0, spread)
        return low, high


class Quadratic(Loss):
    """The quadratic loss :math:`|s|_W^2`, a = 2, with a symmetric positive definite weight W."""

    exponent = 2.0

    def __init__(self, weight: ArrayLike) -> None:
        super().__init__(weight)

    @property
    def c_form(self) -> LossForm | None:
        """See `Loss.c_form`."""
        return LossForm() if type(self) is Quadratic else super().c_form

    def value(self, q: Array) -> Array:
        """See `Loss.value`."""
        return q

    def slope(self, q: Array) -> Array:
        """See `Loss.slope`."""
        return np.ones_like(q)

    def curvature(self, q: Array) -> Array:
        """See `Loss.curvature`."""
        return np.zeros_like(q)


class Huber(Loss):
    r"""Quadratic near zero, linear beyond a threshold: gross outliers cost little.

    .. math::
        \rho = r^2 \text{ for } r \le k, \quad 2 k r - k^2 \text{ beyond}, \qquad r = |s|_W

    It has **no** constants in the sense of (eq:exp_bounds): no single exponent bounds it both near
    zero and far away. The theorem does not apply to it; the cost decrease (eq:estimator) still
    holds.

    Parameters
    ----------
    weight, per_component
        As for `Loss`.
    threshold : float
        k, in standard deviations, > 0; 1.345 keeps 95 % efficiency on normal noise.

    References
    ----------
    Huber, Robust estimation of a location parameter, Ann. Math. Statist. 35 (1964).
    """

    def __init__(
        self, weight: ArrayLike, threshold: float = 1.345, per_component: bool = False
    ) -> None:
        super().__init__(weight, per_component)
        self.threshold = positive("threshold", threshold)

    @property
    def c_form(self) -> LossForm | None:
        """See `Loss.c_form`; a derived class may compute another loss."""
        if type(self) is not Huber:
            return super().c_form
        return LossForm("huber", self.threshold, self.per_component)

    def value(self, q: Array) -> Array:
        """See `Loss.value`."""
        k = self.threshold
        return np.where(q <= k * k, q, 2.0 * k * np.sqrt(q) - k * k)

    def slope(self, q: Array) -> Array:
        """See `Loss.slope`."""
        return np.minimum(1.0, self.threshold / np.sqrt(np.maximum(q, self.threshold**2)))

    def curvature(self, q: Array) -> Array:
        """See `Loss.curvature`."""
        k = self.threshold
        return np.where(q <= k * k, 0.0, -0.5 * k * np.maximum(q, k * k) ** -1.5)


class Power(Loss):
    r"""The power :math:`|s|_W^a` of the weighted norm, :math:`a \ge 1`.

    a = 1 is the Euclidean norm, or the L1 norm with ``per_component``. The constants of
    (eq:exp_bounds) are powers of the extreme eigenvalues of W.

    Parameters
    ----------
    weight, per_component
        As for `Loss`.
    exponent : float
        a >= 1.

    Notes
    -----
    For a < 2 the majorising form has an infinite weight at s = 0; smaller forms are raised to 1e-8,
    which bounds the weight. For a > 2 the form is not above the loss everywhere; evaluating the
    true cost handles this.
    """

    def __init__(self, weight: ArrayLike, exponent: float, per_component: bool = False) -> None:
        super().__init__(weight, per_component)
        self.exponent: float = positive("exponent", exponent)
        if self.exponent < 1.0:
            raise OptionError(f"exponent is {exponent!r}; expected a number >= 1, for convexity.")

    @property
    def c_form(self) -> LossForm | None:
        """See `Loss.c_form`; a derived class may compute another loss."""
        if type(self) is not Power:
            return super().c_form
        return LossForm("power", self.exponent, self.per_component)

    def value(self, q: Array) -> Array:
        """See `Loss.value`."""
        return q ** (0.5 * self.exponent)

    def slope(self, q: Array) -> Array:
        """See `Loss.slope`."""
        return 0.5 * self.exponent * np.maximum(q, 1e-8) ** (0.5 * self.exponent - 1.0)

    def curvature(self, q: Array) -> Array:
        """See `Loss.curvature`."""
        half = 0.5 * self.exponent
        return np.where(q < 1e-8, 0.0, half * (half - 1.0) * np.maximum(q, 1e-8) ** (half - 2.0))

class Barron(Loss):
    r"""Barron's family of losses: the smaller the shape, the less an outlier counts.

    .. math::
        \rho = \frac{2 c^2 (2 - \alpha)}{\alpha}
        \left(\Bigl(1 + \frac{r^2}{c^2 (2 - \alpha)}\Bigr)^{\alpha / 2} - 1\right),
        \qquad r = |s|_W

    and its limits: :math:`r^2` for :math:`\alpha = 2`, :math:`2 c^2 \log(1 + r^2 / (2 c^2))` for 0
    (`Cauchy`), :math:`2 c^2 (1 - e^{-r^2 / (2 c^2)})` for :math:`-\infty` (Welsch). The shape -2
    is `GemanMcClure`, 1 a smooth form of `Huber`. All are close to :math:`r^2` for r well below c.

    It has **no** constants in the sense of (eq:exp_bounds). The theorem does not apply to it; the
    cost decrease (eq:estimator) still holds.

    Parameters
    ----------
    weight, per_component
        As for `Loss`.
    shape : float
        alpha <= 2; ``-math.inf`` for Welsch.
    threshold : float
        c, in standard deviations, > 0.
    graduation : float
        While the first window fills, the sequence of QPs minimises a surrogate: the loss with a
        threshold that starts at this multiple of c and decreases to c. The surrogate's minimiser is
        accepted only if its true cost, with the original loss, is below the candidate's. 1 for
        none.

    Raises
    ------
    WeightError, ShapeError, OptionError
        As for `Loss`; if shape, threshold or graduation is out of range, or graduation is not 1 for
        a shape of at least 1.

    Notes
    -----
    For a shape below 1 the loss is not convex: its slope goes to zero far away, and the problem has
    several minima. Which one is found depends on where the QPs start. Graduation leads there from a
    nearly quadratic problem, so that the first estimate matters less; later the estimator follows
    its minimum from sample to sample with ``warm_start=True``.

    References
    ----------
    Barron, A general and adaptive robust loss function, CVPR 2019. Blake and Zisserman, Visual
    Reconstruction, 1987, on graduated non-convexity.
    """

    def __init__(
        self, weight: ArrayLike, shape: float, threshold: float, per_component: bool = False,
        graduation: float = 1.0,
    ) -> None:
        super().__init__(weight, per_component)
        number = isinstance(shape, (int, float, np.number)) and not isinstance(shape, bool)
        if not number or not shape <= 2.0:
            raise OptionError(f"shape is {shape!r}; expected a number <= 2, or -math.inf.")
        self.shape = float(shape)
        self.threshold = positive("threshold", threshold)
        self.graduation = positive("graduation", graduation)
        if self.graduation < 1.0 or (self.graduation > 1.0 and self.shape >= 1.0):
            raise OptionError(
                f"graduation is {graduation!r} for the shape {shape!r}; expected 1, or a larger "
                "factor for a shape below 1; other losses are convex and need no graduation."
            )

    def value(self, q: Array) -> Array:
        """See `Loss.value`."""
        alpha, square = self.shape, self.threshold**2
        if alpha == 2.0:
            return q
        if alpha == 0.0:
            return 2.0 * square * np.log1p(q / (2.0 * square))
        if alpha == -math.inf:
            return -2.0 * square * np.expm1(-q / (2.0 * square))
        width = 2.0 - alpha
        exponent = 0.5 * alpha * np.log1p(q / (square * width))
        return (2.0 * square * width / alpha) * np.expm1(exponent)

    def slope(self, q: Array) -> Array:
        """See `Loss.slope`."""
        alpha, square = self.shape, self.threshold**2
        if alpha == 2.0:
            return np.ones_like(q)
        if alpha == -math.inf:
            return np.exp(-q / (2.0 * square))
        return np.exp((0.5 * alpha - 1.0) * np.log1p(q / (square * (2.0 - alpha))))

    def curvature(self, q: Array) -> Array:
        """See `Loss.curvature`."""
        alpha, square = self.shape, self.threshold**2
        if alpha == 2.0:
            return np.zeros_like(q)
        if alpha == -math.inf:
            return -np.exp(-q / (2.0 * square)) / (2.0 * square)
        width = square * (2.0 - alpha)
        steep = 0.5 * alpha - 1.0
        return steep / width * np.exp((steep - 1.0) * np.log1p(q / width))


class Cauchy(Barron):
    r"""The loss :math:`2 c^2 \log(1 + r^2 / (2 c^2))`, `Barron` with the shape 0.

    Parameters
    ----------
    weight, per_component, graduation
        As for `Barron`.
    threshold : float
        c, in standard deviations; 1.686 keeps 95 % efficiency on normal noise.
    """

    def __init__(
        self, weight: ArrayLike, threshold: float = 1.686, per_component: bool = False,
        graduation: float = 10.0,
    ) -> None:
        super().__init__(weight, 0.0, threshold, per_component, graduation)


class GemanMcClure(Barron):
    r"""The bounded loss :math:`r^2 / (1 + r^2 / (4 c^2))`, `Barron` with the shape -2.

    Parameters
    ----------
    weight, per_component, graduation
        As for `Barron`.
    threshold : float
        c, in standard deviations; 1.894 keeps 95 % efficiency on normal noise.
    """

    def __init__(
        self, weight: ArrayLike, threshold: float = 1.894, per_component: bool = False,
        graduation: float = 10.0,
    ) -> None:
        super().__init__(weight, -2.0, threshold, per_component, graduation)
