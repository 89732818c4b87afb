"""Whatever is given for an option: it is taken, or one of our own errors says why not."""

import datetime
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import qpmhe
from qpmhe._checks import make_folder
from qpmhe.errors import QpmheError
from qpmhe.studies import Study, export, run, write_report


class UnshownError(Exception):
    pass


class Unshown:
    def __repr__(self):
        raise UnshownError


VALUES = {
    "huge": 10**400, "less": -(10**400), "vast": 10**5000, "words": np.array(["python", "auto"]),
    "word": np.array("python"), "numbers": np.array([1.0, 2.0]), "number": np.array(1.0),
    "flags": np.array([True, False]), "objects": np.array([object()], object),
    "object": object(), "unshown": Unshown(), "None": None, "list": [], "dict": {}, "NaN": np.nan,
    "blank": "", "bytes": b"x", "complex": 1j, "ragged": [[1.0], 2.0], "huge list": [10**400],
    "NA": pd.NA, "NaT": pd.NaT, "date": np.datetime64("2026-01-01"),
    "duration": np.timedelta64(5, "s"), "durations": np.array([5], "m8[s]"),
    "Timestamp": pd.Timestamp("2026-01-01"), "Timedelta": pd.Timedelta(5, "s"),
    "timedelta": datetime.timedelta(1), "series": pd.Series(["a", "b"]),
    "frame": pd.DataFrame({"a": [1, 2]}),
}
REACTOR = qpmhe.models.batch_reactor()
SYSTEM, OBSERVER, COST, SCENARIO = REACTOR
EYE = np.eye(2)
COVARIANCES = {"disturbance": EYE, "noise": [[1.0]]}
WEIGHTS = {"prior": EYE, **COVARIANCES}


def made(kind, usual):
    """A call of ``kind`` that works, but for the options given."""
    return lambda **options: kind(**(usual | options))


def estimator(system=SYSTEM, observer=OBSERVER, cost=COST, **options):
    usual = {"horizon": 3, "initial_state": [3.0, 0.0]}
    return qpmhe.MovingHorizonEstimator(system, observer, cost, **(usual | options))


def system(f=lambda x: x, h=lambda x: x[..., :1], kind=qpmhe.System, **options):
    return kind(f, h, **({"n": 2, "p": 1} | options))


def amended(**options):
    mhe = estimator()
    mhe.update([1.0])
    return mhe.amend(**({"time": 0, "y": [1.0]} | options))


CALLS = [
    (estimator, "system observer cost horizon initial_state backend max_qps max_solver_iterations "
     "solver_tolerance tolerance engine project_observer infeasible warm_start candidate arrival "
     "time_budget delay isolated"),
    (lambda **options: estimator().update(**({"y": [1.0]} | options)), "y u dt noise_weight"),
    (amended, "time y"),
    (lambda **options: estimator().run(**({"measurements": [[1.0]]} | options)),
     "measurements inputs covariances"),
    (system, "f h n p m f_jacobian h_jacobian states disturbances noises"),
    (made(system, {"kind": qpmhe.System.from_ode, "dt": 0.1}), "f h n p m dt method states"),
    (made(qpmhe.QuadraticCost, WEIGHTS), "prior disturbance noise discount"),
    (made(qpmhe.QuadraticCost.from_covariances, WEIGHTS), "prior disturbance noise discount"),
    (made(qpmhe.RobustCost, WEIGHTS), "prior disturbance noise discount"),
    (made(qpmhe.Huber, {"weight": EYE}), "weight threshold per_component"),
    (made(qpmhe.Power, {"weight": EYE, "exponent": 1.5}), "weight exponent per_component"),
    (qpmhe.ObserverPrior, "minimum maximum"),
    (made(qpmhe.Luenberger, {"gain": [[0.1]]}), "gain metric"),
    (made(qpmhe.OutputInjection, {"correction": np.add}), "correction metric"),
    (made(qpmhe.ExtendedKalman, WEIGHTS), "prior disturbance noise"),
    (made(qpmhe.UnscentedKalman, WEIGHTS), "prior disturbance noise spread"),
    (made(qpmhe.SteadyStateKalman, {"system": SYSTEM, "at": [3.0, 1.0], **COVARIANCES}),
     "system at u disturbance noise prior"),
    (made(qpmhe.HighGain, {"n": 2, "dt": 0.1, "epsilon": 0.5}),
     "n dt epsilon coefficients sampling"),
    (made(qpmhe.design_luenberger, {"system": SYSTEM, "at": [3.0, 1.0], "poles": [0.5, 0.6]}),
     "system at u poles disturbance noise"),
    (made(qpmhe.design_luenberger, {"system": SYSTEM, "at": [3.0, 1.0], **COVARIANCES}),
     "system at u poles disturbance noise"),
    (made(qpmhe.Box, {"lower": [0.0], "upper": [1.0]}), "lower upper"),
    (made(qpmhe.Polytope, {"matrix": EYE, "bound": [1.0, 1.0]}), "matrix bound"),
    (qpmhe.solvers.SolverOptions,
     "max_iterations absolute_tolerance relative_tolerance time_limit warm_start"),
    (made(qpmhe.solvers.create, {"name": "auto"}), "name options isolated"),
    (made(qpmhe.BatchEstimator, {
        "system": SYSTEM, "observer": OBSERVER, "cost": COST, "members": 2, "horizon": 3,
        "initial_states": [3.0, 0.0],
    }), "system observer cost members initial_states threads horizon engine"),
    (made(Study, {"backends": ["banded"], "qps": [1], "seeds": 1}),
     "models backends qps solver_iterations horizons starts seeds steps measure deadline "
     "covariances cell_timeout folder"),
    (lambda **options: Study(**{name: [value] for name, value in options.items()}),
     "models backends qps solver_iterations horizons starts seeds"),
    (made(run, {"study": Study(backends=["banded"], qps=[1], seeds=1, steps=2), "store": ""}),
     "study store jobs progress retry_failed"),
    (lambda **options: replace(SCENARIO, **options),
     "system initial_state initial_estimate disturbance_covariance noise_covariance dt horizon "
     "steps labels inputs settling_time resolution"),
    (made(export, {"store": "none.sqlite", "path": "cells.csv"}), "store path"),
    (made(write_report, {"source": "none.sqlite", "out": "report"}), "source"),
    (make_folder, "path"),
    (made(qpmhe.augment_parameters, {
        "f": lambda x, theta: x * theta[0], "h": lambda x, theta: x[:1], "nominal": [1.0], "n": 2,
        "p": 1,
    }), "f h nominal n p m estimated parameter_bounds states disturbances drifting dt method"),
    (made(qpmhe.noisy_inputs, {
        "system": qpmhe.System(lambda x, u: x + u, lambda x: x, n=1, p=1, m=1),
    }), "system inputs"),
    (made(SCENARIO.simulate, {"seed": 0, "steps": 3}), "seed steps"),
]


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_only_our_own_errors(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for call, names in CALLS:
        for name in names.split():
            with suppress(QpmheError):
                call(**{name: value})


def test_the_message_names_the_odd_value():
    for options, words in (
        ({"engine": np.array("python")}, r"engine is array\(.*expected one of 'auto'"),
        ({"tolerance": -(10**400)}, r"tolerance is -100000.*; expected a finite number > 0"),
        ({"horizon": 10**400}, r"horizon is 10000.*; expected an integer >= 1"),
        ({"system": REACTOR}, r"(?s)system is .*; expected a qpmhe\.System"),
    ):
        with pytest.raises(QpmheError, match=words):
            estimator(**options)
