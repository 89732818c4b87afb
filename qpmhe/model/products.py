"""Products with large constant matrices as one operation each, in functions and their Jacobians.

A trace consists of scalar operations (casadi.SX), and a product with a dense matrix would take one
for each of its entries. New symbols stand for the product instead. The scalar operations between
products become functions, which a graph of matrices (casadi.MX) calls in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

#: A matrix of at least so many nonzeros is kept as one. From 20 by 20 on, loops are faster than as
#: many scalar operations in C, and compiled in less than half the time. Where less than half of a
#: matrix is nonzero, loops over indices run 1.5 times as long; from so many nonzeros on, the
#: scalar operations would be in a compiler for seconds.
LEAST, LEAST_SPARSE = 400, 2000
#: A function of more operations takes longer in CasADi's virtual machine, and in a compiler, than
#: it is worth; of many states, so many for each are worth it.
MOST_OPERATIONS, MOST_OF_EACH = 20_000, 50


def _casadi() -> Any:
    import casadi  # late: `import qpmhe` does without

    return casadi


class _Product(NamedTuple):
    """W = C V, with symbols in place of W."""

    symbols: Any
    matrix: Any
    values: Any


class Products:
    """The products of one trace."""

    def __init__(self) -> None:
        self._found: list[_Product] = []

    def of(self, left: Any, right: Any) -> Any:
        """The product, symbols that stand for it if one side is a large matrix of numbers."""
        ca = _casadi()
        if _is_large(left) and isinstance(right, ca.SX):
            symbols = ca.SX.sym("w", left.size1(), right.size2())
            self._found.append(_Product(symbols, left, right))
            return symbols
        if _is_large(right) and isinstance(left, ca.SX):
            return self.of(right.T, left.T).T
        return ca.mtimes(left, right)

    def function(self, name: str, columns: list[Any], result: Any) -> Any:
        """A function of these columns of symbols to a result in which products may stand."""
        ca = _casadi()
        if not self._found:
            return ca.Function(name, columns, [result])
        depths: dict[int, int] = {}
        levels: dict[int, list[_Product]] = {}
        for one in self._found:
            depth = 1 + max((depths.get(key, 0) for key in _symbols(one.values)), default=0)
            depths.update(dict.fromkeys(_symbols(one.symbols), depth))
            levels.setdefault(depth, []).append(one)
        arguments = [ca.MX.sym(f"a{k}", column.numel()) for k, column in enumerate(columns)]
        known = list(zip(columns, arguments, strict=True))

        def part(values: list[Any]) -> Any:
            used = {key for value in values for key in _symbols(value)}
            given = [pair for pair in known if used.intersection(_symbols(pair[0]))]
            made = ca.Function("part", [one for one, _ in given], values)
            return made.call([one for _, one in given])

        for depth in sorted(levels):
            group = levels[depth]
            found = part([ca.densify(ca.vec(one.values)) for one in group])
            for one, value in zip(group, found, strict=True):
                columns_of = ca.reshape(value, *one.values.shape)
                product = ca.mtimes(ca.MX(one.matrix), columns_of)
                known.append((ca.vec(one.symbols), ca.vec(product)))
        return ca.Function(name, arguments, part([result]))


def with_products(function: Any) -> Any:
    """A graph of matrices (MX) in another form: between products, it has scalar operations.

    Each product with a large constant matrix is one operation. None where there is no such product,
    or where an operation has no scalar form.
    """
    if not any(_multiplies(one) for one in _graphs(function)):
        return None
    ca, products = _casadi(), Products()
    columns = [ca.SX.sym(f"a{k}", function.numel_in(k)) for k in range(function.n_in())]
    try:
        result, = _evaluated(function, columns, products)
    except Exception:  # whatever CasADi makes of it
        return None
    made = products.function(function.name(), columns, ca.densify(ca.SX(result)))
    return made if has_products(made) else None


def _graphs(function: Any) -> Iterator[Any]:
    """A function and those that it calls, if they are graphs of matrices."""
    if function.is_a("MXFunction"):
        yield function
        for one in function.find_functions():
            if one.is_a("MXFunction"):
                yield one


def _multiplies(function: Any) -> bool:
    """Whether there is a product with a large constant matrix in a graph."""
    mtimes = _casadi().OP_MTIMES
    return any(
        code == mtimes and any(node.dep(i).numel() >= LEAST for i in (1, 2))
        for code, node in _instructions(function)
    )


def _instructions(function: Any) -> Iterator[tuple[int, Any]]:
    """The code and the node of each instruction of a graph, in their order."""
    for k in range(function.n_instructions()):
        yield function.instruction_id(k), function.instruction_MX(k)


def _evaluated(function: Any, arguments: list[Any], products: Products) -> list[Any]:
    """The values of a graph for scalar symbols, with its products among ``products``."""
    ca = _casadi()
    if not function.is_a("MXFunction"):
        return list(function.call([ca.SX(one) for one in arguments]))

    def evaluate(code: int, node: Any, given: list[Any]) -> list[Any]:
        if code == ca.OP_CONST:
            return [ca.sparsify(node.to_DM())]
        if code == ca.OP_RESHAPE:
            return [ca.reshape(given[0], *node.shape)]
        if code == ca.OP_MTIMES:
            into, left, right = given
            return [into + products.of(left, right)]
        if code == ca.OP_CALL:
            return _evaluated(node.which_function(), given, products)
        operands = [node.dep(i) for i in range(node.n_dep())]
        symbols = [ca.MX.sym("a", one.sparsity()) for one in operands]
        operation = ca.Function("one", symbols, [ca.graph_substitute(node, operands, symbols)])
        return list(operation.call([ca.SX(one) for one in given]))

    return _walked(function, arguments, evaluate)


def _walked(function: Any, arguments: list[Any], evaluate: Callable[..., list[Any]]) -> list[Any]:
    """The results of a graph, by a function of each instruction's code, node and operands."""
    ca = _casadi()
    work: dict[int, Any] = {}
    results: list[Any] = [None] * function.n_out()
    for k, (code, node) in enumerate(_instructions(function)):
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_INPUT:
            work[outputs[0]] = arguments[inputs[0]]
        elif code == ca.OP_OUTPUT:
            results[outputs[0]] = work[inputs[0]]
        else:
            found = evaluate(code, node, [work[one] for one in inputs])
            work.update(zip(outputs, found, strict=True))
    return results


def _is_large(matrix: Any) -> bool:
    if not isinstance(matrix, _casadi().DM) or matrix.size2() < 2:  # one column has no sums
        return False
    least = LEAST if 2 * matrix.nnz() >= matrix.numel() else LEAST_SPARSE
    return bool(matrix.nnz() >= least and matrix.is_regular())


def _symbols(value: Any) -> list[int]:
    return [one.element_hash() for one in _casadi().symvar(value)]


def operations(function: Any) -> int:
    """The number of operations of a function: a product is one."""
    if function.is_a("SXFunction"):
        return int(function.n_instructions())
    ca = _casadi()
    return sum(
        operations(node.which_function()) if code == ca.OP_CALL else 1
        for code, node in _instructions(function)
    )


def has_products(function: Any) -> bool:
    """Whether it consists of products with constant matrices, and of functions of scalars."""
    if not function.is_a("MXFunction"):
        return False
    ca, products = _casadi(), False
    known = (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_RESHAPE)
    for code, node in _instructions(function):
        if code == ca.OP_CALL:
            inner = node.which_function()
            products |= has_products(inner)
            if not (inner.is_a("SXFunction") or has_products(inner)):
                return False
        elif code == ca.OP_MTIMES:
            if not (node.dep(0).is_zero() and node.dep(1).is_constant()):
                return False
            products = True
        elif code not in known and not (code == ca.OP_PROJECT and node.is_dense()):
            return False
    return products


def in_scalars(function: Any) -> Any:
    """The same function in scalar operations alone, where these are not too many."""
    if not has_products(function):
        return function
    found = function.expand()
    return found if found.n_instructions() <= MOST_OPERATIONS else function


# A value, and its derivative by x, if it has one.
_Known = tuple[Any, Any]


def with_slope(function: Any, x: Any, u: Any) -> tuple[Any, Any]:
    """The value of a function of x and u, and its Jacobian by x."""
    ca = _casadi()
    if not has_products(function):
        value = function(x, u)
        return value, ca.jacobian(value, x)
    (value, slope), = _differentiated(function, [(x, ca.MX.eye(x.numel())), (u, None)])
    return value, ca.MX(value.numel(), x.numel()) if slope is None else slope


def _differentiated(function: Any, arguments: list[_Known]) -> list[_Known]:
    """The values of a function that has products, and their derivatives."""
    ca = _casadi()

    def evaluate(code: int, node: Any, given: list[_Known]) -> list[_Known]:
        if code == ca.OP_CONST:
            return [(node, None)]
        if code == ca.OP_CALL:
            inner = node.which_function()
            of = _of_scalars if inner.is_a("SXFunction") else _differentiated
            return of(inner, given)
        if code == ca.OP_MTIMES:
            (matrix, _), (value, slope) = given[1:]
            return [(ca.mtimes(matrix, value), _moved(matrix, slope))]
        (value, slope), = given
        is_reshape = code == ca.OP_RESHAPE
        return [(ca.reshape(value, *node.shape) if is_reshape else ca.densify(value), slope)]

    return _walked(function, arguments, evaluate)


def _moved(matrix: Any, slope: Any) -> Any:
    """The derivative of C V, column by column, from the derivative of the entries of V."""
    if slope is None:
        return None
    ca, (rows, inner), count = _casadi(), matrix.shape, slope.shape[0] // matrix.shape[1]
    columns = slope.shape[1]
    moved = _product(matrix, ca.reshape(slope, inner, count * columns))
    return ca.reshape(moved, rows * count, columns)


def _product(left: Any, right: Any) -> Any:
    """A matrix product, a matrix of numbers if both are."""
    ca = _casadi()
    if right.is_eye() or left.is_eye():
        return left if right.is_eye() else right
    if left.is_constant() and right.is_constant():
        return ca.MX(ca.mtimes(left.to_DM(), right.to_DM()))
    return ca.mtimes(left, right)


def _of_scalars(function: Any, arguments: list[_Known]) -> list[_Known]:
    """The values of a function of scalar operations, and their derivatives."""
    ca = _casadi()
    symbols = [ca.SX.sym("a", *function.size_in(i)) for i in range(function.n_in())]
    values = function.call(symbols)
    blocks = {
        (i, j): ca.jacobian(value, symbols[j])
        for i, value in enumerate(values)
        for j, (_, slope) in enumerate(arguments) if slope is not None
    }
    variable = [key for key, block in blocks.items() if not block.is_constant()]
    made = ca.Function("part", symbols, [*values, *(blocks[key] for key in variable)])
    found = made.call([value for value, _ in arguments])
    matrices = {key: ca.MX(ca.DM(block)) for key, block in blocks.items() if block.is_constant()}
    matrices |= dict(zip(variable, found[len(values) :], strict=True))
    results: list[_Known] = []
    for i, value in enumerate(found[: len(values)]):
        terms = [
            _product(matrices[i, j], arguments[j][1])
            for j in range(len(arguments)) if (i, j) in matrices and matrices[i, j].nnz()
        ]
        results.append((value, _sum(terms)))
    return results


def _sum(terms: list[Any]) -> Any:
    if not terms:
        return None
    ca = _casadi()
    if all(one.is_constant() for one in terms):
        return ca.MX(sum((one.to_DM() for one in terms[1:]), terms[0].to_DM()))
    return sum(terms[1:], terms[0])
