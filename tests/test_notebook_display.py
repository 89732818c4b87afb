"""What notebooks and consoles show of the library's objects, and runs in files and tables."""

import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError

SPD = {"prior": np.eye(2), "disturbance": 0.5 * np.eye(2), "noise": 0.25}


def run_of(steps=20, max_qps=1, **options):
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=4, initial_state=scenario.initial_estimate,
        max_qps=max_qps,
    )
    return mhe.run(scenario.simulate(0).measurements[:steps], **options)


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (qpmhe.Luenberger([0.3, 0.1]), "Luenberger(gain=[[0.3], [0.1]])"),
        (qpmhe.ExtendedKalman(**SPD),
         "ExtendedKalman(prior=[[1., 0.], [0., 1.]], disturbance=[[0.5, 0. ], [0. , 0.5]], "
         "noise=[[0.25]])"),
        (qpmhe.QuadraticCost(prior=np.eye(4), disturbance=np.eye(4), noise=1.0, discount=0.9),
         "QuadraticCost(prior=<4 x 4>, disturbance=<4 x 4>, noise=[[1.]], discount=0.9)"),
        (qpmhe.RobustCost(prior=1.0, disturbance=qpmhe.Huber(2.0, 3.0), noise=1.0),
         "RobustCost(prior=Quadratic(weight=[[1.]]), disturbance=Huber(weight=[[2.]], "
         "threshold=3), noise=Quadratic(weight=[[1.]]))"),
        (qpmhe.Cauchy(1.0, 2.0, per_component=True), "per_component=True"),
        (qpmhe.Box([0.0], [1.0]), "Box(lower=[0.0], upper=[1.0])"),
        (qpmhe.HighGain(2, epsilon=0.5, dt=0.1), "HighGain(epsilon=0.5, dt=0.1)"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_objects_say_what_they_hold(thing, words):
    assert words in repr(thing)


class Mine(qpmhe.Observer):
    def __init__(self, stiffness, name="mine"):
        self.stiffness, self.name = stiffness, name

    def check(self, system, initial_state):
        pass

    def correct(self, z, v, sample):
        return 0.0 * z, None


def test_an_observer_of_a_users_class_shows_its_arguments():
    assert repr(Mine(2.0)) == "Mine(stiffness=2)"


def test_an_estimator_shows_what_it_was_made_of_and_where_it_is():
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=4, initial_state=[3.0, 0.0], max_qps=2, engine="python"
    )
    mhe.update([1.0])
    for words in ("System(n=2", "Luenberger(", "horizon=4", "max_qps=2", "engine='python'",
                  "time=1"):
        assert words in repr(mhe)
    assert "backend" not in repr(mhe)


def test_a_run_shows_facts_and_a_picture():
    run = run_of()
    assert "steps: 20" in repr(run)
    assert f"mean J: {run.costs.mean():.6g}" in repr(run)
    page = run._repr_html_()
    assert "<td style='text-align:left'>20</td>" in page
    assert "data:image/png;base64,iVBOR" in page
    assert "img" not in run_of(0)._repr_html_()
    assert "steps: 0" in repr(run_of(0))


def test_a_run_is_a_table():
    pytest.importorskip("pandas")
    run = run_of(covariances=True)
    table = run.to_frame()
    np.testing.assert_array_equal(table[["x1", "x2"]], run.states[1:])
    np.testing.assert_array_equal(table["J"], run.costs)
    np.testing.assert_allclose(table["std2"] ** 2, run.covariances[:, 1, 1])
    assert table.index.name == "t"
    assert table["status"].iloc[-1] == str(run.statuses[-1]).removeprefix("Status.")


@pytest.mark.parametrize("covariances", [False, True])
def test_a_run_in_a_file_is_the_same_run(tmp_path, covariances):
    run = run_of(covariances=covariances)
    run.save(tmp_path / "run.npz")
    other = qpmhe.load_run(tmp_path / "run.npz")
    assert other.statuses == run.statuses
    kept = pickle.loads(pickle.dumps(run))
    for name in ("statuses", "source"):
        vars(kept).pop(name, None), vars(other).pop(name, None)
    assert vars(kept).keys() == vars(other).keys()
    for name, value in vars(kept).items():
        np.testing.assert_array_equal(vars(other)[name], value, err_msg=name)


@pytest.mark.parametrize("damage", ["text", "other", "short", "missing", "pickle"])
def test_what_is_no_run_is_refused(tmp_path, damage):
    path = tmp_path / "run.npz"
    run_of().save(path)
    with np.load(path) as file:
        arrays = dict(file)
    if damage == "text":
        path.write_text("time,y\n0,1\n")
    elif damage == "other":
        np.savez(path, a=1)
    elif damage == "short":
        np.savez(path, **arrays | {"costs": arrays["costs"][:-1]})
    elif damage == "pickle":
        np.savez(path, **arrays | {"costs": np.array([None] * 20)})
    else:
        path.unlink()
    with pytest.raises(InvalidInputError, match=r"run\.npz cannot be read as a run"):
        qpmhe.load_run(path)


def test_figures_are_pyplots_where_it_is_imported():
    code = """
import sys, numpy as np, qpmhe
system, observer, cost, scenario = qpmhe.models.batch_reactor()
mhe = qpmhe.MovingHorizonEstimator(
    system, observer, cost, horizon=4, initial_state=scenario.initial_estimate)
run = mhe.run(scenario.simulate(0).measurements[:9])
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


def test_a_cell_shows_its_figure(tmp_path):
    reason = "needs nbformat, nbclient and ipykernel"
    nbformat = pytest.importorskip("nbformat", reason=reason)
    nbclient = pytest.importorskip("nbclient", reason=reason)
    pytest.importorskip("ipykernel", reason=reason)
    first = """
import qpmhe
system, observer, cost, scenario = qpmhe.models.batch_reactor()
mhe = qpmhe.MovingHorizonEstimator(
    system, observer, cost, horizon=4, initial_state=scenario.initial_estimate)
run = mhe.run(scenario.simulate(0).measurements[:9])
run"""
    cells = [first, "qpmhe.plots.costs(run);", "print(1)\nqpmhe.plots.states(run);"]
    notebook = nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, cells)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the client's event loop and sockets
        nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute(cwd=tmp_path)
    shown = [output["data"] for cell in notebook.cells for output in cell["outputs"]
             if "data" in output]
    assert "text/html" in shown[0]
    assert "image/png" in shown[1]
    assert "image/png" in shown[2]
