"""What observers have to return and to weigh, checked once at a few points."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from .._checks import positive_definite
from .._linalg import inverse
from ..costs import Cost, QuadraticCost, RobustCost
from ..costs.contracts import check_own_cost, numbers_of, spare
from ..errors import InvalidInputError, ModelError, PriorWarning, QpmheError
from ..model.functions import EvaluationError
from ..model.system import System
from ..observers import Observer, Sample
from ..observers.base import check_written
from ..terms.base import read_only

Array = NDArray[np.float64]

# Corrections at v = 0, in standard deviations of the prior, that are rounding.
_ROUNDING = 1e-6


def check_observer(system: System, observer: Observer) -> None:
    """Check the matrices that an observer states about itself; raise a `ModelError`."""
    name, n, p = type(observer).__name__, system.n, system.p
    metric = observer.metric
    if metric is not None:
        try:
            positive_definite("metric", metric)
        except QpmheError as error:
            raise ModelError(
                f"{name}.metric is no matrix of an error's norm ({error}) The package projects an "
                "observer onto X in its metric, (n, n) or None; if yours is something else, give "
                "it another name."
            ) from error
    for attribute, matrix, shape in (
        ("initial_covariance", observer.initial_covariance(), (n, n)),
        ("constant_gain", observer.constant_gain, (n, p)),
    ):
        # The package's own observers name the parameter that has the wrong size.
        if matrix is not None and not type(observer).__module__.startswith("qpmhe."):
            numbers_of(f"{name}.{attribute}", matrix, shape)


    memory = observer.initial_memory()
    if memory is not None:
        method = f"{name}.initial_memory"
        found = numbers_of(method, memory, (max(np.size(memory), 1),))
        if not np.isfinite(found).all():
            raise ModelError(f"{method} returned {found.tolist()}; expected finite numbers.")


def check_correction(
    system: System, observer: Observer, cost: Cost, state: Array, u: Array
) -> None:
    """Check what an observer's methods, and an own cost's, return at the initial state.

    The correction has shape (n,), is real, and is zero where the error is; the covariance has shape
    (n, n), and is None if and only if the observer has no initial one.

    Raises
    ------
    ModelError
        With the method's name, the shape that was found, and the one that is expected.
    """
    prior = cost.initial_weight(observer.initial_covariance())
    if type(cost) not in (QuadraticCost, RobustCost):
        check_own_cost(cost, prior)
    if type(observer).__module__.startswith("qpmhe."):
        return
    noise = np.sqrt(inverse(cost.noise).diagonal())
    deviations = cost.prior_deviations(observer.initial_covariance(), system.disturbance_matrix)
    tried = spare(observer)
    for v in (np.zeros(system.p), noise, -3.0 * noise):
        with np.errstate(all="ignore"):
            try:
                sample = _sample(system, observer, state, u)
            except Exception:  # the model's bad luck
                return
        following = sample.next_memory
        try:
            with np.errstate(all="ignore"):
                answer = tried.correct(state.copy(), v.copy(), sample)
                filtered = tried.filter(state.copy(), v.copy(), sample)
        except (ArithmeticError, np.linalg.LinAlgError, EvaluationError, QpmheError):
            continue  # bad luck is for the run
        except Exception as error:
            raise ModelError(
                f"{type(observer).__name__}.correct or filter raised {type(error).__name__}: "
                f"{error} at the initial state {state.tolist()}."
            ) from error
        correction = _checked_pair(observer, answer, filtered, system.n)
        if following is not None:
            check_written(observer, sample, following)
        # Beside zero: rounding, in the prior's units. What is not finite is bad luck, for the run.
        size = _ROUNDING * (deviations + np.abs(state))
        if not v.any() and (np.abs(correction) > size).any() and np.isfinite(correction).all():
            raise ModelError(
                f"{type(observer).__name__}.correct returned the correction {correction.tolist()} "
                "for the error v = 0; expected zero, L(z, 0) = 0."
            )


def _sample(system: System, observer: Observer, state: Array, u: Array) -> Sample:
    sample = Sample(system, u, covariance=observer.initial_covariance())
    if observer.needs_jacobians:
        sample.f_jacobian, sample.h_jacobian = (
            np.array(jacobian(state, u)) for jacobian in (system.f_jacobian, system.h_jacobian)
        )
    if (memory := observer.initial_memory()) is not None:
        sample.memory, sample.next_memory = read_only(np.array(memory)), np.array(memory)
    if observer.sensors:
        count = len(observer.sensors)
        sample.rejections, sample.next_rejections = np.zeros((2, count), np.int64)
    return sample


def _checked_pair(observer: Observer, answer: object, filtered: object, n: int) -> Array:
    """The correction of an answer of the right form."""
    name = type(observer).__name__
    covariance = observer.initial_covariance() is not None
    second = f"the covariance, shape ({n}, {n})" if covariance else "None"
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        shape = f" of shape {answer.shape}" if isinstance(answer, np.ndarray) else ""
        raise ModelError(
            f"{name}.correct returned {type(answer).__name__}{shape}; expected the pair of the "
            f"correction, shape ({n},), and {second}."
        )
    correction = numbers_of(f"{name}.correct, as its correction,", answer[0], (n,))
    if covariance:
        numbers_of(f"{name}.correct, as its covariance,", answer[1], (n, n))
    elif answer[1] is not None:
        raise ModelError(
            f"{name}.correct returned a covariance, but its initial_covariance is None; return "
            "None as the second, or write initial_covariance."
        )
    if filtered is not None:
        if not isinstance(filtered, (tuple, list)) or len(filtered) != 2:
            raise ModelError(
                f"{name}.filter returned {type(filtered).__name__}; expected None, or the pair of "
                f"estimate, shape ({n},), and covariance, shape ({n}, {n})."
            )
        numbers_of(f"{name}.filter, as its estimate,", filtered[0], (n,))
        numbers_of(f"{name}.filter, as its covariance,", filtered[1], (n, n))
    return correction


def check_prior(observer: Observer, cost: Cost, *, warns: bool) -> None:
    """Check that an observer can weigh the prior; warn of a constant weight where it could.

    Without QPs there is nothing to warn of: the estimates do not depend on the weight.
    """
    name, has = type(observer).__name__, observer.initial_covariance() is not None
    if cost.observer_prior is not None and not has:
        raise InvalidInputError(
            f"the prior's weight comes from the observer's covariance, but {name} has none; give "
            "the cost prior=, the covariance (n, n) of this observer's error for from_covariances "
            "and else its inverse, or take a Kalman-type observer, such as qpmhe.ExtendedKalman."
        )
    if cost.observer_prior is None and has and warns:
        warnings.warn(
            f"the cost's prior is a constant weight beside {name}, which has a covariance: every "
            "window counts the data before it only as much as that weight says. Leave prior out, "
            "and the weight follows the covariance. If the constant weight is meant, ignore "
            "qpmhe.PriorWarning.",
            PriorWarning,
            stacklevel=4,
        )
