"""Gaps, and units of time that are taken for them."""

import pytest

from qpmhe.records import RecordError, estimate_record
from qpmhe.records.steps import Steps

from .conftest import DISCRETE
from .oscillator import discrete
from .test_resume import put


def steps(**options):
    system, *_ = discrete()
    return Steps(system, usual=1.0, **options)


def record(times):
    put("record.csv", ["time,y1,y2", *(f"{t},{k % 7},{k % 3}" for k, t in enumerate(times))])


def test_milliseconds_taken_for_seconds(here):
    record(range(0, 50_000, 1000))
    with pytest.raises(RecordError, match=r"line 3: .*--max-gap.*--time-scale"):
        estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0)
    told = estimate_record(
        DISCRETE, "record.csv", "out.csv", dt=1.0, time_scale=1e-3, overwrite=True
    )
    assert (told.samples, told.inserted, told.notes) == (50, 0, [])


def test_a_long_gap_is_filled_when_allowed(here):
    record([*range(150), *range(900, 950)])
    with pytest.raises(RecordError, match=r"line 152: .*--max-gap"):
        estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0)
    told = estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0, max_gap=750, resume=True)
    assert (told.before, told.samples, told.inserted) == (100, 100, 750)


def test_more_gaps_than_samples_are_noted(here):
    record(range(0, 100, 10))
    told = estimate_record(DISCRETE, "record.csv", "out.csv", dt=1.0)
    assert told.inserted == 81
    assert "--time-scale" in told.notes[0]


@pytest.mark.parametrize(
    "spacings",
    [
        [5, 5, 1, 5, 1, 5, 5, 5, 5, 5, 5],  # two usual ones
        [2, 9, 4, 30, 2, 7, 3, 12],  # gaps of all sizes
        [5, 5],
        [1, *[5] * 30],
        [501],
        [],
    ],
)
def test_gaps_that_are_gaps(spacings):
    found = steps()
    assert [found.between(float(one), 0.0).inserted + 1 for one in spacings] == spacings
