"""The comparison of trees sees what differs, and only that."""

import shutil

import numpy as np
import pytest

from .golden import HERE, Comparison, Server, compare

NAME = "inputs"
PLANTED = """
from .estimation.estimate import Estimate as _Estimate
_made = _Estimate.__init__
def _planted(self, *given, **named):
    _made(self, *given, **named)
    self.cost *= 1.0 + 2.0**-52
_Estimate.__init__ = _planted
"""


def records(**changes):
    """Records of two samples; the second with changes."""
    second = {
        "trajectory": np.array([[0.3, 400.0], [0.2, 500.0]]), "cost": 2.0, "qps": 2,
        "status": ("IMPROVED",), "message": "", "covariances": np.diag([4.0, 1e6])[None],
        "filtered": np.array([np.nan, 0.1]),
    }
    return {"update 0": dict(second), "update 1": second | changes}, {}


def compared(found, expected, flip=-np.inf):
    total = Comparison()
    compare(total, "case", found, expected, flip)
    return total


def different(total):
    return {name: gap for name, (gap, _) in total.gaps.items() if gap > 0.0}


def test_equal_records_have_no_gaps():
    total = compared(records(), records())
    assert (total.samples, total.flips, total.bad_flips, total.lacking) == (2, [], 0, set())
    assert total.gaps.keys() == records()[0]["update 0"].keys() - {"qps", "status"}
    assert different(total) == {}


@pytest.mark.parametrize(("name", "value", "gap"), [
    ("trajectory", np.array([[0.3, 400.0], [0.2 + 3e-16, 500.0]]), 1e-15),
    ("trajectory", np.array([[0.3, 400.0 + 5e-13], [0.2, 500.0]]), 1e-15),
    ("trajectory", np.array([[0.3, 400.0]]), np.inf), ("cost", 2.0 + 2e-15, 1e-15),
    ("covariances", np.array([[[4.0, 2e-12], [0.0, 1e6]]]), 1e-15),
    ("filtered", np.array([0.0, 0.1]), np.inf), ("message", "other", np.inf),
    ("trajectory", None, np.inf), ("cost", np.nan, np.inf),
])
def test_a_change_is_seen_in_its_field_relative_to_its_size(name, value, gap):
    for total in (
        compared(records(**{name: value}), records()), compared(records(), records(**{name: value}))
    ):
        assert different(total) == {name: pytest.approx(gap, rel=0.3)}
        assert total.gaps[name][1] == "case, update 1"
        assert total.flips == []


def test_numbers_of_other_decisions_count_unless_j_is_the_same():
    changes = {"qps": 3, "trajectory": np.zeros((2, 2)), "cost": 2.0 + 2e-14}
    found = compared(records(**changes), records())
    assert different(found).keys() == {"trajectory", "cost"}
    assert found.bad_flips == 1
    assert found.flips == ["case, update 1: qps 2 -> 3; J differs by 1.0e-14 of it"]
    tolerated = compared(records(**changes), records(), flip=1e-13)
    assert (different(tolerated), tolerated.bad_flips, len(tolerated.flips)) == ({}, 0, 1)
    assert compared(records(**changes), records(), flip=1e-15).bad_flips == 1


def test_a_field_of_one_tree_is_named_and_an_error_of_one_counts():
    total = compared(records(angle=1.0), records())
    assert (total.lacking, total.bad_flips) == ({"angle (only here)"}, 0)
    total = compared(records(**{"covariances.error": "no"}), records())
    assert total.bad_flips == 1


def test_a_process_that_ends_is_an_error():
    with Server(HERE) as tree:
        tree._process.kill()
        for _ in range(2):
            with pytest.raises(RuntimeError, match="its process ended"):
                tree.ask("names")


@pytest.mark.parametrize("mode", ["free", "resync"])
def test_a_change_planted_in_a_tree_is_seen(tmp_path, mode):
    """The smallest change of J, in a copy of the package."""
    for folder in ("qpmhe", "solvers"):
        shutil.copytree(HERE / folder, tmp_path / folder, ignore=shutil.ignore_patterns("*.pyc"))
    for planted in (False, True):
        if planted:
            with (tmp_path / "qpmhe" / "__init__.py").open("a", encoding="utf-8") as file:
                file.write(PLANTED)
        with Server(tmp_path) as before, Server(HERE) as now:
            given = [NAME, "python"]
            if mode == "resync":
                given.append(before.ask("snapshots", *given))
            found, expected = (tree.ask(mode, *given) for tree in (now, before))
        total = compared(found, expected)
        names = {"cost", "run.costs"} if mode == "free" else {"cost"}
        assert different(total).keys() == (names if planted else set())
        assert total.bad_flips == 0
        assert all(gap < 3e-16 for gap in different(total).values())
