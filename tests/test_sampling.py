"""Which cases `make test` runs."""

import re
from pathlib import Path

import pytest

pytest_plugins = "pytester"

CASES = """
import pytest

@pytest.mark.parametrize("a", range(6))
@pytest.mark.parametrize("b", "uvwxyz")
def test_product(a, b):
    pass

@pytest.mark.parametrize("a", range(4))
def test_few(a):
    pass

@pytest.mark.parametrize("seed", range(50))
def test_seeds(seed):
    pass

def test_one():
    pass

@pytest.mark.slow
def test_slow():
    pass
"""


@pytest.fixture
def run(pytester):
    """Run the cases above with these arguments; names of those that ran, and the output."""
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text(encoding="utf-8"))
    pytester.makeini("[pytest]\nmarkers = slow: left out without --all")
    (pytester.path / "oracles").mkdir()
    for name in ("test_cases.py", "oracles/test_same_cases.py"):
        (pytester.path / name).write_text(CASES)

    def call(*arguments):
        output = pytester.runpytest("-v", *arguments).stdout.str()
        ran = re.findall(r"(test_\w+\.py::\S+) PASSED|PASSED \S*?(test_\w+\.py::\S+)", output)
        return {one or other for one, other in ran}, output

    return call


def test_a_sample_has_some_cases_of_every_test(run):
    ran, output = run()
    product = [name for name in ran if "test_cases.py::test_product" in name]
    assert len(product) == 1 + round(0.022 * 35)
    assert len({name for name in ran if "test_cases.py::test_few" in name}) == 1
    assert "test_cases.py::test_one" in ran
    assert not any("test_slow" in name for name in ran)
    # Oracles keep every value of every parameter, but for many seeds.
    values = {v for name in ran if "same_cases.py::test_product" in name
              for v in name.partition("[")[2].strip("]").split("-")}  # fmt: skip
    assert values == set("uvwxyz012345")
    assert len({name for name in ran if "same_cases.py::test_seeds" in name}) == 11
    left_out = 2 * 92 - len(ran)
    assert f"{left_out} of 184 cases left out; --all (make test-all) runs them too" in output


def test_processes_agree_on_the_sample(run):
    assert run("-n", "2")[0] == run()[0]


def test_all_runs_all(run):
    ran, output = run("--all")
    assert len(ran) == 184
    assert "left out" not in output


def test_a_case_that_is_named_runs(run):
    every = [f"test_cases.py::test_product[{b}-{a}]" for a in range(6) for b in "uvwxyz"]
    ran, _ = run(*every)
    assert ran == set(every)
    assert run("test_cases.py::test_slow")[0] == {"test_cases.py::test_slow"}
