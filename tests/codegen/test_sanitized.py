"""The written C, watched by sanitizers at every level of optimisation that the engine uses."""

import numpy as np
import pytest

from qpmhe.codegen import compiler

from .cases import CASES, case
from .driver import CC, FLAGS, built, driven, recorded, wild

pytestmark = pytest.mark.skipif(CC is None, reason="there is no C compiler")
WATCHED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def turns():
    """All cases at all levels; in the sample, each at one of the levels in turn."""
    levels = compiler._LEVELS
    for i, name in enumerate(CASES):
        for k, level in enumerate(levels):
            marks = () if i % len(levels) == k else pytest.mark.slow
            yield pytest.param(name, level, marks=marks, id=f"{name}{level[0]}")


@pytest.mark.parametrize(("name", "level"), list(turns()))
def test_the_written_code_is_clean(name, level, tmp_path):
    one, (start, samples, expected) = case(name), recorded(name)
    program = built(name, tmp_path, (*FLAGS, *level, *WATCHED))
    for record in (samples, wild(name)):
        found = driven(program, start, record)
        assert (found[:, 0] <= found[:, 1]).all()
        assert np.isfinite(found[:, 2:]).all()
        if record is samples:
            finite = np.isfinite(expected)
            assert (np.isfinite(found) == finite).all()
            sizes = np.where(finite, np.abs(expected), 0.0).max(axis=0)
            apart = np.abs(np.where(finite, found, 0.0) - np.where(finite, expected, 0.0))
            # Beside a column that is nearly zero, another one's rounding.
            sizes = np.maximum(sizes, 1e-3 * sizes.max())
            assert (apart <= 10 * one.tolerance * sizes).all()
