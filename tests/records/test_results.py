"""What is written is what the estimator gives, sample by sample."""

import csv
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import OptionError
from qpmhe.records import estimate_record

from .conftest import CONTINUOUS, DISCRETE
from .oscillator import DT, continuous, discrete, lines

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
    told = estimate_record("battery_cell", "record.csv", "out.csv", max_qps=2, horizon=20)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=20, initial_state=scenario.initial_estimate, max_qps=2
    )
    run, out = mhe.run(Y, U), read("out.csv")
    assert (values(out, "filtered_") == run.filtered).all()
    assert (values(out, "predicted_") == run.states[1:]).all()
    assert (out["cost"] == run.costs).all()
    assert (out["candidate_cost"] == run.candidate_costs).all()
    assert (out["qps"] == run.qps).all()
    assert out["status"].tolist() == [str(s).removeprefix("Status.") for s in run.statuses]
    assert (out["time"] == 5.0 * np.arange(70)).all()
    assert (out["step_time"] > 0).all()
    assert list(out)[1:4] == [f"filtered_{label}" for label in scenario.labels]
    assert (told.samples, told.before, told.inserted, told.held) == (70, 0, 0, 0)
    assert told.improved == sum(qpmhe.Status.IMPROVED in s for s in run.statuses)


def by_hand(text):
    """The same record by single updates, written down independently."""
    system, observer, cost, options = continuous()
    names = options.pop("states")
    assert names == ["position", "speed"]
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, **options)
    rows = list(csv.DictReader(text))
    held, filtered, deviations, inserted = None, [], [], []
    extra = 0
    for k, row in enumerate(rows):
        y = [float(row["y"])] if row["y"] else None
        held = [float(row["u"])] if row["u"] else held
        step, number = DT, 1
        if k + 1 < len(rows):
            step = float(rows[k + 1]["time"]) - float(row["time"])
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
    Path("record.csv").write_text("\n".join(text) + "\n")
    told = estimate_record(CONTINUOUS, "record.csv", "out.csv", covariances="std")
    filtered, deviations, inserted = by_hand(text)
    out = read("out.csv")
    assert values(out, "filtered_") == pytest.approx(filtered, rel=1e-12, abs=1e-14)
    assert values(out, "std_filtered_") == pytest.approx(deviations, rel=1e-9)
    assert out["inserted"].tolist() == inserted
    assert told.inserted == sum(inserted) > 0
    assert told.held == sum(line.endswith(",") for line in text) > 0
    assert told.incomplete == sum(",," in line for line in text) > 0


def test_a_gap_of_a_discrete_model_is_missing_samples(here):
    generator = np.random.default_rng(0)
    Y = generator.standard_normal((20, 2))
    kept = [t for t in range(20) if t not in (7, 8, 12)]
    # A clock that strays by 3 % of a step, and a column that has only one of the outputs.
    frame = pd.DataFrame({
        "t": DT * np.array(kept) + 0.003 * generator.uniform(-1, 1, len(kept)),
        "y1": Y[kept, 0], "y2": Y[kept, 1],
    })
    frame.to_csv("record.csv", index=False)
    estimate_record(DISCRETE, "record.csv", "out.csv", dt=DT, covariances="full")
    system, observer, cost, options = discrete()
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, **options)
    gappy = Y.copy()
    gappy[[7, 8, 12]] = np.nan
    run, out = mhe.run(gappy, covariances=True), read("out.csv")
    assert (values(out, "filtered_") == run.filtered[kept]).all()
    assert (values(out, "predicted_") == run.states[1:][kept]).all()
    upper = run.covariances[kept][:, [0, 0, 1], [0, 1, 1]]
    assert (values(out, "cov_predicted_") == upper).all()
    assert out["inserted"].tolist() == [{9: 2, 13: 1}.get(t, 0) for t in kept]


def test_an_output_that_a_record_lacks_is_left_out(here):
    Path("record.csv").write_text("time,a\n0,1\n1,2\n2,1\n")
    estimate_record(DISCRETE, "record.csv", "out.csv", outputs="y1=a,y2=")
    system, observer, cost, options = discrete()
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, **options)
    run = mhe.run([[1, np.nan], [2, np.nan], [1, np.nan]])
    assert (values(read("out.csv"), "filtered_") == run.filtered).all()


def test_parquet_in_and_out_is_the_same_as_csv(here):
    pytest.importorskip("pyarrow")
    text = lines(40)
    Path("record.csv").write_text("\n".join(text) + "\n")
    read("record.csv").to_parquet("record.parquet")
    options = {"covariances": "full", "step_time": False}
    estimate_record(CONTINUOUS, "record.csv", "out.csv", **options)
    estimate_record(CONTINUOUS, "record.parquet", "deeper/out.parquet", **options)
    found, expected = pd.read_parquet("deeper/out.parquet"), read("out.csv")
    assert list(found) == list(expected)
    assert len(found) == 40
    for name in found:
        assert found[name].tolist() == expected[name].tolist(), name
    assert [item.name for item in Path("deeper").iterdir()] == ["out.parquet"]


def test_dates_count_in_seconds(here):
    pytest.importorskip("pyarrow")
    text = lines(20)
    Path("record.csv").write_text("\n".join(text) + "\n")
    frame = read("record.csv")
    frame["time"] = pd.to_datetime(frame["time"], unit="s", origin="2026-03-01", utc=True)
    frame["time"] = frame["time"].dt.round("us")
    frame.to_parquet("dated.parquet")
    frame.to_csv("dated.csv", index=False)
    for name in ("record.csv", "dated.csv", "dated.parquet"):
        estimate_record(CONTINUOUS, name, f"{name}.out.csv", step_time=False)
    plain = values(read("record.csv.out.csv"), "filtered_")
    for name in ("dated.csv.out.csv", "dated.parquet.out.csv"):
        assert values(read(name), "filtered_") == pytest.approx(plain, rel=1e-12, abs=1e-14)
    estimate_record(CONTINUOUS, "dated.csv", "out.parquet")
    assert pd.read_parquet("out.parquet")["time"].tolist() == frame["time"].tolist()


def test_units_of_time_are_scaled(here):
    text = lines(20, irregular=False, gaps=0)
    Path("record.csv").write_text("\n".join(text))
    milli = [text[0]]
    for line in text[1:]:
        t, rest = line.split(",", 1)
        milli.append(f"{round(1000 * float(t))},{rest}")
    Path("milli.csv").write_text("\n".join(milli))
    estimate_record(CONTINUOUS, "record.csv", "out.csv", step_time=False)
    estimate_record(CONTINUOUS, "milli.csv", "scaled.csv", step_time=False, time_scale=1e-3)
    # Both are the usual steps, in spite of the last digits.
    assert (values(read("out.csv"), "filtered_") == values(read("scaled.csv"), "filtered_")).all()


def test_a_spreadsheets_note_above_the_header(here):
    Path("record.csv").write_text("sep=;\ntime;y1;y2\n0;1,5;2\n1;1,25;\n")
    told = estimate_record(DISCRETE, "record.csv", "out.csv")
    assert (told.samples, told.incomplete) == (2, 1)


@pytest.mark.parametrize(
    ("mark", "decimal", "prefix", "end"),
    [(";", ",", b"", "\r\n"), ("\t", ",", b"\xef\xbb\xbf", "\n"), ("|", ".", b"", "\r\n"),
     (",", ".", b"\xef\xbb\xbf", "\r\n"), (" ", ".", b"", "\n")],
)
def test_ways_of_writing_csv_make_no_difference(here, mark, decimal, prefix, end):
    text = lines(15)
    Path("record.csv").write_text("\n".join(text))
    other = [line.replace(",", mark).replace(".", decimal) for line in text]
    Path("other.csv").write_bytes(prefix + end.join([*other[:5], "", *other[5:], ""]).encode())
    estimate_record(CONTINUOUS, "record.csv", "out.csv", step_time=False)
    separator = "space" if mark == " " else None
    estimate_record(CONTINUOUS, "other.csv", "o.csv", step_time=False, separator=separator)
    assert Path("out.csv").read_bytes() == Path("o.csv").read_bytes()


MESSY = {
    "milliseconds and decimal commas": ("time;y1;y2", "{t:.3f}", "1,5", {}),
    "days first": ("time;y1;y2", "04.05.2026 12:00:{t:02.0f}", "1,5", {}),
    "days first, milliseconds": ("time;y1;y2", "4.5.2026 12:00:{t:06.3f}", "1,5", {}),
    "a form": (
        "time;y1;y2", "05/04/2026 {t:02.0f}", "1.5", {"time_format": "%m/%d/%Y %S"},
    ),
    "lines above the header": ("Plant 3; log\n\n# by hand\ntime;y1;y2", "{t}", "1,5",
                               {"skip_lines": 3}),
    "units in the header": ("time (s);Level / m;Flow [l/s]", "{t}", "1.5",
                            {"outputs": "y1=Level,y2=flow", "time": "Time"}),
    "units in the options": ("time;Level;Flow", "{t}", "1.5",
                             {"outputs": "y1=Level [m],y2=Flow (l/s)", "time": "time (s)"}),
}


@pytest.mark.parametrize(("header", "time", "value", "options"), MESSY.values(), ids=MESSY)
def test_messy_files_are_read_as_tidy_ones(here, header, time, value, options):
    rows = [f"{time.format(t=k)};{value};{k}" for k in range(12)]
    Path("record.csv").write_text("\n".join([header, *rows, ""]))
    tidy = [f"{k},1.5,{k}" for k in range(12)]
    Path("tidy.csv").write_text("\n".join(["time,y1,y2", *tidy, ""]))
    estimate_record(DISCRETE, "record.csv", "out.csv", step_time=False, **options)
    estimate_record(DISCRETE, "tidy.csv", "expected.csv", step_time=False)
    found, expected = (
        [line.split(",")[1:] for line in Path(name).read_text().splitlines()[1:]]
        for name in ("out.csv", "expected.csv")
    )
    assert found == expected


def test_repeated_lines_are_passed_over_if_asked(here):
    text = lines(15)
    Path("record.csv").write_text("\n".join(text))
    estimate_record(CONTINUOUS, "record.csv", "out.csv", step_time=False)
    twice = [text[5].split(",")[0] + ",9.0,9.0", text[5].split(",")[0] + "0,,"]
    Path("other.csv").write_text("\n".join([*text[:6], *twice, *text[6:]]))
    told = estimate_record(CONTINUOUS, "other.csv", "o.csv", step_time=False, skip_repeated=True)
    assert (told.samples, told.repeated) == (15, 2)
    assert Path("out.csv").read_bytes() == Path("o.csv").read_bytes()


def test_quotation_marks_and_commas_in_names(here):
    Path("record.csv").write_text(
        '"Time, h","Level ""1"", m","x"\n"0,0","1,5",3\n"1,0",,"3"\n"2,0","1,25",3\n'
    )
    estimate_record(
        DISCRETE, "record.csv", "out.csv", time="Time, h", separator=",",
        outputs='"y1=Level ""1"", m",y2=x',
    )
    out = read("out.csv")
    assert out["time"].tolist() == [0, 1, 2]
    assert out["status"].str.contains("MISSING").tolist() == [False, True, False]


def test_options_that_do_not_fit(here):
    Path("record.csv").write_text("time,y1,y2\n0,1,2\n")
    for options, words in (
        ({"covariances": "some"}, "none, std, full"),
        ({"outputs": "y3=y1"}, "y1, y2"),
        ({"outputs": "y1=y1,y1=y2"}, "twice"),
        ({"outputs": "y1=,y2="}, "all outputs"),
        ({"inputs": "u1=y1"}, "no inputs"),
        ({"separator": "ab"}, "separator"),
        ({"encoding": "klingon"}, "klingon"),
        ({"time_scale": 0.0}, "time-scale"),
        ({"max_gap": -1}, "max-gap"),
        ({"dt": "x"}, "dt"),
        ({"checkpoint_every": 0}, "checkpoint-every"),
        ({"horizon": 0}, "horizon"),
        ({"backend": "none"}, "none"),
    ):
        with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
            estimate_record(DISCRETE, "record.csv", "out.csv", **options)
        assert not Path("out.csv").exists(), options
    with pytest.raises(OptionError, match="record itself"):
        estimate_record(DISCRETE, "record.csv", here / "record.csv")
    with pytest.raises(OptionError, match=r"\.parquet"):
        estimate_record(DISCRETE, "record.csv", "out.xlsx")
    with pytest.raises(OptionError, match="own step"):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", dt=0.2)
    assert Path("record.csv").read_text() == "time,y1,y2\n0,1,2\n"
