"""Types, ranges and operations of C expressions, by their syntax trees."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pycparser import CParser, c_ast

from .preprocessed import preprocessed
from .ranges import (
    ANY,
    TRUTH,
    Place,
    Range,
    arithmetic,
    compared,
    exact,
    joined,
    joined_ranges,
    span,
    truth_of,
)

INTEGER, REAL, VOID = ("integer",), ("real",), ("void",)
KINDS = {"+": "additions", "-": "additions", "*": "multiplications", "/": "divisions"}
# The standard headers' types that our code names.
_TYPES = "".join(
    f"typedef int {name};\n" for name in (
        "size_t", "int8_t", "uint8_t", "int32_t", "int64_t", "uint32_t", "ptrdiff_t",
    )
)


class UnboundedError(Exception):
    """A loop, or a call, of which the walk finds no bound."""


@dataclass(frozen=True)
class Known:
    """What the code does not say of itself.

    Attributes
    ----------
    counted : dict
        Members of structures that are no larger than an array beside them is long, by the names of
        structure and member: this array, and arrays by whose lengths that is divided.
    members : dict
        Ranges of other members.
    most_calls : dict of int
        How often functions are called at most, in all; each may call those behind it.
    settings : str
        A constant structure whose integers all others of its type have.
    """

    counted: Mapping[tuple[str, str], tuple[str, ...]]
    members: Mapping[tuple[str, str], Range]
    most_calls: Mapping[str, int]
    settings: str = ""


@dataclass
class Frame:
    """The call that is walked: its function, its variables' ranges and types, what it returns."""

    name: str
    ranges: dict[str, Any] = field(default_factory=dict)
    types: dict[str, Any] = field(default_factory=dict)
    returned: Any = None
    # What is assigned to variables, since the innermost loop began.
    assigned: dict[str, Any] = field(default_factory=dict)
    results: dict[str, Any] | None = None


class Expressions(ABC):
    """Operations and ranges of the expressions of a C source, in the call that is walked."""

    def __init__(self, source: str, prefix: str, known: Known) -> None:
        self._prefix = f"{prefix}_"
        self._known = known
        self._members = dict(known.members)
        self._types: dict[str, Any] = {}
        self._structures: dict[str, dict[str, Any]] = {}
        self._globals: dict[str, Any] = {}
        self._numbers: dict[str, Any] = {}
        self._functions: dict[str, Any] = {}
        self._walked = 0  # loops so far, each time that they are walked
        self._done: dict[Any, tuple[Counter[Any], Any, dict[str, Any]]] = {}
        self._sizes = {REAL: 8, INTEGER: 4}
        # Expressions whose cost is the same in all calls, by their nodes' places in the memory.
        self._plain: dict[int, Counter[Any]] = {}
        self._changed: dict[int, dict[str, Any]] = {}
        self._spent: Counter[Any] = Counter()
        self._frame = Frame("")
        text = preprocessed(source)
        lines = (line for line in text.splitlines() if 'extern "C"' not in line)
        self._tree = CParser().parse(_TYPES + "\n".join(lines))
        self._enter(self._tree)

    # Declarations

    def _enter(self, tree: Any) -> None:
        for one in tree.ext:
            if isinstance(one, c_ast.Typedef):
                self._types[one.name] = self._type(one.type, one.name)
            elif isinstance(one, c_ast.FuncDef):
                self._functions[one.decl.name] = one
                self._globals[one.decl.name] = self._type(one.decl.type)
            elif isinstance(one, c_ast.Decl):
                if one.name is None:
                    self._type(one.type)
                    continue
                self._globals[one.name] = self._declared(one)
                if one.name == self._known.settings and one.init is not None:
                    self._enter_settings(one)
                    continue
                if one.init is not None and "const" in one.quals + _qualifiers(one.type):
                    self._numbers[one.name] = self._table(one.init)

    def _enter_settings(self, node: Any) -> None:
        """The integers of a constant structure."""
        kind = self._type(node.type)
        for one in node.init.exprs:
            if self._structures[kind[1]][one.name[0].name] == INTEGER:
                self._members[kind[1], one.name[0].name] = span(self._value(one.expr)[1])

    def _table(self, values: Any) -> Place | None:
        """A constant array of integers."""
        if not isinstance(values, c_ast.InitList):
            return None
        numbers = []
        for one in values.exprs:
            kind, value = (None, ANY) if isinstance(
                one, (c_ast.InitList, c_ast.NamedInitializer)
            ) else self._value(one)
            if kind != INTEGER or not exact(value):
                return None
            numbers.append(int(value[0]))
        return Place(tuple(numbers), 0)

    def _type(self, node: Any, name: str = "") -> Any:
        if isinstance(node, (c_ast.TypeDecl, c_ast.Typename, c_ast.Decl)):
            return self._type(node.type, name)
        if isinstance(node, c_ast.PtrDecl):
            return "to", self._type(node.type), None
        if isinstance(node, c_ast.ArrayDecl):
            length = ANY if node.dim is None else self._value(node.dim)[1]
            return "to", self._type(node.type), int(length[0]) if exact(length) else None
        if isinstance(node, c_ast.FuncDecl):
            return "function", self._type(node.type)
        if isinstance(node, c_ast.Struct):
            own = (name or node.name or str(id(node))).removeprefix(self._prefix)
            if node.decls:
                self._structures[own] = {one.name: self._type(one.type) for one in node.decls}
                self._enter_counted(own)
            return "structure", own
        if isinstance(node, c_ast.Enum):
            self._enter_enumerators(node)
            return INTEGER
        words = " ".join(node.names)
        if words in self._types:
            return self._types[words]
        return {"double": REAL, "float": REAL, "void": VOID}.get(words, INTEGER)

    def _enter_counted(self, structure: str) -> None:
        kinds = self._structures[structure]
        for (of, member), (array, *parts) in self._known.counted.items():
            if of == structure:
                length = kinds[array][2] // math.prod(kinds[one][2] for one in parts)
                self._members[of, member] = 0, length

    def _enter_enumerators(self, node: Any) -> None:
        following: Any = 0
        for one in node.values.enumerators if node.values else ():
            if one.value is not None:
                following = self._value(one.value)[1][0]
            self._numbers[one.name] = (following, following)
            self._globals[one.name] = INTEGER
            following += 1

    def _declared(self, node: Any) -> Any:
        """The type of a declaration, whose initializer may say its length."""
        kind = self._type(node.type)
        if kind[0] == "to" and kind[2] is None and isinstance(node.init, c_ast.InitList):
            return "to", kind[1], len(node.init.exprs)
        return kind

    # Expressions

    def _measured(self, node: Any) -> tuple[Counter[Any], Any]:
        """The cost of an expression, and its range."""
        if id(node) in self._plain:
            return self._plain[id(node)], ANY
        outer, self._spent = self._spent, Counter()
        kind, value = self._value(node)
        cost, self._spent = self._spent, outer
        if kind == REAL and self._is_plain(node):
            self._plain[id(node)] = cost
        return cost, value

    def _is_plain(self, node: Any) -> bool:
        """Whether the cost is the same for all ranges, and no range changes."""
        if isinstance(node, (c_ast.FuncCall, c_ast.TernaryOp, c_ast.UnaryOp)) and not (
            isinstance(node, c_ast.UnaryOp) and node.op in ("-", "*", "+")
        ):
            return isinstance(node, c_ast.FuncCall) and isinstance(node.name, c_ast.ID) and (
                node.name.name.removesuffix("f") in ("fabs", "sqrt")
            ) and all(self._is_plain(one) for one in node.args.exprs)
        if isinstance(node, c_ast.BinaryOp) and node.op in ("&&", "||"):
            return False
        variable = name_of(node.lvalue) if isinstance(node, c_ast.Assignment) else ""
        if variable and self._frame.types.get(variable, REAL) != REAL:
            return False
        return all(self._is_plain(child) for _, child in node.children())

    def _value(self, node: Any) -> tuple[Any, Any]:
        """Type and range of an expression, whose operations are counted."""
        found: tuple[Any, Any] = getattr(self, f"_of_{type(node).__name__.lower()}")(node)
        return found

    def _of_constant(self, node: Any) -> tuple[Any, Any]:
        if node.type in ("float", "double", "long double"):
            return REAL, ANY
        if node.type in ("string", "char"):
            return INTEGER, ANY
        digits = node.value.rstrip("uUlL")
        number = int(digits, 8 if digits.isdigit() and digits[0] == "0" else 0)
        return INTEGER, (number, number)

    def _of_id(self, node: Any) -> tuple[Any, Any]:
        name = node.name
        if name in self._frame.types:
            return self._frame.types[name], self._frame.ranges.get(name, ANY)
        if name in self._functions:
            return self._globals[name], name
        if name in self._globals:
            return self._globals[name], self._numbers.get(name) or ANY
        return REAL if name in ("NAN", "INFINITY") else INTEGER, ANY

    def _of_structref(self, node: Any) -> tuple[Any, Any]:
        kind, _ = self._value(node.name)
        if kind[0] == "to":
            kind = kind[1]
        if kind[0] != "structure":
            raise UnboundedError(f"{self._frame.name} reads {node.field.name} of no structure")
        known = self._members.get((kind[1], node.field.name), ANY)
        return self._structures[kind[1]][node.field.name], known

    def _of_arrayref(self, node: Any) -> tuple[Any, Any]:
        kind, array = self._value(node.name)
        _, index = self._value(node.subscript)
        if isinstance(node.name, c_ast.StructRef) and kind[1] == INTEGER and array != ANY:
            return kind[1], array
        if isinstance(array, Place) and isinstance(array.base, tuple):
            low, high = span(index)
            numbers = array.base
            if low > -math.inf and high < math.inf:
                numbers = numbers[max(int(low) + array.offset, 0) : int(high) + array.offset + 1]
            if numbers:
                return kind[1], (min(numbers), max(numbers))
        return kind[1], ANY

    def _of_funccall(self, node: Any) -> tuple[Any, Any]:
        return self._called(node)

    @abstractmethod
    def _called(self, node: Any) -> tuple[Any, Any]:
        """Type and range of what a call returns, whose operations are counted."""

    def _of_cast(self, node: Any) -> tuple[Any, Any]:
        kind = self._type(node.to_type)
        inner, value = self._value(node.expr)
        return kind, value if (inner[0] == "to") == (kind[0] == "to") else ANY

    def _of_exprlist(self, node: Any) -> tuple[Any, Any]:
        return [self._value(one) for one in node.exprs][-1]

    def _of_initlist(self, node: Any) -> tuple[Any, Any]:
        for one in node.exprs:
            self._value(one)
        return VOID, ANY

    def _of_namedinitializer(self, node: Any) -> tuple[Any, Any]:
        return self._value(node.expr)

    def _of_compoundliteral(self, node: Any) -> tuple[Any, Any]:
        self._value(node.init)
        return self._type(node.type), ANY

    def _of_ternaryop(self, node: Any) -> tuple[Any, Any]:
        _, condition = self._value(node.cond)
        truth, before = truth_of(condition), self._frame.ranges
        costs, values, kinds, ends = [], [], [], []
        for is_true, part in ((True, node.iftrue), (False, node.iffalse)):
            if truth not in (None, is_true):
                continue
            self._frame.ranges = dict(before)
            self._refine(node.cond, is_true)
            outer, self._spent = self._spent, Counter()
            kind, value = self._value(part)
            costs.append(self._spent)
            self._spent = outer
            kinds.append(kind)
            values.append(value)
            ends.append(self._frame.ranges)
        self._frame.ranges = joined_ranges(ends)
        self._spent.update(largest(costs))
        kind = next((one for one in kinds if one == REAL), kinds[0])
        pointer = next((one for one in kinds if one[0] == "to"), None)
        value = values[0]
        for one in values[1:]:
            value = joined(value, one)
        return pointer or kind, value

    def _of_assignment(self, node: Any) -> tuple[Any, Any]:
        kind, before = self._value(node.lvalue)
        other, value = self._value(node.rvalue)
        name = name_of(node.lvalue)
        if node.op != "=":
            if kind == REAL:
                self._spent[KINDS[node.op[0]]] += 1
            value = self._combined(node.op[:-1], kind, before, other, value)
        if name:
            self._assign(name, value if kind == INTEGER or isinstance(value, Place) else ANY)
        return kind, value

    def _assign(self, name: str, value: Any) -> None:
        if not isinstance(value, Place):
            self._forget_places(name)
        self._frame.ranges[name] = value
        self._frame.assigned[name] = joined(self._frame.assigned.get(name), value)

    def _forget_places(self, name: str) -> None:
        """Forget what points to where a variable pointed."""
        for one, value in list(self._frame.ranges.items()):
            if isinstance(value, Place) and value.base == name:
                del self._frame.ranges[one]

    def _of_unaryop(self, node: Any) -> tuple[Any, Any]:
        op = node.op
        if op == "sizeof":
            return self._sizeof(node.expr)
        kind, value = self._value(node.expr)
        if op == "*":
            name = name_of(node)
            inner = kind[1] if kind[0] == "to" else kind
            if isinstance(value, Place) and isinstance(value.base, tuple):
                numbers = value.base[value.offset : value.offset + 1]
                return inner, (numbers[0], numbers[0]) if numbers else ANY
            return inner, self._frame.ranges.get(name, ANY) if name else ANY
        if op == "&":
            if isinstance(node.expr, c_ast.ID) and self._frame.types.get(node.expr.name) == INTEGER:
                raise UnboundedError(f"{self._frame.name} keeps the address of {node.expr.name}")
            return ("to", kind, None), ANY
        if op == "!":
            truth = truth_of(value)
            return INTEGER, TRUTH if truth is None else (int(not truth), int(not truth))
        if op in ("p++", "++", "p--", "--"):
            if kind == REAL:
                self._spent["additions"] += 1
            by = 1 if "+" in op else -1
            name = name_of(node.expr)
            moved = self._combined("+", kind, value, INTEGER, (by, by))
            if name:
                self._assign(name, moved)
            return kind, value if op[0] == "p" else moved
        low, high = span(value)
        if op == "-" and kind == INTEGER:
            return kind, (-high, -low)
        if op == "~" and kind == INTEGER and exact(value):
            return kind, (~int(low), ~int(low))
        return kind, value if op == "+" else ANY

    def _sizeof(self, node: Any) -> tuple[Any, Any]:
        outer, self._spent = self._spent, Counter()
        kind = self._type(node) if isinstance(node, c_ast.Typename) else self._value(node)[0]
        self._spent = outer
        size = self._size(kind)
        return INTEGER, ANY if size is None else (size, size)

    def _size(self, kind: Any) -> int | None:
        if kind[0] == "to" and kind[2] is not None:
            inner = self._size(kind[1])
            return None if inner is None else inner * int(kind[2])
        return self._sizes.get(kind)

    def _of_binaryop(self, node: Any) -> tuple[Any, Any]:
        kind, left = self._value(node.left)
        if node.op in ("&&", "||"):
            decided = truth_of(left)
            if decided is (node.op == "||"):
                return INTEGER, (int(decided), int(decided))
            before = self._frame.ranges
            self._frame.ranges = dict(before)
            self._refine(node.left, node.op == "&&")
            _, right = self._value(node.right)
            self._frame.ranges = joined_ranges([before, self._frame.ranges])
            truth = truth_of(right)
            if decided is not None:
                return INTEGER, TRUTH if truth is None else (int(truth), int(truth))
            settles = truth is not None and truth is (node.op == "||")
            return INTEGER, (int(truth or 0),) * 2 if settles else TRUTH
        other, right = self._value(node.right)
        if node.op in ("<", ">", "<=", ">=", "==", "!="):
            if (kind, other) != (INTEGER, INTEGER):
                null = "to" in (kind[0], other[0]) and exact(left) and exact(right)
                return INTEGER, compared(node.op, left, right) if null else TRUTH
            return INTEGER, compared(node.op, left, right)
        if REAL in (kind, other):
            self._spent[KINDS[node.op]] += 1
            return REAL, ANY
        whole = kind if kind[0] == "to" else other if other[0] == "to" else INTEGER
        if kind[0] == other[0] == "to":
            return INTEGER, ANY
        if left == ANY and kind[0] == "to" and isinstance(node.left, c_ast.ID):
            left = Place(node.left.name, 0)
        return whole, self._combined(node.op, kind, left, other, right)

    def _combined(self, op: str, kind: Any, left: Any, other: Any, right: Any) -> Any:
        """The range of a sum, or of another operation, of integers."""
        if isinstance(left, Place) and op in ("+", "-") and exact(right):
            return Place(left.base, left.offset + int(right[0]) * (1 if op == "+" else -1))
        if (kind, other) != (INTEGER, INTEGER):
            return ANY
        return arithmetic(op, span(left), span(right))

    def _refine(self, condition: Any, is_true: bool) -> None:
        """Narrow the ranges of variables by a condition that holds, or does not."""
        if isinstance(condition, c_ast.UnaryOp) and condition.op == "!":
            self._refine(condition.expr, not is_true)
        elif isinstance(condition, c_ast.ID) and self._frame.types.get(condition.name) == INTEGER:
            self._narrow(condition.name, "!=" if is_true else "==", (0, 0))
        if not isinstance(condition, c_ast.BinaryOp):
            return
        op = condition.op
        if op in ("&&", "||"):
            if is_true == (op == "&&"):
                self._refine(condition.left, is_true)
                self._refine(condition.right, is_true)
            return
        opposite = {"<": ">=", ">=": "<", ">": "<=", "<=": ">", "==": "!=", "!=": "=="}
        if op not in opposite:
            return
        op = op if is_true else opposite[op]
        for left, right, own in (
            (condition.left, condition.right, op),
            (condition.right, condition.left, op.translate(str.maketrans("<>", "><"))),
        ):
            name = name_of(left)
            if not name:
                continue
            outer, self._spent = self._spent, Counter()
            kind, _ = self._value(left)
            other, value = (None, ANY) if _changes_something(right) else self._value(right)
            self._spent = outer
            if kind == other == INTEGER:
                self._narrow(name, own, span(value))

    def _narrow(self, name: str, op: str, limit: Range) -> None:
        low, high = span(self._frame.ranges.get(name, ANY))
        if op in ("<", "<="):
            high = min(high, limit[1] - (op == "<"))
        elif op in (">", ">="):
            low = max(low, limit[0] + (op == ">"))
        elif op == "==":
            low, high = max(low, limit[0]), min(high, limit[1])
        elif exact(limit):
            low, high = low + (low == limit[0]), high - (high == limit[0])
        if low <= high:
            self._frame.ranges[name] = (low, high)


def name_of(node: Any) -> str:
    """The variable that is written, or what a pointer points to; blank for all else."""
    if isinstance(node, c_ast.ID):
        return str(node.name)
    if isinstance(node, c_ast.UnaryOp) and node.op == "*" and isinstance(node.expr, c_ast.ID):
        return f"*{node.expr.name}"
    return ""


def _changes_something(node: Any) -> bool:
    if isinstance(node, (c_ast.Assignment, c_ast.FuncCall)):
        return True
    if isinstance(node, c_ast.UnaryOp) and node.op in ("p++", "++", "p--", "--"):
        return True
    return any(_changes_something(child) for _, child in node.children())


def _qualifiers(node: Any) -> list[str]:
    while node is not None:
        if getattr(node, "quals", None):
            return list(node.quals)
        node = getattr(node, "type", None)
    return []


def largest(costs: list[Counter[Any]]) -> Counter[Any]:
    """Of alternatives, the larger number of each kind."""
    found: Counter[Any] = Counter()
    for one in costs:
        found |= one
    return found
