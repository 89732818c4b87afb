"""What notebooks and consoles show of the library's objects, and runs in files and tables."""

import pickle
import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError

SETUP = """
import sys, numpy as np, qpmhe
system, observer, cost, scenario = qpmhe.models.batch_reactor()
mhe = qpmhe.MovingHorizonEstimator(
    system, observer, cost, horizon=4, initial_state=scenario.initial_estimate, max_qps=1)
run = mhe.run(scenario.simulate(0).measurements[:20], covariances=True)
"""


@pytest.fixture(scope="module")
def made():
    names = {}
    exec(SETUP, names)
    return names


class Mine(qpmhe.Observer):
    def __init__(self, stiffness, name="mine"):
        self.stiffness, self.name = stiffness, name

    def check(self, system, initial_state):
        pass

    def correct(self, z, v, sample):
        return 0.0 * z, None


def test_objects_and_runs_say_what_they_hold(made):
    run, mhe = made["run"], made["mhe"]
    for thing, *words in (
        (qpmhe.Luenberger([0.3, 0.1]), "Luenberger(gain=[[0.3], [0.1]])"),
        (qpmhe.QuadraticCost(prior=np.eye(4), disturbance=np.eye(4), noise=1.0, discount=0.9),
         "QuadraticCost(prior=<4 x 4>, disturbance=<4 x 4>, noise=[[1.]], discount=0.9)"),
        (qpmhe.RobustCost(prior=1.0, disturbance=qpmhe.Huber(2.0, 3.0), noise=1.0),
         "disturbance=Huber(weight=[[2.]], threshold=3), noise=Quadratic(weight=[[1.]]))"),
        (Mine(2.0), "Mine(stiffness=2)"),
        (mhe, "System(n=2", "Luenberger(", "horizon=4", "time=20"),
        (run, "steps: 20", f"mean J: {run.costs.mean():.6g}"),
    ):
        for one in words:
            assert one in repr(thing)
    assert "backend" not in repr(mhe)
    page = run._repr_html_()
    assert "<td style='text-align:left'>20</td>" in page
    assert "data:image/png;base64,iVBOR" in page
    mhe.reset()
    empty = mhe.run(np.empty((0, 1)))
    assert "img" not in empty._repr_html_()
    assert "steps: 0" in repr(empty)


def test_a_run_is_a_table(made):
    pytest.importorskip("pandas")
    run = made["run"]
    table = run.to_frame()
    np.testing.assert_array_equal(table[["x1", "x2"]], run.states)
    np.testing.assert_array_equal(table["J"][:-1], run.costs)
    np.testing.assert_allclose(table["std2"][1:] ** 2, run.covariances[:, 1, 1])
    assert table.index.name == "t"
    assert table["status"].iloc[-2] == str(run.statuses[-1]).removeprefix("Status.")


def test_a_run_in_a_file_is_the_same_run_and_anything_else_is_refused(made, tmp_path):
    path, run = tmp_path / "run.npz", made["run"]
    run.save(path)
    other = qpmhe.load_run(path)
    assert other.statuses == run.statuses
    kept = pickle.loads(pickle.dumps(run))
    for name in ("statuses", "source"):
        vars(kept).pop(name, None), vars(other).pop(name, None)
    assert vars(kept).keys() == vars(other).keys()
    for name, value in vars(kept).items():
        np.testing.assert_array_equal(vars(other)[name], value, err_msg=name)
    with np.load(path) as file:
        arrays = dict(file)
    for damage in (
        {"a": 1}, arrays | {"costs": arrays["costs"][:-1]},
        arrays | {"costs": np.array([None] * 20)}, "time,y\n0,1\n", None,
    ):
        if isinstance(damage, dict):
            np.savez(path, **damage)
        elif damage is None:
            path.unlink()
        else:
            path.write_text(damage)
        with pytest.raises(InvalidInputError, match=r"run\.npz cannot be read as a run") as caught:
            qpmhe.load_run(path)
        assert "pickle" not in str(caught.value)


@pytest.mark.slow
def test_figures_are_pyplots_where_it_is_imported():
    code = SETUP + """
qpmhe.plots.costs(run)
assert "matplotlib.pyplot" not in sys.modules
import matplotlib
matplotlib.use("Agg")
from matplotlib import pyplot
axes = qpmhe.plots.states(run)
assert pyplot.gcf() is axes[0].figure and len(pyplot.get_fignums()) == 1
run._repr_html_()
assert len(pyplot.get_fignums()) == 1
"""
    subprocess.run([sys.executable, "-c", code], check=True)
