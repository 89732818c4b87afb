"""Weights from records: what is found, what is refused, and a search that resumes."""

import contextlib
import functools
import json
import signal
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, QpmheError
from qpmhe.model.signals import Signal, Signals
from qpmhe.tuning import (
    TuningCheckpointError,
    TuningRecord,
    contest,
    judge,
    likelihood,
    load,
    score,
    search,
)
from qpmhe.tuning.structures import Correlated

tuning_module = sys.modules["qpmhe.tuning.tune"]

A = np.array([[0.5, 1.0], [0.0, 0.8]])


def first_of_two(x):
    return x[..., :1]


def line(x, u):
    return x @ A.T + np.array([0.0, 1.0]) * u


def make(k=0.8, worst=0.0):
    if k < worst:
        raise ValueError(f"k is {k}")
    return qpmhe.System(
        lambda x, u: k * x + u, first_of_two, n=2, p=1, m=2,
        f_jacobian=lambda x, u: np.broadcast_to(k * np.eye(2), (*x.shape, 2)),
    )


SYSTEM = qpmhe.System(line, first_of_two, n=2, p=1, m=1)


def simulated(seed=0, steps=600, truth=False, f=line, noise=(0.4, 0.3, 0.3), m=1):
    generator = np.random.default_rng(seed)
    u = generator.standard_normal((steps, m))
    w = generator.standard_normal((steps, 2)) @ np.diag(noise[:2])
    x = np.zeros((steps + 1, 2))
    for t in range(steps):
        x[t + 1] = f(x[t], u[t]) + w[t]
    y = x[:-1, :1] + noise[2] * generator.standard_normal((steps, 1))
    return (y, u, x) if truth else (y, u)


def tuned(records=None, system=SYSTEM, **options):
    given = {
        "prior": np.eye(2), "disturbance": np.eye(2), "noise": [[1.0]], "initial_state": [0, 0],
        "objective": "likelihood", "progress": False,
    }
    return qpmhe.tune(system, [simulated()] if records is None else records, **{**given, **options})


@pytest.mark.slow
def test_known_covariances_are_within_the_intervals_of_a_table():
    tuning = tuned([simulated(steps=2000)])
    for name, true in {"disturbance x1": 0.4, "disturbance x2": 0.3, "noise y1": 0.3}.items():
        low, high = tuning.intervals[name]
        assert low < true < high < 3.0 * true
    assert tuning.values["noise y1"] ** 2 == pytest.approx(tuning.noise[0, 0])
    found = [tuning.values[f"disturbance x{i}"] for i in (1, 2)]
    np.testing.assert_allclose(tuning.disturbance, np.diag(np.square(found)), rtol=1e-12)
    np.testing.assert_array_equal(tuning.prior, np.eye(2))
    assert tuning.unidentified == ()
    before, after = tuning.scores["negative log likelihood per sample"]
    assert after < before
    text = str(tuning)
    assert repr(tuning).startswith("Tuning(")
    assert "\n" not in repr(tuning)
    page = tuning._repr_html_()
    for name, value in tuning.values.items():
        assert f"{name}: " in repr(tuning)
        assert f"<td>{name}</td>" in page
        assert f"<td>{value:.4g}</td>" in page
    assert page.count("<table>") == page.count("</table>") == 2
    for part in ("95 % interval", "disturbance x2", "held-out blocks", "Chosen by the likelihood"):
        assert part in text
    left, right = tuning.plot()
    assert [label.get_text() for label in left.get_yticklabels()][-1] == "disturbance x1"
    assert right.get_xlabel() == "block"
    assert all(tick == round(tick) for tick in right.get_xticks())
    tuning.intervals["disturbance x1"] = (0.0, 3.0)  # drawn over many decades, with few labels
    assert len(tuning.plot()[0].get_xticks()) < 10


@pytest.mark.slow
def test_neither_start_nor_units_matter():
    y, u = simulated()
    unit = 1e6
    scaled = qpmhe.System(
        lambda x, u: line(x / unit, u) * unit, lambda x: first_of_two(x) / unit, n=2, p=1, m=1
    )
    usual = tuned([(y, u)]).values
    for s in (0.1, 10.0):
        found = tuned([(y, u)], disturbance=s * np.eye(2), noise=[[1 / s]]).values
        assert found == pytest.approx(usual, rel=1e-3)
    covariance = unit**2 * np.eye(2)
    other = tuned([(y, u)], scaled, prior=covariance, disturbance=covariance).values
    assert other == pytest.approx(
        {name: value * (unit if "dist" in name else 1.0) for name, value in usual.items()}, rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["van_der_pol", "cstr", "vehicle"])
def test_recovery(name):
    """A small sample of examples/studies/tuning_recovery.py."""
    system, _, cost, scenario = qpmhe.models.catalogue()[name]()
    inside = []
    for seed in range(100, 120):
        record = scenario.simulate(seed, 400)
        tuning = qpmhe.tune(
            system, [(record.measurements, record.inputs)],
            prior=np.linalg.inv(cost.prior) / 100.0,
            disturbance=4.0 * scenario.disturbance_covariance, noise=scenario.noise_covariance,
            initial_state=scenario.initial_state, objective="likelihood", held_out=0.0,
            progress=False,
        )
        true = {key: value * (0.5 if "dist" in key else 1.0) for key, value in tuning.start.items()}
        inside += [low <= true[key] <= high for key, (low, high) in tuning.intervals.items()]
    # Of 60 intervals or more at 95 %; those of one record are not independent.
    assert np.mean(inside) > 0.87


@pytest.mark.slow
def test_what_the_records_do_not_identify_is_named():
    y = simulated(f=lambda x, u: 0.9 * x, steps=400)[0]
    unseen = tuned([y], qpmhe.System(lambda x: 0.9 * x, first_of_two, n=2, p=1))
    assert any("disturbance x2: the records say nothing" in text for text in unseen.unidentified)
    assert unseen.intervals["disturbance x2"] == (0.0, np.inf)
    x = simulated(f=lambda x, u: 0.9 * x, noise=(0.3, 0.3, 0.3), steps=2000, truth=True)[2][:-1]
    y = x.sum(axis=1) + 0.3 * np.random.default_rng(1).standard_normal(len(x))
    alike = qpmhe.System(lambda x: 0.9 * x, lambda x: x[..., :1] + x[..., 1:], n=2, p=1)
    names = " ".join(tuned([y[:, None]], alike).unidentified)
    assert "disturbance x1" in names
    assert "disturbance x2" in names


@pytest.mark.slow
def test_structures():
    scalar = tuned(structure="scalar", disturbance=[[1.0, 0.5], [0.5, 1.0]])
    assert list(scalar.values) == ["disturbance level", "noise level"]
    assert scalar.disturbance[0, 1] / scalar.disturbance[0, 0] == pytest.approx(0.5)
    groups = tuned(structure={"disturbance": {"second": [1]}, "noise": "scalar"})
    assert groups.disturbance[0, 0] == 1.0 != groups.disturbance[1, 1]
    full = tuned(structure="full")
    assert np.linalg.eigvalsh(full.disturbance)[0] > 0.0
    assert full.cost_per_sample <= tuned().cost_per_sample + 1e-9
    drawn = [label.get_text() for label in full.plot()[0].get_yticklabels()]
    assert drawn == ["noise y1", "disturbance x2", "disturbance x1"]  # no correlation
    # A disturbance without variance stays without.
    second = tuned(disturbance=np.diag([0.0, 1.0]))
    assert list(second.values) == ["disturbance x2", "noise y1"]
    np.testing.assert_array_equal(second.disturbance[0], 0.0)
    second.cost()


@pytest.mark.slow
def test_whole_matrices_are_told_as_standard_deviations_and_correlations():
    """All states are measured: each of the true values is within its interval."""
    true = np.array([[0.16, 0.8 * 0.4 * 0.3, -0.04], [0.0, 0.09, 0.0], [0.0, 0.0, 0.25]])
    true = np.triu(true) + np.triu(true, 1).T
    generator, total = np.random.default_rng(11), 1500
    w = generator.standard_normal((total, 3)) @ np.linalg.cholesky(true).T
    x = np.zeros((total + 1, 3))
    for t in range(total):
        x[t + 1] = 0.9 * x[t] + w[t]
    y = x[:-1] + 0.1 * generator.standard_normal((total, 3))
    tuning = tuned(
        [y], qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=3, p=3), prior=np.eye(3),
        disturbance=np.eye(3), noise=0.1**2 * np.eye(3), initial_state=np.zeros(3),
        structure={"disturbance": "full"})
    assert list(tuning.values) == [
        "disturbance x1", "disturbance x2", "disturbance x3",
        "correlation of disturbance x1 and x2", "correlation of disturbance x1 and x3",
        "correlation of disturbance x2 and x3"]
    below = [1, 2, 2], [0, 0, 1]
    for covariance, told in (
        (tuning.disturbance, tuning.values.values()), (np.eye(3), tuning.start.values()),
    ):
        deviations = np.sqrt(covariance.diagonal())
        expected = [*deviations, *(covariance / np.outer(deviations, deviations))[below]]
        np.testing.assert_allclose(list(told), expected, rtol=1e-9, atol=1e-12)
    deviations = np.sqrt(true.diagonal())
    for one, (low, high) in zip(
        [*deviations, *(true / np.outer(deviations, deviations))[below]],
        tuning.intervals.values(), strict=True,
    ):
        assert low < one < high < low + 0.25
    for name, value in tuning.values.items():
        low, high = tuning.intervals[name]
        assert low < value < high
    assert tuning.unidentified == ()
    assert "Weights, as standard deviations and correlations" in str(tuning)


def test_interval_of_a_correlation_that_depends_on_several_numbers():
    """In another order of the states the same correlation is a number of its own: its profile."""
    y = np.random.default_rng(5).standard_normal((500, 3)) @ np.array(
        [[1.0, 0.6, 0.3], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    ends = []
    for order in ([0, 1, 2], [1, 2, 0]):
        tuning = tuned(
            [y[:, order]], qpmhe.System(lambda x: 0.0 * x, lambda x: x, n=3, p=3),
            prior=np.eye(3), disturbance=np.eye(3), noise=1e-4 * np.eye(3), held_out=0.0,
            initial_state=np.zeros(3), structure={"disturbance": "full"})
        names = [f"x{order.index(i) + 1}" for i in (1, 2)]
        ends.append(tuning.intervals["correlation of disturbance " + " and ".join(names)])
    np.testing.assert_allclose(ends[0], ends[1], atol=0.01)


def test_derivatives_of_correlations():
    generator = np.random.default_rng(0)
    root, slope = generator.standard_normal((2, 4, 4))
    start = root @ root.T
    part = Correlated("noise", start, "abcd")
    np.testing.assert_allclose(part.covariance(part.start), start, rtol=1e-12, atol=1e-12)
    theta = part.start + 0.3 * generator.standard_normal(10)
    moves = 1e-5 * np.eye(10)
    expected = [
        np.sum(slope * (part.covariance(theta + move) - part.covariance(theta - move))) / 2e-5
        for move in moves
    ]
    np.testing.assert_allclose(part.adjoint(theta, slope), expected, rtol=1e-6, atol=1e-7)
    wild = part.covariance(np.array([limit for _, limit in part.limits]))
    assert np.isfinite(wild).all()
    # A start that is almost singular keeps its correlations.
    start = np.array([[1.0, 1.0 - 1e-12], [1.0 - 1e-12, 1.0]])
    part = Correlated("noise", start, "ab")
    np.testing.assert_allclose(part.covariance(part.start), start, rtol=1e-14)


@pytest.mark.parametrize("rule", ["threshold", qpmhe.Gate(), qpmhe.HuberInnovation()])
def test_outliers_tune_little_where_a_threshold_or_the_observer_doubts_them(rule):
    """5 % of the measurements are off by 50 standard deviations."""
    (y, u), generator = simulated(3), np.random.default_rng(4)
    hit = generator.random(y.shape) < 0.05
    spoilt = y + hit * generator.choice([-1.0, 1.0], y.shape) * 50.0 * 0.3
    robust = {"threshold": 2.0} if rule == "threshold" else {
        "observer": functools.partial(qpmhe.ExtendedKalman, innovation=rule)
    }
    structure = {"noise": "scalar"}
    clean, plain = (
        tuned([(one, u)], structure=structure).values["noise level"] for one in (y, spoilt)
    )
    tuning = tuned([(spoilt, u)], structure=structure, **robust)
    assert tuning.values["noise level"] < 3.0 * clean < 0.5 * plain
    assert isinstance(tuning.cost(), qpmhe.RobustCost) == (rule == "threshold")


def test_innovations_that_are_not_white_or_outlying_are_told():
    (y, u), generator = simulated(5, 400), np.random.default_rng(6)
    plain = tuned([(y, u)], structure="scalar")
    assert not plain.notes
    low, high = plain.innovations.nis_limits
    assert low < plain.innovations.nis < high
    assert f"mean NIS is {plain.innovations.nis:.3g}" in " ".join(str(plain).split())
    hit = generator.random(y.shape) < 0.03
    (note,) = tuned([(y + 10.0 * hit, u)], structure="scalar").notes
    assert note.startswith("there are outliers, ")
    assert note.endswith("tune with threshold=1.5.")
    assert not tuned([(y + 10.0 * hit, u)], structure="scalar", threshold=1.5).notes
    other = simulated(5, 400, f=lambda x, u: line(x, u) + 1.0)[0]  # a bias that the model lacks
    notes = tuned([(other, u)], structure="scalar").notes
    assert any(one.startswith("the intervals are too narrow: the innovations of y1 are not white")
               for one in notes)


def test_weights_and_intervals_are_of_all_blocks_once_some_have_judged():
    record = simulated(7, 300)
    some, every = tuned([record], structure="scalar"), tuned(
        [record], structure="scalar", held_out=0.0)
    for name, value in every.values.items():
        assert some.values[name] == pytest.approx(value, rel=1e-3)
        assert some.intervals[name] == pytest.approx(every.intervals[name], rel=2e-2)
    assert some.cost_per_sample == pytest.approx(every.cost_per_sample, rel=1e-6)


@pytest.mark.slow
def test_parameters_of_a_model():
    record = simulated(1, 400, f=make(0.9).f, noise=(0.1, 0.1, 0.3), m=2)
    structure = {"disturbance": {"x1": [0]}, "noise": "scalar"}
    failing = functools.partial(make, worst=0.8)
    for system, start in ((make, 0.6), (failing, 0.85)):
        tuning = tuned([record], system, parameters={"k": start}, structure=structure)
        low, high = tuning.intervals["k"]
        assert low < 0.9 < high
        assert tuning.parameters["k"] == pytest.approx(0.9, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["prediction", "auto"])
def test_the_estimators_own_error_is_lowered(objective):
    y, u, x = simulated(steps=300, truth=True)
    x[:, 1] = np.nan  # a state without truth does not count
    y[50:55] = x[50:55, 0] = np.nan  # a gap of the record
    tuning = tuned([(y, u, x)], objective=objective, horizon=3, structure="scalar", held_out=0.0,
                   disturbance=0.01 * np.eye(2))
    assert "the estimator's" in tuning.judgement
    assert "error of x2" not in tuning.scores
    error = "error of x1" if objective == "auto" else "y1, 5 ahead"
    for name in ("negative log likelihood per sample", error):
        before, after = tuning.scores[name]
        assert after < before


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["prediction", "truth"])
def test_the_estimators_own_error_leaves_the_scale_to_the_likelihood(objective):
    """The initial error is larger than the prior says: smaller Q and R would make up for that."""
    record = simulated(2, 300, truth=objective == "truth")
    options = {"prior": 0.3 * np.eye(2), "initial_state": [8, -8], "horizon": 5, "max_qps": 1}
    tuning = tuned([record], objective=objective, **options)
    changes = [tuning.values[name] / tuning.likeliest[name] for name in tuning.values]
    assert np.prod(changes) == pytest.approx(1.0, rel=0.4)
    assert tuning.values["noise y1"] == pytest.approx(tuning.likeliest["noise y1"], rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_estimators_search_ends_without_a_gradient_that_changes_nothing(seed, monkeypatch):
    totals, found = [], []
    total = score.Score.total
    monkeypatch.setattr(score.Score, "total", lambda *given: (totals.append(1), total(*given))[1])
    for wolfe in (0.9, -np.inf):  # the second never ends early
        monkeypatch.setattr(search, "_WOLFE", wolfe)
        totals.clear()
        tuning = tuned(
            [simulated(seed, 200)], objective="prediction", horizon=3, max_qps=0,
            structure={"disturbance": "scalar", "noise": "scalar"})
        found.append((len(totals), tuning.noise, tuning.disturbance, tuning.judgement))
    assert found[0][0] < found[1][0]
    for mine, expected in zip(found[0][1:3], found[1][1:3], strict=True):
        np.testing.assert_array_equal(mine, expected)
    assert found[0][3] == found[1][3]


@pytest.mark.slow
def test_the_estimators_search_takes_a_part_first_and_all_where_that_matters(monkeypatch):
    lengths, found = [], []
    run = score.Score._of_record
    monkeypatch.setattr(score.Score, "_of_record", lambda self, system, weights, one: (
        lengths.append(len(one)), run(self, system, weights, one))[1])
    for part, matters in ((80, 0.01), (80, -np.inf), (10**6, 0.0)):
        monkeypatch.setattr(search, "_PART", part)
        monkeypatch.setattr(search, "_MATTERS", matters)
        lengths.clear()
        tuning = tuned(
            [simulated(steps=440)], objective="prediction", horizon=3, max_qps=0,
            structure="scalar")
        found.append((lengths.count(440), len(lengths), tuning.scores["y1, 5 ahead"][1] ** 2))
    (some, both, mine), (more, _, _), (all_, whole, best) = found
    assert both > some
    assert whole == all_ > 6
    # The start, the likeliest weights and up to four on the way.
    assert some <= 6 < more
    assert mine < 1.005 * best


@pytest.mark.slow
def test_the_estimators_search_takes_all_where_a_record_begins_with_a_gap(monkeypatch):
    y, u = simulated(steps=440)
    y[:90] = np.nan
    runs, found = [], []
    run = score.Score._of_record
    monkeypatch.setattr(score.Score, "_of_record", lambda *given: (
        runs.append(len(given[-1])), run(*given))[1])
    for part in (80, 10**6):
        monkeypatch.setattr(search, "_PART", part)
        runs.clear()
        tuning = tuned(
            [(y, u)], objective="prediction", horizon=3, max_qps=0, structure="scalar",
            held_out=0.0)
        found.append((runs.count(440), tuning.values))
    assert found[0] == found[1]


def test_a_first_part_that_rests_leads_the_likelihood_to_no_worse_minimum(monkeypatch):
    y, u = simulated(steps=800, noise=(0.05, 0.05, 0.3))
    u[:] = 0.0
    y[:210] *= 0.02
    found = []
    for short in (200, 10**6):
        monkeypatch.setattr(search, "_SHORT", short)
        found.append(tuned([(y, u)], held_out=0.0, starts=1).scores)
    (_, mine), (_, whole) = (one["negative log likelihood per sample"] for one in found)
    assert mine < whole + 1e-4


@pytest.mark.slow
def test_a_search_of_the_estimator_that_does_not_move_ends(monkeypatch):
    """In a record that begins with numbers without noise, its steps round to none."""
    monkeypatch.setattr(search, "_SHORT", 100)
    monkeypatch.setattr(search, "_PART", 150)
    A = np.array([[0.9, 0.2], [-0.2, 0.9]])
    rng, x, y = np.random.default_rng(0), np.zeros(2), np.zeros((810, 2))
    for t in range(170, 810):
        y[t] = x + 0.3 * rng.standard_normal(2)
        x = A @ x + 0.05 * rng.standard_normal(2)
    tuning = tuned(
        [y], qpmhe.System(lambda x: x @ A.T, lambda x: x, n=2, p=2), objective="prediction",
        horizon=3, max_qps=0, noise=0.1 * np.eye(2), disturbance=0.01 * np.eye(2), held_out=0.0,
        starts=1)
    assert tuning.values["noise y1"] > 0.1


def test_a_judge_runs_no_estimator_again(monkeypatch):
    runs = []
    run = score.Score._of_record
    monkeypatch.setattr(score.Score, "_of_record", lambda *given: (
        runs.append(1), run(*given))[1])
    tuning = tuned(objective="prediction", horizon=3, max_qps=0, structure="scalar")
    before = len(runs)
    weights = tuning._structure.weights
    for theta in (tuning._structure.start, tuning._judged_theta):
        tuning._score.errors(weights(theta))
    assert len(runs) == before
    tuning._score.errors(weights(tuning._judged_theta + 0.01))
    assert len(runs) == before + 1


def test_gradients_of_a_search_are_few(monkeypatch):
    gradients = []
    gradient = likelihood.Likelihood.gradient
    monkeypatch.setattr(likelihood.Likelihood, "gradient", lambda *given: (
        gradients.append(1), gradient(*given))[1])
    tuning = tuned(starts=1, held_out=0.0)
    assert len(gradients) < 60
    theta, one = tuning._likeliest, tuning._likelihood
    exact = np.array([
        one.gradient(theta + move)[1] - one.gradient(theta - move)[1] for move in 1e-4 * np.eye(3)
    ]) / 2e-4
    np.testing.assert_allclose(search.polish(one, theta)[1], exact, rtol=2e-3, atol=2e-3)
    for k, name in enumerate(tuning.values):  # ends of intervals are on the limit
        end = search.limit(one, theta, exact, k, 1.0)
        free = np.delete(np.arange(3), k)

        def least(part, k=k, end=end, free=free):
            at = theta.copy()
            at[k], at[free] = end, part
            value, slope = gradient(one, at)
            return value, slope[free]

        rise = minimize(least, theta[free], jac=True).fun - one.value(theta)
        assert np.sqrt(2.0 * rise) == pytest.approx(search.NORMAL, abs=0.04), name


def test_an_estimate_at_the_end_of_its_range_has_no_limit_beyond():
    """It divided by the distance to itself there."""
    structure = SimpleNamespace(limits=[(0.0, 2.0), (-9.0, 9.0)], seen=2)
    one = SimpleNamespace(structure=structure, value=lambda theta: 0.0)
    for k, sign, at in (0, 1.0, 2.0), (0, -1.0, 0.0), (1, 1.0, 9.0):
        theta = np.array([1.0, 1.0])
        theta[k] = at
        assert search.limit(one, theta, np.eye(2), k, sign) is None


@pytest.mark.parametrize("errors", [1.5, 3.0])
def test_a_gain_must_be_beyond_chance_and_scores_are_those_of_the_answer(errors, monkeypatch):
    """The second search's weights are less likely, and better by so many standard errors."""
    likely = tuned(structure="scalar", held_out=0.0)
    gains = 0.01 * (errors + np.sqrt(11.0) * np.resize([-1.0, 1.0], 12))
    means = iter([np.ones(12), 1.0 - gains, 1.0 - gains, np.full(12, 2.0)])
    monkeypatch.setattr(judge.Blocks, "means", lambda *_: next(means))
    monkeypatch.setattr(contest, "refine", lambda score, structure, theta, *_: theta + 0.7)
    tuning = tuned(structure="scalar", held_out=0.0, objective="prediction", max_qps=1)
    found, least = (
        one.scores["negative log likelihood per sample"][1] for one in (tuning, likely)
    )
    if errors < 2.0:
        assert tuning.values == tuning.likeliest
        assert "no gain beyond chance" in tuning.judgement
        assert found == pytest.approx(least, rel=1e-6)
        assert not tuning.notes
    else:
        assert tuning.values["noise level"] == pytest.approx(
            np.exp(0.7) * tuning.likeliest["noise level"])
        assert found > least + 0.1
        (note,) = tuning.notes
        assert note.startswith("disturbance level and noise level are outside of their intervals")


@pytest.mark.parametrize(("share", "truth", "stays"), [
    (1.03, False, False), (1.03, True, True), (1.2, False, True), (0.9, False, False),
])
def test_the_start_stays_where_it_is_better_by_what_matters(share, truth, stays):
    """Three blocks agree on the mean square with tuned weights, as a share of that at the start."""
    block = np.repeat(np.arange(3), 4)
    blocks = judge.Blocks([SimpleNamespace(block=block, held=np.ones(12, np.bool_))])
    squares = {0.0: np.ones(12), 1.0: share + 0.002 * (block - 1.0)}
    score = SimpleNamespace(truth=truth, samples=lambda theta: [squares[min(theta, 1.0)]])
    structure = SimpleNamespace(start=0.0, weights=lambda theta: theta)
    theta, text = judge.judge(blocks, score, structure, 1.0, 2.0)
    assert theta == (0.0 if stays else 1.0)
    assert text.startswith("as at the start" if stays else "by the likelihood")
    assert not stays or f"is {100.0 * (share - 1.0) / share:.2g} % smaller with these" in text


def test_what_was_found_makes_an_estimator_and_compares_horizons():
    y, u = simulated(steps=300)
    tuning = tuned([(y, u)], horizon=6)
    mhe = qpmhe.MovingHorizonEstimator(
        SYSTEM, tuning.observer(), tuning.cost(), horizon=tuning.weights.horizon,
        initial_state=[0, 0],
    )
    assert mhe.run(y, u).share(qpmhe.Status.IMPROVED) > 0.5
    rows = {(row.horizon, row.arrival): row.score for row in tuning.horizons((2, 6))}
    # On a linear system the Kalman filter's prior makes all horizons the same.
    assert rows[2, "observer"] == pytest.approx(rows[6, "observer"], rel=1e-6)
    assert rows[2, "constant"] != pytest.approx(rows[6, "constant"], rel=1e-6)


def test_observers_are_alike_on_a_linear_system_and_the_simplest_is_taken():
    tuning = tuned([simulated(steps=250)], horizon=3, observers="all", max_qps=1,
                   structure="scalar")
    rows = tuning.observers
    assert {(row.observer.partition("(")[0], row.max_qps) for row in rows} == {
        (name, qps) for name in ("ekf", "gated", "ukf", "steady") for qps in (0, 1)
    }
    scores = [row.score for row in rows]
    assert scores == sorted(scores)
    assert scores[-1] == pytest.approx(scores[0], rel=0.05)
    plain = {row.score for row in rows if row.observer in ("ekf", "ukf")}
    assert max(plain) == pytest.approx(min(plain), rel=1e-6)
    assert (tuning.weights.observer_name, tuning.weights.max_qps) == ("ekf", 0)
    text, page = str(tuning), tuning._repr_html_()
    assert "ekf *" in text
    assert "MHE, 1 QP on steady" in text
    assert page.count("<table>") == 3
    assert "<td>ekf *</td>" in page
    assert all(row.seconds > 0.0 for row in rows)


def cube(x):
    return x**3


def test_the_unscented_filter_wins_where_the_tangent_says_nothing(tmp_path):
    """The slope of x^3 is 0 about the mean: the extended filter does not see x from there."""
    generator, steps = np.random.default_rng(3), 400
    x = np.zeros((steps + 1, 1))
    for t in range(steps):
        x[t + 1] = 0.95 * x[t] + 0.3 * generator.standard_normal()
    y = cube(x[:-1]) + 0.1 * generator.standard_normal((steps, 1))
    system = qpmhe.System(lambda x: 0.95 * x, cube, n=1, p=1)
    given = {"prior": [[1.0]], "disturbance": [[0.09]], "noise": [[0.01]], "initial_state": [0.0]}
    found = tuned([(y, None, x)], system, **given, observers=["ekf", "ukf"], max_qps=0,
                  structure="scalar", ahead=1)
    best, other = found.observers
    assert (best.observer, other.observer) == ("ukf", "ekf")
    assert best.errors["y1"] < 0.9 * other.errors["y1"]
    weights = load(found.save(tmp_path / "weights.toml"))
    assert (weights.observer_name, weights.max_qps) == ("ukf", 0)
    with pytest.raises(OptionError, match=r"observer\(system=system\)"):
        weights.observer()
    with pytest.raises(ModelError, match="system is 'plant'"):
        weights.observer(system="plant")
    assert isinstance(found.observer(), qpmhe.UnscentedKalman)
    states = [
        qpmhe.MovingHorizonEstimator(
            system, observer, weights.cost(), horizon=3, initial_state=[0.0], max_qps=0,
        ).run(y).states for observer in (weights.observer(system=system), found.observer())
    ]
    np.testing.assert_array_equal(*states)


def test_an_observer_that_fails_is_last_and_says_why():
    """No constant gain observes the integrator that no output shows."""
    system = qpmhe.System(lambda x, u: x + 0.1 * u, first_of_two, n=2, p=1, m=1)
    tuning = tuned([simulated(steps=200)], system, observers=["steady", "ekf"], max_qps=0,
                   structure="scalar")
    assert [row.observer.partition("(")[0] for row in tuning.observers] == ["ekf", "steady"]
    assert "not detectable" in tuning.observers[-1].failure
    assert "steady fails: observer" in str(tuning)
    assert tuning.weights.observer_name == "ekf"
    with pytest.raises(ModelError, match=r"no observer can be tuned .*: steady: .*not detectable"):
        tuned([simulated(steps=200)], system, observers=["steady"], max_qps=0)


def test_one_function_with_other_arguments_is_searched_anew_and_a_failing_search_is_a_row(
    monkeypatch,
):
    known, real = [], contest.search_all

    def refined(score, likelihood, theta, kept, advance):
        known.append(kept.known("estimator")[2])
        kept.note("estimator", theta, 0.0, True)
        return theta

    def searched(likelihood, *rest):
        if likelihood.recipe[-1] is not None:
            raise ModelError("the search found no weights")
        return real(likelihood, *rest)

    monkeypatch.setattr(contest, "refine", refined)
    monkeypatch.setattr(contest, "search_all", searched)
    names = ["steady(at=[0, 0], u=[0])", "steady(at=[1, 0], u=[0])"]
    tuning = tuned([simulated(steps=200)], observers=[*names, "gated"], max_qps=0,
                   structure="scalar", objective="prediction")
    assert known == [False, False]
    assert [row.title for row in tuning.observers] == [*names, "gated"]
    assert tuning.observers[-1].failure == "the search found no weights"


def test_a_checkpoint_that_cannot_be_written_is_no_failure_of_an_observer(tmp_path):
    with pytest.raises(TuningCheckpointError, match=r"^cannot write"):
        tuned([simulated(steps=200)], observers=["ekf"], max_qps=0, structure="scalar",
              checkpoint=tmp_path / "missing" / "search.json")


def test_the_initial_state_is_the_records_or_the_systems_where_none_is_given():
    system, _, _, scenario = qpmhe.models.van_der_pol()
    record, given = scenario.simulate(0, 60), {
        "prior": np.eye(2), "disturbance": 0.01 * np.eye(2), "noise": [[1.0]], "held_out": 0.0,
        "structure": "scalar", "objective": "likelihood", "progress": False,
    }
    np.testing.assert_array_equal(record.initial_estimate, scenario.initial_estimate)
    alone = qpmhe.tune(system, [record], **given).values
    start = {"initial_state": scenario.initial_estimate}
    assert alone == qpmhe.tune(system, [(record.measurements,)], **start, **given).values
    other = qpmhe.tune(system, [record], initial_state=[3.0, 3.0], **given).values
    assert other != alone
    states = tuple(Signal(name, value=value) for name, value in (("a", 3.0), ("b", 3)))
    system = system.with_origin(signals=Signals(states))
    assert other == qpmhe.tune(system, [(record.measurements,)], **given).values
    assert alone == qpmhe.tune(system, [record], **given).values


def test_a_search_that_was_stopped_resumes(tmp_path, monkeypatch):
    path, real, calls = tmp_path / "search.json", search.search_likelihood, []

    def stopped(likelihood, begin, note, *known):
        calls.append(begin)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(likelihood, begin, note, *known)

    monkeypatch.setattr(search, "search_likelihood", stopped)
    with pytest.raises(KeyboardInterrupt):
        tuned(starts=3, checkpoint=path)
    assert json.loads(path.read_text())["searches"]["start 0"]["done"]
    with pytest.raises(TuningCheckpointError, match="another search"):
        tuned(starts=3, checkpoint=path, threshold=2.0)
    resumed = tuned(starts=3, checkpoint=path)
    assert len(calls) == 4  # two of three starts were left
    assert not path.exists()
    # Uninterrupted, and in two processes.
    assert resumed.values == tuned(starts=3).values
    assert tuned(starts=3, jobs=2).values == pytest.approx(resumed.values, rel=1e-6)


def test_an_interrupt_that_casadi_turns_into_another_error(monkeypatch):
    def interrupted(*_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise NotImplementedError("Wrong number or type of arguments")

    # A process that a shell started in the background ignores the signal.
    outside = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(contest, "search_all", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tuned()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, outside)


Y, U, X = simulated(steps=60, truth=True)
TWO = {"system": qpmhe.System(line, lambda x: x, n=2, p=2, m=1), "noise": np.eye(2),
       "records": [(np.hstack((Y, np.nan * Y)), U)]}
ROOT = qpmhe.System(lambda x, u: np.sqrt(x - 5.0), first_of_two, n=2, p=1, m=1,
                    f_jacobian=lambda x, u: np.eye(2), states=qpmhe.Box([0, 0], [99, 99]))


def of_a_gain(problem):
    return qpmhe.Luenberger([[0.1], [0.1]])


BAD = {
    "too short": (InvalidInputError, "too few for 3 parameters",
                  {"records": [(Y[:20], U[:20])], "held_out": 0.0}),
    "ten samples": (InvalidInputError, "the records have 10 samples, too few for held-out blocks",
                    {"records": [(Y[:10], U[:10])]}),
    "no samples": (InvalidInputError, "has no samples", {"records": [(Y[:0], U[:0])]}),
    "no measurements": (InvalidInputError, "all measurements", {"records": [(Y * np.nan, U)]}),
    "no truth": (InvalidInputError, "true states", {"objective": "truth"}),
    "dead sensor": (InvalidInputError, "never changes: .* 1,", {"records": [(0.0 * Y + 1.0, U)]}),
    "gap in the truth": (InvalidInputError, "state 1 .* row 1", {
        "records": [(Y, U, np.where(np.arange(61) == 1, np.nan, X.T).T)]}),
    "missing output": (InvalidInputError, "output 2 is missing", TWO),
    "dt": (InvalidInputError, "discrete", {"records": [TuningRecord(Y, U, dt=np.ones(60))]}),
    "no start": (InvalidInputError, "initial_state", {"initial_state": None}),
    "constant inputs": (InvalidInputError, "inputs are constant", {
        "records": [(Y, np.ones((60, 2)))], "system": make, "parameters": {"k": 0.5}}),
    "broken model": (ModelError, "not finite at the start", {"system": ROOT}),
    "no threshold": (OptionError, "threshold=3.0", {"structure": {"threshold": True}}),
    "observer of a gain": (OptionError, "raised TypeError", {"observer": qpmhe.Luenberger}),
    "unknown observer": (ModelError, "'eckf' is not known.*Did you mean ekf", {
        "observers": ["ukf", "eckf"]}),
    "no observers": (OptionError, "observers is empty", {"observers": []}),
    "one word": (OptionError, "observers is 'ekf'; expected 'all', or a list", {
        "observers": "ekf"}),
    "twice": (OptionError, "'ekf' more than once", {"observers": ["ekf", "ekf"]}),
    "two ways": (OptionError, "both observer and observers", {
        "observers": ["ekf"], "observer": qpmhe.UnscentedKalman}),
    "no covariance": (OptionError, "no covariance to weigh the prior, so it cannot be tuned", {
        "observers": [f"{__name__}:of_a_gain"]}),
    "endless QPs": (InvalidInputError, "max_qps is None", {"observers": ["ekf"], "max_qps": None}),
    "option": (QpmheError, "no option", {"objective": "prediction", "horizn": 3}),
    "option of all": (QpmheError, "^MovingHorizonEstimator has no option", {
        "observers": ["ekf"], "horizn": 3}),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_with_a_remedy(case):
    error, text, options = BAD[case]
    with pytest.raises(error, match=text), np.errstate(invalid="ignore"):
        tuned(**{"records": [(Y, U)], **options})
    if case == "missing output":  # and is no matter where its noise is not tuned
        assert tuned(**options, structure={"noise": {"first": [0]}}).noise[1, 1] == 1.0
