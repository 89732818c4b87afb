"""The gallery's harness: what is compared, how errors are counted, what is written."""

from importlib import import_module

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


def linear(parts, records, **options):
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    return parts["problem"].Problem(
        "linear", "Linear", system, records, qpmhe.tuning.Weights(**WEIGHTS),
        lambda x, real: np.abs(x[:, 0] - real[:, 0]), "m", 1.0, **options,
    )


def simulated(parts, noise=0.1, steps=40, tunes=0):
    """A record whose error is the noise's."""
    rng, states = np.random.default_rng(1), [np.array([1.0, -0.5])]
    for _ in range(steps - 1):
        states.append(A @ states[-1])
    truth = np.array(states)
    y = truth[:, :1] + noise * rng.standard_normal((steps, 1))
    return parts["problem"].Record("made", y, None, truth, [np.zeros(2), np.ones(2)], tunes)


def test_an_iterated_filter_of_a_linear_system_is_the_kalman_filter(parts):
    record = simulated(parts)
    record.measurements[7] = np.nan
    problem = linear(parts, [record])
    runs = [
        problem.estimator(np.ones(2), problem.weights, kind, max_qps=0).run(record.measurements)
        for kind in (parts["baselines"].IteratedKalman, qpmhe.ExtendedKalman)
    ]
    np.testing.assert_allclose(runs[0].filtered, runs[1].filtered, atol=1e-12)
    np.testing.assert_allclose(runs[0].states, runs[1].states, atol=1e-12)


def test_an_iterated_filter_solves_one_update_of_a_nonlinear_output(parts):
    """Its update is the minimum of the squares of prior and measurement."""
    system = qpmhe.System(lambda x: x, lambda x: np.exp(x), n=1, p=1)
    observer = parts["baselines"].IteratedKalman(
        prior=np.array([[1.0]]), disturbance=np.array([[1.0]]), noise=np.array([[0.01]])
    )
    z, y = np.array([0.0]), np.array([3.0])
    sample = qpmhe.Sample(
        system, np.zeros(0), np.eye(1), system.h_jacobian(z, np.zeros(0)), covariance=np.eye(1)
    )
    found, _ = observer.filter(z, y - system.h(z, np.zeros(0)), sample)
    slope = found - np.exp(found) * (y - np.exp(found)) / 0.01
    assert abs(slope) < 1e-4
    assert np.array_equal(observer.correct(z, np.zeros(1), sample)[0], np.zeros(1))


@pytest.mark.parametrize("lag", [0, 3])
def test_estimates_with_a_lag_are_compared_with_their_own_times(parts, lag):
    record = simulated(parts, noise=0.0)
    problem = linear(parts, [record])
    delay = {"delay": lag + 1} if lag else {}
    mhe = problem.estimator(record.truth[0], problem.weights, max_qps=1, **delay)
    found = parts["problem"].causal(mhe.run(record.measurements), mhe)
    until = len(found) - lag
    np.testing.assert_allclose(found[:until], record.truth[:until], atol=1e-9)
    assert np.isnan(found[until:]).all()


def test_errors_count_the_part_that_judges_and_lost_runs(parts):
    judge, record = parts["problem"].judge, simulated(parts, tunes=10)
    problem = linear(parts, [record])
    found = judge(
        problem, "by hand", "still", lambda start: Still(start), [record], compiled=False
    )
    offsets = [np.abs(start[0] - record.truth[:, 0]) for start in record.starts]
    np.testing.assert_allclose(found.errors, [np.sqrt(np.mean(e[10:] ** 2)) for e in offsets])
    np.testing.assert_allclose(found.whole, [np.sqrt(np.mean(e**2)) for e in offsets])
    assert found.lost == np.mean(found.errors > 1.0)


class Still:
    """An estimator that never moves."""

    def __init__(self, start):
        self.reset(start)

    def reset(self, start):
        self.start = start

    def run(self, y, u):
        filtered = np.repeat(self.start[None], len(y), axis=0)
        return type("Run", (), {"filtered": filtered, "times": np.zeros(len(y))})


def test_an_estimate_that_is_not_finite_is_lost(parts):
    record = simulated(parts)
    record.starts[0][:] = np.inf
    found = parts["problem"].judge(
        linear(parts, [record]), "by hand", "still", Still, [record], compiled=False
    )
    assert found.lost >= 0.5


def test_a_baseline_that_wins_is_called_one(parts):
    rows = pd.DataFrame({"estimator": ["EKF", "MHE"], "median": [1.0, 2.0], "worst": [3.0, 2.0]})
    words = parts["report"].verdict(linear(parts, []), rows, ["EKF"])
    assert "Lowest median error: EKF, 1.00 m (a baseline: it wins)." in words
    assert "Lowest worst error: MHE, 2.00 m (of the baselines EKF, 3.00)." in words


def test_a_problem_is_tuned_judged_and_written(parts, tmp_path, capsys):
    record = simulated(parts, steps=200, tunes=100)
    problem = linear(parts, [record], tuning={"objective": "likelihood"}, note="A note.")
    code = parts["command"].main(
        "linear", "Made.", lambda folder, quick: [problem],
        lambda problems, results: parts["report"].tracks(
            record.truth, {"EKF": results[0][0].middle}
        ).figure,
        arguments=["--quick", "--out", str(tmp_path)],
    )
    assert code == 0
    table = pd.read_csv(tmp_path / "linear.csv")
    assert set(table["weights"]) == {"by hand", "tuned"}
    names = {"EKF", "EKF, gated", "EKF, iterated", "UKF", "MHE, 1 QP", "MHE, converged"}
    assert names <= set(table["estimator"])
    # On a linear system they are one filter.
    mine = table[(table["weights"] == "by hand") & table["estimator"].isin(names - {"EKF, gated"})]
    np.testing.assert_allclose(mine["median"], mine["median"].iloc[0], rtol=1e-6)
    text = (tmp_path / "linear.md").read_text()
    assert "Lowest median error" in text
    assert text.rstrip().endswith("A note.")
    assert (tmp_path / "linear.png").read_bytes().startswith(b"\x89PNG")
    assert "Lowest median error" in capsys.readouterr().out


def test_without_data_a_problem_says_where_they_are(parts, tmp_path, capsys):
    missing = str(tmp_path / "none")
    for given in ([], ["--data", missing]):
        assert parts["command"].main("it", "Made.", None, None, "They are there.", given) == 0
        assert "They are there." in capsys.readouterr().out


def write(folder, ranges, wheels, points):
    lines = [f"range2 {t} {d} 0.01 {x} {y} 105 0" for t, d, x, y in ranges]
    lines += [f"odom2diff {t} {r} {left} 0 0.0785 1 1 1" for t, r, left in wheels]
    (folder / "input.txt").write_text("\n".join(lines) + "\n")
    truth = [f"point2 {t} {x} {y} 0 0 0 0" for t, x, y in points]
    (folder / "ground_truth.txt").write_text("\n".join(truth) + "\n")


def drive(count=120, dt=0.1):
    """A circle within five anchors, and wheels' speeds in columns of the data set's order."""
    anchors = np.array([[0, 0], [3, 0], [3, 2], [0, 2], [1.5, 2.5]])
    at = [np.array([1.0, 0.5, 0.2])]
    speed, turn = 0.4, 0.5
    for _ in range(count - 1):
        x, y, heading = at[-1]
        middle = heading + 0.5 * turn * dt
        at.append(np.array([
            x + speed * dt * np.cos(middle), y + speed * dt * np.sin(middle), heading + turn * dt
        ]))
    times = dt * (1.0 + np.arange(count))
    path = np.array(at)
    turns = anchors[np.arange(count) % 5]
    distances = np.hypot(*(path[:, :2] - turns).T)
    half = turn * 0.0785
    return (
        np.column_stack((times, distances, turns)),
        np.column_stack((times, np.full(count, speed - half), np.full(count, speed + half))),
        np.column_stack((times, path[:, :2])), path,
    )


def test_an_indoor_record_with_any_anchors_is_read_and_estimated(gallery, tmp_path):
    robot = import_module("gallery.indoor_uwb.robot")
    *files, path = drive()
    write(tmp_path, *files)
    y, u, truth = robot.read(tmp_path)
    np.testing.assert_allclose(truth, path[:, :2])
    np.testing.assert_allclose(u[:, 1], 0.5, rtol=1e-6)
    problem = robot.problems(tmp_path, quick=True)[0]
    low, high = problem.system.states.lower[:2], problem.system.states.upper[:2]
    np.testing.assert_allclose([low, high], [[-0.75, -0.625], [3.75, 3.125]])
    np.testing.assert_allclose(problem.records[0].starts[0][:2], [1.5, 1.25])
    way = robot.own(problem, problem.weights)[robot.ROBUST]
    found = way(problem.records[0].starts[0]).run(y, u).filtered
    assert problem.error(found, truth)[60:].max() < 0.02


@pytest.mark.parametrize("damage", ["short", "words", "order"])
def test_an_indoor_record_that_is_none_is_refused(gallery, tmp_path, capsys, damage):
    robot, command = (import_module(f"gallery.{one}") for one in ("indoor_uwb.robot", "command"))
    ranges, wheels, points, _ = drive(120 if damage == "order" else 60)
    write(tmp_path, ranges[::-1] if damage == "order" else ranges, wheels, points)
    if damage == "words":
        (tmp_path / "input.txt").write_text("range2 one two\n")
    assert command.main(
        "indoor_uwb", "It.", robot.problems, None, robot.SOURCE, ["--data", str(tmp_path)]
    ) == 2
    assert str(tmp_path) in capsys.readouterr().err
