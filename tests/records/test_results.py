"""What is written is what the estimator gives, sample by sample."""

import csv
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import OptionError

from .oscillator import DT, continuous, discrete, lines
from .tools import CONTINUOUS, DISCRETE, estimate, put

pd = pytest.importorskip("pandas")


def field(text):
    try:
        return float(text or "nan")
    except ValueError:
        return text


def read(path):
    with Path(path).open(encoding="utf-8", newline="") as file:
        return pd.DataFrame([{k: field(v) for k, v in row.items()} for row in csv.DictReader(file)])


def values(frame, prefix):
    return frame[[name for name in frame if name.startswith(prefix)]].to_numpy()


def test_a_zoo_model_gives_what_run_gives(here):
    system, observer, cost, scenario = qpmhe.models.battery_cell()
    _, Y, U = scenario.simulate(seed=3, steps=70)
    frame = pd.DataFrame({"Time (s)": 5.0 * np.arange(70), "Y": Y[:, 0], "u [A]": U[:, 0]})
    frame.to_csv("record.csv", index=False)
    summary = estimate("battery_cell", max_qps=2, horizon=20, step_time=True)
    run = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=20, initial_state=scenario.initial_estimate, max_qps=2
    ).run(Y, U)
    out = read("out.csv")
    for name, expected in (
        ("filtered_", run.filtered), ("predicted_", run.states[1:]), ("cost", run.costs[:, None]),
        ("candidate_cost", run.candidate_costs[:, None]), ("qps", run.qps[:, None]),
        ("time", 5.0 * np.arange(70)[:, None]),
    ):
        np.testing.assert_array_equal(values(out, name), expected)
    assert out["status"].tolist() == [str(s).removeprefix("Status.") for s in run.statuses]
    assert (out["step_time"] > 0).all()
    assert list(out)[1:4] == [f"filtered_{label}" for label in scenario.labels]
    assert (summary.samples, summary.before, summary.inserted, summary.held) == (70, 0, 0, 0)
    assert summary.improved == sum(qpmhe.Status.IMPROVED in s for s in run.statuses)
    assert estimate("battery_cell", out="observer.csv", max_qps=0).improved == 0


def by_hand(text):
    """The same record by single updates, written down independently."""
    system, observer, cost, options = continuous()
    assert options.pop("states") == ["position", "speed"]
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, **options)
    table = list(csv.DictReader(text))
    held, filtered, deviations, inserted, extra = None, [], [], [], 0
    for row, following in zip(table, [*table[1:], None], strict=True):
        y = [float(row["y"])] if row["y"] else None
        held = [float(row["u"])] if row["u"] else held
        step = DT if following is None else float(following["time"]) - float(row["time"])
        number = max(1, round(step / DT))
        filtered.append(mhe.update(y, held, dt=step / number).filtered)
        deviations.append(np.sqrt(np.diagonal(mhe.covariances()[-2])))
        inserted.append(extra)
        for _ in range(number - 1):
            mhe.update(None, held, dt=step / number)
        extra = number - 1
    return np.array(filtered), np.array(deviations), inserted


def test_irregular_steps_gaps_and_blanks_are_single_updates(here):
    text = lines(60, seed=2, gaps=0.15)
    put("record.csv", text)
    summary = estimate(CONTINUOUS, covariances="std")
    filtered, deviations, inserted = by_hand(text)
    out = read("out.csv")
    assert values(out, "filtered_") == pytest.approx(filtered, rel=1e-12, abs=1e-14)
    assert values(out, "std_filtered_") == pytest.approx(deviations, rel=1e-9)
    assert out["inserted"].tolist() == inserted
    assert summary.inserted == sum(inserted) > 0
    assert summary.held == sum(line.endswith(",") for line in text) > 0
    assert summary.incomplete == sum(",," in line for line in text) > 0


def test_a_gap_of_a_discrete_model_is_missing_samples(here):
    generator = np.random.default_rng(0)
    Y = generator.standard_normal((20, 2))
    kept = [t for t in range(20) if t not in (7, 8, 12)]
    # A clock that strays by 3 % of a step.
    frame = pd.DataFrame({
        "t": DT * np.array(kept) + 0.003 * generator.uniform(-1, 1, len(kept)),
        "y1": Y[kept, 0], "y2": Y[kept, 1],
    })
    frame.to_csv("record.csv", index=False)
    estimate(DISCRETE, dt=DT, covariances="full")
    system, observer, cost, options = discrete()
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, **options)
    gappy = Y.copy()
    gappy[[7, 8, 12]] = np.nan
    run, out = mhe.run(gappy, covariances=True), read("out.csv")
    upper = run.covariances[kept][:, [0, 0, 1], [0, 1, 1]]
    np.testing.assert_array_equal(values(out, "filtered_"), run.filtered[kept])
    np.testing.assert_array_equal(values(out, "predicted_"), run.states[1:][kept])
    np.testing.assert_array_equal(values(out, "cov_predicted_"), upper)
    assert out["inserted"].tolist() == [{9: 2, 13: 1}.get(t, 0) for t in kept]
    # An output that the record lacks is missing throughout.
    estimate(DISCRETE, out="half.csv", dt=DT, outputs="y1=y1,y2=")
    mhe.reset()
    gappy[:, 1] = np.nan
    filtered = mhe.run(gappy).filtered[kept]
    np.testing.assert_array_equal(values(read("half.csv"), "filtered_"), filtered)


def test_parquet_in_and_out_is_the_same_as_csv_and_dates_count_in_seconds(here):
    pytest.importorskip("pyarrow")
    put("record.csv", lines(40))
    frame = read("record.csv")
    frame.to_parquet("record.parquet")
    estimate(CONTINUOUS, covariances="full")
    estimate(CONTINUOUS, "record.parquet", "deeper/out.parquet", covariances="full")
    found, expected = pd.read_parquet("deeper/out.parquet"), read("out.csv")
    assert list(found) == list(expected)
    assert len(found) == 40
    for name in found:
        assert found[name].tolist() == expected[name].tolist(), name
    assert [item.name for item in Path("deeper").iterdir()] == ["out.parquet"]
    frame["time"] = pd.to_datetime(frame["time"], unit="s", origin="2026-03-01", utc=True)
    frame["time"] = frame["time"].dt.round("us")
    frame.to_parquet("dated.parquet")
    frame.to_csv("dated.csv", index=False)
    for name in ("dated.csv", "dated.parquet"):
        estimate(CONTINUOUS, name, "dated.out.parquet", overwrite=True)
        dated = pd.read_parquet("dated.out.parquet")
        np.testing.assert_allclose(
            values(dated, "filtered_"), values(expected, "filtered_"), rtol=1e-12, atol=1e-14
        )
        assert dated["time"].tolist() == frame["time"].tolist()


MISFITS = [
    ({"covariances": "some"}, "none, std, full"),
    ({"outputs": "y3=y1"}, "y1, y2"), ({"outputs": "y1=y1,y1=y2"}, "twice"),
    ({"outputs": "y1=,y2="}, "all outputs"),
    ({"outputs": "y1=time"}, "'time' is both the time and"),
    ({"inputs": "u1=y1"}, "no inputs"),
    ({"separator": "ab"}, "separator"), ({"encoding": "klingon"}, "klingon"),
    ({"time_scale": 0.0}, "time-scale"), ({"max_gap": -1}, "max-gap"), ({"dt": "x"}, "dt"),
    ({"checkpoint_every": 0}, "checkpoint-every"), ({"horizon": 0}, "horizon"),
    ({"backend": "none"}, "none"),
]


def test_options_that_do_not_fit(here):
    put("record.csv", ["time,y1,y2", "0,1,2"])
    for options, words in MISFITS:
        with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
            estimate(DISCRETE, **options)
        assert not Path("out.csv").exists(), options
    put("record.csv", lines(3))
    with pytest.raises(OptionError, match="own step"):
        estimate(CONTINUOUS, dt=0.2)
