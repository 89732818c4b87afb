"""A system's functions as nodes of a graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..model.expressions import CasadiModel, import_casadi
from ..model.system import System
from ..model.tracing import Traced
from .graph import CONDITIONS, Graph

#: How the reason ends for functions that no other way of writing them gives an expression.
SOLVES = "which solves equations"


def expression_of(system: System, name: str) -> Traced:
    """F or h of a system as a CasADi function of one column of states and inputs."""
    if system.origin.equations is not None:
        return Traced(None, f"it has algebraic states, {SOLVES}")
    tracing, model = system.tracing, system.symbolic if system.tracing is None else None
    if tracing is not None:
        found = tracing.scalar(name)
        if found.function is None:
            return found
        model = CasadiModel(
            found.function, found.function, system.n, system.p, system.m, tracing.dt,
            tracing.how,
        )
    if model is None:
        return Traced(None, "it was not made of functions that are known")
    if name == "f" and model.is_implicit:
        return Traced(None, f"it is an implicit step, {SOLVES}")
    ca = import_casadi()
    x, u = ca.SX.sym("x", system.n), ca.SX.sym("u", system.m)
    try:
        value = (
            model.step().expand()(x, u, model.dt or 0.0) if name == "f"
            else model.h.expand()(x, u)
        )
    except RuntimeError as error:
        return Traced(None, f"CasADi has no scalar form of it ({str(error).splitlines()[-1]})")
    return Traced(ca.Function(name, [ca.vertcat(x, u)], [ca.densify(value)]), "")


def read(graph: Graph, function: Any) -> list[int]:
    """The nodes of the entries that a casadi.Function returns, of one column of the variables."""
    ca = import_casadi()
    names = {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}
    work: dict[int, int] = {}
    results = [graph.constant(0.0)] * function.numel_out(0)
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_INPUT:
            work[outputs[0]] = graph.variables[inputs[1]]
        elif code == ca.OP_CONST:
            work[outputs[0]] = graph.constant(function.instruction_constant(k))
        elif code == ca.OP_OUTPUT:
            results[outputs[1]] = _settled(graph, work[inputs[0]])
        else:
            nodes = [work[one] for one in inputs]
            work[outputs[0]] = _operation(graph, names[code], nodes)
    return results


def _settled(graph: Graph, node: int) -> int:
    """A number in place of a condition, or of half of a choice."""
    operation, arguments, _ = graph.nodes[node]
    if operation == "pick":
        return graph.choice(arguments[0], arguments[1], graph.constant(0.0))
    return graph.of("truth", node) if operation in CONDITIONS else node


def _condition(graph: Graph, node: int) -> int:
    """What is not zero, as a condition."""
    if graph.nodes[node][0] in CONDITIONS:
        return node
    return graph.negated(_equal(graph, _settled(graph, node), graph.constant(0.0)))


def _pick(graph: Graph, c: int, a: int) -> int:
    c, a = _condition(graph, c), _settled(graph, a)
    return a if graph.value(a) == 0.0 else graph.of("pick", c, a)


def _add(graph: Graph, a: int, b: int) -> int:
    if graph.nodes[a][0] == graph.nodes[b][0] == "pick":
        (c, first), (other, second) = graph.nodes[a][1], graph.nodes[b][1]
        if c == graph.negated(other):
            return graph.choice(c, first, second)
    return graph.add(_settled(graph, a), _settled(graph, b))


def _divided(graph: Graph, a: int, b: int) -> int:
    if graph.value(a) == 1.0 and graph.nodes[b][0] == "add":
        # 1 / (1 + exp(s)), whose derivatives are enclosed as those of one function.
        for one, other in (graph.nodes[b][1], graph.nodes[b][1][::-1]):
            if graph.value(one) == 1.0 and graph.nodes[other][0] == "exp":
                return graph.of("sigmoid", graph.neg(graph.nodes[other][1][0]))
    return graph.mul(a, graph.power(b, -1))


def _raised(graph: Graph, a: int, b: int) -> int:
    exponent = graph.value(b)
    if exponent is not None:
        return graph.raised(a, exponent)
    return graph.of("exp", graph.mul(b, graph.of("log", a)))


def _equal(graph: Graph, a: int, b: int) -> int:
    return graph.of("equal", *sorted((a, b)))


_Reader = Callable[..., int]
_OF_CONDITIONS: dict[str, _Reader] = {
    "AND": lambda graph, a, b: graph.of("and", a, b),
    "OR": lambda graph, a, b: graph.of("or", a, b), "NOT": Graph.negated,
}
_OF_NUMBERS: dict[str, _Reader] = {
    "SUB": Graph.sub, "MUL": Graph.mul, "NEG": Graph.neg, "DIV": _divided, "SQRT": Graph.root,
    "POW": _raised, "CONSTPOW": _raised, "SQ": lambda graph, a: graph.power(a, 2),
    "TWICE": lambda graph, a: graph.mul(graph.constant(2.0), a),
    "INV": lambda graph, a: _divided(graph, graph.constant(1.0), a),
    "ASSIGN": lambda _, a: a, "LIFT": lambda _, a, *__: a,
    "LT": lambda graph, a, b: graph.of("less", a, b), "LE": Graph.atmost, "EQ": _equal,
    "NE": lambda graph, a, b: graph.negated(_equal(graph, a, b)),
    "FABS": Graph.absolute, "FMAX": Graph.largest, "FMIN": Graph.least,
    "ATAN2": lambda graph, a, b: graph.of("angle", a, b),
    "HYPOT": lambda graph, a, b: graph.of("length", a, b),
    "FMOD": lambda graph, a, b: graph.sub(
        a, graph.mul(b, graph.of("trunc", _divided(graph, a, b)))),
    "COPYSIGN": lambda graph, a, b: graph.choice(
        graph.atmost(graph.constant(0.0), b), graph.absolute(a), graph.neg(graph.absolute(a))),
}
_ELEMENTARY = {
    "EXP", "LOG", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SINH", "COSH", "TANH", "ASINH",
    "ACOSH", "ATANH", "EXPM1", "LOG1P", "ERF", "FLOOR", "CEIL", "SIGN",
}


def _operation(graph: Graph, name: str, nodes: list[int]) -> int:
    """The node of one of CasADi's operations."""
    if name in ("ADD", "IF_ELSE_ZERO"):
        return (_add if name == "ADD" else _pick)(graph, *nodes)
    if name in _OF_CONDITIONS:
        return _OF_CONDITIONS[name](graph, *(_condition(graph, one) for one in nodes))
    nodes = [_settled(graph, one) for one in nodes]
    if name in _ELEMENTARY:
        return graph.of(name.lower(), nodes[0])
    if name in _OF_NUMBERS:
        return _OF_NUMBERS[name](graph, *nodes)
    return graph.node("unknown", parameter=name.lower())
