import dataclasses
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import BackendError, OptionError

from .spoil import check, estimator


@pytest.mark.parametrize(
    ("name", "value", "least"),
    [
        *(("horizon", value, 1) for value in (0, -1, 1.5, 3.0, True, "3", None)),
        *(("max_qps", value, 0) for value in (-1, 1.5, True, "2")),
    ],
)
def test_counts_out_of_range(name, value, least):
    check(
        OptionError, [f"{name} is {value!r}", f"expected an integer >= {least}"],
        lambda: estimator(**{name: value}),
    )


@pytest.mark.parametrize("value", [0, -2, 1.5, True, "5"])
def test_iteration_caps_out_of_range(value):
    check(
        OptionError,
        [f"max_solver_iterations is {value!r}", "expected an integer >= 1", "max_qps=0"],
        lambda: estimator(max_solver_iterations=value),
    )


@pytest.mark.parametrize("value", [0, 0.0, -1e-9, math.nan, math.inf, "tight", True, None, [1e-7]])
@pytest.mark.parametrize("name", ["tolerance", "solver_tolerance"])
def test_tolerances_out_of_range(name, value):
    check(
        OptionError, [f"{name} is {value!r}", "expected a finite number > 0"],
        lambda: estimator(**{name: value}),
    )


@pytest.mark.parametrize(
    "option",
    [
        {"horizon": np.int64(3)},
        {"max_qps": np.int32(2)},
        {"max_solver_iterations": np.int64(5)},
        {"solver_tolerance": np.float32(1e-5)},
        {"tolerance": np.float64(1e-5)},
        {"max_qps": None},
        {"max_solver_iterations": None},
        {"delay": np.int64(2)},
        {"time_budget": np.float64(60.0)},
        {"time_budget": np.float32(60.0)},
        {"time_budget": np.int64(60)},
    ],
    ids=str,
)
def test_numbers_of_numpy_are_numbers(option):
    assert estimator(**option).update([1.0]).state.shape == (2,)


@pytest.mark.parametrize("name", ["nosuch", "", "OSQP", None, 3, ["osqp"]])
def test_an_unknown_backend_lists_the_known_ones(name):
    known = [entry.name for entry in qpmhe.solvers.backends()]
    assert "auto" in known
    check(
        BackendError, [f"backend {name!r} is not known", *known], lambda: estimator(backend=name)
    )


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_available_backends_are_accepted(backend):
    assert estimator(backend=backend).update([1.0]).cost >= 0.0


@pytest.mark.parametrize(
    ("name", "value", "known"),
    [
        *(("engine", value, ["python"]) for value in ("fast", "Python", None, 0)),
        *(
            ("infeasible", value, ["drop_rows", "keep_candidate"])
            for value in ("drop", "", "Keep_candidate", None, True, ["drop_rows"])
        ),
        *(
            ("candidate", value, ["observer", "reinitialized"])
            for value in ("reinitialised", "best", None, 0)
        ),
        *(("arrival", value, ["observer", "smoothed"]) for value in ("smooth", None, True)),
    ],
)
def test_unknown_choices_list_the_known_ones(name, value, known):
    check(
        OptionError, [f"{name} is {value!r}", "expected one of", *map(repr, known)],
        lambda: estimator(**{name: value}),
    )


@pytest.mark.parametrize("name", ["warm_start", "project_observer"])
@pytest.mark.parametrize("value", ["best", None, 1])
def test_flags_are_true_or_false(name, value):
    check(
        OptionError, [f"{name} is {value!r}", "True or False"], lambda: estimator(**{name: value})
    )


@pytest.mark.parametrize("value", [0, 0.0, -1.0, math.nan, math.inf, True, "1", [0.1]])
def test_time_budgets_out_of_range(value):
    check(
        OptionError, [f"time_budget is {value!r}", "expected a finite number > 0"],
        lambda: estimator(time_budget=value),
    )


@pytest.mark.parametrize("value", [-1, 1.5, 1.0, True, "1", None])
def test_delays_that_are_no_count(value):
    check(
        OptionError, [f"delay is {value!r}", "expected an integer >= 0"],
        lambda: estimator(delay=value),
    )


@pytest.mark.parametrize("value", [4, 5, 100])
def test_delays_beyond_the_horizon(value):
    assert estimator(horizon=3, delay=3).settings.delay == 3
    check(
        OptionError, [f"delay is {value}", "at most the horizon, 3"],
        lambda: estimator(horizon=3, delay=value),
    )


def test_settings_are_kept_and_frozen():
    given = {
        "horizon": 4, "backend": "banded", "max_qps": 2, "max_solver_iterations": 7,
        "solver_tolerance": 1e-5, "tolerance": 1e-6, "engine": "python",
        "infeasible": "keep_candidate", "project_observer": False,
        "warm_start": True, "candidate": "reinitialized", "time_budget": 3.5, "delay": 1,
        "arrival": "smoothed",
    }
    settings = estimator(**given).settings
    assert given.items() <= dataclasses.asdict(settings).items()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.horizon = 5
    defaults = dataclasses.asdict(estimator().settings)
    assert (defaults["infeasible"], defaults["warm_start"]) == ("drop_rows", False)
    assert defaults["project_observer"] is True
    assert (defaults["candidate"], defaults["time_budget"]) == ("observer", None)
    assert (defaults["max_qps"], defaults["delay"]) == (1, 0)


def test_an_unknown_option_is_a_type_error():
    with pytest.raises(TypeError, match="max_qp"):
        estimator(max_qp=3)


def test_a_horizon_beyond_the_memory(monkeypatch):
    def exhausted(*_):
        raise MemoryError("Unable to allocate 745. GiB")

    monkeypatch.setattr("qpmhe.estimation.estimator.engine_for", exhausted)
    check(
        OptionError, ["horizon is 10000000", "745. GiB", "take a shorter one"],
        lambda: estimator(horizon=10_000_000),
    )
