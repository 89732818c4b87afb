"""Gaps, and units of time that are taken for them."""

import re
from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import RecordError, estimate_record
from qpmhe.records.steps import Steps

from .conftest import CONTINUOUS, DISCRETE
from .oscillator import discrete
from .test_resume import put, rows


def steps(**options):
    system, *_ = discrete()
    return Steps(system, usual=1.0, **options)


def record(times):
    put("record.csv", ["time,y1,y2", *(f"{t},{k % 7},{k % 3}" for k, t in enumerate(times))])


@pytest.mark.parametrize(
    "times",
    [
        range(0, 50_000, 1000),
        [*range(0, 3000, 999), *range(3000, 40_000, 1000)],
        range(0, 100, 2),
        range(0, 4000, 1000),  # a record too short to be judged before its end
    ],
)
def test_a_record_of_nothing_but_gaps(here, times):
    record(times)
    with pytest.raises(RecordError, match=r"nothing but gaps.*--time-scale.*--max-gap") as caught:
        estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0)
    size = times[-1] - times[-2]
    scale = re.search(r"--time-scale (\S+) or so", str(caught.value))
    assert float(scale[1]) == pytest.approx(1 / size, rel=2e-3)
    assert str(caught.value).endswith("start again by --overwrite.")
    done = rows(Path("out.csv"))
    assert done <= 9
    # Nor by going on.
    with pytest.raises(RecordError, match="nothing but gaps"):
        estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0, resume=True)
    if len(set(np.diff(times))) == 1:
        told = estimate_record(
            DISCRETE, "record.csv", "out.csv", dt=1.0, time_scale=1 / size, overwrite=True
        )
        assert (told.samples, told.inserted) == (len(times), 0)


def test_whoever_says_so_may_have_them(here):
    record(range(0, 100, 10))
    told = estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0, max_gap=9)
    assert told.inserted == 81


def test_checkpoints_do_not_hide_it(here):
    record(range(0, 50_000, 1000))
    for resume in (False, True):
        with pytest.raises(RecordError, match="nothing but gaps"):
            estimate_record(
                DISCRETE, "record.csv", "out.csv", dt=1.0, checkpoint_every=2,
                checkpoint_seconds=0.0, resume=resume,
            )


def test_a_continuous_model_in_seconds_and_a_record_in_milliseconds(here):
    put("record.csv", ["time,y,u", *(f"{100 * k},0.1,0" for k in range(30))])
    with pytest.raises(RecordError, match=r"--time-scale 0\.001 or so"):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", max_gap=None)


@pytest.mark.parametrize(
    "spacings",
    [
        [5, 5, 1, 5, 1, 5, 5, 5, 5, 5, 5],  # two usual ones
        [2, 9, 4, 30, 2, 7, 3, 12],  # gaps of all sizes
        [5, 5],
        [1, *[5] * 30],
        [],
    ],
)
def test_gaps_that_are_gaps(spacings):
    found = steps()
    assert [found.between(float(one), 0.0).inserted + 1 for one in spacings] == spacings


def test_within_a_record_nothing_is_judged():
    found = steps()
    found.resume(1.0)
    assert found.settled
    assert [found.between(1000.0, 0.0).inserted for _ in range(20)] == [999] * 20


def test_clocks_stray():
    found, generator = steps(), np.random.default_rng(0)
    spacings = (60 + generator.uniform(-2, 2, 20)).round().tolist()
    with pytest.raises(ValueError, match=r"nothing but gaps of about (59|60|61) "):
        [found.between(one, 0.0) for one in spacings]
