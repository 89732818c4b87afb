"""Noise of sensors that is correlated in time, as further states."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import numbers, positive_definite, positive_semidefinite, vector
from ..errors import InvalidInputError, OptionError, ShapeError
from .augmentation import Augmentation, Index, augmented, chosen, inherited
from .discretize import Discretization, discretize
from .signals import Signal
from .system import System, checked_system

Array = NDArray[np.float64]

# Products k dt of a substep, among which the first is looked for that forgets enough.
_GRID: Array = np.linspace(0.0, 4.0, 401)


@dataclass(frozen=True, eq=False)
class ColouredNoise:
    """A system with coloured noise among its states, and the covariances of these states.

    Attributes
    ----------
    system : System
        With the k states of the noise behind the n others.
    correlation : (k,) array
        rho of each, over one step of the usual length.
    prior, disturbance : (k, k) array
        Covariances of c(0) and of w_c(t), in the outputs' units squared.
    """

    system: System
    correlation: Array
    prior: Array = field(repr=False)
    disturbance: Array = field(repr=False)

    def covariances(
        self, *, prior: ArrayLike, disturbance: ArrayLike, noise: ArrayLike
    ) -> dict[str, Array]:
        """Covariances of the larger system, as ``**options`` of an observer or a cost.

        Parameters
        ----------
        prior, disturbance : (n, n) and (r, r) array_like
            The covariances of x(0) and w.
        noise : (p, p) array_like
            R, the covariance of v: of the white part of the noise alone.

        Raises
        ------
        WeightError, ShapeError
            If a matrix is not a covariance, or has the wrong shape.
        """
        from scipy.linalg import block_diag  # late: `import qpmhe` does without

        k = len(self.correlation)
        n, r, p = self.system.n - k, self.system.r - k, self.system.p
        return {
            "prior": block_diag(positive_definite("prior", prior, n), self.prior),
            "disturbance": block_diag(
                positive_semidefinite("disturbance", disturbance, r)[0], self.disturbance
            ),
            "noise": positive_definite("noise", noise, p),
        }

    def initial_state(self, x: ArrayLike) -> Array:
        """The initial state x (n,), with zeros for the noise behind."""
        k = len(self.correlation)
        return np.append(vector("x", x, self.system.n - k), np.zeros(k))


def augment_noise(
    system: System,
    outputs: ArrayLike | Sequence[str],
    *,
    deviation: ArrayLike,
    correlation: ArrayLike | None = None,
    time_constant: ArrayLike | None = None,
) -> ColouredNoise:
    r"""Extend the state of a system by noise of its sensors that is correlated in time.

    .. math::
        x(t+1) = f(x(t), u(t)) + w(t), \qquad c(t+1) = \rho\, c(t) + w_c(t), \qquad
        y(t) = h(x(t), u(t)) + S c(t) + v(t)

    The noise c of the chosen outputs is a first-order Gauss-Markov process with standard deviation
    :math:`\sigma`: c(0) has the variance :math:`\sigma^2` and :math:`w_c` the variance
    :math:`\sigma^2 (1 - \rho^2)`, so that each c(t) has :math:`\sigma^2`. The state is (x, c), and
    v remains the white noise.

    Parameters
    ----------
    system : System
        The model. It keeps its sets, angles, sampling time, names and kind of derivatives; V is the
        set of v alone.
    outputs : array_like
        Indices of the outputs with such noise, a boolean mask (p,), or names, where the system
        has `signals`.
    deviation : (k,) array_like
        sigma, one for all or one for each, above 0, in the outputs' units.
    correlation : (k,) array_like, optional
        rho of noise that is one sample apart, one for all or one for each, in [0, 1).
    time_constant : (k,) array_like, optional
        Instead: tau, after which the correlation is 1/e, above 0 and in the unit of dt. Then
        :math:`\rho = e^{-dt / \tau}`. The system needs a sampling time.

    Returns
    -------
    ColouredNoise
        The larger system, the covariances of its further states, and functions that put both
        behind those that you have.

    Raises
    ------
    ModelError
        If ``system`` is not a `System`.
    InvalidInputError, ShapeError
        If an output is unknown, a deviation or time constant is not above 0, a correlation is
        outside of [0, 1), their number is wrong, or the system has nonlinear constraints.
    SetError
        If a set is soft.
    OptionError
        If not exactly one of correlation and time_constant is given, or the discretisation of the
        system's rate cannot forget as fast.

    Notes
    -----
    In a system with a rate, c has the rate :math:`-\kappa c`, which is discretised as the rate of
    x is; :math:`\kappa` is chosen so that a step of the usual length multiplies c by rho exactly.
    Longer steps forget more and shorter ones less, but the covariance of :math:`w_c` is the same.
    One step of ``"rk4"`` multiplies by 0.27 at least, with two substeps by 0.073.

    The set W of the larger system does not bound :math:`w_c`. For a certificate, give it one with
    bounds of all disturbances by `System.with_sets`, or sizes.

    Source: A. E. Bryson and D. E. Johansen, "Linear filtering for time-varying systems using
    measurements containing colored noise", IEEE Trans. Automatic Control 10, 1965.

    Examples
    --------
    >>> import qpmhe
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    >>> noisy = qpmhe.augment_noise(system, [0], correlation=0.6, deviation=0.5)
    >>> noisy.covariances(prior=[[1.0]], disturbance=[[0.01]], noise=[[0.04]])["disturbance"]
    array([[0.01, 0.  ],
           [0.  , 0.16]])
    """
    n, p = checked_system(system).n, system.p
    places = _places(system, outputs)
    k = places.size
    deviations = _each("deviation", deviation, k)
    with np.errstate(over="ignore"):
        variances = deviations**2
    if not ((deviations > 0.0) & (variances > 0.0) & np.isfinite(variances)).all():
        raise InvalidInputError(
            f"deviation is {shown(deviation)}; expected numbers above 0 with finite squares, the "
            "standard deviations of the noise. Leave out an output without coloured noise."
        )
    kept = _correlations(system, correlation, time_constant, k)
    factors, how = kept, system.origin.how
    if system.dt is not None and how is not None:
        factors = np.array([-_decay(float(rho), how) / system.dt for rho in kept])
    added = np.eye(p)[:, places]
    change = Augmentation(n, system.m, np.zeros(0), np.arange(0), added, factors)
    options = inherited(system, k)
    if system.has_scales and system.scales is not None:
        options["scales"] = np.append(system.scales, deviations)
    signals = system.signals
    if signals is not None:
        ours = zip((signals.outputs[j] for j in places), deviations.tolist(), strict=True)
        further = [Signal(f"noise of {one.name}", one.unit, 0.0, sigma) for one, sigma in ours]
        signals = signals._replace(states=(*signals.states, *further))
    recipe = {"system": system, "outputs": places, "deviation": deviations, "correlation": kept}
    made = augmented(system, change, **options).with_origin(
        recipe=(_system, recipe), signals=signals
    )
    return ColouredNoise(
        made, kept, np.diag(variances), np.diag(variances * (1.0 - kept) * (1.0 + kept))
    )


def _system(**arguments: Any) -> System:
    return augment_noise(**arguments).system


def _places(system: System, outputs: Any) -> Index:
    """The indices of the chosen outputs."""
    given: Any = [outputs] if isinstance(outputs, str) else outputs
    if isinstance(given, Iterable) and any(isinstance(one, str) for one in given):
        known = [one.name for one in system.signals.outputs] if system.signals else []
        for one in given:
            if one not in known:
                indices = f"indices from 0 to {system.p - 1}"
                raise InvalidInputError(
                    f"outputs names {one!r}; expected "
                    f"{f'names among {known}, or ' if known else ''}{indices}."
                )
        given = [known.index(one) for one in given]
    places = chosen("outputs", given, system.p, "output")
    if places.size == 0 or outputs is None:
        raise InvalidInputError(f"outputs is {shown(outputs)}; expected at least one output.")
    return places


def _each(name: str, given: ArrayLike, k: int) -> Array:
    found = numbers(name, given)
    if found.shape not in ((), (k,)):
        raise ShapeError(
            f"{name} has shape {found.shape}; expected one number, or one for each of the {k} "
            "outputs."
        )
    return np.array(np.broadcast_to(found, k), np.float64)


def _correlations(
    system: System, correlation: ArrayLike | None, time_constant: ArrayLike | None, k: int
) -> Array:
    if correlation is not None and time_constant is None:
        kept = _each("correlation", correlation, k)
        if not ((kept >= 0.0) & (kept < 1.0)).all():
            raise InvalidInputError(
                f"correlation is {shown(correlation)}; expected numbers in [0, 1), the "
                "correlation of noise one sample apart. For a constant bias, see "
                "augment_parameters."
            )
        return kept
    if time_constant is None or correlation is not None:
        raise OptionError(
            f"correlation is {shown(correlation)} and time_constant {shown(time_constant)}; "
            "expected exactly one of them."
        )
    constants = _each("time_constant", time_constant, k)
    if (constants <= 0.0).any():
        raise InvalidInputError(
            f"time_constant is {shown(time_constant)}; expected numbers above 0, in the unit of dt."
        )
    if system.dt is None:
        raise OptionError(
            f"time_constant is {shown(time_constant)}, but the system has no sampling time; give "
            "correlation = exp(-dt / time_constant)."
        )
    kept = np.exp(-system.dt / constants)
    if (kept == 1.0).any():
        raise InvalidInputError(
            f"time_constant is {shown(time_constant)}, with which the noise is constant at dt = "
            f"{system.dt}; estimate it as a bias, see augment_parameters."
        )
    return kept


def _decay(rho: float, how: Discretization) -> float:
    """The product k dt with which the discretised rate -k c multiplies c by rho in a step."""
    from scipy.optimize import brentq  # late: `import qpmhe` does without

    step, _ = discretize(
        lambda c: -c, lambda c: np.full((*c.shape, 1), -1.0), Discretization(how.method)
    )
    root, steps = rho ** (1.0 / how.steps), how.steps

    def factors(products: Array) -> Array:
        found: Array = step(products[:, None], np.ones((products.size, 1)))[:, 0]
        return found

    tried = factors(_GRID)
    passed = np.flatnonzero(tried <= root)
    if not passed.size:
        raise OptionError(
            f"the correlation is {rho:.3g}, but a step of {how.method!r} with steps = {steps} "
            f"multiplies the noise by {tried.min() ** steps:.3g} at least, at rates of up to "
            f"{_GRID[-1]:g} per substep; make the system with more steps, or leave this noise in "
            "the covariance of v: it is nearly white."
        )
    i = int(passed[0])
    return steps * float(brentq(
        lambda one: float(factors(np.array([one]))[0]) - root, _GRID[i - 1], _GRID[i],
        xtol=1e-15, rtol=1e-14,
    ))
