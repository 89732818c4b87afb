import re
import sys

import pytest

from qpmhe.errors import BackendError, ModelError, OptionError, QpmheError, UnknownOptionError
from qpmhe.models import batch_reactor
from qpmhe.studies import StudyError
from qpmhe.studies.grid import Study
from qpmhe_solvers import available, backend

ODD = "tests/studies/odd_models.py"


def keys(**options):
    return [cell.key for cell in Study(**options).cells()]


def test_the_defaults_are_all_native_backends_on_the_reactor():
    study = Study()
    assert study.models == ("batch_reactor",)
    assert study.backends == tuple(name for name in available() if ":" not in name)
    assert study.seeds == tuple(range(20))
    capped = sum(backend(name).iteration_cap for name in study.backends)
    cells = study.cells()
    # One observer; four other numbers of QPs; five caps where there are caps.
    assert len(cells) == 20 * (1 + 4 * (5 * capped + len(study.backends) - capped))
    assert len({cell.key for cell in cells}) == len(set(cells)) == len(cells)


def test_cells_that_would_be_the_same_are_one():
    assert keys(backends=["banded"], solver_iterations=[1, 5], seeds=1, qps=[1]) == [
        "batch_reactor/banded/i=1/cap=none/N=10/candidate/T=150/seed=0"
    ]
    assert keys(backends=["osqp", "auto"], qps=[0], starts=["candidate", "best"], seeds=1) == [
        "batch_reactor/observer/i=0/cap=none/N=10/candidate/T=150/seed=0"
    ]
    # The model's own horizon is 10; twice the same of anything is once.
    assert len(keys(backends=["osqp"] * 2, horizons=[None, 10, 10], qps=[1, 1], seeds=[3, 3],
                    solver_iterations=[2], models=["batch_reactor"] * 2)) == 1


def test_the_grid_is_the_product_of_its_lists():
    study = Study(
        models=["batch_reactor", "chain_of_masses( masses = 1 )"], backends=["osqp"],
        qps=[2, None], solver_iterations=[5, None], horizons=[3, None], starts=["best"],
        seeds=[7, 2], steps=9,
    )
    cells = study.cells()
    assert len(cells) == 2 * 2 * 2 * 2 * 2
    assert {cell.model for cell in cells} == {"batch_reactor", "chain_of_masses(masses=1)"}
    assert {cell.steps for cell in cells} == {9}
    assert {cell.horizon for cell in cells if cell.model == "batch_reactor"} == {3, 10}
    assert {(cell.qps, cell.solver_iterations) for cell in cells} == {
        (2, 5), (2, None), (None, 5), (None, None)
    }
    # Seed by seed, so that what is there early covers the grid.
    assert [cell.seed for cell in cells] == [7] * 16 + [2] * 16


def test_lists_may_be_any_iterable_and_single_values_stand_for_lists():
    study = Study(models="batch_reactor", backends="osqp", qps=2, horizons=4,
                  solver_iterations=None, starts="best", seeds=range(1, 3))
    assert [(cell.qps, cell.horizon, cell.start, cell.seed) for cell in study.cells()] == [
        (2, 4, "best", 1), (2, 4, "best", 2)
    ]


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"models": []}, StudyError, "models is empty"),
        ({"models": ["reactor"]}, ModelError, "expected one of batch_reactor"),
        ({"models": [3]}, StudyError, "models has 3; expected the name"),
        ({"models": ["chain_of_masses(2)"]}, ModelError, "plain values by keyword"),
        ({"models": ["chain_of_masses(masses=open)"]}, ModelError, "plain values"),
        ({"models": ["chain_of_masses(mases=2)"]}, ModelError, "mases"),
        ({"models": ["chain_of_masses(masses=0)"]}, ModelError, "masses is 0"),
        ({"models": ["nowhere.py:make"]}, ModelError, "nowhere.py"),
        ({"models": ["no.such.module:make"]}, ModelError, "cannot import no.such.module"),
        ({"models": ["os.path:no_such"]}, ModelError, "has no function no_such"),
        ({"models": ["os:3"]}, ModelError, "expected a name of the catalogue"),
        ({"models": [f"{ODD}:not_callable"]}, ModelError, "no function not_callable"),
        ({"models": [f"{ODD}:cannot_be_made"]}, ModelError, "RuntimeError: no such reactor"),
        ({"models": [f"{ODD}:three_parts"]}, ModelError, "expected (system, observer, cost"),
        ({"models": [f"{ODD}:wrong_part"]}, ModelError, "gave a str for its cost"),
        ({"backends": []}, StudyError, "backends is empty"),
        ({"backends": ["osq"]}, BackendError, "'osq' is not known"),
        ({"backends": [None]}, BackendError, "None is not known"),
        ({"qps": []}, StudyError, "qps is empty"),
        ({"qps": [-1]}, OptionError, "qps is -1"),
        ({"qps": [True]}, OptionError, "qps is True"),
        ({"qps": "all"}, OptionError, "qps is 'all'"),
        ({"solver_iterations": [0]}, OptionError, "solver_iterations is 0"),
        ({"horizons": [0]}, OptionError, "horizons is 0"),
        ({"horizons": [2.0]}, OptionError, "horizons is 2.0"),
        ({"starts": []}, StudyError, "starts is empty"),
        ({"starts": ["worst"]}, OptionError, "expected one of 'candidate', 'best'"),
        ({"seeds": 0}, OptionError, "seeds is 0"),
        ({"seeds": []}, StudyError, "seeds is empty"),
        ({"seeds": [-1]}, OptionError, "seeds is -1"),
        ({"steps": 0}, OptionError, "steps is 0"),
        ({"measure": "speed"}, OptionError, "'both', 'accuracy', 'time'"),
        ({"deadline": 0.0}, OptionError, "deadline is 0.0"),
        ({"covariances": 1}, OptionError, "covariances is 1"),
        ({"cell_timeout": float("inf")}, OptionError, "cell_timeout is inf"),
        ({"seed": 1}, UnknownOptionError, "Did you mean seeds?"),
    ],
)
def test_what_does_not_fit_is_refused(options, error, words):
    with pytest.raises(error, match=re.escape(words)) as caught:
        Study(**options)
    assert isinstance(caught.value, QpmheError)


def test_a_backend_that_is_not_installed_is_refused_by_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "osqp", None)
    with pytest.raises(BackendError, match="'osqp' is not installed; pip install osqp"):
        Study(backends=["osqp"])


def test_a_file_is_a_model_by_its_function(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from qpmhe.models import batch_reactor\n"
        "def make(method='euler'):\n    return batch_reactor(method)\n"
    )
    study = Study(models=[f"{file}:make(method='rk4')"], backends=["banded"], qps=[1], seeds=1)
    (cell,) = study.cells()
    assert cell.model == f"{file}:make(method='rk4')"
    assert cell.steps == batch_reactor().scenario.steps


def test_a_module_in_the_working_directory_is_a_model(tmp_path, monkeypatch):
    (tmp_path / "my_models_here.py").write_text("from qpmhe.models import batch_reactor as mine\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [item for item in __import__("sys").path if item])
    (cell,) = Study(models=["my_models_here:mine"], backends=["banded"], qps=[1], seeds=1).cells()
    assert cell.model == "my_models_here:mine"
