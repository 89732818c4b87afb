"""Few cases in place of every combination of a test's parameters."""

import itertools

import pytest


def covering(strength=2, **axes):
    """Mark a test with cases in which every combination of so many parameters' values occurs.

    One by one, the case is taken that has most combinations which none before it has. With
    ``strength=1``, each value occurs.
    """
    sides = [list(enumerate(values)) for values in axes.values()]
    groups = list(itertools.combinations(range(len(sides)), min(strength, len(sides))))

    def held(case):
        return {(group, *(case[axis][0] for axis in group)) for group in groups}

    every = {case: held(case) for case in itertools.product(*(
        [_Value((number, value)) for number, value in side] for side in sides
    ))}
    left, kept = set().union(*every.values()), []
    while left:
        case = max(every, key=lambda one: len(every[one] & left))
        left -= every.pop(case)
        kept.append(_joined([value for _, value in case]))
    return pytest.mark.parametrize(tuple(axes), kept)


class _Value(tuple):
    """A number and a value that need not be hashable."""

    def __hash__(self):
        return self[0]

    def __eq__(self, other):
        return self[0] == other[0]


def _joined(values):
    """One case of values, some of which have marks."""
    marks, plain = [], []
    for value in values:
        is_marked = isinstance(value, type(pytest.param()))
        marks += value.marks if is_marked else ()
        plain += value.values if is_marked else (value,)
    return pytest.param(*plain, marks=marks)
