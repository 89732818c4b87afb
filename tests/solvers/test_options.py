import dataclasses
import math

import numpy as np
import pytest

from qpmhe_solvers import InvalidInputError, OptionError, QpmheError, SolverOptions

FIELDS = [field.name for field in dataclasses.fields(SolverOptions)]


def test_every_field_has_a_valid_default():
    options = SolverOptions()
    assert options.max_iterations is None
    assert options.absolute_tolerance == 1e-7
    assert options.relative_tolerance == 0.0
    assert options.time_limit is None
    assert options.warm_start is True


@pytest.mark.parametrize("name", FIELDS)
def test_options_are_frozen(name):
    options = SolverOptions()
    with pytest.raises(dataclasses.FrozenInstanceError, match=name):
        setattr(options, name, getattr(options, name))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_iterations", 1),
        ("max_iterations", 10**9),
        ("absolute_tolerance", 1),
        ("absolute_tolerance", np.float64(1e-12)),
        ("relative_tolerance", 0),
        ("relative_tolerance", 0.5),
        ("time_limit", 1e-9),
        ("time_limit", 3600),
        ("warm_start", False),
    ],
)
def test_values_in_range(name, value):
    assert getattr(SolverOptions(**{name: value}), name) == value


CAP = r"expected an integer >= 1 or None.*max_qps=0"
ABOVE = "expected a finite number > 0"
LEAST = "expected a finite number >= 0"
SWITCH = "expected True or False"


@pytest.mark.parametrize(
    ("name", "value", "expectation"),
    [
        ("max_iterations", 0, CAP),
        ("max_iterations", -2, CAP),
        ("max_iterations", 2.0, CAP),
        ("max_iterations", math.inf, CAP),
        ("max_iterations", "5", CAP),
        ("max_iterations", True, CAP),
        ("absolute_tolerance", 0.0, ABOVE),
        ("absolute_tolerance", -1e-9, ABOVE),
        ("absolute_tolerance", math.nan, ABOVE),
        ("absolute_tolerance", math.inf, ABOVE),
        ("absolute_tolerance", None, ABOVE),
        ("absolute_tolerance", "1e-6", ABOVE),
        ("absolute_tolerance", True, ABOVE),
        ("relative_tolerance", -1e-9, LEAST),
        ("relative_tolerance", math.nan, LEAST),
        ("relative_tolerance", math.inf, LEAST),
        ("relative_tolerance", None, LEAST),
        ("relative_tolerance", False, LEAST),
        ("time_limit", 0, ABOVE),
        ("time_limit", -1.0, ABOVE),
        ("time_limit", math.nan, ABOVE),
        ("time_limit", math.inf, ABOVE),
        ("time_limit", "1 s", ABOVE),
        ("time_limit", True, ABOVE),
        ("warm_start", 1, SWITCH),
        ("warm_start", None, SWITCH),
        ("warm_start", "yes", SWITCH),
    ],
)
def test_values_out_of_range(name, value, expectation):
    with pytest.raises(OptionError, match=f"^{name} is {value!r}; {expectation}") as caught:
        SolverOptions(**{name: value})
    assert isinstance(caught.value, InvalidInputError)
    assert isinstance(caught.value, QpmheError)
    assert isinstance(caught.value, ValueError)


def test_replace_checks_again():
    with pytest.raises(OptionError, match="max_iterations is 0"):
        dataclasses.replace(SolverOptions(), max_iterations=0)


def test_a_misspelt_option_is_an_error():
    with pytest.raises(TypeError, match="max_iter"):
        SolverOptions(max_iter=3)
