"""Constant parameters as states, against the certified values and MINPACK's LM."""

import numpy as np
import pytest
from scipy.optimize import leastsq

from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler

from .nist import MODELS, regression

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
NAMES = sorted(MODELS)
# Here full steps alone end far from the certified parameters.
HARD = "Rat42", "Rat43", "MGH09", "MGH10", "MGH17", "Eckerle4"


def starts(names):
    """All starts."""
    return [(name, start) for name in names for start in ("start", "near")]


def check(name, start, form, engine):
    """Solved as MINPACK solves it, with at most 1.5 times its Jacobians, or 60 QPs."""
    data, jacobians = regression(name), 0
    first = getattr(data, start)

    def jacobian(b):
        nonlocal jacobians
        jacobians += 1
        return data.jacobian(b, first)

    solution, *_ = leastsq(
        lambda b: data.residuals(b, first), first, Dfun=jacobian, ftol=1e-15, xtol=1e-12,
        gtol=0.0, maxfev=5000, full_output=True,
    )
    assert data.missed(solution) < 1
    estimate = data.fit(first, form, 600, engine)
    assert data.missed(estimate.filtered) < 1
    assert Status.CONVERGED in estimate.status
    assert estimate.cost <= np.square(data.residuals(solution, first)).sum() * (1 + 1e-9)
    assert estimate.qps <= max(60, 1.5 * jacobians)


@pytest.mark.parametrize(("name", "start"), starts(NAMES))
def test_certified_parameters(name, start):
    check(name, start, "set", "python")


@pytest.mark.parametrize("form", ["wide small", "small", "wide set"])
@pytest.mark.parametrize(("name", "start"), starts(HARD[:2]))
def test_damped_steps_and_small_disturbances(name, start, form):
    """Bounds have damping in place of a region; its scale does not grow with their weight."""
    check(name, start, form, "python")


@pytest.mark.parametrize("engine", [
    "python",
    pytest.param("compiled", marks=pytest.mark.skipif(
        find_compiler() is None, reason="there is no C compiler"
    )),
])
@pytest.mark.parametrize("form", ["small", "wide small"])
def test_hessians_that_are_singular_up_to_rounding(form, engine):
    """Vague priors, small disturbances: whether H has a factor is rounding, the end is not."""
    data, solved = regression("Rat43"), 0
    for seed in range(6):
        moved = np.random.default_rng([seed, 7]).uniform(-0.05, 0.05, data.start.size)
        estimate = data.fit(data.start * (1.0 + moved), form, 100, engine)
        assert not estimate.status & (Status.SOLVER_FAILED | Status.SOLVER_STOPPED)
        solved += data.missed(estimate.filtered) < 1 and Status.CONVERGED in estimate.status
    assert solved >= 4


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize(("form", "name", "start"), [
    *(("set", name, "start") for name in HARD),
    *((form, name, "start") for name in HARD[:2] for form in ("small", "wide small")),
])
def test_compiled(form, name, start):
    check(name, start, form, "compiled")
