"""Weights from records: what is found, what is refused, and a search that resumes."""

import contextlib
import functools
import json
import signal
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, QpmheError, ShapeError
from qpmhe.tuning import TuningCheckpointError, TuningRecord, search

tuning_module = sys.modules["qpmhe.tuning.tune"]

A = np.array([[0.5, 1.0], [0.0, 0.8]])


def first_of_two(x):
    return x[..., :1]


def line(x, u):
    return x @ A.T + np.array([0.0, 1.0]) * u


def wrong_below(x, u, k):
    return k * x + u


def make(k=0.8, worst=None):
    if worst is not None and k < worst:
        raise ValueError(f"k is {k}")
    return qpmhe.System(
        functools.partial(wrong_below, k=k), first_of_two, n=2, p=1, m=2,
        f_jacobian=lambda x, u: np.broadcast_to(k * np.eye(2), (*x.shape, 2)),
    )


SYSTEM = qpmhe.System(line, first_of_two, n=2, p=1, m=1)


def simulated(seed=0, steps=600, truth=False):
    generator = np.random.default_rng(seed)
    u = generator.standard_normal((steps, 1))
    w = generator.standard_normal((steps, 2)) @ np.diag([0.4, 0.3])
    x = np.zeros((steps + 1, 2))
    for t in range(steps):
        x[t + 1] = line(x[t], u[t]) + w[t]
    y = x[:-1, :1] + 0.3 * generator.standard_normal((steps, 1))
    return (y, u, x) if truth else (y, u)


def tuned(records=None, system=SYSTEM, **options):
    given = {
        "prior": np.eye(2), "disturbance": np.eye(2), "noise": [[1.0]], "initial_state": [0, 0],
        "objective": "likelihood", "progress": False,
    }
    return qpmhe.tune(system, [simulated()] if records is None else records, **{**given, **options})


def test_known_covariances_are_within_the_intervals():
    tuning = tuned([simulated(steps=3000)])
    for name, true in {"disturbance x1": 0.4, "disturbance x2": 0.3, "noise y1": 0.3}.items():
        low, high = tuning.intervals[name]
        assert low < true < high < 3.0 * true
    assert tuning.values["noise y1"] ** 2 == pytest.approx(tuning.noise[0, 0])
    np.testing.assert_allclose(
        np.sqrt(tuning.disturbance.diagonal()),
        [tuning.values[f"disturbance x{i}"] for i in (1, 2)],
    )
    assert tuning.disturbance[0, 1] == 0.0
    np.testing.assert_array_equal(tuning.prior, np.eye(2))
    assert tuning.unidentified == ()
    before, after = tuning.scores["negative log likelihood per sample"]
    assert after < before


def test_the_start_does_not_matter():
    found = [tuned(disturbance=s * np.eye(2), noise=[[1 / s]]).values for s in (0.1, 10.0)]
    for name, value in found[0].items():
        assert found[1][name] == pytest.approx(value, rel=1e-3)


def test_units_do_not_matter():
    y, u = simulated()
    unit = 1e6
    scaled = qpmhe.System(
        lambda x, u: line(x / unit, u) * unit, lambda x: first_of_two(x) / unit, n=2, p=1, m=1
    )
    one = tuned([(y, u)])
    other = tuned(
        [(y, u)], scaled, prior=unit**2 * np.eye(2), disturbance=unit**2 * np.eye(2)
    )
    assert other.values["disturbance x2"] == pytest.approx(
        unit * one.values["disturbance x2"], rel=1e-3
    )
    assert len(one.unidentified) == len(other.unidentified)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["van_der_pol", "cstr", "vehicle"])
def test_recovery(name):
    """A small sample of examples/studies/tuning_recovery.py."""
    system, _, cost, scenario = qpmhe.models.catalogue()[name]()
    inside = []
    for seed in range(100, 125):
        record = scenario.simulate(seed, 600)
        tuning = qpmhe.tune(
            system, [(record.measurements, record.inputs)],
            prior=np.linalg.inv(cost.prior) / 100.0,
            disturbance=4.0 * scenario.disturbance_covariance, noise=scenario.noise_covariance,
            initial_state=scenario.initial_state, objective="likelihood", held_out=0.0,
            progress=False,
        )
        true = {key: value * (0.5 if "dist" in key else 1.0) for key, value in tuning.start.items()}
        inside += [low <= true[key] <= high for key, (low, high) in tuning.intervals.items()]
    # Of 75 intervals or more at 95 %; those of one record are not independent.
    assert np.mean(inside) > 0.87


def test_what_is_not_seen_is_named():
    system = qpmhe.System(lambda x: 0.9 * x, first_of_two, n=2, p=1)
    y = np.random.default_rng(0).standard_normal((400, 1))
    tuning = tuned([y], system)
    assert any("disturbance x2: the records say nothing" in text for text in tuning.unidentified)
    assert tuning.intervals["disturbance x2"] == (0.0, np.inf)


def test_two_that_act_alike_are_named_together():
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x[..., :1] + x[..., 1:], n=2, p=1
    )
    generator = np.random.default_rng(0)
    x, ys = np.zeros(2), []
    for _ in range(2000):
        ys.append([x.sum() + 0.3 * generator.standard_normal()])
        x = 0.9 * x + 0.3 * generator.standard_normal(2)
    tuning = tuned([np.array(ys)], system)
    names = " ".join(tuning.unidentified)
    assert "disturbance x1" in names
    assert "disturbance x2" in names


def test_structures():
    scalar = tuned(structure="scalar", disturbance=[[1.0, 0.5], [0.5, 1.0]])
    assert list(scalar.values) == ["disturbance level", "noise level"]
    assert scalar.disturbance[0, 1] / scalar.disturbance[0, 0] == pytest.approx(0.5)
    groups = tuned(structure={"disturbance": {"second": [1]}, "noise": "scalar"})
    assert groups.disturbance[0, 0] == 1.0
    assert groups.disturbance[1, 1] != 1.0
    full = tuned(structure="full")
    assert np.linalg.eigvalsh(full.disturbance)[0] > 0.0
    assert full.cost_per_sample <= tuned().cost_per_sample + 1e-9


def test_the_prior_needs_several_records():
    generator = np.random.default_rng(0)
    records = []
    for k in range(30):
        y, u = simulated(k, 40)
        records.append(TuningRecord(y, u, initial_state=2.0 * generator.standard_normal(2)))
    tuning = tuned(records, structure={"prior": "scalar"}, held_out=0.0, initial_state=None)
    low, high = tuning.intervals["prior level"]
    assert low < 2.0 < high < 4.0


def test_a_disturbance_without_variance_stays_without():
    tuning = tuned(disturbance=np.diag([0.0, 1.0]))
    assert list(tuning.values) == ["disturbance x2", "noise y1"]
    np.testing.assert_array_equal(tuning.disturbance[0], 0.0)
    tuning.cost()


def test_outliers_do_not_count_with_a_threshold():
    y, u = simulated(steps=1500)
    y[::50] += 20.0
    plain = tuned([(y, u)]).values["noise y1"]
    robust = tuned([(y, u)], threshold=2.0)
    assert plain > 2.0
    assert robust.values["noise y1"] == pytest.approx(0.3, rel=0.25)
    assert isinstance(robust.cost(), qpmhe.RobustCost)


@pytest.mark.parametrize("k", [0.5, 0.9])
def test_parameters_of_a_model(k):
    system = make(k)
    generator = np.random.default_rng(0)
    u = generator.standard_normal((400, 2))
    x, ys = np.zeros(2), []
    for t in range(400):
        ys.append([x[0] + 0.3 * generator.standard_normal()])
        x = system.f(x, u[t]) + 0.1 * generator.standard_normal(2)
    structure = {"disturbance": {"x1": [0]}, "noise": "scalar"}
    tuning = tuned([(np.array(ys), u)], make, parameters={"k": 0.7}, structure=structure)
    low, high = tuning.intervals["k"]
    assert low < k < high
    assert tuning.parameters["k"] == pytest.approx(k, abs=0.05)
    failing = tuned(
        [(np.array(ys), u)], functools.partial(make, worst=k - 0.1), parameters={"k": 0.9},
        structure=structure,
    )
    assert failing.parameters["k"] == pytest.approx(tuning.parameters["k"], abs=1e-3)


def test_the_estimators_own_error():
    record = simulated(steps=400, truth=True)
    found = {
        objective: tuned(
            [record], objective=objective, horizon=4, structure="scalar", held_out=0.0
        )
        for objective in ("prediction", "truth")
    }
    for tuning in found.values():
        before, after = tuning.scores["negative log likelihood per sample"]
        assert after < before
        assert "the estimator's" in tuning.judgement
    assert "error of x2" in found["truth"].scores
    assert "y1, 5 ahead" in found["prediction"].scores
    before, after = found["truth"].scores["error of x1"]
    assert after < before


def test_a_state_without_truth_does_not_count():
    y, u, x = simulated(steps=300, truth=True)
    x[:, 1] = np.nan
    y[50:55] = x[50:55, 0] = np.nan  # a gap of the record
    tuning = tuned([(y, u, x)], objective="auto", horizon=3, structure="scalar")
    assert "error of x1" in tuning.scores
    assert "error of x2" not in tuning.scores


def test_what_was_found_makes_an_estimator():
    y, u = simulated(steps=300)
    tuning = tuned([(y, u)], horizon=6)
    mhe = qpmhe.MovingHorizonEstimator(
        SYSTEM, tuning.observer(), tuning.cost(), horizon=tuning.weights.horizon,
        initial_state=[0, 0],
    )
    assert mhe.run(y, u).share(qpmhe.Status.IMPROVED) > 0.5
    rows = tuning.horizons((2, 6))
    assert [(row.horizon, row.arrival) for row in rows] == [
        (2, "observer"), (2, "constant"), (6, "observer"), (6, "constant")
    ]
    # On a linear system the Kalman filter's prior makes all horizons the same.
    assert rows[0].score == pytest.approx(rows[2].score, rel=1e-6)
    assert rows[1].score != pytest.approx(rows[3].score, rel=1e-6)


def test_several_starts_and_processes():
    alone, together = (tuned(starts=2, seed=3, jobs=jobs) for jobs in (1, 2))
    assert together.values == pytest.approx(alone.values, rel=1e-6)


def test_a_search_that_was_stopped_resumes(tmp_path, monkeypatch):
    path, real, calls = tmp_path / "search.json", search.search_likelihood, []

    def stopped(likelihood, begin, note):
        calls.append(begin)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(likelihood, begin, note)

    monkeypatch.setattr(search, "search_likelihood", stopped)
    with pytest.raises(KeyboardInterrupt):
        tuned(starts=3, checkpoint=path)
    assert json.loads(path.read_text())["searches"]["start 0"]["done"]
    with pytest.raises(TuningCheckpointError, match="another search"):
        tuned(starts=3, checkpoint=path, threshold=2.0)
    resumed = tuned(starts=3, checkpoint=path)
    assert len(calls) == 4  # two of three starts were left
    assert not path.exists()
    assert resumed.values == tuned(starts=3).values
    path.write_text("{")
    with pytest.raises(TuningCheckpointError, match="remove it"):
        tuned(checkpoint=path)


def test_an_interrupt_that_casadi_turns_into_another_error(monkeypatch):
    def interrupted(*_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise NotImplementedError("Wrong number or type of arguments")

    # A process that a shell started in the background ignores the signal.
    outside = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(tuning_module, "search_all", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tuned()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, outside)


def test_it_prints_a_table_and_draws():
    tuning = tuned([simulated(steps=300)])
    text = str(tuning)
    for part in ("95 % interval", "disturbance x2", "held-out blocks", "Chosen by the likelihood"):
        assert part in text
    left, right = tuning.plot()
    assert [label.get_text() for label in left.get_yticklabels()][-1] == "disturbance x1"
    assert right.get_xlabel() == "block"


def broken(x, u):
    raise ValueError("no")


Y, U, X = simulated(steps=60, truth=True)
MISSING = X.copy()
MISSING[7, 1] = np.nan
BAD = {
    "too short": (InvalidInputError, "too few for 3 parameters", {"records": [(Y[:20], U[:20])],
                                                                 "held_out": 0.0}),
    "no blocks": (InvalidInputError, "held_out=0", {"records": [(Y[:20], U[:20])]}),
    "no measurements": (InvalidInputError, "all measurements", {"records": [(Y * np.nan, U)]}),
    "no records": (InvalidInputError, "expected a list", {"records": []}),
    "no inputs": (InvalidInputError, "has no inputs", {"records": [(Y,)]}),
    "inputs with gaps": (InvalidInputError, "Hold the last", {"records": [(Y, U * np.nan)]}),
    "gaps in the truth": (InvalidInputError, "state 2 .* row 7", {"records": [(Y, U, MISSING)]}),
    "shape of the truth": (ShapeError, "states of", {"records": [(Y, U, X[:5])]}),
    "no truth": (InvalidInputError, "true states", {"objective": "truth"}),
    "constant inputs": (InvalidInputError, "inputs are constant", {
        "records": [(Y, np.ones((60, 2)))], "system": make, "parameters": {"k": 0.5}}),
    "parameter at zero": (InvalidInputError, "typical value", {"parameters": {"k": 0.0},
                                                               "system": make}),
    "broken maker": (ModelError, "raised TypeError", {"parameters": {"q": 1.0}, "system": make}),
    "no system": (ModelError, "expected a qpmhe.System", {"system": 3}),
    "no start": (InvalidInputError, "initial_state", {"initial_state": None}),
    "structure": (OptionError, "structure is", {"structure": "diag"}),
    "structure's key": (OptionError, "keys among", {"structure": {"noises": "full"}}),
    "group": (OptionError, "group 'a'", {"structure": {"noise": {"a": [3]}}}),
    "two groups": (OptionError, "group 'b'", {"structure": {"disturbance": {"a": [0], "b": [0]}}}),
    "threshold": (OptionError, "standard deviations", {"threshold": -1.0}),
    "no threshold": (OptionError, "threshold=3.0", {"structure": {"threshold": True}}),
    "share of letters": (OptionError, "held_out is 'a'", {"held_out": "a"}),
    "no samples": (InvalidInputError, "no samples", {"records": [(Y[:0], U[:0])]}),
    "dead sensor": (InvalidInputError, "never changes: .* 1,", {"records": [(0.0 * Y + 1.0, U)]}),
    "names in a list": (OptionError, "names is .* a dict", {"names": ["a", "b"]}),
    "parameters in a list": (OptionError, "parameters is .* a dict", {"parameters": ["k"]}),
    "checkpoint": (InvalidInputError, "checkpoint is 3", {"checkpoint": 3}),
    "no observer": (OptionError, "observer is 3", {"observer": 3}),
    "observer of a gain": (OptionError, "raised TypeError", {"observer": qpmhe.Luenberger}),
    "maker of no observer": (OptionError, "returned {}", {"observer": lambda **_: {}}),
    "threshold of letters": (OptionError, "threshold is 'a'", {"threshold": "a"}),
    "discount of letters": (OptionError, "discount is 'a'", {"discount": "a"}),
    "held out": (OptionError, "held_out", {"held_out": 0.9}),
    "covariance": (QpmheError, "noise covariance", {"noise": [[-1.0]]}),
    "names": (OptionError, "names of states", {"names": {"states": ["a"]}}),
    "dt": (InvalidInputError, "discrete", {"records": [TuningRecord(Y, U, dt=np.ones(60))]}),
    "option": (QpmheError, "no option", {"objective": "prediction", "horizn": 3}),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_with_a_remedy(case):
    error, text, options = BAD[case]
    with pytest.raises(error, match=text):
        tuned(**{"records": [(Y, U)], **options})


def test_a_model_that_fails_at_the_start_is_named():
    system = qpmhe.System(
        lambda x: np.sqrt(x - 5.0), first_of_two, n=2, p=1,
        f_jacobian=lambda x: np.eye(2), states=qpmhe.Box([0.0, 0.0], [100.0, 100.0]),
    )
    with pytest.raises(ModelError, match="not finite at the start"):
        tuned([np.linspace(0.9, 1.1, 60)[:, None]], system, initial_state=[1.0, 1.0])


def test_an_output_that_is_never_there():
    y, u = simulated(steps=100)
    system = qpmhe.System(line, lambda x: x, n=2, p=2, m=1)
    both = np.hstack((y, np.full_like(y, np.nan)))
    with pytest.raises(InvalidInputError, match="output 2 is missing"):
        tuned([(both, u)], system, noise=np.eye(2))
    found = tuned(
        [(both, u)], system, noise=np.eye(2), structure={"noise": {"first": [0]}}
    )
    assert found.noise[1, 1] == 1.0


@pytest.mark.parametrize("rule", [qpmhe.Gate(), qpmhe.HuberInnovation()])
def test_innovations_that_the_observer_doubts_tune_little(rule):
    """5 % of the measurements are off by 30 standard deviations."""
    (Y, U), generator = simulated(3)[:2], np.random.default_rng(4)
    hit = generator.random(Y.shape) < 0.05
    spoilt = Y + hit * generator.choice([-1.0, 1.0], Y.shape) * 30.0 * 0.5
    found = []
    for innovation, y in ((None, Y), (None, spoilt), (rule, spoilt)):
        kind = functools.partial(qpmhe.ExtendedKalman, innovation=innovation)
        tuning = tuned([(y, U)], horizon=5, observer=kind, structure={"noise": "scalar"})
        found.append(float(np.sqrt(tuning.noise[0, 0])))
    clean, plain, judged = found
    assert plain > 5.0 * clean
    assert judged < 3.0 * clean
    assert judged < 0.4 * plain
