"""Which cases `make test` runs."""

import itertools
import re
from pathlib import Path

import pytest

from tests.covering import covering

pytest_plugins = "pytester"

CASES = """
import pytest

@pytest.mark.parametrize("a", range(6))
@pytest.mark.parametrize("b", "uvwxyz")
def test_product(a, b):
    pass

@pytest.mark.parametrize("seed", range(50))
def test_seeds(seed):
    pass

def test_one():
    pass

@pytest.mark.slow
def test_slow():
    pass

@pytest.mark.shortened
def test_short():
    pass

@pytest.mark.whole
@pytest.mark.parametrize("word", "pqr")
def test_whole(word):
    pass
"""
WHOLE = {f"test_whole[{word}]" for word in "pqr"}


def test_some_cases_of_every_test_run_and_the_rest_is_what_is_left_out(pytester):
    def run(*arguments):
        output = pytester.runpytest("-v", *arguments).stdout.str()
        ran = re.findall(r"(test_\w+\.py::\S+) PASSED|PASSED \S*?(test_\w+\.py::\S+)", output)
        return {one or other for one, other in ran}, output

    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text(encoding="utf-8"))
    pytester.makeini("[pytest]\nmarkers = slow\n shortened\n whole")
    (pytester.path / "oracles").mkdir()
    for name in ("test_cases.py", "oracles/test_same_cases.py"):
        (pytester.path / name).write_text(CASES)
    ran, output = run()
    few = {name.rpartition("::")[2] for name in ran if name.startswith("test_cases.py")}
    assert few == {
        "test_product[u-0]", "test_seeds[0]", "test_one", "test_short", *WHOLE,
    }
    # Oracles have more, each with other values.
    assert {name.rpartition("::")[2] for name in ran if "same_cases.py" in name} == {
        *(f"test_product[{b}-{a}]" for a, b in enumerate("uv")), "test_one", "test_short",
        *(f"test_seeds[{seed}]" for seed in range(2)), *WHOLE,
    }
    assert f"cases: {len(ran)} of 184" in output
    assert run("-n", "2")[0] == ran  # processes agree
    every, output = run("--all")
    assert len(every) == 184
    assert "cases: 184 of 184" in output
    rest, output = run("--rest")
    assert rest == every - {name for name in ran if "test_short" not in name}
    assert f"cases: {len(rest)} of 184" in output
    # A case that is named runs.
    named = [f"test_cases.py::test_product[{b}-{a}]" for a in range(6) for b in "uvwxyz"]
    named.append("test_cases.py::test_slow")
    assert run(*named)[0] == set(named)


def test_a_covering_array_has_every_pair_in_few_cases():
    axes = {"a": "uvwxyz", "b": range(5), "c": [[], pytest.param({}, marks=pytest.mark.slow), ()]}
    mark = covering(**axes).mark
    assert mark.args[0] == ("a", "b", "c")
    cases = mark.args[1]
    for one, other in itertools.combinations(range(3), 2):
        pairs = {(repr(case.values[one]), repr(case.values[other])) for case in cases}
        assert len(pairs) == [6, 5, 3][one] * [6, 5, 3][other]
    assert 30 <= len(cases) <= 36  # of 90
    assert all(bool(case.marks) == (case.values[2] == {}) for case in cases)
    assert len(covering(strength=1, **axes).mark.args[1]) == 6
