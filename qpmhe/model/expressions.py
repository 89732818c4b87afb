"""A model as CasADi functions, in the form from which C code and evaluators are made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._checks import dimension, positive
from ..errors import InvalidInputError, ModelError
from .discretize import Discretization
from .functions import check_inputs, takes_input
from .products import has_products, with_products, with_slope
from .quiet import quiet


def import_casadi() -> Any:
    """The casadi package, imported late: `import qpmhe` does without."""
    import casadi

    return casadi


@dataclass(frozen=True)
class CasadiModel:
    """f and h as functions of (x, u) to a dense column, with n, p, m states, outputs and inputs.

    f is the rate of an ODE with sampling time ``dt`` and discretisation ``how``, or the
    discrete-time map itself, where these are None. u has no rows where there are no inputs.
    With k algebraic states z, of which there is a ``guess`` for each, x is w = (x, z) in both
    functions, and f also has the algebraic equations' residuals, below the rate.
    ``output_residual`` and ``state_residual`` are the user's functions of (a, b) for differences,
    where there are any; ``losses`` those of one number q to rho(q) and rho'(q), for prior, w and v;
    ``correction`` an observer's function of (z, v); ``constraints`` one of ((x, w, v), u, z) to
    the values of all nonlinear constraints; z is empty where none is a function of z.
    """

    f: Any
    h: Any
    n: int
    p: int
    m: int
    dt: float | None = None
    how: Discretization | None = None
    guess: tuple[float, ...] = ()
    output_residual: Any = None
    state_residual: Any = None
    losses: tuple[Any, Any, Any] = (None, None, None)
    correction: Any = None
    constraints: Any = None

    def __post_init__(self) -> None:
        # A map that is taken for a rate, with a step of 0, would be the identity.
        if (self.dt is None) != (self.how is None):
            raise ValueError(f"dt is {self.dt} and {self.how}; expected both or none.")

    @property
    def width(self) -> int:
        """Number of states and algebraic states, which f and h are functions of."""
        return self.n + len(self.guess)

    @property
    def equations(self) -> CasadiModel:
        """The functions of w alone, as those of a map."""
        return replace(self, n=self.width, guess=(), dt=None, how=None)

    @property
    def is_implicit(self) -> bool:
        """Whether a step solves equations, so that it is no expression."""
        return self.how is not None and self.how.is_implicit

    def with_jacobian(self, which: str) -> tuple[Any, list[int]]:
        """A function of (x, u) to f or h and the nonzeros of its Jacobian by x.

        Also where each nonzero is in the dense Jacobian, counted by rows.
        """
        ca, function = import_casadi(), getattr(self, which)
        x, u = symbols(function, self.width, self.m)
        value, slopes = with_slope(function, x, u)
        rows, columns = slopes.sparsity().get_triplet()
        nonzeros = ca.sparsity_cast(slopes, ca.Sparsity.dense(slopes.nnz(), 1))
        made = ca.Function(f"{which}_jacobian", [x, u], [value, nonzeros])
        return made, [row * self.width + column for row, column in zip(rows, columns, strict=True)]

    def step(self) -> Any:
        """The discrete-time map as a casadi.Function of (x, u, dt), unless it is implicit."""
        assert not self.is_implicit
        ca = import_casadi()
        x, u = symbols(self.f, self.n, self.m)
        dt = type(x).sym("dt")
        following = x
        if self.how is None:
            following = self.f(x, u)
        else:
            h = dt / self.how.steps if self.how.steps > 1 else dt
            for _ in range(self.how.steps):
                following = self._substep(following, u, h)
        return ca.Function("step", [x, u, dt], [following])

    def slope(self, name: str, value: Any, x: Any, u: Any, dt: Any) -> Any:
        """The Jacobian by x of ``value``, which is the map f or h at these symbols."""
        ca, function = import_casadi(), getattr(self, name)
        if not has_products(function):
            return ca.jacobian(value, x)
        if name == "h" or self.how is None:
            return with_slope(function, x, u)[1]
        h, slope, one = dt / self.how.steps, ca.DM.eye(self.n), ca.DM.eye(self.n)
        for _ in range(self.how.steps):
            k1, K1 = with_slope(self.f, x, u)
            inner = one + h * K1
            if self.how.method == "rk4":
                k2, J2 = with_slope(self.f, x + h / 2 * k1, u)
                K2 = ca.mtimes(J2, one + h / 2 * K1)
                k3, J3 = with_slope(self.f, x + h / 2 * k2, u)
                K3 = ca.mtimes(J3, one + h / 2 * K2)
                K4 = ca.mtimes(with_slope(self.f, x + h * k3, u)[1], one + h * K3)
                inner = one + h / 6 * (K1 + 2 * (K2 + K3) + K4)
            slope, x = ca.mtimes(inner, slope), self._substep(x, u, h)
        return slope

    def _substep(self, x: Any, u: Any, h: Any) -> Any:
        assert self.how is not None
        if self.how.method == "euler":
            return x + h * self.f(x, u)
        k1 = self.f(x, u)
        k2 = self.f(x + h / 2 * k1, u)
        k3 = self.f(x + h / 2 * k2, u)
        k4 = self.f(x + h * k3, u)
        return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)


def casadi_model(
    f: Any,
    h: Any,
    *,
    n: int | None = None,
    p: int | None = None,
    m: int | None = None,
    dt: float | None = None,
    how: Discretization | None = None,
) -> CasadiModel:
    """Check the arguments of `qpmhe.from_casadi`, and bring the model to the common form."""
    ca = import_casadi()
    for name, size, least in (("n", n, 1), ("p", p, 1), ("m", m, 0)):
        if size is not None:
            dimension(name, size, least)
    if isinstance(f, ca.Function):
        _check_arguments("f", f)
        n = _agreed("n", n, f.numel_in(0))
        # An input may act on the output alone.
        known = [one for one in (f, h) if isinstance(one, ca.Function) and one.n_in() > 1]
        if known or m is None or isinstance(h, ca.Function):
            m = _agreed("m", m, known[0].numel_in(1) if known else 0)
    elif n is None:
        raise InvalidInputError("n is missing, and f is no casadi.Function, which would define it.")
    n, m = dimension("n", n, 1), dimension("m", 0 if m is None else m, 0)
    made_f = _canonical(ca, "f", f, n, m)
    made_h = _canonical(ca, "h", h, n, m)
    check_inputs(m, **{
        name: one.n_in() > 1 if isinstance(one, ca.Function) else takes_input(name, one, m)
        for name, one in (("f", f), ("h", h))
    })
    _agreed("the number of values of f", n, made_f.numel_out(0))
    p = _agreed("p", p, made_h.numel_out(0))
    if dt is None:
        return CasadiModel(made_f, made_h, n, p, m)
    return CasadiModel(made_f, made_h, n, p, m, positive("dt", dt), how)


def integrated(model: CasadiModel) -> tuple[str, ...]:
    """Which of f and h call an integrator of variable steps."""
    kinds = {"CvodesInterface", "IdasInterface"}
    return tuple(
        name for name in ("f", "h")
        if any(one.class_name() in kinds for one in getattr(model, name).find_functions())
    )


def _check_arguments(name: str, function: Any) -> None:
    if function.n_in() not in (1, 2) or function.n_out() != 1:
        raise ModelError(
            f"{name} has {function.n_in()} inputs and {function.n_out()} outputs; expected "
            "(x) or (x, u) to one column."
        )


def _agreed(name: str, stated: int | None, found: int) -> int:
    if stated is not None and stated != found:
        raise ModelError(f"{name} is {found}, according to the function; expected {stated}.")
    return int(found)


def symbols(function: Any, n: int, m: int) -> tuple[Any, Any]:
    """Columns x (n,) and u (m,) of symbols of the kind that a function takes."""
    ca = import_casadi()
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    return kind.sym("x", n), kind.sym("u", m)


def _canonical(ca: Any, name: str, given: Any, n: int, m: int) -> Any:
    """(x, u) to a dense column, of scalar operations where that is possible."""
    call: Callable[[Any, Any], Any]
    if isinstance(given, ca.Function):
        _check_arguments(name, given)
        sizes = [given.numel_in(i) for i in range(given.n_in())]
        if sizes[0] != n or (len(sizes) > 1 and sizes[1] != m):
            raise ModelError(
                f"{name} takes arguments of sizes {sizes}; expected n = {n}"
                + (f" and m = {m}." if m else ", and no inputs.")
            )
        call = given if given.n_in() > 1 else _without_input(given)
    elif callable(given):
        call = given if takes_input(name, given, m) else _without_input(given)
    else:
        raise ModelError(f"{name} is {given!r}; expected a casadi.Function or a callable.")
    error: Exception | None = None
    graph = _graph(ca, name, call, n, m)
    # Scalar operations are quicker, but cannot break off.
    asserting = graph is not None and _asserts(ca, graph)
    if graph is not None and not asserting:
        found = with_products(graph)
        if found is not None:
            _check_same(ca, name, call, found, n, m)
            return found
    for kind in (ca.MX,) if asserting else (ca.SX, ca.MX):
        x, u = kind.sym("x", n), kind.sym("u", m)
        try:
            value = call(x, u)
            if isinstance(value, (list, tuple)):
                value = ca.vertcat(*value)
            function = ca.Function(name, [x, u], [ca.densify(ca.vec(kind(value)))])
        except Exception as caught:  # whatever the user's function makes of symbols
            error = caught
            continue
        if not asserting:
            with suppress(Exception):  # operations that have no scalar form
                function = function.expand()
        _check_same(ca, name, call, function, n, m)
        return function
    raise ModelError(
        f"{name} cannot be evaluated on CasADi symbols ({type(error).__name__}: {error}); write "
        "it with CasADi's functions (casadi.sin, casadi.vertcat), or use qpmhe.System."
    )


def _check_same(
    ca: Any, name: str, call: Callable[[Any, Any], Any], function: Any, n: int, m: int
) -> None:
    """Compare the expression with what the user gave, on numbers; what takes none is left out."""
    generator = np.random.default_rng(0)
    for scale in (1.0, 0.1, 10.0):
        x, u = (scale * generator.uniform(0.2, 1.0, size) for size in (n, m))
        try:
            with quiet():
                value = call(ca.DM(x), ca.DM(u))
                if isinstance(value, (list, tuple)):
                    value = ca.vertcat(*value)
                theirs = ca.DM(value).full().ravel(order="F")
                mine = function(x, u).full().ravel()
        except Exception:  # of symbols alone, or outside of its domain
            continue
        size = np.max(np.abs(theirs), initial=0.0, where=np.isfinite(theirs))
        if theirs.size == mine.size and not np.allclose(
            theirs, mine, rtol=1e-9, atol=1e-9 * size, equal_nan=True
        ):
            raise ModelError(
                f"{name} returns {theirs.tolist()} for the numbers {x.tolist()}, and its "
                f"expression of CasADi symbols is {mine.tolist()} there: it depends on more than "
                "its arguments, or on their types; write one formula for both."
            )


def _graph(ca: Any, name: str, call: Callable[[Any, Any], Any], n: int, m: int) -> Any:
    """A function as a graph of matrices, to look into; None if it takes scalars alone."""
    x, u = ca.MX.sym("x", n), ca.MX.sym("u", m)
    try:
        value = call(x, u)
        if isinstance(value, (list, tuple)):
            value = ca.vertcat(*value)
        return ca.Function(name, [x, u], [ca.vec(ca.MX(value))])
    except Exception:  # of scalar operations alone, or reported when it is used
        return None


def _asserts(ca: Any, function: Any) -> bool:
    """Whether there is an assertion (attachAssert) in a graph, or in a function that it calls."""
    return any(
        one.is_a("MXFunction")
        and any(one.instruction_id(k) == ca.OP_ASSERTION for k in range(one.n_instructions()))
        for one in functions_within(function)
    )


def functions_within(function: Any) -> Iterator[Any]:
    """A function and all that it calls."""
    found, waiting = set(), [function]
    while waiting:
        one = waiting.pop()
        if hash(one) in found:
            continue
        found.add(hash(one))
        yield one
        # Those of a graph, and those of a map or switch.
        waiting += one.find_functions()
        waiting += [one.get_function(name) for name in one.get_function()]


def _without_input(function: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda x, _: function(x)
