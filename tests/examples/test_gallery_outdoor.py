"""Outdoor ranges of the gallery: the reader on small made files."""

import gzip
from importlib import import_module

import numpy as np
import pytest

ANCHORS = {3: (2.6, 0.9, 2.0), 5: (2.6, -0.9, 2.0), 12: (0.7, 0.9, 0.5)}
BEGAN = 1_734_501_485_000_000_000  # ns


@pytest.fixture(scope="module")
def parts(gallery):
    return {name: import_module(f"gallery.outdoor_uwb.{name}") for name in ("ranges", "tag")}


def path(t):
    """A straight walk past the anchors."""
    return np.stack((-3.0 + 1.2 * t, -4.0 + 0.1 * t), axis=-1)


def write(folder, anchors=ANCHORS):
    """Files as those of the data set: ranges at times of their own, with a gap and an outlier."""
    folder.mkdir(parents=True, exist_ok=True)

    def save(name, lines):
        (folder / f"{name}.gz").write_bytes(gzip.compress(("\n".join(lines) + "\n").encode()))

    times = np.arange(0.0, 20.0, 0.125)
    save("trajectory.csv", ["timestamp,x,y,z,heading_degrees", *(
        f"{BEGAN + round(1e9 * t)},{x},{y},0,0"
        for t, (x, y) in zip(times, path(times), strict=True)
    )])
    head = "%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag,field.rssi"
    for k, (number, (x, y, z)) in enumerate(anchors.items()):
        t = np.arange(-0.2, 20.0, 0.1) + 0.001 * k
        t = t[(t < 8.0) | (t > 9.0)]
        far = np.sqrt((path(t)[:, 0] - x) ** 2 + (path(t)[:, 1] - y) ** 2 + (z - 1.0) ** 2)
        far[len(far) // 2] *= 0.2
        save(f"a{number}.csv", [head, *(
            f"{BEGAN + round(1e9 * a)},0,{number},{x},{y},{z},{d},-80"
            for a, d in zip(t, far, strict=True)
        )])
    return folder


@pytest.mark.slow
def test_records_are_read_with_their_own_times_and_any_number_of_anchors(parts, tmp_path):
    walk = parts["ranges"].read(write(tmp_path / "one"))
    np.testing.assert_array_equal(walk.anchors, list(ANCHORS.values()))
    # Neither behind the trajectory nor before it, where a range at -0.2 s was.
    assert walk.times[0] == 0.0
    assert 19.0 < walk.times[-1] < 20.0
    np.testing.assert_allclose(walk.steps[:-1], np.diff(walk.times), atol=1e-9)
    # The anchors' milliseconds make one sample, and the gap is filled by empty ones.
    assert np.isfinite(walk.ranges[:5]).all()
    gap = (walk.times > 8.05) & (walk.times < 8.95)
    assert gap.sum() >= 8
    assert np.isnan(walk.ranges[gap]).all()
    assert walk.steps.max() < 0.15
    np.testing.assert_allclose(walk.path, path(walk.times), atol=0.01)
    write(tmp_path / "deep" / "two", ANCHORS | {7: (-3.0, 2.0, 0.4), 8: (5.0, -3.0, 1.2)})
    problems = parts["tag"].problems(tmp_path, quick=True)
    assert [(one.records[0].name, one.system.p) for one in problems] == [("two", 5), ("one", 3)]
    record = problems[0].records[0]
    way = parts["tag"].own(problems[0], problems[0].weights)["MHE, Geman-McClure, 5 QPs"]
    found = way(np.array([-3.5, -3.0, 0.0, 0.0])).run(record.measurements, record.inputs)
    assert problems[0].error(found.filtered, record.truth)[50:].max() < 0.2
    for file in (tmp_path / "one").glob("a*.csv.gz"):
        file.unlink()
    with pytest.raises(import_module("gallery.command").DataError, match="no ranges"):
        parts["ranges"].read(tmp_path / "one")
