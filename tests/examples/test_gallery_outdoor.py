"""Outdoor ranges of the gallery: the reader on small made files, and bad geometry."""

import gzip
from functools import partial
from importlib import import_module

import numpy as np
import pytest

import qpmhe

ANCHORS = {3: (2.6, 0.9, 2.0), 5: (2.6, -0.9, 2.0), 12: (0.7, 0.9, 0.5)}
BEGAN = 1_734_501_485_000_000_000  # ns


@pytest.fixture(scope="module")
def parts(gallery):
    names = ("ranges", "tag")
    return {name: import_module(f"gallery.outdoor_uwb.{name}") for name in names} | {
        "command": import_module("gallery.command")
    }


def path(t):
    """A straight walk past the anchors."""
    return np.stack((-3.0 + 1.2 * t, -4.0 + 0.1 * t), axis=-1)


def write(folder, anchors=ANCHORS, seconds=20.0, every=0.1, packed=False, silent=(8.0, 9.0)):
    """Files as those of the data set: ranges at times of their own, with a gap and an outlier."""
    folder.mkdir(parents=True, exist_ok=True)

    def save(name, lines):
        text = "\n".join(lines) + "\n"
        if packed:
            with gzip.open(folder / f"{name}.gz", "wt") as file:
                file.write(text)
        else:
            (folder / name).write_text(text)

    times = np.arange(0.0, seconds, 0.125)
    save("trajectory.csv", ["timestamp,x,y,z,heading_degrees", *(
        f"{BEGAN + round(1e9 * t)},{x},{y},0,0"
        for t, (x, y) in zip(times, path(times), strict=True)
    )])
    head = "%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag,field.rssi"
    for k, (number, (x, y, z)) in enumerate(anchors.items()):
        t = np.arange(-0.2, seconds, every) + 0.001 * k
        t = t[(t < silent[0]) | (t > silent[1])]
        far = np.sqrt((path(t)[:, 0] - x) ** 2 + (path(t)[:, 1] - y) ** 2 + (z - 1.0) ** 2)
        far[len(far) // 2] *= 0.2
        save(f"a{number}.csv", [head, *(
            f"{BEGAN + round(1e9 * a)},0,{number},{x},{y},{z},{d},-80"
            for a, d in zip(t, far, strict=True)
        )])
    return folder


@pytest.mark.parametrize("packed", [False, True])
def test_a_record_is_read_with_its_own_times(parts, tmp_path, packed):
    walk = parts["ranges"].read(write(tmp_path / "walk", packed=packed))
    assert walk.name == "walk"
    np.testing.assert_array_equal(walk.anchors, list(ANCHORS.values()))
    assert walk.times[0] == 0.0
    # Neither behind the trajectory nor before it, where a range at -0.2 s was.
    assert 19.0 < walk.times[-1] < 20.0
    np.testing.assert_allclose(walk.steps[:-1], np.diff(walk.times), atol=1e-9)
    # The anchors' milliseconds make one sample, and the gap is filled by empty ones.
    assert np.isfinite(walk.ranges[:5]).all()
    gap = (walk.times > 8.05) & (walk.times < 8.95)
    assert gap.sum() >= 8
    assert np.isnan(walk.ranges[gap]).all()
    assert walk.steps.max() < 0.15
    np.testing.assert_allclose(walk.path, path(walk.times), atol=0.01)


def test_ranges_that_come_one_at_a_time_are_samples_of_their_own(parts):
    when = 0.1 * np.arange(12)
    times, ranges = parts["ranges"].samples(when, np.arange(12) % 3, 1.0 + when, 3)
    np.testing.assert_allclose(times, when)
    np.testing.assert_array_equal(np.isfinite(ranges).sum(axis=1), 1)
    np.testing.assert_allclose(np.nansum(ranges, axis=1), 1.0 + when)


def test_records_below_a_folder_are_found_and_any_number_of_anchors_is_estimated(parts, tmp_path):
    write(tmp_path / "one")
    write(tmp_path / "deep" / "two", ANCHORS | {7: (-3.0, 2.0, 0.4), 8: (5.0, -3.0, 1.2)})
    problems = parts["tag"].problems(tmp_path, quick=True)
    assert [one.records[0].name for one in problems] == ["two", "one"]
    assert [one.system.p for one in problems] == [5, 3]
    for problem in problems:
        record = problem.records[0]
        way = parts["tag"].own(problem, problem.weights)["MHE, Geman-McClure, 5 QPs"]
        found = way(np.array([-3.5, -3.0, 0.0, 0.0])).run(record.measurements, record.inputs)
        assert problem.error(found.filtered, record.truth)[50:].max() < 0.2


def damage(folder, kind):
    write(folder)
    if kind == "empty":
        for file in folder.iterdir():
            file.unlink()
    elif kind == "no ranges":
        for number in ANCHORS:
            (folder / f"a{number}.csv").unlink()
    elif kind == "one anchor":
        for number in (5, 12):
            (folder / f"a{number}.csv").unlink()
    elif kind == "in a line":
        write(folder, {1: (0.0, 0.0, 0.5), 2: (1.0, 2.0, 1.9), 3: (2.0, 4.0, 0.5)})
        for number in (5, 12):
            (folder / f"a{number}.csv").unlink()
    elif kind == "moving":
        lines = (folder / "a5.csv").read_text().splitlines()
        lines[50] = lines[50].replace("-0.9", "-0.8")
        (folder / "a5.csv").write_text("\n".join(lines))
    elif kind == "other times":
        lines = (folder / "trajectory.csv").read_text().splitlines()
        (folder / "trajectory.csv").write_text("\n".join(
            [lines[0], *("9" + line for line in lines[1:])]
        ))
    elif kind == "columns":
        (folder / "trajectory.csv").write_text("t,a,b\n1,2,3\n2,3,4\n")
    elif kind == "binary":
        (folder / "a3.csv").write_bytes(bytes(range(256)))


@pytest.mark.parametrize(("kind", "words"), [
    ("empty", "no trajectory.csv"), ("no ranges", "no ranges"), ("one anchor", "1 anchor"),
    ("in a line", "are in a line"), ("moving", "anchor 5 of it moves"),
    ("other times", "no ranges at the times"), ("columns", "no column 'timestamp'"),
    ("binary", "a3.csv of it"),
])
def test_a_bad_record_is_refused_by_name(parts, tmp_path, capsys, kind, words):
    damage(tmp_path / "it", kind)
    code = parts["command"].main(
        "outdoor_uwb", "It.", parts["tag"].problems, None, parts["tag"].SOURCE,
        ["--data", str(tmp_path), "--out", str(tmp_path), "--quick"],
    )
    assert code == 2
    assert words in " ".join(capsys.readouterr().err.split())


LINE = [(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (3.0, 0.0, 1.0)]


@pytest.mark.parametrize(("anchors", "engine"), [
    ([(0.0, 0.0, 1.0)], "python"), (LINE, "python"), (LINE, "compiled"),
], ids=["one anchor", "in a line", "in a line, compiled"])
@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
def test_bad_geometry_breaks_no_step(parts, anchors, engine):
    """The start is on the line, where distances do not say which side; at an anchor in one case."""
    anchors = np.array(anchors)
    system, p = parts["tag"].model(anchors), len(anchors)
    gated = qpmhe.ExtendedKalman(
        prior=np.eye(4), disturbance=0.01 * np.eye(2), noise=0.04 * np.eye(p),
        innovation=qpmhe.Gate(reopen=3),
    )
    cost = qpmhe.RobustCost(
        prior=np.eye(4), disturbance=100.0 * np.eye(2),
        noise=qpmhe.GemanMcClure(25.0 * np.eye(p), per_component=True),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, gated, cost, horizon=8, initial_state=np.zeros(4), max_qps=2, warm_start=True,
        engine=engine,
    )
    rng, measured = np.random.default_rng(2), partial(system.h, u=np.array([0.1]))
    rejected = 0
    for k in range(40):
        y = measured(np.array([2.0, 1.0 + 0.05 * k, 0.0, 0.5])) + 0.1 * rng.standard_normal(p)
        if 20 <= k < 24:
            y = y + 50.0
        estimate = mhe.update(y, [0.1])
        assert np.isfinite(estimate.state).all()
        assert estimate.cost <= estimate.candidate_cost
        rejected += len(estimate.rejected_sensors) == p
        assert isinstance(estimate.status.explain(), str)
    assert rejected >= 3
