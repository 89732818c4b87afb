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


def place(latitude=52.5, longitude=13.4, radius=6.371e6):
    """A point of the Earth's surface and its axes east, north, up, all Earth-centred."""
    b, a = np.radians((latitude, longitude))
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
    return radius * up, np.stack((east, np.cross(up, east), up))


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


def write(folder, packed=False, reflected=0.0):
    """A record in the form of the data set; without pseudoranges in one of ten steps."""
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
            range_ = travelled(satellite, receiver) + CLOCK + DRIFT * time
            range_ += GLONASS * (system == 4)
            if reflected and n % 3 == 2:
                range_ += reflected
            range_ += 0.5 * rng.standard_normal() * bool(reflected)
            lines.append(
                f"pseudorange3 {time!r} {float(range_)!r} {16 + n} "
                f"{' '.join(map(repr, satellite.tolist()))} {name} {system} {height} {30 + 2 * n}"
            )
    folder.mkdir(exist_ok=True)
    text = "\n".join(lines) + "\n"
    if packed:
        (folder / "input.txt.gz").write_bytes(gzip.compress(text.encode()))
        (folder / "ground_truth.txt").write_text("\n".join(truth))
    else:
        (folder / "Somewhere_Input.txt").write_text(text)
        (folder / "Somewhere_GT.txt").write_text("\n".join(truth))
    return folder


def state(system, time, where, heading):
    x = np.zeros(system.n)
    x[:3], x[3], x[4], x[5], x[7] = where, heading, CLOCK + DRIFT * time, DRIFT, GLONASS
    return x


@pytest.mark.parametrize("packed", [False, True])
def test_the_model_at_the_truth_leaves_no_residuals(parts, tmp_path, packed):
    """Sagnac's correction, clock and GLONASS offset; the car's way turns far less than a mm."""
    found = parts["record"].read(write(tmp_path / "made", packed))
    system, u = parts["car"].system(found), parts["car"].inputs(found)
    assert found.ranges.shape == (STEPS, len(SKY))
    assert system.n == 8  # SBAS keeps the time of GPS
    times, positions, headings = drive()
    np.testing.assert_allclose(found.positions, positions, atol=1e-7)
    np.testing.assert_allclose(found.lengths, STEP)
    states = [state(system, *one) for one in zip(times, positions, headings, strict=True)]
    left = found.ranges - np.array([system.h(x, one) for x, one in zip(states, u, strict=True)])
    missing = np.isnan(left)
    assert np.array_equal(missing.all(axis=1), np.arange(STEPS) % 10 == 9)
    assert missing[:5].sum() == 5
    assert np.abs(left[~missing]).max() < 1e-3
    for k in range(STEPS - 1):
        np.testing.assert_allclose(system.f(states[k], u[k]), states[k + 1], atol=1e-9)


def test_the_earth_turns_while_a_signal_travels(parts):
    """Sagnac's effect to first order, in another form: twice the area swept, over c."""
    receiver, axes = place()
    satellite = receiver + 2.2e7 * np.array([0.6, 0.3, np.sqrt(1 - 0.45)]) @ axes
    turned = parts["record"].rotated(satellite[None], receiver)[0]
    longer = np.linalg.norm(turned - receiver) - np.linalg.norm(satellite - receiver)
    area = satellite[0] * receiver[1] - satellite[1] * receiver[0]
    assert abs(longer) > 10.0
    np.testing.assert_allclose(longer, TURN / LIGHT * area, atol=1e-3)


def test_weak_signals_can_be_left_out(parts, tmp_path):
    found = parts["record"].read(write(tmp_path / "made"))
    strong = found.strong(36.0)
    assert np.array_equal(np.isfinite(strong.ranges), found.strengths >= 36.0)
    assert 0 < np.isfinite(strong.ranges).sum() < np.isfinite(found.ranges).sum()


def test_records_are_found_in_a_folder_or_in_its_folders(parts, tmp_path):
    one, two = write(tmp_path / "smartloc_here"), write(tmp_path / "smartloc_there", packed=True)
    write(tmp_path / "other")
    assert parts["record"].folders(tmp_path) == [one, two]
    assert parts["record"].folders(two) == [two]


@pytest.mark.parametrize(("change", "words"), [
    (lambda f: (f / "Somewhere_GT.txt").unlink(), "ground or gt"),
    (lambda f: (f / "Somewhere_GT.txt").write_text("point3 0 1 2\n"), "point3"),
    (lambda f: (f / "Somewhere_Input.txt").write_text("odom3 0 1 0 0 0 0 0 0\n"), "pseudoranges"),
    (lambda f: (f / "Somewhere_Input.txt").write_text(
        "odom3 100 1 0 0 0 0 0 0\nodom3 101 1 0 0 0 0 0 0\n"
        "pseudorange3 0 2e7 25 2e7 0 0 1 1 50 40\n"
    ), "of the time"),
    (lambda f: (f / "Somewhere_Input.txt").write_bytes(b"\xff\xfe\x00"), "no text"),
    (lambda f: (f / "Somewhere_Input.txt").write_text("odom3 0 1 0 a 0 0 0\n"), "odom3"),
])
def test_folders_that_are_no_records_are_refused(gallery, parts, tmp_path, change, words):
    folder = write(tmp_path / "made")
    change(folder)
    with pytest.raises(import_module("gallery.command").DataError, match=words):
        parts["record"].read(folder)


def test_the_least_cost_is_found_from_far_away(parts, tmp_path):
    """A third of the signals is reflected: filters are off by more, and a far start is no harm."""
    found = parts["record"].read(write(tmp_path / "made", reflected=60.0))
    problem = parts["car"].problem("made", "", found, {5.0: 1, 100.0: 1}, compiled=False)
    ways = parts["car"].own(found, False, problem, problem.weights)
    y, u = found.ranges, parts["car"].inputs(found)
    for start in (problem.records[0].starts[0], problem.records[1].starts[0]):
        off = problem.error(ways[parts["car"].CAUSAL](start).run(y, u).filtered,
                            found.positions[:, :2])
        assert off[-5:].max() < 3.0
    filtered = ways["EKF, Huber innovation"](start).run(y, u).filtered
    assert problem.error(filtered, found.positions[:, :2])[-5:].min() > 10.0


def test_the_command_runs_on_a_record(parts, tmp_path, capsys):
    car, record = parts["car"], parts["record"]
    code = import_module("gallery.command").main(
        "smartloc", "Made.", car.problems, car.draw, record.SOURCE,
        ["--quick", "--data", str(write(tmp_path / "made", reflected=60.0)),
         "--out", str(tmp_path / "out")],
    )
    assert code == 0
    text = (tmp_path / "out" / "made.md").read_text()
    assert car.CAUSAL in text
    assert "EKF, gated" in text
    assert (tmp_path / "out" / "smartloc.png").exists()
