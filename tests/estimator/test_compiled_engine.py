"""Where the compiled engine comes from, and what has no C form."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.codegen.library import planned
from qpmhe.codegen.rehearsal import checked_library
from qpmhe.errors import EngineWarning, OptionError, QpmheError

from .test_compiled import estimator, made, system_of

casadi = pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

INF = np.inf


def fallen_back(model, match):
    """Insist on a warning that tells why, and on the results of the Python step."""
    with pytest.warns(EngineWarning, match=match) as caught:
        mhe = estimator(model)
    assert [Path(w.filename).name for w in caught] == ["test_compiled.py"]
    assert mhe.engine == "python"
    twin = estimator(model, "python")
    for y in model.Y[:8]:
        np.testing.assert_array_equal(mhe.update(y).trajectory, twin.update(y).trajectory)


@pytest.mark.parametrize("command", ["", " ", "/nowhere/cc", "no-such-compiler -O2", "/tmp"])
def test_no_compiler(monkeypatch, command):
    monkeypatch.setenv("CC", command)
    fallen_back(made("n=1"), "falls back to the Python step: there is no C compiler.*install")


def test_no_compiler_on_the_path(monkeypatch, tmp_path):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    fallen_back(made("n=1"), "there is no C compiler")


def test_a_compiler_that_cannot_be_read(monkeypatch):
    monkeypatch.setenv("CC", 'gcc "')
    fallen_back(made("n=1"), "falls back to the Python step")


def test_a_compiler_that_fails(monkeypatch, tmp_path):
    program = tmp_path / "cc"
    program.write_text("#!/bin/sh\necho out of order >&2\nexit 3\n")
    program.chmod(0o700)
    monkeypatch.setenv("CC", str(program))
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "cache"))
    fallen_back(made("n=1"), "failed: out of order")
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_compiler_with_options(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", f"{find_compiler()[0]} -DNOTHING=1")
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path))
    assert estimator(made("n=1")).engine == "compiled"


@pytest.mark.parametrize("named", [".", "deep/er"])
def test_a_cache_relative_to_the_working_directory(monkeypatch, tmp_path, named):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("QPMHE_CACHE_DIR", named)
    assert estimator(made("n=1")).engine == "compiled"
    assert len(list((tmp_path / named).glob("*.so"))) == 1


def test_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert estimator(made("n=1")).engine == "compiled"
    assert len(list(tmp_path.glob("qpmhe-*/*.so"))) == 1
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "file"))
    fallen_back(made("n=1"), "cannot be written; set QPMHE_CACHE_DIR")


PROGRAM = """
import casadi, qpmhe
system = qpmhe.from_casadi(lambda x: 0.9 * x, lambda x: x, n=1, compiled=False)
cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
mhe = qpmhe.MovingHorizonEstimator(
    system, qpmhe.Luenberger([0.3]), cost, horizon=2, initial_state=[0.0], engine="compiled"
)
print(mhe.engine, repr(float(mhe.run([[1.0], [2.0], [0.5]]).costs.sum())))
"""


def started(folder):
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", PROGRAM], text=True,
        env={**os.environ, "QPMHE_CACHE_DIR": str(folder)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )


def finished(process):
    out, err = process.communicate(timeout=100)
    assert process.returncode == 0, f"{process.returncode}: {err[-500:]}"
    return out


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """What two processes that begin at once make, and say."""
    folder = tmp_path_factory.mktemp("cache")
    processes = [started(folder) for _ in range(2)]
    said = [finished(process) for process in processes]
    assert said[0] == said[1]
    assert said[0].startswith("compiled")
    assert all(path.is_file() for path in folder.iterdir())  # nothing is left over
    (made_library,) = folder.glob("*.so")
    return made_library, said[0]


@pytest.mark.parametrize("damage", ["empty", "text", "cut early", "cut late", "zeros", "another"])
def test_a_damaged_library_is_made_anew(library, damage, tmp_path):
    path, said = library
    good = path.read_bytes()
    other = min(Path(np.__file__).parent.rglob("*.so"), key=lambda p: p.stat().st_size)
    shutil.copytree(path.parent, tmp_path, dirs_exist_ok=True)
    (tmp_path / path.name).write_bytes({
        "empty": b"", "text": b"no library" * 2000, "cut early": good[:1000],
        "cut late": good[:-100], "zeros": good[:4096] + bytes(len(good) - 4096),
        "another": other.read_bytes(),
    }[damage])
    assert finished(started(tmp_path)) == said


def test_weights_and_options_need_no_compiler(monkeypatch, tmp_path):
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path))
    estimator(made("n=1"))
    (library,) = tmp_path.glob("*.so")
    stamp = library.stat()
    cost = qpmhe.QuadraticCost(prior=2.0, disturbance=3.0, noise=4.0 * np.eye(2), discount=0.9)
    estimator(
        made("n=1"), cost=cost, observer=qpmhe.Luenberger([[0.1, 0.1]]), max_qps=None,
        warm_start=True, delay=1, backend="banded", tolerance=1e-4, initial_state=[0.1],
    )
    assert list(tmp_path.glob("*.so")) == [library]
    assert (library.stat().st_ino, library.stat().st_mtime_ns) == (stamp.st_ino, stamp.st_mtime_ns)


def plain():
    return qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)


def symbolic(**sets):
    return system_of(lambda x: 0.9 * x, lambda x: x, n=1, **sets)


ONES = {"prior": 1.0, "disturbance": 1.0, "noise": 1.0}


def uncovered(**given):
    arguments = {
        "system": given.pop("system", symbolic)(),
        "observer": given.pop("observer", lambda: qpmhe.Luenberger([0.3]))(),
        "cost": given.pop("cost", lambda: qpmhe.QuadraticCost(**ONES))(),
    }
    return qpmhe.MovingHorizonEstimator(
        **arguments, **({"horizon": 2, "initial_state": [0.0], "engine": "compiled"} | given)
    )


class OwnGain(qpmhe.Luenberger):
    """Corrects by something else."""

    def correct(self, z, v, sample):
        return 2.0 * super().correct(z, v, sample)[0], None


class OwnInjection(qpmhe.OutputInjection):
    """Corrects by something else."""

    def correct(self, z, v, sample):
        return 2.0 * super().correct(z, v, sample)[0], None


class OwnFilter(qpmhe.ExtendedKalman):
    """Filters by something else."""

    def filter(self, z, v, sample):
        return z + v, np.eye(z.size)


class OwnSteady(qpmhe.SteadyStateKalman):
    """Starts with another covariance."""

    def initial_covariance(self):
        return 2.0 * super().initial_covariance()


class OwnCost(qpmhe.QuadraticCost):
    """May weigh in another way."""


class OwnRobustCost(qpmhe.RobustCost):
    """May weigh in another way."""


class Whole(qpmhe.Huber):
    """Has a cost of its own."""

    def cost(self, s, weight):
        return 2.0 * super().cost(s, weight)


class Branching(qpmhe.Huber):
    """Asks for the value of the form."""

    def _value(self, q):
        return np.array([one if one < 1.0 else 2.0 * one for one in q])


class Together(qpmhe.Huber):
    """Loses less where others lose more."""

    def _value(self, q):
        return q / (1.0 + q.sum())


LOSSES = {Whole: "cost of its own", Branching: "", Together: "depends on others"}


@pytest.mark.parametrize(
    ("remedy", "given"),
    [
        ("from_casadi", {"system": lambda: qpmhe.System(
            lambda x: x if x[0] > 12.0 else 0.9 * x, lambda x: x, n=1, p=1)}),
        ("OwnGain has no C form; take an observer of qpmhe", {"observer": lambda: OwnGain([0.3])}),
        (r"the correction of OutputInjection has no C form \(.*asks for .*\); change that",
         {"observer": lambda: qpmhe.OutputInjection(lambda z, v: 0.3 * v if v[0] > 0 else v)}),
        ("OwnInjection has no C form", {"observer": lambda: OwnInjection(lambda z, v: 0.3 * v)}),
        *((rf"{kind.__name__}, the loss of noise, has no C form \(.*{why}.*\); take Quadratic, "
           "Huber, Power or Barron",
           {"cost": lambda kind=kind: qpmhe.RobustCost(**(ONES | {"noise": kind(1.0)}))})
          for kind, why in LOSSES.items()),
        ("OwnRobustCost has no C form", {"cost": lambda: OwnRobustCost(**ONES)}),
        ("OwnCost has no C form; take a QuadraticCost", {"cost": lambda: OwnCost(**ONES)}),
        ("OwnFilter has no C form", {"observer": lambda: OwnFilter(**ONES)}),
        ("covariance of OwnSteady has no C form, and is the metric",
         {"system": lambda: symbolic(states=qpmhe.Box(-5.0, 5.0)),
          "observer": lambda: OwnSteady(
              plain(), [0.0], disturbance=[[1.0]], noise=[[1.0]])}),
        ("covariance of OwnSteady has no C form.*take a constant weight",
         {"cost": lambda: qpmhe.QuadraticCost(**(ONES | {"prior": qpmhe.ObserverPrior()})),
          "observer": lambda: OwnSteady(
              plain(), [0.0], disturbance=[[1.0]], noise=[[1.0]])}),
        ("not by 'osqp'; take backend='auto'", {"backend": "osqp"}),
    ],
)
def test_what_has_no_c_form_is_an_error_with_a_remedy(remedy, given):
    with pytest.raises(OptionError, match=f"no C code for this estimator: .*{remedy}"):
        uncovered(**given)


def test_one_library_serves_other_losses():
    costs = [
        qpmhe.RobustCost(**(ONES | {name: loss}))
        for name, loss in (("noise", qpmhe.Huber(1.0, 2.0)), ("noise", qpmhe.Huber(1.0, 3.0)),
                           ("prior", qpmhe.Power(2.0, 1.5, per_component=True)))
    ]
    layouts = {planned(mhe.system, mhe.observer, mhe.cost, mhe.settings)[0]
               for mhe in (uncovered(cost=lambda cost=cost: cost) for cost in costs)}
    assert len(layouts) == 1


@pytest.mark.parametrize("option", ["max_qps", "max_solver_iterations"])
def test_caps_beyond_all_bounds(option):
    try:
        mhe = uncovered(**{option: 2**31})
    except QpmheError:
        return
    assert mhe.update([1.0]).improved


@pytest.mark.parametrize("case", ["opposite rows", "three rows", "rows and a box"])
def test_equalities_made_of_inequalities(case):
    flat = {
        "opposite rows": qpmhe.Polytope([[1, -1], [-3, 3]], [0.1, -0.3]),
        "three rows": qpmhe.Polytope([[1, 0], [0, 1], [-1, -1]], [0.0, 0.0, 0.0]),
        "rows and a box": qpmhe.Box([0, 0], [1, 1]) & qpmhe.Polytope([[1, 2]], [0.0]),
    }[case]
    system = system_of(lambda x: 0.9 * x, lambda x: x[:1], n=2, disturbances=flat)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    expected, found = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.1, 0.1]), cost, horizon=4, initial_state=[0.0, 0.0],
            engine=engine, infeasible="keep_candidate",
        ).run(np.random.default_rng(1).standard_normal((12, 1)))
        for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(found.costs, expected.costs, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.candidate_costs, expected.candidate_costs, rtol=1e-9)
    assert found.share(qpmhe.Status.IMPROVED) > 0.5


@pytest.mark.parametrize("horizon", [5 * 10**7, 2 * 10**9])
def test_horizons_beyond_a_structure(horizon):
    with pytest.raises(OptionError, match=rf"a horizon of {horizon} .* bytes .* shorter one"):
        uncovered(horizon=horizon)


def test_more_memory_than_there_is():
    mhe = uncovered()
    library = checked_library(mhe.system, mhe.observer, mhe.cost, mhe.settings)
    with pytest.raises(OptionError, match=r"memory of 1000000000000 estimators needs .* bytes"):
        library.estimators(np.broadcast_to(np.zeros(1), (10**12, 1)))
