"""Estimates and snapshots compared bit by bit, and steps that are interrupted."""

import pathlib
import sys

import numpy as np

import qpmhe
from qpmhe.memory.snapshot import read

WITHIN = str(pathlib.Path(qpmhe.__file__).parent)
NAMES = ("trajectory", "state", "filtered", "candidate", "disturbances", "noises")


def assert_same(found, expected, ignoring=None):
    """Equality of all bits of two estimates, but for flags of the status."""
    for name in NAMES:
        one, other = (np.array(getattr(each, name), float) for each in (found, expected))
        np.testing.assert_array_equal(one, other, err_msg=name)
    assert (found.cost, found.candidate_cost) == (expected.cost, expected.candidate_cost)
    assert found.status | (ignoring or found.status) == expected.status | (
        ignoring or expected.status
    )


def leaves(value):
    """A state as a flat list that can be compared."""
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in (key, *leaves(item))]
    if isinstance(value, (list, tuple)):
        return [leaf for item in value for leaf in leaves(item)]
    return [value.tobytes()] if isinstance(value, np.ndarray) else [value]


class Interruption:
    """Raises KeyboardInterrupt at the k-th line of the package."""

    def __init__(self, after):
        self.left, self.count = after, 0

    def __enter__(self):
        self.before = sys.gettrace()
        sys.settrace(self.call)
        return self

    def __exit__(self, *_):
        sys.settrace(self.before)

    def call(self, frame, event, argument):
        return self.line if frame.f_code.co_filename.startswith(WITHIN) else None

    def line(self, frame, event, argument):
        if event == "line":
            self.count += 1
            if self.count == self.left:
                raise KeyboardInterrupt
        return self.line


def interrupted(mhe, do, generator, stride):
    """Interrupt something again and again, each time at a later line, until it is done."""
    before, after = leaves(read(mhe.state_dict())), 1
    while True:
        found = None
        with Interruption(after) as interruption:
            try:
                found = do(mhe)
            except KeyboardInterrupt:
                assert leaves(read(mhe.state_dict())) == before, after
        if interruption.count < after:
            return found
        assert found is None, "the interrupt was swallowed"
        after += 1 if after < 4 else int(generator.integers(1, stride))
