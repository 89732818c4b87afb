"""The textbook reactors are estimated as the gallery says."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]

SEEDS = 4


@pytest.fixture(scope="module")
def reactors(gallery):
    return import_module("gallery.reactors.reactors")


@pytest.fixture(scope="module")
def judged(gallery, reactors):
    """The result of one estimator on some records of a reactor."""
    judge = import_module("gallery.problem").judge
    estimators = import_module("gallery.baselines").estimators
    problems = [reactors.problem(reactor, SEEDS) for reactor in reactors.REACTORS]

    def result(which, name):
        problem = problems[which]
        way = estimators(problem, problem.weights)[name]
        return judge(problem, "by hand", name, way, problem.records, False)

    return result


@pytest.mark.parametrize(("which", "most"), [(0, 0.04), (1, 0.005)])
@pytest.mark.parametrize(
    "name", ["EKF, projected", "MHE, 1 QP", "MHE, 2 QPs", "MHE, 5 QPs", "MHE, converged",
     "MHE, UKF, 2 QPs"],
)
def test_a_projected_filter_and_mhe_on_it_settle_on_the_truth(judged, which, most, name):
    found = judged(which, name)
    assert np.median(found.errors) < most
    assert found.outside == 0.0
    assert found.lost == 0.0


def test_a_plain_filter_settles_outside_of_x(judged):
    found = judged(1, "EKF")
    assert np.median(found.errors) > 0.1
    assert found.outside > 0.5


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("gain", ["0.001", "0.01"])
def test_two_qps_improve_on_a_projected_constant_gain(judged, which, gain):
    alone, two = (
        np.median(judged(which, name).errors)
        for name in (f"gain {gain}, projected", f"MHE, gain {gain}, 2 QPs")
    )
    assert two < alone / 1.5


@pytest.mark.slow  # make examples runs it, too
def test_the_command_writes_both_reactors(gallery, tmp_path):
    pd = pytest.importorskip("pandas")
    subprocess.run(
        [sys.executable, "-m", "examples.gallery.reactors", "--quick", "--out", tmp_path],
        cwd=ROOT, check=True, capture_output=True,
    )
    for name in ("reactors_dimer", "reactors_batch"):
        table = pd.read_csv(tmp_path / f"{name}.csv").set_index("estimator")
        assert table["median"]["MHE, UKF, 2 QPs"] < table["median"]["gain 0.01, projected"]
        assert (tmp_path / f"{name}.md").is_file()
    assert (tmp_path / "reactors.png").read_bytes().startswith(b"\x89PNG")
