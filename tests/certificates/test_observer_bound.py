"""The observer's bound against adversaries, and against plain computations of the same."""

import itertools

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    Evidence,
    NotCertifiedError,
    ObserverBound,
    OutOfTimeError,
    Sizes,
    certify,
    observer_bound,
)
from qpmhe.certificates import certificate as certification
from qpmhe.certificates.regions import bounded_region
from qpmhe.certificates.sizes import lengths_of
from qpmhe.errors import InvalidInputError, OptionError, SetError, ShapeError

from .attacks import RELATIVE
from .helpers import box, linear, scalar, unit_box, unit_cost


def bound_of(system, gain, region, disturbances, noises):
    """The certified bound of a Luenberger observer."""
    return certify(
        system, qpmhe.Luenberger(gain), unit_cost(system.n, system.p), horizon=1, region=region,
        sizes=Sizes(disturbances, noises),
    ).observer_bound


def reactor():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    sizes = box([-0.1, -0.1], [0.1, 0.1]), box(-0.2, 0.2)
    return bound_of(system, observer.gain, box([2.0, 0.0], [6.0, 4.0]), *sizes), system


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


def extremes(size, dimension, rng):
    """The corners of a box, or the ends of many directions."""
    if isinstance(size, qpmhe.Box):
        return np.array(list(itertools.product(*zip(size.lower, size.upper, strict=True))))
    directions = rng.standard_normal((12, dimension))
    return size * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("made", ["reactor", "four"])
def test_no_adversary_exceeds_the_bound(made, four, pytestconfig):
    """Each takes the w and v, of all extreme ones, that take the error farthest in P."""
    bound, system = four if made == "four" else reactor()
    assert bound.evidence is Evidence.PROVED
    runs, rng = 4000 if pytestconfig.option.all else 300, np.random.default_rng(0)
    P, K, (n, p) = bound.metric, bound.gain, bound.gain.shape
    low, high = bound.region.lower[:n], bound.region.upper[:n]
    x, z = (rng.choice([0.0, 0.1, 0.5, 0.9, 1.0], (runs, n)) * (high - low) + low for _ in "xz")
    x[::7] = z[::7]  # some begin without an error: the noise alone
    pairs = list(itertools.product(
        extremes(bound.sizes.disturbance, n, rng), extremes(bound.sizes.noise, p, rng)
    ))
    u, alive = np.zeros((runs, 0)), np.ones(runs, bool)
    b = np.array([bound.initial(e) for e in x - z])
    quiet, entering, sums = b == 0.0, bound.entering(), bound.stability.sums
    paper, share = sums.initial * np.linalg.norm(x - z, axis=1), 0.0  # (eq:RGES)
    for _ in range(60):
        f, h, ahead = system.f.batch(x, u), system.h.batch(x, u), system.f.batch(z, u)
        best, chosen, added = np.full(runs, -1.0), np.array([f, ahead]), np.zeros(runs)
        for w, v in pairs:
            after, following = f + w, ahead + (h + v - system.h.batch(z, u)) @ K.T
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
    assert 0.4 < share <= 1.0 + RELATIVE
    assert bound.limit() / np.sqrt(best[alive & quiet]).max() < 4.0


def test_a_scalar_system_has_the_bound_that_one_computes_by_hand():
    bound = bound_of(linear(0.8, 1.0), [[0.3]], box(-9.0, 9.0), 0.1, 0.2)
    assert bound.entering()[0] == pytest.approx(np.sqrt(bound.metric[0, 0]) * (0.1 + 0.3 * 0.2))
    # The worst that w and v can do is 0.16 / (1 - 0.5).
    assert 0.32 <= bound.components(bound.limit())[0] <= 1.1 * 0.32
    reached = bound.components(bound.radii(1, 2.0)[1])[0]
    assert 2.0 * 0.5 + 0.16 <= reached <= 2.0 * bound.rate + 0.1601
    assert bound.components(bound.radii(0, [-2.0])[0])[0] == pytest.approx(2.0)
    # A record of the worst comes near it.
    w, v = np.full((40, 1), 0.1), np.full((40, 1), -0.2)
    found = bound.components(bound.radii(40, [2.0], w, v))[:, 0]
    true = 2.0 * 0.5 ** np.arange(41) + 0.32 * (1.0 - 0.5 ** np.arange(41))
    assert (true <= found).all()
    assert found[-1] <= 1.5 * true[-1]
    np.testing.assert_allclose(found, bound.components(bound.radii(40, 2.0))[:, 0])
    samples = bound.settling_samples
    whole = bound.radii(samples, box(-18.0, 18.0))
    assert whole[samples] <= 1.1 * bound.limit() < whole[samples - 1]


def plain(vectors, weight):
    return np.sqrt(np.einsum("...i,ij,...j->...", vectors, weight, vectors))


def test_sizes_may_be_lengths_sets_or_vectors(four):
    (four, _), rng = four, np.random.default_rng(1)
    P, Q, R, V = four.metric, four.stability.Q, four.stability.R, four.gain.T
    V = V @ P @ four.gain
    w, v = 0.02 * rng.standard_normal((50, 4)), 0.05 * rng.standard_normal((50, 2))
    vectors = four.entering(w, v)
    np.testing.assert_allclose(vectors[:, 0], plain(w, P) + plain(v, V), rtol=1e-9)
    np.testing.assert_allclose(vectors[:, 1], np.hypot(plain(w, Q), plain(v, R)), rtol=1e-9)
    boxes = [box(-side, side) for side in (np.abs(w).max(axis=0), np.abs(v).max(axis=0))]
    corners = (plain(extremes(*each, rng), M).max() for each, M in zip(
        ((boxes[0], 4), (boxes[1], 2)), (P, V), strict=True
    ))
    assert four.entering(*boxes)[0] == pytest.approx(sum(corners), rel=1e-9)
    most = max(np.linalg.norm(w, axis=1)), max(np.linalg.norm(v, axis=1))
    for larger in (four.entering(*boxes), four.entering(*most), four.entering(boxes[0], v)):
        assert (vectors <= larger).all()
    # A box with too many corners is bounded by its sides.
    side, weight = np.linspace(0.1, 0.2, 14), np.full((14, 14), -0.05) + np.eye(14)
    found = float(lengths_of("w", box(-side, side), weight))
    assert found == pytest.approx(plain(side, np.abs(weight)), rel=1e-9)
    # The system's own sets come first.
    system = scalar(disturbances=box(-0.1, 0.2), noises=box(-np.inf, np.inf))
    found = Sizes.usual(system, np.eye(1), 4.0 * np.eye(1), "the data")
    assert str(found) == (
        "w in [-0.1, 0.2], |v| <= 6 (the system's W and three standard deviations of the data)"
    )
    assert found.largest == pytest.approx((0.2, 6.0))


def test_sizes_that_do_not_fit_are_named(four):
    four, ones = four[0], np.ones((3, 4))
    for asked, error, words in (
        (lambda: Sizes(noise=-1.0), OptionError, "noise is"),
        (lambda: four.entering(-1.0), OptionError, "disturbances is -1"),
        (lambda: four.entering(np.ones((3, 2))), ShapeError, r"vectors \(T, 4\)"),
        (lambda: four.entering(ones, np.ones((4, 2))), ShapeError, "3 samples, and .* 4"),
        (lambda: four.entering(box(-1.0, 1.0)), ShapeError, "dimension 1"),
        (lambda: four.entering(0.1, box([-1.0, -np.inf], [1.0, 1.0])), SetError, "unbounded"),
        (lambda: four.radii(4, 1.0, ones), ShapeError, "3 samples; expected 4"),
        (lambda: four.limit(ones), OptionError, "sample by sample"),
        (lambda: four.initial([1.0, 2.0]), ShapeError, "initial_error has shape"),
        (lambda: four.initial(ones), ShapeError, "several samples"),
        (lambda: four.initial(np.nan), InvalidInputError, "initial_error"),
    ):
        with pytest.raises(error, match=words):
            asked()


# The set around the observer


def random_bound(rng, n, unit=1.0):
    """A bound with any P, whatever it is of."""
    root = rng.standard_normal((n, n))

    class Stability:
        rho, V, gain, evidence = 0.9, np.eye(1), np.ones((n, 1)), Evidence.PROVED
        P = (root @ root.T + 0.05 * np.eye(n)) / unit**2

    whole = bounded_region(linear(np.eye(n), np.eye(n)), box(-1e9 * np.ones(n), 1e9 * np.ones(n)))
    return ObserverBound(Stability(), whole, Sizes(1.0, 1.0))


@pytest.mark.parametrize("n", [1, 2, 6])
def test_no_point_of_the_set_is_farther(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        bound, b = random_bound(rng, n), 10.0 ** rng.uniform(-3.0, 3.0)
        offset = 10.0 ** rng.uniform(-3.0, 3.0) * rng.standard_normal(n)
        e = np.vstack((np.eye(n), rng.standard_normal((60, n))))
        for _ in range(50):  # to the next point that maximises the linearised distance
            direction = np.linalg.solve(bound.metric, (e - offset).T).T
            e = b * direction / plain(direction, bound.metric)[:, None]
        true, found = np.linalg.norm(e - offset, axis=1).max(), float(bound.farthest(b, offset))
        reach = b / np.sqrt(np.linalg.eigvalsh(bound.metric)[0])
        assert true <= found <= (np.linalg.norm(offset) + reach) * (1.0 + 1e-5)
        assert float(bound.farthest(b, np.zeros(n))) == pytest.approx(reach, rel=1e-5)
        assert float(bound.farthest(0.0, offset)) == pytest.approx(np.linalg.norm(offset))
    for unit in (1e-9, 1e9):
        one, other = (random_bound(np.random.default_rng(7), n, each) for each in (1.0, unit))
        found = float(other.farthest(0.3, unit * np.ones(n)))
        assert found == pytest.approx(unit * float(one.farthest(0.3, np.ones(n))), rel=1e-9)


def test_what_is_beyond_the_region_does_not_count(four):
    four, z, far = four[0], np.array([0.4, -0.4, 0.0, 0.0]), 1e6
    np.testing.assert_array_equal(four.around(far, z), (-0.5 * np.ones(4), 0.5 * np.ones(4)))
    assert float(four.farthest(far, np.zeros(4), z)) == pytest.approx(np.sqrt(2 * 0.9**2 + 0.5))
    np.testing.assert_allclose(four.around(1e-3, z)[1] - z, 1e-3 * four.slopes, rtol=1e-9)


# What the headline rests on


def scalar_certificate(slope, w=0.01):
    return certify(
        linear(slope, 1.0), qpmhe.Luenberger([[max(slope - 0.5, 0.1)]]),
        unit_cost(), horizon=3, region=unit_box(1), sizes=Sizes(box(-w, w), 0.01),
    )


def test_the_headline_says_whether_the_region_is_kept():
    certificate = scalar_certificate(1.5)
    assert "(proved while x stays in the region)" in certificate.headline
    text = str(certificate)
    assert "not proved that x stays in the region: f and the disturbances reach x1 = " in text
    assert "1.51 through the face" in text
    assert certificate.observer_bound.inner is None
    assert certificate.to_dict()["observer_bound"]["invariance"]["holds"] is False
    certificate = scalar_certificate(0.8)
    assert "(proved), on a region 2 wide" in certificate.headline
    bound = certificate.observer_bound
    low, high = bound.inner.region.lower[0], bound.inner.region.upper[0]
    limit = bound.components(bound.limit())[0]
    assert (low, high) == pytest.approx((limit - 1.0, 1.0 - limit))
    assert bound.condition.startswith("x and z stay in the region (proved) from x1 in [-0.9")
    # Where the disturbance just fits, there is no room for the observer's error.
    tight = scalar_certificate(0.8, w=0.199).observer_bound
    assert tight.inner is None
    assert tight.condition == "x stays in the region (proved); z is checked at each sample"


def test_time_up_leaves_what_was_reached(monkeypatch):
    def late(*_, **__):
        raise OutOfTimeError("the time for this search (1 s) was too short", ("more seconds",))

    monkeypatch.setattr(certification, "certify_detectability", late)
    certificate = scalar_certificate(0.8)
    assert certificate.observer_bound.evidence is Evidence.PROVED
    assert not certificate.constants
    assert "Not certified: detectability: the time for this search" in str(certificate)
    monkeypatch.setattr(observer_bound, "certify_observer", late)
    with pytest.raises(OutOfTimeError, match="more seconds"):
        scalar_certificate(0.8)
    for ending in ("", "."):
        error = NotCertifiedError(f"f may jump there{ending}", ("a smaller region",))
        assert str(error) == "f may jump there. What may help: a smaller region."
        assert error.finding == "f may jump there"
