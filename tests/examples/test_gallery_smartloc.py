"""The car between houses: its reader and its model, on a small record made here."""

import gzip
from importlib import import_module

import numpy as np
import pytest

LIGHT, TURN = 299792458.0, 7.2921151467e-5
STEP, STEPS, CLOCK, DRIFT, GLONASS = 0.25, 48, 1234.5, -40.0, 17.0
SPEED, RATE = 4.0, 0.05
# Systems and directions (azimuth, elevation in degrees) of the satellites.
SKY = {(1, 3): (10, 40), (1, 7): (100, 60), (1, 12): (190, 30), (1, 30): (280, 50),
       (2, 120): (180, 30), (4, 301): (60, 35), (4, 310): (230, 70), (4, 320): (330, 20)}


@pytest.fixture(scope="module")
def parts(gallery):
    return {name: import_module(f"gallery.smartloc.{name}") for name in ("record", "car", "bank")}


def place():
    """A point of the Earth's surface and its axes east, north, up, all Earth-centred."""
    b, a = np.radians((52.5, 13.4))
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
    return 6.371e6 * up, np.stack((east, np.cross(up, east), up))


def drive():
    """Times, positions (east, north, up) and headings of a car that turns slowly."""
    times = STEP * np.arange(STEPS)
    headings = 0.3 + RATE * times
    ahead = SPEED * STEP * np.stack(
        (np.cos(headings + 0.5 * RATE * STEP), np.sin(headings + 0.5 * RATE * STEP),
         np.zeros(STEPS)), axis=1,
    )
    return times, np.vstack((np.zeros(3), np.cumsum(ahead, axis=0)[:-1])), headings


def travelled(satellite, receiver):
    """The way of a signal, during which the Earth turns: satellite in the axes of its sending."""
    delay = 0.07
    for _ in range(10):
        cos, sin = np.cos(TURN * delay), np.sin(TURN * delay)
        turned = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ satellite
        delay = np.linalg.norm(turned - receiver) / LIGHT
    return LIGHT * delay


def write(folder, reflected=0.0):
    """A packed record in the form of the data set; no pseudoranges in one of ten steps."""
    origin, axes = place()
    times, positions, _ = drive()
    rng = np.random.default_rng(3)
    lines, truth = [], []
    for k, (time, where) in enumerate(zip(times.tolist(), positions, strict=True)):
        receiver = origin + where @ axes
        truth.append(f"point3 {time!r} {' '.join(map(repr, receiver.tolist()))}" + " 0" * 9)
        lines.append(f"odom3 {time!r} {SPEED} 0 0 0 0 {RATE} 0.0025 0.0009 0.0009" + " 4e-6" * 3)
        if k % 10 == 9:
            continue
        for n, ((system, name), (azimuth, height)) in enumerate(SKY.items()):
            if k < 5 and name == 320:
                continue  # rises later
            a, e = np.radians((azimuth + 0.01 * time, height))
            way = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
            satellite = origin + 2.2e7 * way @ axes
            range_ = travelled(satellite, receiver) + CLOCK + DRIFT * time + GLONASS * (system == 4)
            if reflected:
                range_ += reflected * (n % 3 == 2) + 0.5 * rng.standard_normal()
            lines.append(
                f"pseudorange3 {time!r} {float(range_)!r} {16 + n} "
                f"{' '.join(map(repr, satellite.tolist()))} {name} {system} {height} {30 + 2 * n}"
            )
    folder.mkdir(exist_ok=True)
    (folder / "input.txt.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    (folder / "ground_truth.txt").write_text("\n".join(truth))
    return folder


def test_the_model_at_the_truth_leaves_no_residuals(parts, tmp_path):
    """Sagnac's correction, clock and GLONASS offset; the car's way turns far less than a mm."""
    assert parts["record"].folders(write(tmp_path / "smartloc_made").parent) == [
        tmp_path / "smartloc_made"]
    found = parts["record"].read(tmp_path / "smartloc_made")
    system, u = parts["car"].system(found), parts["car"].inputs(found)
    assert found.ranges.shape == (STEPS, len(SKY))
    assert system.n == 8  # SBAS keeps the time of GPS
    times, positions, headings = drive()
    np.testing.assert_allclose(found.positions, positions, atol=1e-7)
    np.testing.assert_allclose(found.lengths, STEP)
    states = np.zeros((STEPS, 8))
    states[:, :3], states[:, 3], states[:, 4] = positions, headings, CLOCK + DRIFT * times
    states[:, 5], states[:, 7] = DRIFT, GLONASS
    left = found.ranges - np.array([system.h(x, one) for x, one in zip(states, u, strict=True)])
    missing = np.isnan(left)
    assert np.array_equal(missing.all(axis=1), np.arange(STEPS) % 10 == 9)
    assert missing[:5].sum() == 5
    assert np.abs(left[~missing]).max() < 1e-3
    for k in range(STEPS - 1):
        np.testing.assert_allclose(system.f(states[k], u[k]), states[k + 1], atol=1e-9)
    assert np.array_equal(np.isfinite(found.strong(36.0).ranges), found.strengths >= 36.0)
    (tmp_path / "smartloc_made" / "ground_truth.txt").write_text("point3 0 1 2\n")
    with pytest.raises(import_module("gallery.command").DataError, match="point3"):
        parts["record"].read(tmp_path / "smartloc_made")


@pytest.mark.slow
def test_the_least_cost_is_found_from_far_away_and_the_command_runs(parts, tmp_path):
    """A third of the signals is reflected: filters are off by more, and a far start is no harm."""
    car, record = parts["car"], parts["record"]
    found = record.read(write(tmp_path / "made", reflected=60.0))
    problem = car.problem("made", "", found, {5.0: 1, 100.0: 1}, compiled=False)
    ways = car.own(found, False, problem, problem.weights)
    y, u = found.ranges, car.inputs(found)
    for start in (problem.records[0].starts[0], problem.records[1].starts[0]):
        off = problem.error(ways[car.CAUSAL](start).run(y, u).filtered, found.positions[:, :2])
        assert off[-5:].max() < 3.0
    # The late estimates are states of the same run's trajectories, in the rows of their own times.
    late = ways[car.LATE](start).run(y, u).filtered
    off = problem.error(late, found.positions[:, :2])
    assert np.isnan(off[1:]).all()
    assert off[0] < 3.0
    filtered = ways["EKF, Huber innovation"](start).run(y, u).filtered
    assert problem.error(filtered, found.positions[:, :2])[-5:].min() > 10.0
    given = ["--quick", "--data", str(tmp_path / "made"), "--out", str(tmp_path / "out")]
    assert import_module("gallery.command").main(
        "smartloc", "Made.", car.problems, car.draw, record.SOURCE, given) == 0
    assert car.CAUSAL in (tmp_path / "out" / "made.md").read_text()
    assert (tmp_path / "out" / "smartloc.png").exists()
