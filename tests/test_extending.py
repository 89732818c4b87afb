"""An observer, a loss, a backend and a model from outside of the package: one new file each."""

import csv
import importlib
import math
import os
import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.studies import Store

OBSERVER = """
import numpy as np
import qpmhe

class Saturated(qpmhe.Observer):
    "A constant gain times the output error, which is limited first."

    def __init__(self, gain, limit):
        self.gain, self.limit = np.asarray(gain), limit

    def check(self, system, initial_state):
        if self.gain.shape != (system.n, system.p):
            raise qpmhe.errors.ShapeError(f"gain has shape {self.gain.shape}; expected (n, p).")

    def correct(self, z, v, sample):
        return self.gain @ np.clip(v, -self.limit, self.limit), None
"""
LOSS = """
import numpy as np
import qpmhe

class PseudoHuber(qpmhe.Loss):
    "2 (sqrt(1 + q) - 1): quadratic near zero, and linear far away."

    def value(self, q):
        return 2.0 * (np.sqrt(1.0 + q) - 1.0)

    def slope(self, q):
        return 1.0 / np.sqrt(1.0 + q)
"""
BACKEND = """
import numpy as np
from qpmhe.solvers import Backend, RawSolution, Solver

class Dense(Solver):
    "The minimum without inequalities, by LAPACK."

    solved = 0

    def _solve(self, qp, start):
        if qp.rows or qp.bounded:
            raise NotImplementedError("limits")
        Dense.solved += 1
        return RawSolution(np.linalg.solve(qp.dense(), -qp.gradient.ravel()), True)

entry = Backend("outside", Dense, "factorisation", inequalities=False)
"""
MODEL = """
import numpy as np
import qpmhe
from outside_loss import PseudoHuber
from outside_observer import Saturated

def f(x):
    return np.stack((x[..., 0] + 0.1 * x[..., 1],
                     x[..., 1] - 0.1 * np.sin(x[..., 0]) - 0.02 * x[..., 1]), axis=-1)

def make():
    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    observer = Saturated([[0.4], [0.3]], limit=1.0)
    cost = qpmhe.RobustCost(prior=np.eye(2), disturbance=1e4 * np.eye(2),
                            noise=PseudoHuber([[25.0]]))
    scenario = qpmhe.models.Scenario(
        system=system, initial_state=[0.5, 0.0], initial_estimate=[0.0, 0.0],
        disturbance_covariance=1e-4 * np.eye(2), noise_covariance=0.04, dt=0.1, horizon=5,
        steps=30, labels=("angle", "speed"))
    return system, observer, cost, scenario
"""
FILES = {
    "outside_observer": OBSERVER, "outside_loss": LOSS, "outside_backend": BACKEND,
    "outside_model": MODEL,
}


@pytest.fixture
def folder(tmp_path):
    """The four files."""
    for name, text in FILES.items():
        (tmp_path / f"{name}.py").write_text(text)
    return tmp_path


@pytest.fixture
def outside(folder, monkeypatch):
    """The four modules, with the backend registered."""
    monkeypatch.syspath_prepend(folder)
    modules = {name.removeprefix("outside_"): importlib.import_module(name) for name in FILES}
    qpmhe.solvers.register(modules["backend"].entry)
    yield modules
    qpmhe.solvers.unregister("outside")
    for name in FILES:
        del sys.modules[name]


def test_an_estimator_of_them(outside):
    system, observer, cost, scenario = outside["model"].make()
    _, measurements = scenario.simulate(0)
    measurements[12] += 5.0  # an outlier, where observer and loss differ from the usual ones
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=scenario.initial_estimate,
        backend="outside", max_qps=3,
    )
    outside["backend"].Dense.solved = 0
    z, improved = np.array(scenario.initial_estimate), 0
    for t, y in enumerate(measurements):
        estimate = mhe.update(y)
        z = system.f(z, None) + observer.gain @ np.clip(y - z[:1], -1.0, 1.0)
        np.testing.assert_allclose(estimate.candidate[-1], z, rtol=1e-12, atol=1e-14)
        # The cost once more, as the files above say.
        path = estimate.trajectory
        K = len(path) - 1
        w = path[1:] - system.f(path[:-1], None)
        v = measurements[t + 1 - K : t + 1, 0] - path[:-1, 0]
        start = path[0] - estimate.candidate[0]
        expected = (
            start @ start + 1e4 * np.sum(w * w)
            + np.sum(2.0 * (np.sqrt(1.0 + 25.0 * v * v) - 1.0))
        )
        assert estimate.cost == pytest.approx(expected, rel=1e-9)
        assert estimate.cost <= estimate.candidate_cost
        improved += estimate.cost < 0.999 * estimate.candidate_cost
    assert outside["backend"].Dense.solved >= improved > 20


@pytest.mark.slow
def test_the_command_line_finds_them_in_an_installed_package(folder):
    info = folder / "outside-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[qpmhe.backends]\noutside = outside_backend:entry\n")
    (folder / "record.csv").write_text(
        "t,y\n" + "".join(f"{k / 10},{0.5 * math.cos(0.1 * k):.6f}\n" for k in range(20))
    )
    path = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    for command in (
        "compare --model outside_model.py:make --backend outside --qps 0,2 --seeds 2 --steps 15 "
        "--solver-iterations none --jobs 1 --store store.sqlite --out report",
        "estimate outside_model.py:make record.csv --out estimates.csv --backend outside",
    ):
        done = subprocess.run(
            [sys.executable, "-c", "from qpmhe.cli import main; main()", *command.split()],
            cwd=folder, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True,
            timeout=120, check=False,
        )
        assert done.returncode == 0, done.stderr
    frame = Store(folder / "store.sqlite").frame()
    assert set(frame["backend"]) == {"observer", "outside"}
    assert set(frame["outcome"]) == {"done"}
    with (folder / "estimates.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20
    assert all(math.isfinite(float(row["filtered_angle"])) for row in rows)
