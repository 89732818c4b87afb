"""Which cases `make test` runs."""

import re
from pathlib import Path

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
"""


def test_a_sample_has_some_cases_of_every_test_and_all_runs_all(pytester):
    def run(*arguments):
        output = pytester.runpytest("-v", *arguments).stdout.str()
        ran = re.findall(r"(test_\w+\.py::\S+) PASSED|PASSED \S*?(test_\w+\.py::\S+)", output)
        return {one or other for one, other in ran}, output

    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text(encoding="utf-8"))
    pytester.makeini("[pytest]\nmarkers = slow: left out without --all")
    (pytester.path / "oracles").mkdir()
    for name in ("test_cases.py", "oracles/test_same_cases.py"):
        (pytester.path / name).write_text(CASES)
    ran, output = run()
    product = [name for name in ran if "test_cases.py::test_product" in name]
    assert len(product) == 1 + round(0.022 * 35)
    assert "test_cases.py::test_one" in ran
    assert not any("test_slow" in name for name in ran)
    # Oracles keep every value of every parameter, but for many seeds.
    values = {v for name in ran if "same_cases.py::test_product" in name
              for v in name.partition("[")[2].strip("]").split("-")}  # fmt: skip
    assert values == set("uvwxyz012345")
    assert len({name for name in ran if "same_cases.py::test_seeds" in name}) == 11
    assert f"{2 * 88 - len(ran)} of 176 cases left out; --all (make test-all) runs" in output
    assert run("-n", "2")[0] == ran  # processes agree on the sample
    ran, output = run("--all")
    assert len(ran) == 176
    assert "left out" not in output
    # A case that is named runs.
    every = [f"test_cases.py::test_product[{b}-{a}]" for a in range(6) for b in "uvwxyz"]
    every.append("test_cases.py::test_slow")
    assert run(*every)[0] == set(every)
