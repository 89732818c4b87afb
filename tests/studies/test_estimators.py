"""Other observers and other estimators as cells of a study."""

import re

import numpy as np
import pytest

import qpmhe
from qpmhe.baselines import ExtendedKalmanFilter, Problem
from qpmhe.errors import ModelError, OptionError
from qpmhe.studies import Store, StoreError, Study, StudyError, metrics, run, summarise
from qpmhe.studies.cell import Task, compute
from qpmhe.studies.summary import alone, sequential, with_observers

from .report_study import command

FILE = """
import numpy as np
import qpmhe
from qpmhe.baselines import ExtendedKalmanFilter

def filter(problem, iterations=1):
    return ExtendedKalmanFilter(problem, iterations=iterations)

class Kept:
    def __init__(self, problem):
        self.state = np.array(problem.initial_state)
    def update(self, y):
        return self.state

def observer(problem):
    return qpmhe.ExtendedKalman(**problem.covariances)

def gated(problem):
    return qpmhe.MovingHorizonEstimator(
        problem.system, observer(problem), qpmhe.QuadraticCost(
            prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
        horizon=3, initial_state=problem.initial_state,
    )

def wrong(problem):
    return 3

def far(problem):
    if problem.system.n != 12:
        raise ValueError("for 12 states")
    return Kept(problem)

class Raises(Kept):
    def update(self, y):
        return 1 / 0

class Diverges(Kept):
    def update(self, y):
        if abs(self.state).max() < 1e150:  # its square overflows, the state itself does not
            self.state = self.state * 1e60
        return self.state

class Lost(Kept):
    def update(self, y):
        return self.state * np.nan

class Word(Kept):
    def update(self, y):
        return "word"
"""
SMALL = {"backends": ["banded"], "seeds": 2, "steps": 12}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "my.py").write_text(FILE)
    return tmp_path


def computed(study):
    sources = {source.name: source for source in study.sources}
    return [
        compute(Task(
            cell, sources[cell.model], frozenset({"accuracy", "time", "covariance"}), 60.0,
            observer=study.makers["observers"].get(cell.observer),
            estimator=study.makers["estimators"].get(cell.backend),
        ))
        for cell in study.cells()
    ]


def test_another_estimator_is_a_cell_with_times_errors_and_nees(folder):
    study = Study(
        qps=[0], estimators={"EKF": "my.py:filter", "kept": "my.py:Kept", "MHE": "my.py:gated",
                             "few": "enkf(members=5)"},
        folder=folder, **SMALL,
    )
    assert [cell.backend for cell in study.cells()][:3] == ["observer", "EKF", "kept"]
    rows = {(row.backend, row.seed): row for row in computed(study)}
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    for seed in (0, 1):
        states, y = scenario.simulate(seed, 12)
        by_hand = ExtendedKalmanFilter(
            Problem.of(system, observer, cost, scenario.initial_estimate)).run(y)
        row, kept = rows["EKF", seed], rows["kept", seed]
        assert (row.outcome, row.observer, row.qps) == ("done", "", 0)
        assert row.rmse == metrics.accuracy(by_hand.states, states, 5)["rmse"]
        assert row.nees == metrics.consistency(by_hand.states, states, by_hand.covariances)
        assert 0.0 < row.time_median <= row.time_max
        assert len(row.times) == 12
        # A filter has neither J nor a status.
        assert np.isnan([row.cost, row.cost_ratio, row.improved, row.kept, row.qps_mean]).all()
        assert row.reasons is None
        assert kept.rmse == pytest.approx(1.0)  # by the definition of the measure
        assert np.isnan(kept.nees)
        mhe = rows["MHE", seed]
        assert (mhe.improved, mhe.reasons is None) == (pytest.approx(1.0, abs=0.5), False)
        assert rows["few", seed].nees != rows["few", 1 - seed].nees  # random numbers of the seed


@pytest.mark.parametrize(("name", "words"), [
    ("Raises", r"my.py, line \d+: ZeroDivisionError: division by zero"),
    ("Diverges", r"the estimates diverge: after 3 steps, one is \["),
    ("Lost", r"the estimates diverge: after 1 steps, one is \[nan"),
    ("Word", "InvalidInputError: the estimate of Word is 'word', which is not an array"),
])
def test_an_estimator_that_fails_at_run_time_is_a_failed_cell(folder, name, words):
    study = Study(qps=[0], estimators=[f"my.py:{name}"], folder=folder, **SMALL | {"seeds": 1})
    row = computed(study)[-1]
    assert row.outcome == "failed"
    assert re.search(words, row.reason)


@pytest.mark.slow
def test_an_estimator_takes_no_name_of_the_observer(folder):
    """Not even one that looks like an observer's in tables with several observers."""
    study = Study(
        qps=[0], observers=["model", "ekf"], estimators={"observer / own": "my.py:Kept"},
        folder=folder, **SMALL,
    )
    store = run(study, folder / "store.sqlite", jobs=1, progress=False)
    rows = summarise(with_observers(store.frame()))
    assert set(rows.loc[alone(rows), "backend"]) == {"observer / model", "observer / ekf"}
    assert not sequential(rows).any()


@pytest.mark.slow
def test_observers_are_an_axis(folder, tmp_path):
    study = Study(
        qps=[0, 1], observers=["model", "ekf", "my.py:observer"], estimators=["ekf"],
        folder=folder, **SMALL,
    )
    cells = study.cells()
    assert len(cells) == 2 * (2 * 3 + 1)
    assert {cell.key for cell in cells if cell.seed == 0 and cell.observer != "model"} == {
        f"batch_reactor/{name}/i={i}/cap=none/N=10/candidate/T=12{observer}/seed=0"
        for name, i, observer in (
            ("observer", 0, "/observer=ekf"), ("observer", 0, "/observer=my.py:observer"),
            ("banded", 1, "/observer=ekf"), ("banded", 1, "/observer=my.py:observer"),
            ("ekf", 0, ""),
        )
    }
    store = run(study, tmp_path / "store.sqlite", jobs=1, progress=False)
    frame = store.frame()
    assert set(frame["outcome"]) == {"done"}
    values = frame.set_index(["backend", "observer", "seed"])["rmse"]
    for name in ("observer", "banded"):
        assert values[name, "ekf", 0] == values[name, "my.py:observer", 0]
        assert values[name, "ekf", 0] != values[name, "model", 0]
    assert (frame.loc[frame["backend"] == "banded", "cost_ratio"] >= 1.0 - 1e-9).all()
    named = set(with_observers(frame)["backend"])
    assert {"banded / ekf", "observer / model", "ekf"} < named
    assert named == set(summarise(with_observers(frame))["backend"])
    assert set(with_observers(frame[frame["observer"] != "ekf"][:1])["backend"]) <= {"observer"}
    text = study.to_latex(store)
    assert "banded / my.py:observer" in text
    # Another function by the same name is another estimator.
    with pytest.raises(StoreError, match="estimator 'ekf' has changed since its cells"):
        run(Study(estimators={"ekf": "enkf"}, qps=[0], **SMALL), store, jobs=1, progress=False)


@pytest.mark.slow
def test_the_command_line_and_the_report_have_them(folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = command(
        "compare", "--backend", "banded", "--qps", "0,1", "--seeds", 2, "--steps", 8, "--jobs", 1,
        "--estimator", "EKF=my.py:filter(iterations=2)", "--estimator", "particles(particles=50)",
        "--observer", "model", "--observer", "ekf", "--out", "out", "--store", "s.sqlite",
        "--covariances",
    )
    frame = Store("s.sqlite").frame()
    assert {"EKF", "particles(particles=50)"} < set(frame["backend"])
    assert set(frame["outcome"]) == {"done"}
    for words in ("observer / ekf", "EKF 0 none", "No backend failed"):
        assert words in text
    page = (folder / "out" / "index.html").read_text()
    assert 'data-backend="EKF"' in page
    assert 'data-backend="banded / model"' in page


def test_a_file_has_the_same_and_names_no_other_function(folder, monkeypatch):
    (folder / "packages").mkdir()
    (folder / "packages" / "some_makers.py").write_text(
        "import qpmhe\ndef bare(problem):\n    raise AssertionError\n"
        "def said(problem) -> qpmhe.ExtendedKalman:\n"
        "    return qpmhe.ExtendedKalman(**problem.covariances)\n"
    )
    monkeypatch.syspath_prepend(folder / "packages")
    file = folder / "study.toml"

    def read(text):
        file.write_text(f'backends = ["banded"]\nseeds = 2\nsteps = 12\nqps = [0]\n{text}\n')
        return Study.from_toml(file)

    found = read('observers = ["model", "ekf", "my.py:observer"]\n[estimators]\n'
                 'EnKF = "enkf(members=7)"\nother = "my.py:filter"')
    assert found == Study(
        qps=[0], observers=["model", "ekf", "my.py:observer"],
        estimators={"EnKF": "enkf(members=7)", "other": "my.py:filter"}, folder=folder, **SMALL,
    )
    assert read('estimators = ["qpmhe.baselines:ExtendedKalmanFilter"]').estimators
    assert read('observers = ["some_makers:said"]').makers["observers"]
    for text, words in (
        ('estimators = ["os:system"]', "line 5: estimator 'os:system' is in Python's standard"),
        ('observers = ["os:system"]', "observer 'os:system' is in Python's standard library"),
        ('estimators = ["some_makers:bare"]', "as in def bare(...) -> qpmhe.baselines"),
        ('observers = ["some_makers:bare"]', "nothing says that bare returns an observer"),
        # A class that is no observer, and a function of ours that is not annotated as one.
        ('observers = ["qpmhe.baselines:ExtendedKalmanFilter"]', "annotate it"),
        ('estimators = ["qpmhe.models:batch_reactor"]', "annotate it"),
        ('estimators = ["../my.py:filter"]', "outside of the study's folder"),
        ('estimators = ["my.py:ExtendedKalmanFilter"]', "does not define ExtendedKalmanFilter"),
        ('estimators = ["eknf"]', "estimator 'eknf' is not known; expected one of ekf, ukf, enkf"),
        ('observers = ["enkf"]', "observer 'enkf' is not known; expected one of ekf, gated, ukf"),
    ):
        with pytest.raises(StudyError, match=re.escape(words)):
            read(text)


def test_what_does_not_fit_is_refused(folder):
    for error, words, options in (
        (StudyError, "has the name 'osqp', which is taken", {"estimators": {"osqp": "ekf"}}),
        (StudyError, "has the name 'observer', which is", {"estimators": {"observer": "ekf"}}),
        (StudyError, "estimators has 3; expected some of ekf", {"estimators": 3}),
        (StudyError, "estimators has None; expected some", {"estimators": ["ekf", None]}),
        (StudyError, "estimators has '': 'ekf'; expected", {"estimators": {"": "ekf"}}),
        (StudyError, "observers has None; expected some", {"observers": None}),
        (StudyError, "estimators has 'x': 3", {"estimators": {"x": 3}}),
        (StudyError, "observers is empty", {"observers": []}),
        (StudyError, "observers has 3", {"observers": [3]}),
        (ModelError, "cannot read", {"estimators": ["none.py:make"]}),
        (ModelError, "names no function; expected my.py", {"observers": ["my.py"]}),
        (OptionError, "Did you mean", {"estimator": ["ekf"]}),
        (ModelError, "observer 'my.py:wrong' returned 3; expected a qpmhe.Observer",
         {"observers": "my.py:wrong"}),
        (ModelError, "'my.py:wrong' returned 3; expected an object with update(y, u)",
         {"estimators": "my.py:wrong"}),
        (ModelError, "my.py has no function missing", {"estimators": "my.py:missing"}),
        (ModelError, "'ekf(iterations=0)' cannot be made: iterations is 0",
         {"estimators": "ekf(iterations=0)"}),
        (ModelError, "'my.py:far' cannot be made: ValueError: for 12 states",
         {"estimators": "my.py:far"}),
    ):
        with pytest.raises(error, match=re.escape(words)):
            Study(**SMALL | options, folder=folder)
    assert Study(**SMALL, estimators=[]).estimators == {}
    # It can be made for one of the models.
    both = {"models": ["batch_reactor", "chain_of_masses(masses=2)"]}
    assert Study(**SMALL, **both, estimators=["my.py:far"], folder=folder).estimators


def test_a_models_file_registers_a_backend(folder):
    (folder / "model.py").write_text(
        "import qpmhe\nfrom qpmhe.models import batch_reactor\n"
        "from qpmhe_solvers.banded import BandedSolver\n"
        "qpmhe.solvers.register(qpmhe.solvers.Backend('of_a_file', BandedSolver, 'Cholesky',\n"
        "                                             inequalities=False))\n"
        "def make():\n    return batch_reactor()\n"
    )
    file = folder / "study.toml"
    file.write_text('backends = ["of_a_file"]\nmodels = ["model.py:make"]\nseeds = 1\nqps = 1\n')
    with pytest.raises(StudyError, match=r"line 1: backend 'of_a_file' is not known.*model's file"):
        Study.from_toml(_without_models(file))
    try:
        study = Study.from_toml(file)
        assert study.backends == ("of_a_file",)
        assert len(study.cells()) == 1
        other = (folder / "model.py").read_text().replace("of_a_file", "of_another")
        (folder / "other.py").write_text(other)
        file.write_text('estimators = {of_another = "ekf"}\nmodels = ["other.py:make"]\n')
        with pytest.raises(StudyError, match="line 1: estimators has the name 'of_another'"):
            Study.from_toml(file)
        qpmhe.solvers.unregister("of_another")
    finally:
        qpmhe.solvers.unregister("of_a_file")


@pytest.mark.slow
def test_a_backend_whose_class_is_in_a_models_file_runs_in_the_studys_processes(folder, tmp_path):
    """Also where another model's file registers it; the class is known there by its file alone."""
    (folder / "solving.py").write_text(
        "import numpy as np\nimport qpmhe\nfrom qpmhe.models import batch_reactor\n"
        "class Dense(qpmhe.solvers.Solver):\n"
        "    def _solve(self, qp, start):\n"
        "        d = np.linalg.solve(qp.dense(), -qp.gradient.ravel())\n"
        "        return qpmhe.solvers.RawSolution(d.reshape(qp.stages, qp.n), claimed=True)\n"
        "qpmhe.solvers.register(qpmhe.solvers.Backend('dense', Dense, 'LU', inequalities=False))\n"
        "def make():\n    return batch_reactor()\n"
    )
    try:
        study = Study(models=["solving.py:make", "batch_reactor"], backends=["dense", "banded"],
                      seeds=1, qps=[1], solver_iterations=[None], steps=20, folder=folder)
        frame = run(study, tmp_path / "study.sqlite", progress=False).frame()
    finally:
        qpmhe.solvers.unregister("dense")
    assert frame["outcome"].tolist() == ["done"] * len(frame), frame["reason"].tolist()
    errors = frame.set_index(["backend", "model"])["rmse"]
    assert errors["dense"].to_numpy() == pytest.approx(errors["banded"].to_numpy(), rel=0.05)


def _without_models(file):
    other = file.with_name("other.toml")
    other.write_text(file.read_text().replace('models = ["model.py:make"]\n', ""))
    return other
