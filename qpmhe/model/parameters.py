"""Unknown constants of a model, estimated along with its state."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import dimension, numbers
from ..errors import InvalidInputError, ModelError, SetError, ShapeError
from .functions import BatchedFunction, Probes, Trusted
from .sets import Box, ConvexSet
from .system import System, probe_points

Array = NDArray[Any]
Index = NDArray[np.intp]
Function = Callable[..., Any]


def augment_parameters(
    f: Function,
    h: Function,
    *,
    n: int,
    p: int,
    m: int = 0,
    nominal: ArrayLike,
    estimated: ArrayLike | None = None,
    states: ConvexSet | None = None,
    disturbances: ConvexSet | None = None,
    noises: ConvexSet | None = None,
    parameter_bounds: ConvexSet | None = None,
) -> System:
    r"""The system whose state is the model's state together with its unknown constants.

    .. math::
        x(t+1) = f(x(t), u(t), \theta) + w(t), \qquad \theta(t+1) = \theta(t), \qquad
        y(t) = h(x(t), u(t), \theta) + v(t)

    Its state is :math:`(x, \theta_e)` with the estimated parameters behind, in the order in
    which they were named. Their disturbance is {0}: they are constant along every estimated
    trajectory, to the last bit. So an observer fits that does not correct them, with zeros in
    their rows of the gain; where another one is used, its candidate is outside of W, and the
    estimator looks for a trajectory with constant parameters that costs no more.

    Parameters
    ----------
    f : callable
        f(x, u, theta), or f(x, theta) where m is 0: x of shape (n,), u of (m,) and theta of
        (k,), all parameters, to (n,). Functions of (..., n), (..., m), (..., k) are called
        once for a whole window, as with `System`.
    h : callable
        h(x, u, theta), or h(x, theta) where m is 0, to (p,); a scalar will do where p is 1.
    n, p, m : int
        Numbers of states x, outputs and known inputs.
    nominal : (k,) array_like
        Values of all parameters, each in its own unit: the prior of those that are
        estimated, the constants of the others.
    estimated : array_like, optional
        Indices of the parameters to be estimated, or a boolean mask (k,). All if left out;
        none with an empty list, which gives the model at its nominal parameters.
    states, disturbances : Box or Polytope, optional
        The sets X and W of x alone, of dimension n; the whole space if left out.
    noises : Box or Polytope, optional
        The set V, of dimension p.
    parameter_bounds : Box or Polytope, optional
        Where the estimated parameters are, in their order. The model is also tried out
        within these bounds, which helps where it is not defined everywhere.

    Returns
    -------
    System
        With ``n + len(estimated)`` states. Start the estimator at x and the nominal values
        of the estimated parameters; cost and gain have this dimension, too.

    Raises
    ------
    InvalidInputError, ShapeError
        If a parameter has no finite nominal value, or ``estimated`` does not name parameters.
    ModelError
        If a function does not take the arguments above, or returns a wrong shape.
    SetError
        If a set has the wrong dimension, or a nominal value is outside of its bounds.

    Examples
    --------
    An unknown decay, seen through the state:

    >>> import numpy as np, qpmhe
    >>> from qpmhe.model.parameters import augment_parameters
    >>> system = augment_parameters(
    ...     lambda x, theta: theta * x + 1.0, lambda x, theta: x, n=1, p=1, nominal=[0.5])
    >>> system.n
    2
    >>> cost = qpmhe.QuadraticCost(
    ...     prior=np.diag([1.0, 1e-3]), disturbance=100.0 * np.eye(2), noise=100.0)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, qpmhe.Luenberger([0.4, 0.0]), cost, horizon=10,
    ...     initial_state=[0.0, 0.5], max_qps=None)
    """
    n, p, m = dimension("n", n, 1), dimension("p", p, 1), dimension("m", m, 0)
    values = _nominal(nominal)
    chosen = _chosen(estimated, values.size)
    k = chosen.size
    for name, one, size in (("states", states, n), ("disturbances", disturbances, n)):
        _check_set(name, one, size, "the dimension of x alone: the parameters are added here")
    if parameter_bounds is not None and k == 0:
        raise SetError("parameter_bounds was given, but no parameter is estimated; leave it out.")
    _check_set("parameter_bounds", parameter_bounds, k, "the number of estimated parameters")
    if parameter_bounds is not None and parameter_bounds.violation(values[chosen]) > 0.0:
        raise SetError(
            f"nominal is {values[chosen].tolist()} for the estimated parameters, outside of "
            f"parameter_bounds {parameter_bounds!r}; the prior value must be within."
        )
    probes = _parameter_probes(probe_points(states, n, m), values, chosen, parameter_bounds)
    model = _AugmentedModel(n, m, values, chosen)
    return System(
        model.function("f", f, n, probes, append=True),
        model.function("h", h, p, probes, append=False),
        n=n + k, p=p, m=m,
        states=_product(states, n, parameter_bounds, k),
        disturbances=_product(disturbances, n, Box(np.zeros(k), np.zeros(k)) if k else None, k),
        noises=noises,
    )


class _AugmentedModel:
    """Turns functions of (x, u, theta) into functions of the augmented state z = (x, theta_e)."""

    def __init__(self, n: int, m: int, nominal: Array, chosen: Index) -> None:
        self._n, self._m, self._nominal, self._chosen = n, m, nominal, chosen
        self._whole = np.array_equal(chosen, np.arange(nominal.size))

    def function(
        self, name: str, written: Function, size: int, probes: Probes, append: bool
    ) -> Trusted:
        """The function of z, or of z and u, that takes leading dimensions in any case.

        With ``append``, the estimated parameters stand behind its value, unchanged.
        """
        n, m = self._n, self._m
        _check_arguments(name, written, m)
        tried = _Split(name, written, n, m, size, probes)
        if tried.batched.mode == "unknown":
            tried.explain_failure(probes)

        def evaluate(z: Array, u: Array | None) -> Array:
            x, theta = z[..., :n], self._theta(z)
            known = theta if u is None else np.concatenate((u, theta), axis=-1)
            if z.ndim == 1:
                value = np.asarray(tried.batched(x, known)).reshape(size)
            else:
                value = tried.batched.batch(x, known)
            return np.concatenate((value, z[..., n:]), axis=-1) if append else value

        if m == 0:
            return Trusted(lambda z: evaluate(z, None))
        return Trusted(evaluate)

    def _theta(self, z: Array) -> Array:
        """All parameters at augmented states z (..., n + k_e)."""
        if self._whole:
            return z[..., self._n :]
        theta = np.empty((*z.shape[:-1], self._nominal.size), z.dtype)
        theta[...] = self._nominal
        theta[..., self._chosen] = z[..., self._n :]
        return theta


class _Split:
    """A function of (x, u, theta) tried as one of x and the known vector (u, theta)."""

    def __init__(
        self, name: str, written: Function, n: int, m: int, size: int, probes: Probes
    ) -> None:
        self._written, self._n, self._m = written, n, m
        known = probes[0][1].size
        self._found: BatchedFunction | None = None
        self.batched = BatchedFunction(name, self._evaluate, (size,), known, probes)
        self._found = self.batched

    def _evaluate(self, x: Array, known: Array) -> Any:
        m = self._m
        if x.ndim == 2 and self._by_columns(x):
            u, theta = known[:m], known[m:]
        else:
            u, theta = known[..., :m], known[..., m:]
        return self._written(x, theta) if m == 0 else self._written(x, u, theta)

    def _by_columns(self, x: Array) -> bool:
        """Whether the states are the columns of x; shapes do not say so where it is square."""
        if self._found is None:
            return bool(x.shape[-1] != self._n)
        return self._found.mode == "columns"

    def explain_failure(self, probes: Probes) -> None:
        """Raise if the function is written wrongly; pass over points outside its domain."""
        x, known = probes[0]
        try:
            with np.errstate(all="ignore"):
                self._evaluate(x.copy(), known.copy())
        except (IndexError, TypeError) as error:
            raise ModelError(
                f"{self.batched.name} raised {type(error).__name__}: {error} at "
                f"x = {x.tolist()} and theta = {known[self._m :].tolist()}, the nominal values; "
                f"expected a function of x ({self._n},) and theta ({known.size - self._m},). "
                "Check nominal and the order of the arguments."
            ) from error
        except Exception:  # outside its domain; the estimator checks at the initial state
            return


def _nominal(given: ArrayLike) -> Array:
    values = np.atleast_1d(numbers("nominal", given, finite=False))
    if values.ndim != 1 or values.size == 0:
        raise ShapeError(
            f"nominal has shape {values.shape}; expected (k,), a value for each parameter."
        )
    if not np.isfinite(values).all():
        j = int(np.argmin(np.isfinite(values)))
        raise InvalidInputError(
            f"nominal[{j}] is {values[j]}: a parameter without a prior value; expected a finite "
            "number. A poor guess will do, with a small prior weight."
        )
    return values


def _chosen(estimated: ArrayLike | None, size: int) -> Index:
    """Indices of the estimated parameters."""
    if estimated is None:
        return np.arange(size)
    refused = InvalidInputError(
        f"estimated is {shown(estimated)}; expected indices of parameters or a boolean mask."
    )
    try:
        given = np.atleast_1d(np.asarray(estimated))
    except ValueError as error:  # rows of different lengths
        raise refused from error
    if given.dtype == np.bool_:
        if given.shape != (size,):
            raise ShapeError(
                f"estimated is a mask of shape {given.shape}; expected ({size},), one entry for "
                "each parameter."
            )
        return np.flatnonzero(given)
    if given.size == 0:
        return np.empty(0, np.intp)
    if given.ndim != 1 or given.dtype.kind not in "iu":
        raise refused
    outside = (given < 0) | (given >= size)
    if outside.any():
        raise InvalidInputError(
            f"estimated names parameter {int(given[outside][0])}; expected indices from 0 to "
            f"{size - 1}, for nominal has {size} values."
        )
    if np.unique(given).size < given.size:
        raise InvalidInputError(
            f"estimated is {given.tolist()}, which names a parameter twice; expected different "
            "indices."
        )
    return given.astype(np.intp)


def _check_set(name: str, one: ConvexSet | None, dimension: int, meaning: str) -> None:
    if one is None:
        return
    if not isinstance(one, ConvexSet):
        raise SetError(f"{name} is {shown(one)}; expected a qpmhe.Box, a qpmhe.Polytope or None.")
    if one.dimension != dimension:
        raise SetError(f"{name} has dimension {one.dimension}; expected {dimension}, {meaning}.")


def _check_arguments(name: str, written: Function, m: int) -> None:
    if not callable(written):
        raise ModelError(f"{name} is {shown(written)}; expected a function.")
    arguments = ("x", "theta") if m == 0 else ("x", "u", "theta")
    try:
        signature = inspect.signature(written)
    except (TypeError, ValueError):  # some compiled functions have no signature
        return
    try:
        signature.bind(*arguments)
    except TypeError as error:
        inputs = "no inputs" if m == 0 else f"{m} inputs"
        raise ModelError(
            f"{name}{signature} cannot be called as {name}({', '.join(arguments)}), which a model "
            f"with {inputs} is, whether it uses all of them or not ({error})."
        ) from error


def _parameter_probes(
    probes: Probes, nominal: Array, chosen: Index, bounds: ConvexSet | None
) -> Probes:
    """The probes with parameters behind their inputs: nominal first, and then others."""
    generator = np.random.default_rng(20210829)
    joined: Probes = []
    for i, (x, u) in enumerate(probes):
        theta = nominal.copy()
        if i > 0:
            near = theta[chosen] * generator.uniform(0.9, 1.1, chosen.size)
            near += generator.uniform(0.0, 0.01, chosen.size)
            theta[chosen] = near if bounds is None else np.clip(near, bounds.lower, bounds.upper)
        joined.append((x, np.concatenate((u, theta))))
    return joined


def _product(
    first: ConvexSet | None, n: int, second: ConvexSet | None, k: int
) -> ConvexSet | None:
    """All (x, theta) with x in the first set and theta in the second; None is everything."""
    if first is None and second is None:
        return None
    if k == 0:
        return first
    one, two = _or_everything(first, n), _or_everything(second, k)
    lower, upper = np.append(one.lower, two.lower), np.append(one.upper, two.upper)
    rows = one.matrix.shape[0] + two.matrix.shape[0]
    if rows == 0:
        return Box(lower, upper)
    matrix = np.zeros((rows, n + k))
    matrix[: one.matrix.shape[0], :n] = one.matrix
    matrix[one.matrix.shape[0] :, n:] = two.matrix
    return ConvexSet(
        lower, upper, matrix,
        np.append(one.row_lower, two.row_lower), np.append(one.row_upper, two.row_upper),
    )


def _or_everything(one: ConvexSet | None, dimension: int) -> ConvexSet:
    if one is not None:
        return one
    free = np.full(dimension, np.inf)
    return Box(-free, free)
