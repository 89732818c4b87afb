"""What is written is what the estimator gives; and the options of the command."""

import csv
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.records import CheckpointError
from qpmhe.records.record_model import load_record_model

from .oscillator import DT, continuous, discrete, lines
from .tools import CONTINUOUS, DISCRETE, command, cut_off, estimate, get, put

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


def by_hand(text):
    """The same record by single updates, written down independently."""
    *parts, options = continuous()
    assert options.pop("states") == ["position", "speed"]
    mhe = qpmhe.MovingHorizonEstimator(*parts, **options)
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


def test_a_discrete_record_gives_what_run_gives_and_gaps_are_missing_samples(here):
    generator = np.random.default_rng(0)
    Y = generator.standard_normal((20, 2))
    kept = [t for t in range(20) if t not in (7, 8, 12)]
    # A clock that strays by 3 % of a step.
    frame = pd.DataFrame({
        "t": DT * np.array(kept) + 0.003 * generator.uniform(-1, 1, len(kept)),
        "y1": Y[kept, 0], "y2": Y[kept, 1],
    })
    frame.to_csv("record.csv", index=False)
    summary = estimate(DISCRETE, dt=DT, covariances="full", step_time=True)
    *parts, options = discrete()
    mhe = qpmhe.MovingHorizonEstimator(*parts, **options)
    Y[[7, 8, 12]] = np.nan
    run, out = mhe.run(Y, covariances=True), read("out.csv")
    for name, expected in (
        ("filtered_", run.filtered), ("predicted_", run.states[1:]), ("cost", run.costs[:, None]),
        ("cov_predicted_", run.covariances[:, [0, 0, 1], [0, 1, 1]]),
        ("candidate_cost", run.candidate_costs[:, None]), ("qps", run.qps[:, None]),
    ):
        np.testing.assert_array_equal(values(out, name), expected[kept])
    assert out["status"].tolist() == [
        str(run.statuses[k]).removeprefix("Status.") for k in kept]
    assert (out["step_time"] > 0).all()
    assert out["inserted"].tolist() == [{9: 2, 13: 1}.get(t, 0) for t in kept]
    assert (summary.samples, summary.inserted, summary.held) == (17, 3, 0)
    assert summary.improved == sum(qpmhe.Status.IMPROVED in run.statuses[k] for k in kept)
    # An output that the record lacks is missing throughout.
    estimate(DISCRETE, out="half.csv", dt=DT, outputs="y1=y1,y2=")
    mhe.reset()
    Y[:, 1] = np.nan
    np.testing.assert_array_equal(values(read("half.csv"), "filtered_"), mhe.run(Y).filtered[kept])


def test_parquet_in_and_out_is_the_same_as_csv(here):
    pytest.importorskip("pyarrow")
    put("record.csv", lines(40))
    frame = read("record.csv")
    frame.to_parquet("record.parquet")
    estimate(CONTINUOUS, covariances="full")
    estimate(CONTINUOUS, "record.parquet", "deeper/out.parquet", covariances="full")
    found, expected = pd.read_parquet("deeper/out.parquet"), read("out.csv")
    pd.testing.assert_frame_equal(found, expected, check_exact=True, check_dtype=False)
    assert [item.name for item in Path("deeper").iterdir()] == ["out.parquet"]


def test_options_that_do_not_fit(here):
    put("record.csv", ["time,y1,y2", "0,1,2"])
    for options, words in (
        ({"covariances": "some"}, "none, std, full"),
        ({"outputs": "y3=y1"}, "y1, y2"), ({"inputs": "u1=y1"}, "no inputs"),
        ({"outputs": "y1=time"}, "no column for the time .* 'time' is used already"),
        ({"outputs": "y1=time", "time": "time"}, "'time' is both the time and"),
        ({"separator": "ab"}, "separator"), ({"encoding": "klingon"}, "klingon"),
        ({"time_scale": 0.0}, "time-scale"), ({"max_gap": -1}, "max-gap"), ({"dt": "x"}, "dt"),
        ({"checkpoint_every": 0}, "checkpoint-every"), ({"missing": [" "]}, "--missing"),
        ({"model": CONTINUOUS, "dt": 0.2}, "model's step is"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            estimate(**{"model": DISCRETE} | options)
        assert not Path("out.csv").exists(), options
    for option, value, words in (("--max-qps", "many", "'none'"), ("--engine", "steam", "steam"),
                                 ("--initial-state", "0;1", "separated by commas")):
        answer = command(DISCRETE, "record.csv", option, value)
        assert isinstance(answer.exception, OptionError)
        assert (words in str(answer.exception), answer.stdout) == (True, "")


@pytest.mark.parametrize(("arguments", "options"), [
    ("--horizon 3 --backend osqp --max-qps none --max-solver-iterations 7 --missing n/a",
     {"horizon": 3, "backend": "osqp", "max_qps": None, "max_solver_iterations": 7,
      "missing": ["n/a"]}),
    ("--max-qps 0 --max-solver-iterations none --initial-state -0.1,0.25 --time-format %S.%f",
     {"max_qps": 0, "max_solver_iterations": None, "initial_state": [-0.1, 0.25],
      "time_format": "%S.%f"}),
    ("--covariances full --time TIME --outputs y=u --inputs u1=u --skip-repeated --skip-lines 0",
     {"covariances": "full", "time": "TIME", "outputs": "y=u", "inputs": "u1=u",
      "skip_repeated": True, "skip_lines": 0}),
    ("--separator comma --decimal . --encoding latin-1 --checkpoint-every 7 --time-scale 0.5",
     {"separator": ",", "decimal": ".", "encoding": "latin-1", "checkpoint_every": 7,
      "time_scale": 0.5}),
    ("--max-gap 0 --equal-steps --dt 0.1", {"max_gap": 0, "equal_steps": True, "dt": 0.1}),
])
def test_options_are_handed_on(here, arguments, options):
    put("record.csv", lines(12))
    expected = ""
    try:
        estimate(CONTINUOUS, out="expected.csv", **options)
    except InvalidInputError as error:
        expected = str(error).replace("expected.csv", "out.csv")
    answer = command(
        CONTINUOUS, "record.csv", "--out", "out.csv", "--no-step-time", *arguments.split()
    )
    assert str(answer.exception or "") == expected
    assert get("out.csv") == get("expected.csv") != b""


def test_standard_output_is_the_default_and_files_are_resumed_or_replaced(here):
    cut_off(lines(30), 20, checkpoint_every=5)
    options = ("--checkpoint-every", "5", "--no-step-time")
    again = (CONTINUOUS, "record.csv", "--out", "out.csv", *options)
    assert isinstance(command(*again).exception, CheckpointError)
    assert "15 samples after 15 before" in command(*again, "--resume").stderr
    whole = get("out.csv")
    assert "30 samples" in command(*again, "--overwrite").stderr
    assert get("out.csv") == whole
    piped = command(CONTINUOUS, "-", *options, "--quiet", text=get("record.csv"))
    assert (piped.stdout_bytes, piped.stderr) == (whole, "")


def test_a_kept_run_has_the_dates_of_its_record(here):
    """Those that `run` has of a frame, gaps included; a resumed one, too."""
    index = pd.date_range("2026-05-04 12:00", periods=40, freq="100ms", tz="UTC")
    index = index.delete([9, 20, 21])
    frame = pd.DataFrame({"y1": np.sin(np.arange(37.0)), "y2": np.arange(37) % 3.0}, index)
    frame.rename_axis("time").to_csv("record.csv")
    parts = load_record_model(DISCRETE)
    kept = estimate(DISCRETE, keep_run=True, dt=0.1).run
    expected = parts.estimator.run(frame)
    assert (kept.index == expected.index).all()
    np.testing.assert_array_equal(kept.states, expected.states)
    found = qpmhe.diagnose(kept)
    assert "times are counted from 2026-05-04 12:00:00+00:00" in found._repr_html_()
    lines = Path("record.csv").read_text().splitlines()
    for name, length in (("durations.csv", "0:00:{:06.3f}"), ("numbers.csv", "{}")):
        put(name, [lines[0], *(f"{length.format(0.1 * k)},1.0,2.0" for k in range(5))])
    durations = estimate(DISCRETE, "durations.csv", "a.csv", keep_run=True).run.index
    assert durations.total_seconds().round(9).tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert estimate(DISCRETE, "numbers.csv", "b.csv", keep_run=True).run.index is None
    put("record.csv", lines[:10])
    estimate(DISCRETE, "record.csv", "c.csv", dt=0.1, checkpoint_every=3)
    put("record.csv", lines)
    resumed = estimate(DISCRETE, "record.csv", "c.csv", dt=0.1, resume=True, keep_run=True,
                       checkpoint_every=3).run
    assert (resumed.index == expected.index[9:]).all()
