"""The observer's bound against adversaries, and against plain computations of the same."""

import itertools
import re

import numpy as np
import pytest

import qpmhe
from qpmhe import certificates
from qpmhe.certificates import Evidence, Sizes, certify
from qpmhe.certificates import certificate as certification
from qpmhe.certificates.evidence import MismatchError, at_most
from qpmhe.certificates.regions import bounded_region
from qpmhe.certificates.sizes import lengths_of
from qpmhe.errors import OptionError, SetError, ShapeError

from .helpers import box, linear, unit_box, unit_cost


def bound_of(system, gain, region, disturbances, noises):
    """The certified bound of a Luenberger observer."""
    return certify(
        system, qpmhe.Luenberger(gain), unit_cost(system.n, system.p), horizon=1, region=region,
        sizes=Sizes(disturbances, noises),
    ).observer_bound


@pytest.fixture(scope="module")
def four():
    """Four states in a row, with a sine at its first; the outer ones are measured."""
    A = 0.6 * np.eye(4) + 0.1 * np.eye(4, k=1) + 0.1 * np.eye(4, k=-1)
    system = qpmhe.System(
        lambda x: x @ A.T + 0.1 * np.sin(x[..., :1]) * np.eye(4)[0], lambda x: x[..., [0, 3]],
        n=4, p=2,
    )
    K, half = np.zeros((4, 2)), np.full(4, 0.005)
    K[0, 0] = K[3, 1] = 0.3
    region = box(-0.5 * np.ones(4), 0.5 * np.ones(4))
    return bound_of(system, K, region, box(-half, half), 0.01), system


def corners(sides):
    return np.array(list(itertools.product(*zip(sides.lower, sides.upper, strict=True))))


@pytest.mark.slow
def test_no_adversary_exceeds_the_bound(four, pytestconfig):
    """Each takes the w and v, of all extreme ones, that take the error farthest in P."""
    bound, system = four
    assert bound.evidence is Evidence.PROVED
    runs, rng = 500 if pytestconfig.option.all else 300, np.random.default_rng(0)
    P, K, n = bound.metric, bound.gain, system.n
    low, high = bound.region.lower[:n], bound.region.upper[:n]
    x, z = (rng.choice([0.0, 0.1, 0.5, 0.9, 1.0], (runs, n)) * (high - low) + low for _ in "xz")
    x[::7] = z[::7]  # some begin without an error: the noise alone
    angles = np.arange(12) * np.pi / 6
    noises = bound.sizes.noise * np.column_stack((np.cos(angles), np.sin(angles)))
    pairs = list(itertools.product(corners(bound.sizes.disturbance), noises))
    u, alive = np.zeros((runs, 0)), np.ones(runs, bool)
    b = np.array([bound.initial(e) for e in x - z])
    entering, sums, share = bound.entering(), bound.stability.sums, 0.0
    paper = sums.initial * np.linalg.norm(x - z, axis=1)  # (eq:RGES)
    for _ in range(60):
        f, h, ahead = system.f.batch(x, u), system.h.batch(x, u), system.f.batch(z, u)
        best, chosen, added = np.full(runs, -1.0), np.array([f, ahead]), np.zeros(runs)
        innovation = h - system.h.batch(z, u)
        for w, v in pairs:
            after, following = f + w, ahead + (innovation + v) @ K.T
            size = np.einsum("ti,ij,tj->t", after - following, P, after - following)
            size[~bound.region.contains(after)] = -1.0
            better = size > best
            chosen[:, better] = after[better], following[better]
            best = np.where(better, size, best)
            signals = np.linalg.norm(w) * sums.disturbance + np.linalg.norm(v) * sums.noise
            added = np.where(better, signals, added)
        alive &= (best >= 0.0) & bound.region.contains(z)
        x, z = chosen
        b = np.array([bound.advanced(each, entering) for each in b])
        paper = sums.rate * (paper + added)
        x[~alive] = z[~alive] = 0.5 * (low + high)  # those that left are counted no more
        e = (x - z)[alive]
        assert np.all(bound.length(e) * (1.0 - 1e-12) <= b[alive])
        assert np.all(np.abs(e) <= bound.components(b[alive]))
        share = max(share, np.max(np.linalg.norm(e, axis=1) / paper[alive]))
        inside = alive & bound.region.contains(x)
        lower, upper = bound.around(b[inside], z[inside])
        assert np.all((lower <= x[inside]) & (x[inside] <= upper))
        other = rng.uniform(low, high, x.shape)[inside]  # any estimate at all beside it
        far = bound.farthest(b[inside], other - z[inside], z[inside])
        assert np.all(np.linalg.norm(other - x[inside], axis=1) <= far)
    assert alive.mean() > 0.2
    assert 0.4 < share <= 1.0 + 1e-9
    assert bound.limit() / np.sqrt(best[alive]).max() < 4.0


def test_a_scalar_system_has_the_bound_that_one_computes_by_hand():
    bound = bound_of(linear(0.8, 1.0), [[0.3]], box(-9.0, 9.0), 0.1, 0.2)
    assert bound.entering()[0] == pytest.approx(np.sqrt(bound.metric[0, 0]) * (0.1 + 0.3 * 0.2))
    # The worst that w and v can do is 0.16 / (1 - 0.5).
    assert 0.32 <= bound.components(bound.limit())[0] <= 1.1 * 0.32
    reached = bound.components(bound.radii(1, 2.0)[1])[0]
    assert 2.0 * 0.5 + 0.16 <= reached <= 2.0 * bound.rate + 0.1601
    assert bound.components(bound.radii(0, [-2.0])[0])[0] == pytest.approx(2.0)
    assert 0.32 <= bound.settled.box[0] <= 1.001 * 0.32
    tube, whole = bound.begun(box(-18.0, 18.0)), []
    for _ in range(bound.settling_samples):
        tube = bound.followed(tube, bound.entering(), bound.added(), projected=False)
        whole.append(tube.box[0])
    assert whole[-1] <= 1.1 * bound.settled.box[0] < whole[len(whole) // 2]
    # What is shown is no smaller than what is proved.
    shown = re.fullmatch(r"\|x1 - z1\| <= (\S+) in the limit and .* on \(proved.*", bound.headline)
    for value, text in ((0.4031, "0.404"), (0.9, "0.9"), (99.91, "100"), (np.inf, "inf")):
        assert at_most(value, 3) == text
    assert 0.0 <= float(shown[1]) / bound.settled.box[0] - 1.0 < 0.01
    twice = re.search(r"guarded, x_hat is within min\(2 b, \|x_hat - z\| \+ b\) along a run, and "
                      r"in advance within 2 b = (\S+)$", bound.headline)
    assert 0.0 <= float(twice[1]) / (2.0 * bound.settled.box[0]) - 1.0 < 0.01


def plain(vectors, weight):
    return np.sqrt(np.einsum("...i,ij,...j->...", vectors, weight, vectors))


def test_sizes_may_be_lengths_sets_or_vectors(four):
    (four, _), rng, ones = four, np.random.default_rng(1), np.ones((3, 4))
    P, Q, R, V = four.metric, four.stability.Q, four.stability.R, four.stability.V
    w, v = 0.02 * rng.standard_normal((50, 4)), 0.05 * rng.standard_normal((50, 2))
    vectors = four.entering(w, v)
    np.testing.assert_allclose(vectors[:, 0], plain(w, P) + plain(v, V), rtol=1e-9)
    np.testing.assert_allclose(vectors[:, 1], np.hypot(plain(w, Q), plain(v, R)), rtol=1e-9)
    boxes = [box(-side, side) for side in (np.abs(w).max(axis=0), np.abs(v).max(axis=0))]
    most = plain(corners(boxes[0]), P).max() + plain(corners(boxes[1]), V).max()
    assert four.entering(*boxes)[0] == pytest.approx(most, rel=1e-9)
    most = max(np.linalg.norm(w, axis=1)), max(np.linalg.norm(v, axis=1))
    for larger in (four.entering(*boxes), four.entering(*most), four.entering(boxes[0], v)):
        assert (vectors <= larger).all()
    # A box with too many corners is bounded by its sides.
    side, weight = np.linspace(0.1, 0.2, 14), np.full((14, 14), -0.05) + np.eye(14)
    found = float(lengths_of("w", box(-side, side), weight))
    assert found == pytest.approx(plain(side, np.abs(weight)), rel=1e-9)
    for asked, error, words in (
        (lambda: four.entering(np.ones((3, 2))), ShapeError, r"vectors \(T, 4\)"),
        (lambda: four.entering(ones, np.ones((4, 2))), ShapeError, "3 samples, and .* 4"),
        (lambda: four.entering(0.1, box([-1.0, -np.inf], [1.0, 1.0])), SetError, "unbounded"),
        (lambda: four.radii(4, 1.0, ones), ShapeError, "3 samples; expected 4"),
        (lambda: four.limit(ones), OptionError, "sample by sample"),
        (lambda: four.initial([1.0, 2.0]), ShapeError, "initial_error has shape"),
        (lambda: four.initial(ones), ShapeError, "several samples"),
    ):
        with pytest.raises(error, match=words):
            asked()


# The set around the observer


@pytest.mark.parametrize("n", [1, 2, 6])
def test_no_point_of_the_set_is_farther(n):
    """With any P, whatever it is of, in any unit."""
    rng, ones = np.random.default_rng(n), 1e9 * np.ones(n)
    place = bounded_region(linear(np.eye(n), np.eye(n)), box(-ones, ones))
    for unit in np.repeat([1.0, 1e-6, 1e6], 10):
        root = rng.standard_normal((n, n)) / unit
        P, b = root @ root.T + 0.05 * np.eye(n) / unit**2, 10.0 ** rng.uniform(-3.0, 3.0)
        stated = certificates.ObserverStability(0.9, 1.0, 1.0, 1.0, 1.0, P=P, gain=np.eye(n))
        bound = certificates.ObserverBound(stated, place, Sizes(1.0, 1.0))
        offset = 10.0 ** rng.uniform(-3.0, 3.0) * unit * rng.standard_normal(n)
        e = np.vstack((rng.standard_normal((3000, n)), np.linalg.solve(P, offset), np.eye(n)))
        e *= b / plain(e, P)[:, None]
        true, found = np.linalg.norm(e + offset, axis=1).max(), float(bound.farthest(b, offset))
        reach = b / np.sqrt(np.linalg.eigvalsh(P)[0])
        assert true <= found <= (np.linalg.norm(offset) + reach) * (1.0 + 1e-5)
        assert float(bound.farthest(b, np.zeros(n))) == pytest.approx(reach, rel=1e-5)


def test_what_is_beyond_the_region_does_not_count(four):
    four, z = four[0], np.array([0.4, -0.4, 0.0, 0.0])
    np.testing.assert_array_equal(four.around(1e6, z), (-0.5 * np.ones(4), 0.5 * np.ones(4)))
    assert float(four.farthest(1e6, np.zeros(4), z)) == pytest.approx(np.sqrt(2 * 0.9**2 + 0.5))
    np.testing.assert_allclose(four.around(1e-3, z)[1] - z, 1e-3 * four.slopes, rtol=1e-9)


def test_a_bound_is_the_same_in_any_units():
    """Of one state, which makes the eigenvalues of P differ by 1e22 and more."""
    A, found = np.array([[0.9, 0.2], [-0.1, 0.7]]), []
    for unit in (1.0, 1e11, 1e-11):
        d = np.array([1.0, unit])
        bound = bound_of(
            linear(A * d[:, None] / d, [[1.0, 0.0]]), d[:, None] * [[0.4], [0.1]],
            box(-2 * d, 2 * d), box(-0.02 * d, 0.02 * d), box(-0.05, 0.05))
        found.append(bound.settled.box / d)
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=0.1)


def scalar_certificate(slope, w=0.01):
    return certify(
        linear(slope, 1.0), qpmhe.Luenberger([[max(slope - 0.5, 0.1)]]),
        unit_cost(), horizon=3, region=unit_box(1), sizes=Sizes(box(-w, w), 0.01),
    )


@pytest.mark.slow
def test_the_headline_says_whether_the_region_is_kept():
    certificate = scalar_certificate(1.5)
    points = certificate.stability.compared
    assert points > 400
    traced = f"(proved for the traced model, which agreed with f at {points} points"
    assert f"{traced}, while x stays in the region)" in certificate.headline
    words = "not proved that x stays in the region: f and the disturbances reach x1 = "
    assert words in str(certificate)
    certificate = scalar_certificate(0.8)
    assert f"{traced}), on a region 2 wide; guarded" in certificate.headline
    bound = certificate.observer_bound
    limit = bound.components(bound.limit())[0]
    assert bound.inner.region.upper[0] == pytest.approx(1.0 - limit)
    assert bound.condition.startswith("x and z stay in the region (proved) from x1 in [-0.9")
    # Where the disturbance just fits, there is no room for the observer's error.
    tight = scalar_certificate(0.8, w=0.199).observer_bound
    assert tight.condition == "x stays in the region (proved); z is checked at each sample"


def test_time_up_leaves_what_was_reached(monkeypatch):
    def late(*_, **__):
        raise certificates.OutOfTimeError("the time for this search (1 s) was too short")

    monkeypatch.setattr(certification, "certify_detectability", late)
    certificate = scalar_certificate(0.8)
    assert certificate.observer_bound.evidence is Evidence.PROVED
    assert not certificate.constants
    assert "Not certified: detectability: the time for this search" in str(certificate)


def test_a_run_of_another_model_with_the_same_gain_is_refused():
    def made(a, c):
        return qpmhe.System(lambda x: a * x, lambda x: c * x, n=1, p=1)

    def run_of(system):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.1]]), unit_cost(1, 1), horizon=3, initial_state=[0.0],
            max_qps=1,
        )
        return mhe.run(0.05 + 0.01 * np.arange(20.0)[:, None])

    bound = bound_of(made(0.8, 1.0), [[0.1]], qpmhe.Box([-2.0], [2.0]), 0.01, 0.01)
    # Another object with the same functions is the same model.
    assert bound.along(run_of(made(0.8, 1.0)), initial_error=0.1).lost is None
    for name, other in (("f", made(1.0, 1.0)), ("h", made(0.8, 1.1))):
        with pytest.raises(MismatchError, match=f"another than was certified: {name} is"):
            bound.along(run_of(other), initial_error=0.1)


def test_where_the_bound_ends_the_model_need_not_be_defined():
    """The observer leaves the domain of the root, in a run of the certified model."""
    system = qpmhe.System(lambda x: 0.5 * np.sqrt(x) + 0.3, lambda x: 1.0 * x, n=1, p=1)
    bound = bound_of(system, [[0.1]], box(0.1, 2.0), 0.01, 0.01)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.1]]), unit_cost(), horizon=3, initial_state=[0.5]
    )
    run = mhe.run(np.where(np.arange(9) == 4, -90.0, 1.0)[:, None])
    assert run.observer_states.min() < 0.0
    band = bound.along(run, initial_error=1.4)
    assert band.lost == 4
    mhe.reset()
    assert bound.along(mhe.run(np.zeros((0, 1))), initial_error=0.5).lost is None
