"""A diagnosis names the fault that was planted, and none in a healthy run."""

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import qpmhe
from qpmhe.cli.app import app
from qpmhe.errors import InvalidInputError, OptionError, ShapeError
from qpmhe.estimation.observability import prior_shares
from qpmhe.tuning import observability
from qpmhe.tuning.bank import FilterBank, Hypothesis

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "studies"))

import planted_faults as planted

MODELS = list(qpmhe.models.catalogue())


def kinds(diagnosis):
    return [one.kind for one in diagnosis.findings]


@pytest.mark.parametrize("title", planted.FAULTS)
def test_planted_fault_is_named_first(title):
    kind, plant, models = planted.FAULTS[title]
    found = qpmhe.diagnose(plant(models[0], 1).run())
    assert kinds(found)[:1] == [kind], str(found)
    assert str(found).splitlines()[1].startswith("1. ")
    assert found.findings[0].remedy


@pytest.mark.slow
@pytest.mark.parametrize(
    ("title", "model"),
    [(title, model) for title, (_, _, models) in planted.FAULTS.items() for model in models],
)
def test_planted_fault_is_named_first_in_most_records(title, model):
    kind, plant, _ = planted.FAULTS[title]
    assert planted.first_kinds(plant, model, 5)[kind] >= 4


@pytest.mark.parametrize("model", MODELS)
def test_healthy_run_has_no_finding(model):
    case = planted.healthy(model, 2)
    found = qpmhe.diagnose(case.run(), labels=case.labels)
    assert found.is_healthy, str(found)
    assert str(found).startswith("No fault was found")
    low, high = found.nis_mean_limits
    assert 0.9 * low < found.nis_mean < 1.1 * high


def test_size_and_span_of_a_bias():
    case = planted.measured("vehicle", 3, planted.biased)
    (one,) = qpmhe.diagnose(case.run(), outputs=["r1", "r2", "b1", "b2"]).findings
    assert one.text.startswith("Sensor b2 is off by ")
    assert 3.3 < float(one.text.split(" by ")[1].split(" sigma")[0]) < 4.7
    begin, end = one.where
    assert begin == pytest.approx(250 / 3 * 0.2, abs=1.0)
    assert end == pytest.approx(49.8, abs=1.0)


@pytest.mark.parametrize("factor", [0.1, 6.0])
def test_factor_of_the_noise(factor):
    (one,) = qpmhe.diagnose(planted.weighted("vehicle", 0, noise=factor).run()).findings
    assert one.kind == "noise"
    assert f"too {'small' if factor > 1 else 'large'} by about" in one.text
    told = float(one.text.split("about ")[1].split(":")[0])
    assert told == pytest.approx(max(factor, 1.0 / factor), rel=0.35)


def test_stretch_in_which_a_parameter_is_not_seen():
    case = planted.unseen("", 0)
    inputs, y, state = case.inputs.copy(), case.measurements.copy(), np.array([1.0, 0.0, 1.5])
    inputs[150:, 0] = 2.0 * np.sin(0.3 * np.arange(150))
    generator = np.random.default_rng(0)
    for t in range(len(y)):
        y[t] = state[0] + 0.05 * generator.standard_normal()
        state = case.system.f(state, inputs[t]) + 0.01 * generator.standard_normal(3) * [1, 3, 0]
    case = case._replace(inputs=inputs, measurements=y)
    found = qpmhe.diagnose(case.run(), labels=case.labels, dt=0.1)
    unseen = [one for one in found.findings if one.kind == "unseen"]
    assert len(unseen) == 1
    assert unseen[0].text.startswith("gain is not seen by the data between ")
    assert unseen[0].where[1] == pytest.approx(15.0, abs=1.5)


def test_outliers_are_a_note_with_a_robust_cost():
    case = planted.measured("pendulum", 1, planted.outlying)
    cost = qpmhe.RobustCost(
        prior=case.cost.prior, disturbance=case.cost.disturbance,
        noise=qpmhe.Huber(case.cost.noise, threshold=2.0),
    )
    found = qpmhe.diagnose(case._replace(cost=cost).run())
    assert found.is_healthy
    assert "outliers" in [one.kind for one in found.notes]


def test_rounded_sensor_that_rests_is_neither_dead_nor_saturated():
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=4.0, disturbance=1e-6, noise=0.5**2 / 12 + 0.01)
    y = 0.5 * np.round(3.0 * 0.8 ** np.arange(100) / 0.5)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.2]), cost, horizon=5, initial_state=[3.0])
    assert not {"dead", "saturated"} & set(kinds(qpmhe.diagnose(mhe.run(y))))


def test_missing_measurements_are_no_fault():
    case = planted.healthy("vehicle", 0)
    y = case.measurements.copy()
    y[np.random.default_rng(0).random(y.shape) < 0.3] = np.nan
    found = qpmhe.diagnose(case._replace(measurements=y).run())
    assert found.is_healthy
    assert any("Missing" in one.text for one in found.notes)
    y[:, 1] = np.nan
    assert kinds(qpmhe.diagnose(case._replace(measurements=y).run())) == ["missing"]


def test_few_measurements_are_no_evidence_of_correlation():
    case = planted.healthy("vehicle", 1)
    y = np.full_like(case.measurements[:120], np.nan)
    y[:30] = case.measurements[:30]
    few = case._replace(
        measurements=y, inputs=case.inputs[:120], settings={**case.settings, "horizon": 40}
    )
    found = qpmhe.diagnose(few.run())
    assert found.is_healthy
    assert found.correlations.limit > 0.5


@pytest.mark.parametrize("seed", [300, 302, 303])
def test_what_follows_a_gap_is_no_evidence(seed):
    case = planted.healthy("cstr", seed)
    y = case.measurements.copy()
    y[60:110] = np.nan
    found = kinds(qpmhe.diagnose(case._replace(measurements=y).run()))
    assert not {"step", "disturbance", "bias"} & set(found)


@pytest.mark.parametrize("seed", [1, 5, 7, 18, 32])
def test_two_thirds_missing_are_no_fault(seed):
    case = planted.healthy("cstr", seed)
    y = case.measurements.copy()
    y[np.random.default_rng(seed).random(len(y)) < 2 / 3] = np.nan
    assert kinds(qpmhe.diagnose(case._replace(measurements=y).run())) == []


@pytest.mark.parametrize(
    ("model", "signal", "factor"),
    [("van_der_pol", "y1", 1e6), ("van_der_pol", "y1", 1e-3), ("cstr", "y1", 1e6),
     ("cstr", "u1", 1e3), ("pendulum", "y1", 1e3), ("battery_cell", "u1", 1e-3),
     ("vehicle", "y1", 1e6), ("vehicle", "u1", 60.0)],
)  # fmt: skip
def test_wrong_units_are_named_first(model, signal, factor):
    case = planted.healthy(model, 0)
    y, u = case.measurements.copy(), None if case.inputs is None else case.inputs.copy()
    (y if signal == "y1" else u)[:, 0] *= factor
    first = qpmhe.diagnose(case._replace(measurements=y, inputs=u).run()).findings[0]
    assert first.kind == ("gain" if signal == "y1" else "input")
    assert "unit" in first.remedy
    told = float(first.text.split("about ")[1].split(" times")[0])
    assert told == pytest.approx(factor if signal == "y1" else 1.0 / factor, rel=0.05)


def test_rare_measurements_are_evidence_nevertheless():
    case = planted.healthy("batch_reactor", 0)
    y = np.vstack([case.measurements] * 4)
    y[np.arange(len(y)) % 12 > 0] = np.nan
    found = qpmhe.diagnose(case._replace(measurements=y).run())
    assert np.isfinite(found.innovations).any(axis=1).sum() >= 40


def test_short_horizon_leaves_the_start_out():
    for seed in (300, 302):
        case = planted.healthy("battery_cell", seed)
        case = case._replace(settings={**case.settings, "horizon": 1})
        assert qpmhe.diagnose(case.run()).is_healthy


def test_measurement_beyond_all_measure():
    case = planted.healthy("vehicle", 1)
    y = case.measurements.copy()
    y[50] = 1e300
    found = qpmhe.diagnose(case._replace(measurements=y).run())
    assert not found.is_healthy
    assert str(found)


def test_sensor_that_never_changes():
    case = planted.healthy("batch_reactor", 0)
    found = qpmhe.diagnose(case._replace(measurements=np.full((150, 1), 3.0)).run())
    assert kinds(found)[0] == "dead"
    assert "throughout" in found.findings[0].text


def test_estimator_that_is_worse_than_a_filter():
    case = planted.healthy("pendulum", 0)
    case.settings.update(max_qps=0)
    case = case._replace(observer=qpmhe.Luenberger([0.02, 0.02]))
    found = qpmhe.diagnose(case.run())
    assert kinds(found) == ["estimator"]
    assert "max_qps" in found.findings[0].remedy


def test_weak_data_and_the_prior():
    case = planted.healthy("battery_cell", 0)
    case.settings.update(horizon=10)
    found = qpmhe.diagnose(case.run(), labels=case.labels)
    (note,) = (one for one in found.notes if one.kind == "prior")
    assert "With N = 10 the prior still carries" in note.text
    shares = found.prior_shares
    assert shares[0] == pytest.approx(np.ones(3))
    assert shares[10].max() > shares[40].max()


def test_compiled_run_is_diagnosed(tmp_path, monkeypatch):
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    case = planted.weighted("batch_reactor", 0, noise=8.0)
    python, compiled = case.run("python"), case.run("compiled")
    assert compiled.engine == "compiled"
    assert str(qpmhe.diagnose(compiled)) == str(qpmhe.diagnose(python))


def test_changed_weights_are_those_that_are_judged():
    case = planted.healthy("batch_reactor", 0)
    mhe = qpmhe.MovingHorizonEstimator(case.system, case.observer, case.cost, **case.settings)
    mhe.set(noise_weight=10.0 * case.cost.noise)
    assert kinds(qpmhe.diagnose(mhe.run(case.measurements))) == ["noise"]


def test_bad_input():
    case = planted.healthy("batch_reactor", 0)
    run = case.run()
    with pytest.raises(InvalidInputError, match=r"expected a qpmhe\.Run"):
        qpmhe.diagnose(case)
    with pytest.raises(InvalidInputError, match="29 samples with measurements; expected at least"):
        qpmhe.diagnose(case._replace(measurements=case.measurements[:29]).run())
    with pytest.raises(InvalidInputError, match=r"all measurements .* missing; check the columns"):
        qpmhe.diagnose(case._replace(measurements=np.full((50, 1), np.nan)).run())
    with pytest.raises(ShapeError, match=r"labels is .* expected 2 strings"):
        qpmhe.diagnose(run, labels=["a"])
    with pytest.raises(ShapeError, match=r"labels is 3; expected 2 strings"):
        qpmhe.diagnose(run, labels=3)
    with pytest.raises(OptionError, match=r"time_unit is 3; expected a string"):
        qpmhe.diagnose(run, time_unit=3)
    with pytest.raises(InvalidInputError, match="the run has no measurements"):
        qpmhe.diagnose(qpmhe.Run.of(run.states[0], []))
    with pytest.raises(InvalidInputError, match="a folder"):
        qpmhe.diagnose(run).report(Path("/tmp"))


def test_page_is_one_file_with_escaped_names(tmp_path):
    case = planted.measured("vehicle", 1, planted.dead)
    found = qpmhe.diagnose(case.run(), outputs=["<b>r1", "r2 & co", "b1", "b2"])
    path = found.report(tmp_path / "new" / "health.html")
    text = path.read_text(encoding="utf-8")
    assert "r2 &amp; co is dead" in text
    assert "<b>r1" not in text
    assert text.index("is dead") < text.index("<svg")
    assert text.count("<svg") == 7
    for outside in ('src="', "http://", "https://", "<script"):
        assert outside not in text.replace("http://www.w3.org/", "")
    assert len(found.plot().axes) == 7


def linear(seed, total):
    generator = np.random.default_rng(seed)
    a = np.eye(3) + 0.2 * generator.standard_normal((total, 3, 3))
    c = generator.standard_normal((total, 2, 3))
    disturbance, noise = np.diag([0.1, 0.0, 0.3]), np.diag([0.2, 0.5])
    prior = np.diag([1.0, 4.0, 0.25])
    return a, c, disturbance, noise, prior


def test_windows_against_dense_matrices():
    total, horizon = 7, 4
    a, c, disturbance, noise, prior = linear(0, total)
    information = np.einsum("tji,jk,tkl->til", c, np.linalg.inv(noise), c)
    view = observability(a, information, disturbance, prior, horizon)
    for first in range(total - horizon + 1):
        # Outputs of the window for its first state, and their covariance without it.
        maps, shares = [], np.zeros((3, 3 * horizon))
        slope = np.eye(3)
        rows = []
        for k in range(first, first + horizon):
            maps.append(c[k] @ slope)
            rows.append(c[k] @ shares)
            shares = a[k] @ shares
            shares[:, 3 * (k - first) : 3 * (k - first) + 3] += np.eye(3)
            slope = a[k] @ slope
        stacked, driven = np.vstack(maps), np.vstack(rows)
        spread = driven @ np.kron(np.eye(horizon), disturbance) @ driven.T
        spread += np.kron(np.eye(horizon), noise)
        dense = stacked.T @ np.linalg.inv(spread) @ stacked
        assert view.matrices[first] == pytest.approx(dense)
        root = np.sqrt(prior)
        assert view.values[first] == pytest.approx(np.linalg.eigvalsh(root @ dense @ root))
        # All that the prior contributes to the newest state.
        shares_of = prior_shares(
            a[first:], information[first:], disturbance, prior, horizon, most=1
        )
        cross = shares @ np.kron(np.eye(horizon), disturbance) @ driven.T
        gain = (slope @ prior @ stacked.T + cross) @ np.linalg.inv(
            stacked @ prior @ stacked.T + spread
        )
        derivative = slope - gain @ stacked
        whole = slope @ prior @ slope.T + shares @ np.kron(np.eye(horizon), disturbance) @ shares.T
        whole -= gain @ (stacked @ prior @ slope.T + cross.T)
        expected = np.diagonal(derivative @ prior @ derivative.T) / np.diagonal(whole)
        assert shares_of[horizon] == pytest.approx(expected)


def test_filters_are_kalman_filters():
    a, c = np.array([[1.0, 0.1], [-0.3, 0.9]]), np.array([[1.0, 0.5]])
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=1)
    prior, disturbance, noise = np.diag([1.0, 2.0]), np.diag([0.01, 0.02]), np.array([[0.3]])
    y = np.random.default_rng(0).standard_normal((60, 1))
    y[20:28] = np.nan
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=prior, disturbance=disturbance, noise=noise),
        qpmhe.QuadraticCost.from_covariances(prior=prior, disturbance=disturbance, noise=noise),
        horizon=2, initial_state=[1.0, 0.0], max_qps=0)
    run = mhe.run(y)
    bank, start = FilterBank(system, None), np.array([1.0, 0.0])
    base = Hypothesis(y, np.zeros((60, 0)), noise, disturbance, start, prior)
    other = Hypothesis(y, np.zeros((60, 0)), 9.0 * noise, disturbance, start, prior)
    found, alone = bank.run([base, other]), bank.run([other])
    assert found.states == pytest.approx(run.states[:-1], rel=1e-9, abs=1e-12)
    assert found.corrected == pytest.approx(run.filtered, rel=1e-9, abs=1e-12)
    # In units of the noise of the first hypothesis.
    told = alone.likelihoods[0] - 26.0 * np.log(9.0)
    assert told == pytest.approx(found.likelihoods[1])


def test_command_writes_the_page(tmp_path):
    case = planted.scaled_input("cstr", 0, -1.0)
    generator = np.random.default_rng(0)
    times = np.append(0.0, np.cumsum(generator.uniform(0.99, 1.01, len(case.inputs) - 1) * 0.05))
    record = tmp_path / "record.csv"
    np.savetxt(
        record, np.column_stack((times, case.measurements, case.inputs)), delimiter=",",
        header="time,y1,u1", comments="")

    def estimate(page, rows="rows.csv"):
        return CliRunner().invoke(
            app, ["estimate", "cstr", str(record), "--out", str(tmp_path / rows), "--overwrite",
                  "--diagnose", str(tmp_path / page)])

    answer = estimate("health.html")
    assert answer.exit_code == 0, answer.output
    assert "1. Input u1 has the wrong sign." in answer.output
    assert "time (min)" in (tmp_path / "health.html").read_text(encoding="utf-8")
    wrong = estimate("health.pdf", "none.csv")
    assert wrong.exit_code != 0
    assert "expected the name of an .html file" in str(wrong.exception)
    assert not (tmp_path / "none.csv").exists()
    record.write_text("\n".join(record.read_text().splitlines()[:21]))
    short = estimate("short.html")
    assert short.exit_code == 0
    assert "no diagnosis: the run has 20 samples" in short.output.replace("\n", " ")


def test_prior_that_claims_too_much():
    case = planted.healthy("batch_reactor", 0)
    cost = qpmhe.QuadraticCost(
        prior=400.0 * case.cost.prior, disturbance=case.cost.disturbance, noise=case.cost.noise)
    found = qpmhe.diagnose(case._replace(cost=cost).run())
    assert any("The prior says that the observer is off by" in one.text for one in found.notes)


def test_what_a_gate_rejected_is_noted():
    generator = np.random.default_rng(8)
    y = generator.standard_normal((300, 2)) * 0.1
    y[generator.random(300) < 0.1, 1] += 5.0
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=2, p=2)
    covariances = {"prior": np.eye(2), "disturbance": 1e-4 * np.eye(2), "noise": 0.01 * np.eye(2)}
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**covariances, innovation=qpmhe.Gate()),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=10, initial_state=[0.0, 0.0],
    )
    notes = [one for one in qpmhe.diagnose(mhe.run(y)).notes if one.kind == "rejected"]
    assert [one.text for one in notes] == ["The observer's gate rejected y2 at 11% of its samples."]
