"""The guard in written C and in an FMU: the same map as in Python, and the bounds in advance."""

import shutil
import subprocess

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import CertificateError, MismatchError, Monitor, Sizes
from qpmhe.certificates.guard import Guard, tubes_in_advance
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.tube import Tube
from qpmhe.codegen.guard import GuardForm
from qpmhe.errors import InvalidInputError, OptionError

from .helpers import box
from .test_guard import GAIN, START, A, V, W, certified, estimator, plant

CC = shutil.which("cc")
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror", "-Wshadow", "-Wconversion")
DRIVER = r"""
#include <stdio.h>
#include "mhe.c"
static mhe_estimator e;
static mhe_workspace k;
static mhe_estimate out;
static mhe_guard g;
int main(int count, char **names)
{
    double in[3 * MHE_NX + 1], found[MHE_NX + 1], y[MHE_NY], u[MHE_NU + 1], more[2];
    static const uint8_t none[MHE_NY];
    static mhe_settings settings;
    const int map = count > 1 && names[1][0] == 'm';
    if (map) { /* the map alone: an estimate, z, radius and box */
        while (fread(in, sizeof in, 1, stdin) == 1) {
            mhe_tube tube;
            tube.radius = in[2 * MHE_NX];
            memcpy(tube.box, in + 2 * MHE_NX + 1, sizeof tube.box);
            found[MHE_NX] = mhe_guard_move(in, in + MHE_NX, &tube, found);
            fwrite(found, sizeof found, 1, stdout);
        }
        return 0;
    }
    if (fread(in, sizeof(double) * MHE_NX, 1, stdin) != 1) return 2;
    settings = mhe_default_settings;
    if (count > 1) settings.project = 2;
    mhe_reset(&e, &settings, in);
    mhe_guard_start(&g, &e);
    while (fread(y, sizeof y, 1, stdin) == 1) {
        if (MHE_NU && fread(u, sizeof *u * MHE_NU, 1, stdin) != 1) return 2;
        mhe_sample sample = {0};
        sample.y = y, sample.u = u, sample.sampled = isinf(y[0]) ? none : 0;
        mhe_update_special(&e, &k, &sample, &out);
        mhe_guard_check(&g, &e, &out);
        more[0] = g.moved, more[1] = g.off;
        fwrite(g.state, sizeof g.state, 1, stdout);
        fwrite(g.filtered, sizeof g.filtered, 1, stdout);
        fwrite(g.error, sizeof g.error, 1, stdout);
        fwrite(more, sizeof more, 1, stdout);
    }
    return 0;
}
"""
# Of an estimator whose estimates follow the measurements, and so noise.
ROUGH = qpmhe.QuadraticCost(prior=1e-2 * np.eye(2), disturbance=1e4 * np.eye(2), noise=1e4)


def made(bound, mhe, folder):
    """Runs the written guard of an estimator: with a word as the map alone, else along samples."""
    qpmhe.codegen.write(mhe, folder, guard=Monitor(bound, mhe, initial_error=START, guard=True))
    (folder / "main.c").write_text(DRIVER)
    subprocess.run([CC, "-std=c99", *STRICT, "-o", "main", "main.c", "-lm"], cwd=folder, check=True)

    def run(rows, *words):
        done = subprocess.run(
            [folder / "main", *words], input=np.ascontiguousarray(rows, np.float64).tobytes(),
            capture_output=True, check=True, timeout=60)
        return np.frombuffer(done.stdout)

    return run


@pytest.fixture(name="bound")
def fixture_bound():
    return certified()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return made(certified(), estimator(certified(), cost=ROUGH), tmp_path_factory.mktemp("written"))


pytestmark = pytest.mark.skipif(CC is None, reason="there is no C compiler")


def test_the_map_is_that_of_python(bound, written):
    """Where ball, box and the slanted side are active, of estimates near, far and not finite."""
    guard, rng, kinds = Guard(bound, plant()), np.random.default_rng(0), set()
    rows, expected = [], []
    for k in range(140):
        z = rng.uniform(-1.9, 1.9, 2)
        if k % 4 == 0:  # near the slanted side
            z = np.array([1.2, 1.75]) + rng.uniform(-0.2, 0.2) * np.array([1.0, -1.0])
        radius = float(10.0 ** rng.uniform(-3.0, 1.0))
        tube = Tube(radius, bound.components(radius) * rng.uniform(0.3, 1.0, 2))
        x = z + rng.standard_normal(2) * (1e-4, 0.3, 1.0, 1e3, 1e9, 1e150, 1e300)[k % 7]
        if k in (50, 51):
            x = np.array([np.nan, 0.0] if k == 50 else [0.0, np.inf])
        rows.append([*x, *z, tube.radius, *tube.box])
        expected.append(guard(x, z, tube))
    found = written(rows, "map").reshape(-1, 3)
    for row, one, (*point, moved) in zip(rows, expected, found, strict=True):
        assert moved == (-1.0 if one.reason else float(one.acted))
        if one.acted:
            # Of the ball's radius: what halvings, and what rounding of a far estimate, leave open.
            z, e = np.array(row[2:4]), np.array(point) - row[2:4]
            np.testing.assert_allclose(point, one.point, rtol=0, atol=1e-9 * max(
                1.0, np.abs(z).max()))
            assert np.sqrt(e @ bound.metric @ e) <= row[4]
            assert (np.abs(e) <= row[5:]).all()
        kinds.add((float(moved), bool(np.abs(row[0]) > 1e100)))
    assert {moved for moved, _ in kinds} == {-1.0, 0.0, 1.0}
    assert (1.0, True) in kinds


def test_a_run_is_guarded_by_the_bounds_in_advance(bound, written):
    """The bounds along a run are narrower; both hold, and the guard ends with a missing sample."""
    system, guard, rng = plant(), Guard(bound, plant()), np.random.default_rng(1)
    form = guard.c_form(bound.sizes, bound.begun(START))
    x, start = np.array([0.2, -0.1]), np.array([0.45, -0.3])
    truths, measured = [x], []
    for _ in range(40):
        measured.append(x[:1] + rng.choice([-0.05, 0.05], 1))
        x = system.f(x, np.zeros(0)) + rng.choice([-0.02, 0.02], 2)
        truths.append(x)
    found = written(np.concatenate((start, np.ravel(measured)))).reshape(-1, 8)
    mhe, moved = estimator(bound, cost=ROUGH, initial_state=start), 0
    for t, (y, row) in enumerate(zip(measured, found, strict=True)):
        before, estimate = mhe.observer_state, mhe.update(y)
        tubes = [Tube(form.radius[0, k], form.box[0, k]) for k in np.minimum(
            [t, t + 1], form.radius.shape[1] - 1)]
        later, now = guard(estimate.state, estimate.observer_state, tubes[1]), guard(
            estimate.filtered, before, tubes[0])
        np.testing.assert_allclose(row[:4], [*later.point, *now.point], rtol=1e-9, atol=1e-9)
        assert row[6:].tolist() == [later.acted + 2 * now.acted, 0]
        moved += row[6] > 0
        assert (np.abs(truths[t + 1] - row[:2]) <= row[4:6]).all()
        assert (row[4:6] <= 2.0 * tubes[1].box * (1.0 + 1e-12)).all()
    assert moved > 3
    measured[10] = [np.nan]
    found = written(np.concatenate((start, np.ravel(measured)))).reshape(-1, 8)
    assert (found[:10, 7] == 0).all()
    assert (found[10:, 6] == 0).all()
    assert (found[10:, 7] == 2).all()
    assert np.isnan(found[10:, 4:6]).all()
    measured[10] = [np.inf]  # not sampled
    found = written(np.concatenate((start, np.ravel(measured)))).reshape(-1, 8)
    assert (found[:10, 7] == 0).all()
    assert (found[10:, 7] == 2).all()
    measured[10] = [9.0]  # the observer leaves the region one sample later, and no state is left
    found = written(np.concatenate((start, np.ravel(measured)))).reshape(-1, 8)
    assert found[9, 7] == 0
    assert set(found[10:, 7]) == {5}
    measured[:] = [[np.nan]]
    assert written(np.concatenate((start, [np.nan]))).reshape(-1, 8)[0, 7] == 2


@pytest.mark.slow
@pytest.mark.parametrize("projects", [True, False])
def test_a_projected_observer_and_inputs(projects, tmp_path):
    """In the certified metric, other bounds count from the first projection on."""
    X, inputs = box([-1.0, -1.0], [1.0, 1.0]), box(-0.1, 0.1)
    system = qpmhe.System(
        lambda x, u: x @ A.T + 0.05 * np.sin(x[..., :1]) * np.array([0.0, 1.0]) + u,
        lambda x, u: x[..., :1], n=2, p=1, m=1, states=X)
    observer, given = qpmhe.Luenberger(GAIN), Sizes(W, V)
    known = bound_observer(system, observer, ROUGH, inputs=inputs, sizes=given, seconds=300.0)
    if projects:
        observer = qpmhe.Luenberger(GAIN, metric=known.metric)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, ROUGH, horizon=4, initial_state=[0.5, 0.0], max_qps=1)
    run, rng, x = made(known, mhe, tmp_path), np.random.default_rng(0), np.array([0.7, -0.1])
    truths, rows = [x], [[0.5, 0.0]]
    for t in range(60):
        u = np.array([0.085])
        noise = rng.choice([-0.05, 0.05], 1) if t < 20 or t > 40 else 0.05
        rows.append([*(x[:1] + noise), *u])
        ahead, push = system.f(x, u), rng.choice([-0.02, 0.02], 2)
        x = ahead + np.where(np.abs(ahead + push) <= 1.0, push, -push)
        assert (np.abs(x) <= 1.0).all()
        truths.append(x)
    found = run(np.concatenate(rows)).reshape(-1, 8)
    projected = np.array([
        qpmhe.Status.OBSERVER_PROJECTED in mhe.update(y, u).status for y, u in rows[1:]
    ])
    assert projected.any()
    # In another metric, the observer's or that of changed settings, it ends the bound.
    first = int(projected.argmax())
    other = run(np.concatenate(rows), "diagonal").reshape(-1, 8) if projects else found
    assert (other[:first, 7] == 0).all()
    assert (other[first:, 7] == 2).all()
    if not projects:
        return
    assert (found[:, 7] == 0).all()
    assert (found[:, 6] > 0).any()
    assert (np.abs(truths[1:] - found[:, :2]) <= found[:, 4:6]).all()
    rows[5][1] = 0.3  # an input beyond those that were certified
    assert (run(np.concatenate(rows)).reshape(-1, 8)[4:, 7] == 4).all()


@pytest.mark.parametrize("first", [1e-6, 0.05, 2.0])
def test_the_last_bounds_hold_at_all_later_samples(bound, first):
    begun, given = bound.begun(first), (bound.sizes.disturbance, bound.sizes.noise)
    entering, added = bound.entering(*given), bound.added(*given)
    for projected in (False, True):
        found, tube = tubes_in_advance(bound, bound.sizes, begun, projected=projected), begun
        assert len(found) < 200
        for t in range(400):
            own = found[min(t, len(found) - 1)]
            assert tube.radius <= own.radius
            assert (tube.box <= own.box).all()
            tube = bound.followed(tube, entering, added, projected=projected)
        # No more than a little above the limit.
        assert found[-1].radius <= 1.02 * max(tube.radius, bound.limit())


def test_an_fmu_has_the_guarded_estimates(bound, tmp_path):
    pytest.importorskip("fmpy")
    from ..codegen.test_fmu import Unit

    mhe, form = estimator(bound, cost=ROUGH), Guard(bound, plant()).c_form(
        bound.sizes, bound.begun(START))
    unit = Unit(mhe, tmp_path, guard=Monitor(bound, mhe, initial_error=START, guard=True))
    unit.start()
    assert unit.get("error") == form.box[0, 0].tolist()
    guard, rng, moved = Guard(bound, plant()), np.random.default_rng(2), 0
    for t in range(12):
        y, z = rng.uniform(-0.3, 0.3, 1), mhe.observer_state
        state, estimate = unit.take(t, y=y), mhe.update(y)
        tubes = [Tube(form.radius[0, k], form.box[0, k]) for k in (t, t + 1)]
        later = guard(estimate.state, estimate.observer_state, tubes[1])
        now = guard(estimate.filtered, z, tubes[0])
        np.testing.assert_allclose(state, later.point, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(unit.get("filtered"), now.point, rtol=1e-8, atol=1e-9)
        assert unit.integer("moved") == later.acted + 2 * now.acted
        assert unit.integer("guard_off") == 0
        moved += later.acted
    assert moved > 3
    unit.take(12, y=[np.nan])
    assert (unit.integer("guard_off"), unit.integer("moved")) == (2, 0)
    assert np.isnan(unit.get("error")).all()
    unit.fmu.reset()
    unit.start()
    unit.take(0, y=[0.1])
    assert unit.integer("guard_off") == 0


def test_what_cannot_be_written_is_refused(bound, tmp_path):
    mhe = estimator(bound)
    plain, watch = (Monitor(bound, mhe, initial_error=START, guard=on) for on in (False, True))
    assert isinstance(watch.c_form(mhe), GuardForm)
    for given, error, words in (
        ({"guard": plain}, InvalidInputError, "the monitor has no guard"),
        ({"guard": True}, InvalidInputError, "guard is True; expected a qpmhe.certificates.Monit"),
        ({"guard": watch, "real": "float"}, OptionError, "in double precision"),
    ):
        with pytest.raises(error, match=words):
            qpmhe.codegen.write(mhe, tmp_path, **given)
    with pytest.raises(InvalidInputError, match=r"guard is <class .*expected a qpmhe"):
        qpmhe.codegen.write(mhe, tmp_path, guard=Monitor)
    with pytest.raises(InvalidInputError, match="estimator is of type str"):
        watch.c_form("mhe")
    lost = Monitor(bound, mhe, initial_error=START, guard=True)
    lost.load_state_dict(watch.state_dict() | {"lost": 0, "reason": "it left the region"})
    with pytest.raises(InvalidInputError, match="it left the region"):
        lost.c_form(mhe)
    with pytest.raises(InvalidInputError, match="bounds are nan"):
        lost.load_state_dict(watch.state_dict() | {"radius": np.nan})
    with pytest.raises(CertificateError, match="restart=True"):
        watch.c_form(estimator(bound, restart=True))
    other = qpmhe.MovingHorizonEstimator(
        plant(), qpmhe.Luenberger(0.5 * GAIN), ROUGH, horizon=4, initial_state=[0.0, 0.0])
    with pytest.raises(MismatchError, match="gain"):
        watch.c_form(other)
    watch.check(mhe.update([0.1]))
    with pytest.raises(InvalidInputError, match="it has seen samples"):
        qpmhe.codegen.write(mhe, tmp_path, guard=watch)
