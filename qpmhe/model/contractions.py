"""Sums over indices that two arrays share, as matrix products."""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

Names = Sequence[Hashable]


def of_subscripts(subscripts: Any, left: Any, right: Any) -> tuple[Names, Names, Names] | None:
    """The names of both arrays' axes, and of the result's, of `numpy.einsum` in its usual form."""
    if not isinstance(subscripts, str) or subscripts.count(",") != 1:
        return None
    inputs, arrow, output = subscripts.replace(" ", "").partition("->")
    terms = inputs.split(",")
    if not arrow:
        letters = inputs.replace(",", "").replace(".", "")
        once = sorted(one for one in letters if letters.count(one) == 1)
        output = "..." * ("." in inputs) + "".join(once)
    unused = [one for one in string.ascii_letters if one not in subscripts]
    longest = 0
    for k, array in enumerate((left, right)):
        if "..." in terms[k]:
            count = array.ndim - len(terms[k]) + 3
            # They are aligned at their ends.
            terms[k] = terms[k].replace("...", "".join(unused[:count][::-1]))
            longest = max(longest, count)
    output = output.replace("...", "".join(unused[:longest][::-1]))
    if any(len(term) != array.ndim for term, array in zip(terms, (left, right), strict=True)):
        return None
    return list(terms[0]), list(terms[1]), list(output)


def of_axes(axes: Any, left: Any, right: Any) -> tuple[Names, Names, Names]:
    """The names of both arrays' axes, and of the result's, of `numpy.tensordot`."""
    first, second = (
        (range(left.ndim - axes, left.ndim), range(axes)) if isinstance(axes, int)
        else (np.atleast_1d(one).tolist() for one in axes)
    )
    a: list[Hashable] = [("a", k) for k in range(left.ndim)]
    b: list[Hashable] = [("b", k) for k in range(right.ndim)]
    for j, k in zip(first, second, strict=True):
        b[k] = a[j]
    return a, b, [one for one in (*a, *b) if (one in a) != (one in b)]


def product(
    multiply: Callable[[Any, Any], Any], left: Any, right: Any, names: tuple[Names, Names, Names]
) -> Any:
    """The contraction by one matrix product; None where it is none."""
    a, b, output = names
    sums = [one for one in a if one in b]
    rows, columns = ([one for one in part if one not in sums] for part in (a, b))
    kept = [*rows, *columns]
    if not sums or len({*a, *b}) != len(kept) + len(sums) or sorted(map(str, kept)) != sorted(
        map(str, output)
    ):
        return None
    sizes = dict(zip(a, left.shape, strict=True)) | dict(zip(b, right.shape, strict=True))
    inner = math.prod(sizes[one] for one in sums)
    first = left.transpose([a.index(one) for one in (*rows, *sums)]).reshape(-1, inner)
    second = right.transpose([b.index(one) for one in (*sums, *columns)]).reshape(inner, -1)
    found = multiply(first, second).reshape([sizes[one] for one in kept])
    return found.transpose([kept.index(one) for one in output])
