"""Which states flow into which, as structure, and an order in which to eliminate them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .expressions import CasadiModel

Pattern = NDArray[np.bool_]


def flow_pattern(model: CasadiModel) -> Pattern:
    """Where the derivative (n, n) of the rate by x, with z following, may have entries."""
    n, full = model.n, np.zeros((model.width, model.width), np.bool_)
    full.flat[model.with_jacobian("f")[1]] = True
    own, k = full[:n, :n], model.width - n
    if not k:
        return own
    from scipy.sparse import csr_matrix  # late: `import qpmhe` does without
    from scipy.sparse.csgraph import maximum_bipartite_matching

    # With the equation that each z has by itself, z follows those of all z that it reaches.
    rows = maximum_bipartite_matching(csr_matrix(full[n:, n:]), perm_type="row")
    equations = full[n:][rows]
    reached = equations[:, n:] | np.eye(k, dtype=np.bool_)
    for _ in range(k.bit_length()):
        reached = reached @ reached
    found: Pattern = own | full[:n, n:] @ reached @ equations[:, :n]
    return found


def few_fill_ins(pattern: Pattern) -> tuple[list[int], list[list[int]]]:
    """An order of elimination by least degrees, and the states that each is beside at its turn.

    Among equal degrees, those first that wait for the fewest others in a row: a processor works at
    both ends of a chain at the same time.
    """
    beside = [set(np.flatnonzero(row).tolist()) - {a} for a, row in enumerate(pattern | pattern.T)]
    left, order, near, waits = set(range(len(beside))), [], [], [0] * len(beside)
    while left:
        one = min(left, key=lambda a: (len(beside[a]), waits[a], a))
        left.remove(one)
        order.append(one)
        near.append(sorted(beside[one]))
        for a in beside[one]:
            beside[a] = (beside[a] | beside[one]) - {a, one}
            waits[a] = max(waits[a], waits[one] + 1)
    return order, near
