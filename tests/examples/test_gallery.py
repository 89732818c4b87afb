"""The gallery's harness, the motor, the reactors and the robot indoors."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import qpmhe

pd = pytest.importorskip("pandas")

A = np.array([[1.0, 0.1], [0.0, 0.9]])
WEIGHTS = {"prior": np.eye(2), "disturbance": 0.01 * np.eye(2), "noise": np.array([[0.1]])}


@pytest.fixture(scope="module")
def parts(gallery):
    names = ("problem", "baselines", "report", "command")
    return {name: import_module(f"gallery.{name}") for name in names}


def linear(parts, noise=0.1, steps=40, tunes=0, **options):
    """A problem with one record, whose error is the noise's."""
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    rng, states = np.random.default_rng(1), [np.array([1.0, -0.5])]
    for _ in range(steps - 1):
        states.append(A @ states[-1])
    truth = np.array(states)
    y = truth[:, :1] + noise * rng.standard_normal((steps, 1))
    starts = [np.zeros(2), np.ones(2)]
    return parts["problem"].Problem(
        "linear", "Linear", system,
        [parts["problem"].Record("made", y, None, truth, starts, tunes)],
        qpmhe.tuning.Weights(**WEIGHTS), lambda x, real: np.abs(x[:, 0] - real[:, 0]), "m", 1.0,
        **options,
    )


def test_errors_are_those_of_the_samples_own_times_and_lost_runs_count(parts):
    problem = linear(parts, noise=0.0, tunes=10)
    (record,) = problem.records
    mhe = problem.estimator(record.truth[0], problem.weights, max_qps=1)
    np.testing.assert_allclose(mhe.run(record.measurements).filtered, record.truth, atol=1e-9)
    record.starts.append(np.full(2, np.inf))
    judged = parts["problem"].judge(problem, "by hand", "still", Still, [record], compiled=False)
    offsets = [np.abs(start[0] - record.truth[:, 0]) for start in record.starts]
    np.testing.assert_allclose(judged.errors, [np.sqrt(np.mean(e[10:] ** 2)) for e in offsets])
    np.testing.assert_allclose(judged.whole, [np.sqrt(np.mean(e**2)) for e in offsets])
    assert judged.lost == np.mean(judged.errors > 1.0) >= 1 / 3


class Still:
    """An estimator that never moves."""

    def __init__(self, start):
        self.reset(start)

    def reset(self, start):
        self.start = start

    def run(self, y, u):
        filtered = np.repeat(self.start[None], len(y), axis=0)
        return type("Run", (), {"filtered": filtered, "times": np.zeros(len(y))})


@pytest.mark.slow
def test_a_problem_is_tuned_judged_and_written(parts, tmp_path, capsys):
    problem = linear(parts, steps=200, tunes=100, tuning={"objective": "likelihood"}, note="Note.")
    truth, main = problem.records[0].truth, parts["command"].main
    assert main(
        "linear", "Made.", lambda folder, quick: [problem],
        lambda _, results: parts["report"].tracks(truth, {"EKF": results[0][0].middle}).figure,
        arguments=["--quick", "--out", str(tmp_path)],
    ) == 0
    table = pd.read_csv(tmp_path / "linear.csv")
    assert set(table["weights"]) == {"by hand", "tuned"}
    # On a linear system they are one filter.
    names = {"EKF", "EKF, iterated", "UKF", "MHE, 1 QP", "MHE, converged"}
    assert names | {"EKF, gated"} <= set(table["estimator"])
    mine = table[(table["weights"] == "by hand") & table["estimator"].isin(names)]
    np.testing.assert_allclose(mine["median"], mine["median"].iloc[0], rtol=1e-6)
    assert (tmp_path / "linear.md").read_text().rstrip().endswith("Note.")
    assert (tmp_path / "linear.png").read_bytes().startswith(b"\x89PNG")
    assert "Lowest median error" in capsys.readouterr().out
    rows = pd.DataFrame({"estimator": ["EKF", "MHE"], "median": [1.0, 2.0], "worst": [3.0, 2.0]})
    words = parts["report"].verdict(problem, rows, ["EKF"])
    assert "Lowest median error: EKF, 1.00 m (a baseline: it wins)." in words
    assert main("it", "Made.", None, None, "They are there.", ["--data", str(tmp_path / "no")]) == 0
    assert "They are there." in capsys.readouterr().out


@pytest.mark.slow
def test_only_the_held_estimate_of_the_motors_inertia_neither_drifts_nor_gets_stiff(parts):
    motor = import_module("gallery.weak_excitation.motor")
    (problem,) = motor.problems(Path(), True)
    ways, errors = parts["baselines"].estimators(problem, problem.weights), {}
    for name in ("EKF", *motor.SHOWN):
        errors[name] = [
            np.median(parts["problem"].judge(problem, "by hand", name, ways[name], [
                one for one in problem.records if one.name == part
            ], False).errors)
            for part in ("unseen", "again")
        ]
    for name in ("EKF", "MHE, 2 QPs"):
        assert errors[name][0] > 30.0, name
    assert errors[motor.STIFFER][1] > 30.0
    assert max(errors[motor.HELD]) < 12.0


@pytest.mark.slow
@pytest.mark.parametrize(("which", "most"), [(0, 0.04), (1, 0.005)])
def test_projected_filters_and_mhe_of_the_reactors_settle_on_the_truth(parts, which, most):
    reactors = import_module("gallery.reactors.reactors")
    problem = reactors.problem(reactors.REACTORS[which], 4)
    ways = parts["baselines"].estimators(problem, problem.weights)

    def judged(name):
        return parts["problem"].judge(
            problem, "by hand", name, ways[name], problem.records, False)

    for name in ("EKF, projected", "MHE, 1 QP", "MHE, 5 QPs", "MHE, UKF, 2 QPs"):
        found = judged(name)
        assert np.median(found.errors) < most
        assert found.outside == found.lost == 0.0
    if which == 1:
        plain = judged("EKF")
        assert np.median(plain.errors) > 0.1
        assert plain.outside > 0.5
    alone, two = (
        np.median(judged(name).errors)
        for name in ("gain 0.01, projected", "MHE, gain 0.01, 2 QPs")
    )
    assert two < alone / 1.5


def test_a_robot_indoors_is_read_and_estimated_or_refused(parts, tmp_path, capsys):
    """A circle within five anchors, and wheels' speeds in columns of the data set's order."""
    robot = import_module("gallery.indoor_uwb.robot")
    count, dt, speed, turn = 120, 0.1, 0.4, 0.5
    anchors = np.array([[0, 0], [3, 0], [3, 2], [0, 2], [1.5, 2.5]])
    headings = 0.2 + turn * dt * (np.arange(count - 1) + 0.5)
    moves = speed * dt * np.stack((np.cos(headings), np.sin(headings)), axis=1)
    path = np.array([1.0, 0.5]) + np.vstack((np.zeros(2), np.cumsum(moves, axis=0)))
    times, turns, half = dt * (1.0 + np.arange(count)), anchors[np.arange(count) % 5], turn * 0.0785
    distances = np.hypot(*(path - turns).T)
    lines = [
        *(f"range2 {t} {d} 0.01 {x} {y} 105 0"
          for t, d, (x, y) in zip(times, distances, turns, strict=True)),
        *(f"odom2diff {t} {speed - half} {speed + half} 0 0.0785 1 1 1" for t in times),
    ]
    truth = [f"point2 {t} {x} {y} 0 0 0 0" for t, (x, y) in zip(times, path, strict=True)]
    (tmp_path / "input.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "ground_truth.txt").write_text("\n".join(truth) + "\n")
    y, u, found = robot.read(tmp_path)
    np.testing.assert_allclose(found, path)
    np.testing.assert_allclose(u[:, 1], 0.5, rtol=1e-6)
    problem = robot.problems(tmp_path, quick=True)[0]
    low, high = problem.system.states.lower[:2], problem.system.states.upper[:2]
    np.testing.assert_allclose([low, high], [[-0.75, -0.625], [3.75, 3.125]])
    way = robot.own(problem, problem.weights)[robot.ROBUST]
    filtered = way(problem.records[0].starts[0]).run(y, u).filtered
    assert problem.error(filtered, path)[60:].max() < 0.02
    for damaged in (["range2 one two"], lines[count - 1 :: -1] + lines[count:]):
        (tmp_path / "input.txt").write_text("\n".join(damaged) + "\n")
        given = ["--data", str(tmp_path)]
        assert parts["command"].main("it", "It.", robot.problems, None, "X", given) == 2
        assert str(tmp_path) in capsys.readouterr().err
