"""Unknown constants of a model, estimated along with its state."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import finite, shown

from .._checks import dimension, flag, numbers
from ..errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError
from .augmentation import Augmentation, augmented, chosen, inherited, product
from .functions import BatchedFunction
from .points import FEW, Points, points
from .sets import Box, ConvexSet
from .system import System
from .system_arguments import checked_set

Array = NDArray[Any]
Index = NDArray[np.intp]
Function = Callable[..., Any]


def augment_parameters(
    f: Function | System,
    h: Function | None = None,
    *,
    nominal: ArrayLike,
    n: int | None = None,
    p: int | None = None,
    m: int | None = None,
    estimated: ArrayLike | None = None,
    drifting: bool = False,
    dt: float | None = None,
    method: str | None = None,
    steps: int | None = None,
    states: ConvexSet | None = None,
    disturbances: ConvexSet | None = None,
    noises: ConvexSet | None = None,
    parameter_bounds: ConvexSet | None = None,
    hold: ArrayLike | Mapping[int, float] | None = None,
) -> System:
    r"""Extend the state of a model by its unknown constants.

    .. math::
        x(t+1) = f(x(t), u(t), \theta) + w(t), \qquad \theta(t+1) = \theta(t), \qquad
        y(t) = h(x(t), u(t), \theta) + v(t)

    The state is :math:`(x, \theta_e)`, with the estimated parameters last, in the order of
    ``estimated``. Unless they drift, their disturbance is {0}: they are constant along every
    estimated trajectory, to the last bit. Use an observer that does not correct them, with zeros in
    their rows of the gain; the candidate of any other observer violates W, and the estimator then
    searches for a trajectory with constant parameters that costs no more.

    The model is a pair of NumPy functions, or a `System` whose last inputs are the parameters, made
    by `System`, `from_casadi`, `from_jax`, `from_sympy`, `from_control` or `from_fmu`: the result
    has the same kind of derivatives and the same names, and a CasADi model stays one. Jacobians
    that you gave, and those of an FMU, lack the parameters' columns: differences take their place.

    Parameters
    ----------
    f : callable or System
        f(x, u, theta), or f(x, theta): maps x (n,), u (m,) and all parameters theta (k,)
        to (n,). With dt, f is the rate, in units of x per unit of time. Or a system of m + k
        inputs, the last k of which are the parameters; it has its own sizes, sets and sampling
        time, so leave out h, n, p, m, dt, method, steps and
        the sets.
    h : callable
        h(x, u, theta), or h(x, theta), to (p,), or a scalar if p is 1.
    nominal : (k,) array_like
        Values of all parameters, each in its unit: prior means of the estimated ones, constants for
        the others.
    n, p, m : int
        Numbers of states x, outputs and known inputs; m is 0 if left out.
    estimated : array_like, optional
        Indices of the parameters to be estimated, or a boolean mask (k,). All if left out;
        none with an empty list, which gives the model at its nominal parameters.
    drifting : bool
        Whether a disturbance changes the parameters from step to step; the cost weighs it with the
        others.
    dt : float, optional
        Sampling time. If given, f is a rate, discretised with u held over the step, and the system
        takes steps of other lengths.
    method, steps : optional
        With dt: how the rate is discretised, as for `System.from_ode`; one step of ``"rk4"`` if
        left out.
    states, disturbances : Box or Polytope, optional
        The sets X and W of x alone, of dimension n; the whole space if left out.
    noises : Box or Polytope, optional
        The set V, of dimension p.
    parameter_bounds : Box or Polytope, optional
        Bounds of the estimated parameters, in their order. Points of the model also stay within
        them, which helps if it is not defined everywhere.
    hold : float, array_like or mapping, optional
        Number of prior standard deviations, such as 0.1, within which an estimated parameter is
        held at its last trusted value while the window does not see it: one number for all, one for
        each, or a mapping from the indices of some. Nothing is held if left out. See Notes.

    Returns
    -------
    System
        With ``n + len(estimated)`` states and m inputs. Start the estimator at x and the nominal
        values of the estimated parameters; cost and gain have this dimension, too. It pickles
        where the model does.

    Raises
    ------
    InvalidInputError, ShapeError
        If a parameter has no finite nominal value, ``estimated`` does not name parameters, a system
        has fewer inputs than parameters, or ``hold`` is not positive or names a parameter that is
        not estimated.
    ModelError
        If a function does not take the arguments above, or returns a wrong shape.
    SetError
        If a set has the wrong dimension, or a nominal value is outside its bounds.
    OptionError
        If a size, dt or the method is out of range, or given with a system or without dt.

    Notes
    -----
    Without excitation, the data do not determine some parameters. Their estimates then follow the
    observer, which drifts with the noise, or fall back to the nominal values; a disturbance small
    enough to prevent both is too small to follow later changes.

    With ``hold``, J has one more term :math:`|\theta_0 - \bar\theta|_H^2`, on the parameters at the
    start of the window. Its weight H and the trusted value :math:`\bar\theta`, at first the nominal
    one, are fixed before each step, and the candidate's J has the same term: so J(estimate) <=
    J(candidate) compares the same function. What a window sees is measured by the singular values
    of its Gauss-Newton matrix in deviations of the first prior, as in `Diagnosis`, with the other
    states eliminated. A direction with a singular value up to 1, where the data are no more
    informative than that prior, is held fully; above, its weight falls as the inverse square, and
    the trusted value follows the estimate. See `WindowHold`.

    The observer is not held: it stays the theorem's observer, but the theorem does not cover this
    term. A Kalman-type observer only needs a disturbance of the parameter that lets it follow
    changes; its covariance grows while the parameter is unseen, which speeds up recovery.

    Examples
    --------
    An unknown decay, seen through the state:

    >>> import numpy as np, qpmhe
    >>> system = qpmhe.augment_parameters(
    ...     lambda x, theta: theta * x + 1.0, lambda x, theta: x, n=1, p=1, nominal=[0.5])
    >>> system.n
    2
    >>> cost = qpmhe.QuadraticCost(
    ...     prior=np.diag([1.0, 1e-3]), disturbance=100.0 * np.eye(2), noise=100.0)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, qpmhe.Luenberger([0.4, 0.0]), cost, horizon=10,
    ...     initial_state=[0.0, 0.5], max_qps=None)
    """
    values = _nominal(nominal)
    moved = chosen("estimated", estimated, values.size, "parameter")
    held = _held(hold, moved)
    arguments = {
        "f": f, "h": h, "nominal": values, "n": n, "p": p, "m": m, "estimated": moved,
        "drifting": drifting, "dt": dt, "method": method, "steps": steps, "states": states,
        "disturbances": disturbances, "noises": noises, "parameter_bounds": parameter_bounds,
        "hold": hold,
    }
    _check_bounds(parameter_bounds, values[moved])
    k = moved.size
    still = None if flag("drifting", drifting) or not k else Box(np.zeros(k), np.zeros(k))
    parameters = _Parameters(values, moved, parameter_bounds, still)
    if isinstance(f, System):
        system = _of_system(f, _other_inputs(arguments, values.size), parameters)
    else:
        system = _of_functions(arguments, parameters)
    return system.with_origin(
        held={
            **system.held, **{system.n - k + place: within for place, within in held.items()},
        },
        recipe=(augment_parameters, arguments),
    )


class _Parameters(NamedTuple):
    """Values of all, the indices of the estimated ones, their bounds, and their part of W."""

    nominal: Array
    moved: Index
    bounds: ConvexSet | None
    still: ConvexSet | None

    def change(self, n: int, m: int) -> Augmentation:
        """What makes states of the estimated ones and constants of the others."""
        constants = self.nominal.copy()
        constants[self.moved] = 0.0
        return Augmentation(n, m, constants, m + self.moved)


def _of_system(f: System, m: int, parameters: _Parameters) -> System:
    """The augmented system of one whose last inputs, behind ``m`` others, are the parameters."""
    options = inherited(f, parameters.moved.size, parameters.bounds, parameters.still)
    made, signals = augmented(f, parameters.change(f.n, m), **options), f.signals
    if signals is None:
        return made
    states = (*signals.states, *(signals.inputs[m + j] for j in parameters.moved))
    return made.with_origin(signals=signals._replace(states=states, inputs=signals.inputs[:m]))


def _of_functions(given: dict[str, Any], parameters: _Parameters) -> System:
    """The augmented system of functions, from the arguments of `augment_parameters`."""
    n, p = dimension("n", given["n"], 1), dimension("p", given["p"], 1)
    m = dimension("m", 0 if given["m"] is None else given["m"], 0)
    alone = ", the dimension of x alone: the parameters are added here"
    states, disturbances = given["states"], given["disturbances"]
    hard = checked_set("states", states, n, alone)
    checked_set("disturbances", disturbances, n, alone)
    nominal, moved, bounds, still = parameters
    k = moved.size
    sets = {  # raises for soft ones
        "states": product(states, n, bounds, k),
        "disturbances": product(disturbances, n, still, k),
    }
    probes = _probes(points(FEW, n, m, hard), nominal, moved, bounds)
    f, h = _function("f", given["f"], n, m, probes), _function("h", given["h"], p, m, probes)
    change, dt, method = parameters.change(n, m), given["dt"], given["method"]
    output = change.over_leading(h)
    options: Any = {
        "n": change.n, "p": p, "m": change.m, "noises": given["noises"],
        **sets,
    }
    for name in ("method", "steps"):
        if dt is None and given[name] is not None:
            raise OptionError(
                f"{name} is {shown(given[name])}, but dt is missing; give both or neither."
            )
    if dt is None:
        return System(change.over_leading(f, 1.0), output, **options)
    rate = change.over_leading(f, 0.0)
    steps = 1 if given["steps"] is None else given["steps"]
    return System.from_ode(
        rate, output, dt=dt, method=method or "rk4", steps=steps, **options
    )


def _other_inputs(arguments: dict[str, Any], parameters: int) -> int:
    """The number of inputs of a system that are no parameters; raises if more than it is given."""
    own = "h", "n", "p", "m", "dt", "method", "steps", "states", "disturbances", "noises"
    for name in own:
        if arguments[name] is not None:
            raise OptionError(
                f"{name} is {shown(arguments[name])}, but f is a System, which has its own; leave "
                f"{name} out."
            )
    total: int = arguments["f"].m
    if parameters > total:
        raise ShapeError(
            f"nominal has {parameters} values, but the system has {total} inputs; its last "
            f"inputs are the parameters, so expected at most {total} values."
        )
    return total - parameters


def _nominal(given: ArrayLike) -> Array:
    values = np.array(numbers("nominal", given, finite=False), ndmin=1)  # ours: pickles hold it
    if values.ndim != 1 or values.size == 0:
        raise ShapeError(
            f"nominal has shape {values.shape}; expected (k,), a value for each parameter."
        )
    if not np.isfinite(values).all():
        j = int(np.argmin(np.isfinite(values)))
        raise InvalidInputError(
            f"nominal[{j}] is {values[j]}: the parameter has no prior value; expected a finite "
            "number. A poor guess is enough, with a small prior weight."
        )
    return values


def _held(hold: ArrayLike | Mapping[int, float] | None, moved: Index) -> dict[int, float]:
    """Within how many deviations of the prior a parameter is held, by its place in ``moved``."""
    if hold is None:
        return {}
    if not moved.size:
        raise InvalidInputError(
            f"hold is {shown(hold)}, but no parameter is estimated; leave it out."
        )
    found: dict[int, Any]
    if isinstance(hold, Mapping):
        places = {int(j): place for place, j in enumerate(moved)}
        for j in hold:
            if isinstance(j, (bool, np.bool_)) or j not in places:
                raise InvalidInputError(
                    f"hold has the key {shown(j)}, which is not an estimated parameter; expected "
                    f"indices among {moved.tolist()}. To hold parameter {shown(j)}, also name it "
                    "in estimated."
                )
        found = {places[int(j)]: within for j, within in hold.items()}
    elif isinstance(hold, (bool, np.bool_)):
        found = {0: hold}
    else:
        given = numbers("hold", hold, finite=False)
        if given.shape not in ((), moved.shape):
            raise ShapeError(
                f"hold has shape {given.shape}; expected one number, or {moved.shape}, one for "
                "each estimated parameter, or a mapping from some of their indices."
            )
        found = dict(enumerate(np.broadcast_to(given, moved.shape).tolist()))
    for within in found.values():
        size = finite(within)
        if size is None or size <= 0.0:
            raise InvalidInputError(
                f"hold is {shown(within)}; expected numbers above 0, in deviations of the "
                "parameter's prior, such as 0.1. To leave a parameter free, omit it from a mapping."
            )
    return {place: float(within) for place, within in found.items()}


def _check_bounds(bounds: ConvexSet | None, nominal: Array) -> None:
    if bounds is not None and nominal.size == 0:
        raise SetError("parameter_bounds was given, but no parameter is estimated; leave it out.")
    hard = checked_set(
        "parameter_bounds", bounds, nominal.size, ", the number of estimated parameters"
    )
    if hard is not None and hard.violation(nominal) > 0.0:
        raise SetError(
            f"nominal is {nominal.tolist()} for the estimated parameters, outside parameter_bounds "
            f"{bounds!r}; the prior value must be within."
        )


def _function(name: str, written: Any, size: int, m: int, probes: Points) -> BatchedFunction:
    """A user's function of x and (u, theta), tried at the nominal parameters and near them."""
    if not callable(written) or type(written).__module__.startswith("casadi"):
        raise ModelError(
            f"{name} is {shown(written)}; expected a function of NumPy arrays. For a model in "
            "another language, make a System with the parameters as its last inputs, and pass that "
            "as f."
        )
    try:
        signature = inspect.signature(written)
    except (TypeError, ValueError):  # some compiled functions have no signature
        signature = None
    takes_input = m > 0 and not (signature and _is_of_state(signature))
    arguments = ("x", "u", "theta") if takes_input else ("x", "theta")
    try:
        if signature is not None:
            signature.bind(*arguments)
    except TypeError as error:
        inputs = f"{m} inputs" if m else "no inputs"
        raise ModelError(
            f"{name}{signature} cannot be called as {name}({', '.join(arguments)}), as a model "
            f"with {inputs} is, whether it uses all of them or not ({error})."
        ) from error
    x, known = probes[0]


    def joined(x: Array, known: Array) -> Any:
        u, theta = known[:m], known[m:]
        return written(x, u, theta) if takes_input else written(x, theta)

    function = BatchedFunction(name, joined, (size,), known.size, probes)
    if not function.known:
        try:
            with np.errstate(all="ignore"):
                function(x, known)
        except (IndexError, TypeError) as error:
            raise ModelError(
                f"{name} raised {type(error).__name__}: {error} at x = {x.tolist()} and theta = "
                f"{known[m:].tolist()}, the nominal values; expected a function of x ({x.size},) "
                f"and theta ({known.size - m},). Check nominal and the order of the arguments."
            ) from error
        except Exception:  # outside its domain; the estimator checks at the initial state
            pass
    return function


def _is_of_state(signature: inspect.Signature) -> bool:
    """Whether a function is one of x and theta alone, of a model with inputs."""
    parameters = list(signature.parameters.values())
    return (
        len(parameters) == 2 and parameters[1].name != "u"
        and all(q.kind in (q.POSITIONAL_ONLY, q.POSITIONAL_OR_KEYWORD) for q in parameters)
    )


def _probes(probes: Points, nominal: Array, moved: Index, bounds: ConvexSet | None) -> Points:
    """The probes with parameters behind their inputs: nominal first, and then others."""
    generator = np.random.default_rng(20210829)
    joined: Points = []
    for i, (x, u) in enumerate(probes):
        theta = nominal.copy()
        if i > 0:
            near = theta[moved] * generator.uniform(0.9, 1.1, moved.size)
            near += generator.uniform(0.0, 0.01, moved.size)
            theta[moved] = near if bounds is None else np.clip(near, bounds.lower, bounds.upper)
        joined.append((x, np.concatenate((u, theta))))
    return joined
