"""The motor's inertia is estimated as the gallery says."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="module")
def motor(gallery):
    return import_module("gallery.weak_excitation.motor")


@pytest.fixture(scope="module")
def errors(motor):
    """Median errors by hand, unseen and again, of an EKF and of those in the picture."""
    judge = import_module("gallery.problem").judge
    estimators = import_module("gallery.baselines").estimators
    (problem,) = motor.problems(Path(), True)
    ways, found = estimators(problem, problem.weights), {}
    for name in ("EKF", *motor.SHOWN):
        found[name] = [
            np.median(judge(problem, "by hand", name, ways[name], [
                one for one in problem.records if one.name == part
            ], False).errors)
            for part in ("unseen", "again")
        ]
    return found


def test_only_the_held_estimate_neither_drifts_nor_gets_stiff(motor, errors):
    for name in ("EKF", "MHE, 2 QPs"):
        assert errors[name][0] > 30.0, name
    assert errors[motor.STIFFER][1] > 30.0
    assert max(errors[motor.HELD]) < 12.0


def test_the_command_runs_quickly(gallery, motor, tmp_path, capsys):
    main = import_module("gallery.command").main
    given = ["--quick", "--out", str(tmp_path)]
    assert main("weak_excitation", "", motor.problems, motor.draw, arguments=given) == 0
    assert motor.HELD in capsys.readouterr().out
    assert (tmp_path / "weak_excitation.png").stat().st_size > 1000
