"""Whatever is given for an option: it is taken, or one of our own errors says why not."""

import datetime
import inspect
from contextlib import suppress

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
PARTS = {"system": SYSTEM, "observer": OBSERVER, "cost": COST, "horizon": 3}
SIZES = {"n": 2, "p": 1}
FUNCTIONS = {"f": lambda x: x, "h": lambda x: x[..., :1]}
POINT = {"system": SYSTEM, "at": [3.0, 1.0]}
# Axes of a study, which are lists of values.
AXES = ["models", "backends", "qps", "solver_iterations", "horizons", "starts", "seeds"]
# Callables, which are asked for what they return, and what is given to somebody else.
LEFT_OUT = {"progress", "kwargs", "options"}


def calls():
    """What is called, and arguments with which that works."""
    mhe = qpmhe.MovingHorizonEstimator(**PARTS, initial_state=[3.0, 0.0])
    mhe.update([1.0])
    return [
        (qpmhe.MovingHorizonEstimator, PARTS | {"initial_state": [3.0, 0.0]}),
        (mhe.update, {"y": [1.0]}), (mhe.amend, {"time": 0, "y": [1.0]}),
        (mhe.run, {"measurements": [[1.0]]}),
        (qpmhe.BatchEstimator, PARTS | {"members": 2, "initial_states": [3.0, 0.0]}),
        (qpmhe.System, FUNCTIONS | SIZES),
        (qpmhe.System.from_ode, {"rate": np.sin, "h": np.cos, **SIZES, "dt": 0.1}),
        (qpmhe.QuadraticCost, WEIGHTS), (qpmhe.QuadraticCost.from_covariances, WEIGHTS),
        (qpmhe.RobustCost, WEIGHTS), (qpmhe.Huber, {"weight": EYE}),
        (qpmhe.Power, {"weight": EYE, "exponent": 1.5}), (qpmhe.ObserverPrior, {}),
        (qpmhe.Luenberger, {"gain": [[0.1]]}), (qpmhe.OutputInjection, {"correction": np.add}),
        (qpmhe.ExtendedKalman, WEIGHTS), (qpmhe.UnscentedKalman, WEIGHTS),
        (qpmhe.SteadyStateKalman, POINT | COVARIANCES),
        (qpmhe.HighGain, {"n": 2, "dt": 0.1, "epsilon": 0.5}),
        (qpmhe.design_luenberger, POINT | {"poles": [0.5, 0.6]}),
        (qpmhe.design_luenberger, POINT | COVARIANCES),
        (qpmhe.Box, {"lower": [0.0], "upper": [1.0]}),
        (qpmhe.Polytope, {"matrix": EYE, "bound": [1.0, 1.0]}),
        (qpmhe.solvers.SolverOptions, {}), (qpmhe.solvers.create, {"name": "auto"}),
        (Study, {"backends": ["banded"], "qps": [1], "seeds": 1}),
        (run, {"study": Study(backends=["banded"], qps=[1], seeds=1, steps=2), "store": ""}),
        (qpmhe.models.Scenario, vars(SCENARIO)), (SCENARIO.simulate, {"seed": 0, "steps": 3}),
        (export, {"store": "none.sqlite", "path": "cells.csv"}),
        (write_report, {"source": "none.sqlite", "out": "report"}), (make_folder, {}),
        (qpmhe.augment_parameters, {
            "f": lambda x, theta: x * theta[0], "h": lambda x, theta: x[:1], "nominal": [1.0],
            **SIZES,
        }),
        (qpmhe.noisy_inputs, {
            "system": qpmhe.System(lambda x, u: x + u, lambda x: x, n=1, p=1, m=1),
        }),
    ]


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_only_our_own_errors(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for kind, usual in calls():
        for name in set(inspect.signature(kind).parameters) - LEFT_OUT:
            with suppress(QpmheError):
                kind(**(usual | {name: value}))
    for name in AXES:
        with suppress(QpmheError):
            Study(**{name: [value]})


def test_the_message_names_the_odd_value():
    for options, words in (
        ({"engine": np.array("python")}, r"engine is array\(.*expected one of 'auto'"),
        ({"tolerance": -(10**400)}, r"tolerance is -100000.*; expected a finite number > 0"),
        ({"horizon": 10**400}, r"horizon is 10000.*; expected an integer >= 1"),
        ({"system": REACTOR}, r"(?s)system is .*; expected a qpmhe\.System"),
    ):
        with pytest.raises(QpmheError, match=words):
            qpmhe.MovingHorizonEstimator(**(PARTS | {"initial_state": [3.0, 0.0]} | options))
