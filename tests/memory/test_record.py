"""The record slides, is rolled back and saved as a plain list of its rows would be."""

import json
import re

import numpy as np
import pytest

from qpmhe.errors import InvalidInputError
from qpmhe.memory.fields import FIELDS, MemorySizes
from qpmhe.memory.record import MemoryRecord
from qpmhe.memory.snapshot import read, written

SIZES = {
    "plain": MemorySizes.of(2, 1, 0, 3),
    "all": MemorySizes.of(
        3, 2, 1, 5, sensors=2, held=1, memory=4, covariance=True, roots=True, majorised=True
    ),
}
# Rows of these are checked against others when a snapshot is loaded.
CHECKED = {"u", "is_irregular", "cost", "rejections", "history"}


def record_of(sizes):
    n, q = sizes.dimensions["n"], sizes.dimensions["q"]
    covariance = np.eye(n) if "covariance" in sizes.features else None
    return MemoryRecord(sizes, np.arange(1.0, n + 1.0), covariance, 0.5, np.eye(q))


def random_row(array, generator):
    shape = array.shape[1:]
    if array.dtype == np.bool_:
        return generator.random(shape) < 0.5
    if array.dtype == np.int64:
        return generator.integers(0, 9, shape)
    return generator.standard_normal(shape)


def push(record, generator):
    """Fill a stage and the state behind it with anything, in each field of the table."""
    if record.end == record.room:
        record.make_room()
    k = record.end
    for field in record.sizes.fields("python", "stage", "state"):
        array = record.rows[field.name]
        if field.name not in CHECKED or field.name == "history":
            array[k + (field.rows == "state")] = random_row(array, generator)
    record.trajectory = np.vstack([record.history[record.start : k + 1], record.history[k + 1]])
    record.unusual = True
    record.end, record.time = k + 1, record.time + 1
    if record.length > record.horizon:
        record.start += 1
        record.trajectory = record.trajectory[1:]


def window(record):
    """The window's rows in each field, as bytes."""
    return {name: array.tobytes() for name, array in record.copies().items()}


@pytest.mark.parametrize("kind", SIZES)
def test_it_keeps_what_a_list_of_rows_keeps(kind):
    """Beyond two moves to the front, with steps that are undone now and then."""
    sizes, generator = SIZES[kind], np.random.default_rng(4)
    record = record_of(sizes)
    states = {f.name for f in sizes.fields("python", "state")}
    kept = {
        name: [array[0].copy()] if name in states else [] for name, array in record.rows.items()
    }
    for t in range(90):
        if record.end == record.room:
            record.make_room()  # no undo point outlives it
        before, undo = window(record), record.undo_point(whole=t % 3 == 0)
        push(record, generator)
        if t % 4 == 1:
            if t % 3 == 0:  # all rows are undone
                for array in record.rows.values():
                    array[record.start : record.end] = 0
            undo()
            assert window(record) == before
            push(record, generator)
        for name, rows in kept.items():
            row = record.end - 1 + (name in states)
            rows.append(record.rows[name][row].copy())
            expected = rows[-(record.length + (name in states)) :]
            np.testing.assert_array_equal(record.copies()[name], expected)
    assert record.time == 90
    assert record.length == record.horizon


@pytest.mark.parametrize("kind", SIZES)
def test_snapshots_return_every_field(kind):
    sizes, generator = SIZES[kind], np.random.default_rng(9)
    for count in (0, 2, 50):
        record, other = record_of(sizes), record_of(sizes)
        for _ in range(count):
            push(record, generator)
        text = json.dumps(written({"window": record.state_dict()}), default=np.ndarray.tolist)
        other.load_state_dict(
            read(json.loads(text))["window"], lambda own: own, may_be_irregular=False,
            is_smoothed=False, ends_alike=True,
        )
        assert window(other) == window(record)
        good = record.last_good_before(record.start)
        assert other.last_good.tobytes() == good[0].tobytes()
        assert (other.last_good_covariance is None) == (good[1] is None)
        for name in ("time", "watched", "trajectory", "smoothed_prior", "trusted"):
            np.testing.assert_array_equal(getattr(other, name), getattr(record, name))


def test_its_fields_are_contiguous_arrays_of_one_aligned_block():
    record = record_of(SIZES["all"])
    for name, array in record.rows.items():
        assert array.flags.c_contiguous, name
        assert array.flags.aligned, name
        assert array.base is not None
        assert np.shares_memory(array, record.block), name
    assert record.block.nbytes >= sum(array.nbytes for array in record.rows.values())


def test_fields_may_be_larger_together_than_a_structure_of_c():
    """Of 1,500 states with whole matrices; nothing is written, so that the system gives none."""
    sizes = MemorySizes.of(1500, 150, 0, 10)
    block, rows = sizes.arrays("python", 42)
    assert block.nbytes > 2**31
    assert rows["linear"].shape == (42, 1650, 1501)
    assert not rows["panel"][-1, -1].any()


def test_a_row_of_another_shape_or_kind_is_refused_by_its_name():
    record = record_of(SIZES["all"])
    push(record, np.random.default_rng(1))
    for name, array in record.rows.items():
        other, state = record_of(SIZES["all"]), record.state_dict()
        for damaged in (array[:0], np.zeros((2, *array.shape[1:]), np.float32), None):
            with pytest.raises(TypeError, match=f"^{name} is "):
                other.load_state_dict(
                    state | {name: damaged}, lambda own: own, may_be_irregular=True,
                    is_smoothed=False, ends_alike=True,
                )


@pytest.mark.parametrize("missing", ["covariance", "root", "rejections", "memory"])
def test_what_another_estimator_lacks_is_named(missing):
    record = record_of(SIZES["all"])
    state = record.state_dict()
    del state[missing]
    with pytest.raises(InvalidInputError, match="with another observer"):
        record_of(SIZES["all"]).load_state_dict(
            state, lambda own: own, may_be_irregular=True, is_smoothed=False, ends_alike=True
        )


def test_the_structures_of_c_have_the_table_s_names_and_sizes():
    """As text and as NumPy's type, member by member."""
    n, p, m, horizon = 3, 2, 1, 5
    sizes = MemorySizes.of(
        n, p, m, horizon, sensors=2, held=1, covariance=True, roots=True, rows=(6, 4), x_set=True,
        restarts=True,
    )
    numbers = {
        "MHE_NX": n, "MHE_NY": p, "MHE_NU": m, "MHE_HORIZON": horizon, "MHE_SENSORS": 2,
        "MHE_HELD": 1, "MHE_X_SET": 1, "MHE_STAGE_ROWS": 4, "MHE_END_ROWS": 1,
        "MHE_SIZE": lambda size: max(size, 1),
    }
    kinds = {"real": np.float64, "terms": "V8", "x_set": "V8"}
    names = {
        "mhe_real": "f8", "int32_t": "i4", "int64_t": "i8", "uint8_t": "u1", "int8_t": "i1",
        "mhe_terms": "V8", "mhe_x_set": "V8",
    }
    for of_stage in (True, False):
        members = sizes.c_type(of_stage, kinds)
        lines = sizes.c_text(of_stage).splitlines()
        assert len(lines) == len(members)
        for line, (name, kind, shape) in zip(lines, members, strict=True):
            found = re.match(r"    (\w+) (\w+)(?:\[(.+?)\])?;", line)
            assert found is not None, line
            assert found[2] == name
            assert np.dtype(names[found[1]]) == np.dtype(kind), line
            size = eval(found[3], {}, numbers) if found[3] else 1
            assert size == np.prod(shape, dtype=int), line
    both = {field.name for field in FIELDS if field.engine == "both"}
    in_c = {name.removesuffix("_end") for s in (True, False) for name, *_ in sizes.c_type(s, kinds)}
    assert both <= in_c
