"""The observer's bound against adversaries, and against plain computations of the same."""

import itertools
from functools import cache

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    ObserverBound,
    Sizes,
    certify,
    certify_observer,
    observer_bound,
)
from qpmhe.certificates import certificate as certification
from qpmhe.certificates.evidence import Evidence, NotCertifiedError, OutOfTimeError
from qpmhe.certificates.regions import bounded_region
from qpmhe.errors import OptionError, SetError, ShapeError

STEPS = 60
ONES = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)


def bound_of(system, gain, region, disturbances, noises, metric=None):
    """The certified bound of a Luenberger observer, its gain found where none is given."""
    place = bounded_region(system, region)
    stability = certify_observer(system, qpmhe.Luenberger(gain, metric), place)
    return ObserverBound(stability, place, Sizes(disturbances, noises), metric)


@cache
def reactor():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    return bound_of(
        system, observer.gain, qpmhe.Box([2.0, 0.0], [6.0, 4.0]),
        qpmhe.Box([-0.1, -0.1], [0.1, 0.1]), qpmhe.Box([-0.2], [0.2]),
    ), system


@cache
def fitzhugh_nagumo():
    """A neuron whose membrane is measured, sampled by Euler's method."""
    def f(x):
        v, r = x[..., 0], x[..., 1]
        return np.stack([
            v + 0.1 * (v - v**3 / 3.0 - r), r + 0.1 * 0.5 * (v + 0.7 - 0.8 * r)
        ], axis=-1)

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    return bound_of(
        system, [[0.35], [0.1]], qpmhe.Box([-2.2, -1.5], [2.2, 2.0]), 0.02, 0.02,
    ), system


@cache
def coupled():
    """Four states in a row, with a sine at its first; the outer ones are measured."""
    A = 0.6 * np.eye(4) + 0.1 * np.eye(4, k=1) + 0.1 * np.eye(4, k=-1)
    system = qpmhe.System(
        lambda x: x @ A.T + 0.1 * np.sin(x[..., :1]) * np.eye(4)[0], lambda x: x[..., [0, 3]],
        n=4, p=2,
    )
    K = np.zeros((4, 2))
    K[0, 0] = K[3, 1] = 0.3
    half = np.full(4, 0.005)
    return bound_of(
        system, K, qpmhe.Box(-0.5 * np.ones(4), 0.5 * np.ones(4)), qpmhe.Box(-half, half), 0.01
    ), system


def candidates(size, dimension, rng):
    """Extreme values: the corners of a box, or the ends of many directions."""
    if isinstance(size, qpmhe.Box):
        sides = zip(size.lower, size.upper, strict=True)
        return np.array(list(itertools.product(*sides)))
    directions = rng.standard_normal((12, dimension))
    return size * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("runs", [300, pytest.param(4000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("made", [reactor, fitzhugh_nagumo, coupled])
def test_no_adversary_exceeds_the_bound(made, runs, capsys):
    """Each takes the w and v, of all extreme ones, that take the error farthest in P."""
    bound, system = made()
    assert bound.evidence is Evidence.PROVED
    rng, P, K = np.random.default_rng(0), bound.metric, bound.gain
    n, p = K.shape
    low, high = bound.region.lower[:n], bound.region.upper[:n]
    x, z = (rng.choice([0.0, 0.1, 0.5, 0.9, 1.0], (runs, n)) * (high - low) + low for _ in "xz")
    x[::7] = z[::7]  # some begin without an error: the noise alone
    pairs = list(itertools.product(
        candidates(bound.sizes.disturbance, n, rng), candidates(bound.sizes.noise, p, rng)
    ))
    u, alive = np.zeros((runs, 0)), np.ones(runs, bool)
    b = np.array([bound.initial(e) for e in x - z])
    quiet, entering = b == 0.0, bound.entering()
    worst, tightest = 0.0, np.inf
    for t in range(STEPS):
        f, h = system.f.batch(x, u), system.h.batch(x, u)
        ahead = system.f.batch(z, u)
        best, chosen = np.full(runs, -1.0), None
        for w, v in pairs:
            after = f + w
            following = ahead + (h + v - system.h.batch(z, u)) @ K.T
            e = after - following
            size = np.einsum("ti,ij,tj->t", e, P, e)
            size[~bound.region.contains(after)] = -1.0
            better = size > best
            if chosen is None:
                chosen = after.copy(), following.copy()
            for old, new in zip(chosen, (after, following), strict=True):
                old[better] = new[better]
            best = np.where(better, size, best)
        alive &= (best >= 0.0) & bound.region.contains(z)
        x, z = chosen
        b = np.array([bound.advanced(each, entering) for each in b])
        x[~alive] = z[~alive] = 0.5 * (low + high)  # those that left are counted no more
        e, keep = x - z, alive
        assert np.all(bound.length(e[keep]) * (1.0 - 1e-12) <= b[keep])
        assert np.all(np.abs(e[keep]) <= bound.components(b[keep]))
        inside = keep & bound.region.contains(x)
        lower, upper = bound.around(b[inside], z[inside])
        assert np.all((lower <= x[inside]) & (x[inside] <= upper))
        # Any estimate at all beside it.
        other = rng.uniform(low, high, x.shape)[inside]
        far = bound.farthest(b[inside], other - z[inside], z[inside])
        assert np.all(np.linalg.norm(other - x[inside], axis=1) <= far)
        lengths = np.linalg.norm(e, axis=1)
        worst = max(worst, float(lengths[keep].max(initial=0.0)))
        if t == STEPS - 1:
            tightest = bound.limit() / np.sqrt(best[keep & quiet]).max()
    assert alive.mean() > 0.2
    with capsys.disabled():
        print(
            f"\n{made.__name__}: {alive.sum()} of {runs} runs stay; in the limit the bound is "
            f"{tightest:.2f} times the worst error"
        )
    assert tightest < 4.0


# Sizes


def scalar(disturbance=0.1, noise=0.2, side=9.0):
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=1, p=1)
    return bound_of(system, [[0.3]], qpmhe.Box([-side], [side]), disturbance, noise)


def test_a_scalar_system_has_the_bound_that_one_computes_by_hand():
    bound = scalar()
    scale = float(np.sqrt(bound.metric[0, 0]))
    assert float(bound.entering().length) == pytest.approx(scale * (0.1 + 0.3 * 0.2))
    # The worst that w and v can do is 0.16 / (1 - 0.5).
    assert 0.32 <= bound.components(bound.limit())[0] <= 1.1 * 0.32
    reached = bound.components(bound.radii(1, 2.0)[1])[0]
    assert 2.0 * 0.5 + 0.16 <= reached <= 2.0 * bound.rate + 0.1601
    assert bound.components(bound.radii(0, [-2.0])[0])[0] == pytest.approx(2.0)
    # With one sign of each, the worst of both is no sum of the worst.
    box = scalar(qpmhe.Box([0.0], [0.1]), qpmhe.Box([0.0], [0.2]))
    scale = float(np.sqrt(box.metric[0, 0]))
    assert float(box.entering().length) == pytest.approx(scale * 0.1)


@pytest.fixture(scope="module")
def four():
    return coupled()[0]


def plain(vectors, weight):
    return np.sqrt(np.einsum("...i,ij,...j->...", vectors, weight, vectors))


def test_sizes_may_be_lengths_sets_or_vectors(four):
    rng, P, K = np.random.default_rng(1), four.metric, four.gain
    w, v = 0.02 * rng.standard_normal((50, 4)), 0.05 * rng.standard_normal((50, 2))
    vectors = four.entering(w, v).length
    np.testing.assert_allclose(vectors, plain(w - v @ K.T, P), rtol=1e-12)
    lengths = four.entering(np.linalg.norm(w, axis=1), np.linalg.norm(v, axis=1)).length
    assert (vectors <= lengths).all()
    most = max(np.linalg.norm(w, axis=1)), max(np.linalg.norm(v, axis=1))
    assert lengths.max() <= float(four.entering(*most).length)
    sides = np.abs(w).max(axis=0), np.abs(v).max(axis=0)
    boxes = [qpmhe.Box(-side, side) for side in sides]
    corners = [
        plain(np.array(a) * sides[0] - (np.array(c) * sides[1]) @ K.T, P)
        for a in itertools.product((-1, 1), repeat=4) for c in itertools.product((-1, 1), repeat=2)
    ]
    assert float(four.entering(*boxes).length) == pytest.approx(max(corners), rel=1e-12)
    mixed = four.entering(boxes[0], v).length
    assert mixed.shape == (50,)
    assert (vectors <= mixed).all()


def test_boxes_with_too_many_corners_are_bounded_by_their_sides():
    n = 14
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: x[..., :1], n=n, p=1)
    side = np.linspace(0.1, 0.2, n)
    bound = bound_of(
        system, np.zeros((n, 1)), qpmhe.Box(-np.ones(n), np.ones(n)), qpmhe.Box(-side, side), 0.0
    )
    found = float(bound.entering().length)
    assert found >= plain(side, bound.metric) * (1.0 - 1e-12)
    assert found <= plain(side, np.abs(bound.metric)) * (1.0 + 1e-9)


def test_the_systems_own_sets_come_first_and_are_named():
    sets = {"disturbances": qpmhe.Box([-0.1], [0.2]), "noises": qpmhe.Box([-np.inf], [np.inf])}
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=1, p=1, **sets)
    found = Sizes.usual(system, np.eye(1), 4.0 * np.eye(1), "the data")
    assert found.disturbance is sets["disturbances"]
    assert found.noise.upper == pytest.approx([6.0])
    assert str(found) == (
        "w in [-0.1, 0.2], |v| <= 6 (the system's W and three standard deviations of the data)"
    )
    assert found.largest == pytest.approx((0.2, 6.0))


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"disturbances": -1.0}, OptionError, "disturbances"),
        ({"disturbances": [0.1, -0.1]}, OptionError, "disturbances"),
        ({"disturbances": np.ones((3, 2))}, ShapeError, r"vectors \(T, 4\)"),
        ({"noises": np.ones((3, 3, 2))}, ShapeError, "noises"),
        ({"disturbances": np.ones(3), "noises": np.ones(4)}, ShapeError, "3 samples, and .* 4"),
        ({"disturbances": qpmhe.Box([-1.0], [1.0])}, ShapeError, "dimension 1"),
        ({"noises": qpmhe.Box([-1.0, -np.inf], [1.0, 1.0])}, SetError, "unbounded"),
    ],
)
def test_sizes_that_do_not_fit_are_named(four, arguments, error, words):
    with pytest.raises(error, match=words):
        four.entering(**arguments)


def test_initial_errors_that_do_not_fit_are_named(four):
    for wrong, words in (([1.0, 2.0], "shape"), (-1.0, "initial_error"), (np.nan, "initial_error")):
        with pytest.raises((ShapeError, OptionError, qpmhe.errors.InvalidInputError), match=words):
            four.initial(wrong)


# The set around the observer


def random_bound(rng, n, units=1.0):
    """A bound with any P, whatever it is of."""
    root = rng.standard_normal((n, n))
    P = (root @ root.T + 0.05 * np.eye(n)) / np.outer(units, units) * np.ones((n, n))

    class Stability:
        rho, V, gain, evidence = 0.9, np.eye(1), np.ones((n, 1)), Evidence.PROVED

    Stability.P = P
    whole = qpmhe.Box(-1e9 * np.ones(n), 1e9 * np.ones(n))
    system = qpmhe.System(lambda x: x, lambda x: x[..., :1], n=n, p=1)
    return ObserverBound(Stability(), bounded_region(system, whole), Sizes(1.0, 1.0))


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_farthest_point_is_that_of_the_ellipsoid(n):
    rng = np.random.default_rng(n)
    for case in range(40):
        bound = random_bound(rng, n)
        roots = np.linalg.cholesky(bound.metric)
        b, offset = 10.0 ** rng.uniform(-3.0, 3.0), rng.standard_normal(n)
        if case % 4 == 0:  # across the longest axis, where the multiplier is at its limit
            vectors = np.linalg.eigh(bound.metric)[1]
            offset -= vectors[:, 0] * (vectors[:, 0] @ offset)
        found = float(bound.farthest(b, offset))
        # From many starts, to the next point that maximises the linearised distance.
        e = rng.standard_normal((60, n))
        for _ in range(300):
            direction = np.linalg.solve(bound.metric, (e - offset).T).T
            e = b * direction / plain(direction, bound.metric)[:, None]
        true = np.linalg.norm(e - offset, axis=1).max()
        assert true <= found * (1.0 + 1e-12)
        assert found <= true * (1.0 + 1e-4)
        reach = b / np.sqrt(np.linalg.eigvalsh(bound.metric)[0])
        assert found <= (np.linalg.norm(offset) + reach) * (1.0 + 1e-5)
        assert bound.length(np.linalg.solve(roots.T, np.eye(n)).T) == pytest.approx(1.0)


def test_without_an_error_or_an_offset_it_is_the_other():
    bound = random_bound(np.random.default_rng(5), 3)
    longest = 1.0 / np.sqrt(np.linalg.eigvalsh(bound.metric)[0])
    assert float(bound.farthest(2.0, np.zeros(3))) == pytest.approx(2.0 * longest, rel=1e-6)
    assert float(bound.farthest(0.0, [3.0, 0.0, 4.0])) == pytest.approx(5.0)
    assert float(bound.farthest(0.0, np.zeros(3))) == 0.0
    assert np.isnan(bound.farthest(np.nan, np.ones(3)))
    several = bound.farthest(np.array([0.0, 1.0]), np.ones((2, 3)))
    assert several[1] == float(bound.farthest(1.0, np.ones(3)))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_units_change_numbers_alone(unit):
    units = np.array([1.0, unit, 1.0])
    one, other = (random_bound(np.random.default_rng(7), 3, each) for each in (1.0, units))
    np.testing.assert_allclose(other.slopes, one.slopes * units, rtol=1e-9)
    one, other = (random_bound(np.random.default_rng(7), 3, each) for each in (1.0, unit))
    found = float(other.farthest(0.3, unit * np.ones(3)))
    assert found == pytest.approx(unit * float(one.farthest(0.3, np.ones(3))), rel=1e-9)


def test_what_is_beyond_the_region_does_not_count(four):
    z, far = np.array([0.4, -0.4, 0.0, 0.0]), 1e6
    lower, upper = four.around(far, z)
    np.testing.assert_array_equal((lower, upper), (-0.5 * np.ones(4), 0.5 * np.ones(4)))
    assert float(four.farthest(far, np.zeros(4), z)) == pytest.approx(np.sqrt(2 * 0.9**2 + 0.5))
    lower, upper = four.around(1e-3, z)
    np.testing.assert_allclose(0.5 * (lower + upper), z, atol=1e-12)
    np.testing.assert_allclose(upper - z, 1e-3 * four.slopes, rtol=1e-9)


# Certificates that have nothing else


def test_a_cost_without_constants_leaves_the_observers_bound():
    system = qpmhe.System(
        lambda x: 0.8 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-9.0], [9.0])
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0, discount=0.9)
    certificate = certify(system, qpmhe.Luenberger([[0.3]]), cost, horizon=3)
    assert certificate.holds
    assert not certificate.constants
    assert list(certificate.errors) == ["the theorem"]
    limit = certificate.observer_bound.components(certificate.observer_bound.limit())[0]
    assert 7.8 <= limit <= 1.05 * 7.8
    assert certificate.headline.startswith(f"|x1 - z1| <= {limit:.2g} after ")
    assert "Not certified: the theorem: the cost has no constants" in certificate.summary()
    with pytest.raises(OptionError, match=r"could not be certified.*discount"):
        certificate.of()


def test_an_undetectable_part_leaves_nothing_to_bound():
    system = qpmhe.System(
        lambda x: x * np.array([0.5, 1.2]), lambda x: x[..., :1], n=2, p=1,
        states=qpmhe.Box([-1.0, -1.0], [1.0, 1.0]),
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    with pytest.raises(NotCertifiedError, match=r"eigenvalue 1\.2"):
        certify(system, qpmhe.Luenberger([[0.1], [0.0]]), cost, horizon=3)


def test_a_record_of_the_worst_comes_near_the_bound():
    bound = scalar(0.1, 0.2, 90.0)
    w, v = np.full((40, 1), 0.1), np.full((40, 1), -0.2)
    found = bound.components(bound.radii(40, [2.0], w, v))[:, 0]
    true = 2.0 * 0.5 ** np.arange(41) + 0.16 * np.array(
        [sum(0.5**k for k in range(t)) for t in range(41)]
    )
    assert (true <= found).all()
    assert found[0] == pytest.approx(2.0)
    assert found[-1] <= 1.5 * true[-1]
    always = bound.components(bound.radii(400, 2.0))[:, 0]
    assert (found <= always[:41] * (1.0 + 1e-9)).all()
    assert bound.components(bound.limit())[0] == pytest.approx(always[-1])
    wide = bound.settling_samples
    whole = bound.radii(wide, qpmhe.Box([-180.0], [180.0]))
    assert whole[wide] <= 1.1 * bound.limit() < whole[wide - 1]
    with pytest.raises(ShapeError, match="40 samples; expected 39"):
        bound.radii(39, 2.0, w, v)
    with pytest.raises(OptionError, match="of single samples"):
        bound.limit(w, v)


# What the headline rests on


def scalar_certificate(slope, region=1.0, w=0.01):
    system = qpmhe.System(lambda x: slope * x, lambda x: x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    return certify(
        system, qpmhe.Luenberger([[max(slope - 0.5, 0.1)]]), cost, horizon=3,
        region=qpmhe.Box([-region], [region]), sizes=Sizes(qpmhe.Box([-w], [w]), 0.01),
    )


def test_a_region_that_the_state_leaves_is_said_first():
    certificate = scalar_certificate(1.5)
    assert "(proved while x stays in the region)" in certificate.headline
    text = certificate.summary()
    assert "not proved: f and the disturbances reach x1 = " in text
    assert "1.51 through the face" in text
    assert certificate.observer_bound.inner is None
    told = certificate.to_dict()["observer_bound"]
    assert told["invariance"]["holds"] is False
    assert told["invariance"]["reach"] == pytest.approx(1.51)


def test_a_region_that_is_kept_is_said_and_the_observer_with_it():
    certificate = scalar_certificate(0.8)
    assert "(proved), on a region 2 wide" in certificate.headline
    bound = certificate.observer_bound
    assert bound.invariance.holds
    low, high = bound.inner.region.lower[0], bound.inner.region.upper[0]
    limit = bound.components(bound.limit())[0]
    assert (low, high) == pytest.approx((limit - 1.0, 1.0 - limit))
    assert bound.condition.startswith("x and z stay in the region: proved from x1 in [-0.9")
    # Where the disturbance just fits, there is no room for the observer's error.
    tight = scalar_certificate(0.8, w=0.199).observer_bound
    assert tight.invariance.holds
    assert tight.inner is None
    assert "that z does is checked at each sample" in tight.condition



def test_time_up_leaves_what_was_reached(monkeypatch):
    def late(*_, **__):
        raise OutOfTimeError("the time for this search (1 s) was too short", ("more seconds",))

    monkeypatch.setattr(certification, "certify_detectability", late)
    certificate = scalar_certificate(0.8)
    assert certificate.observer_bound.evidence is Evidence.PROVED
    assert isinstance(certificate.errors["detectability"], OutOfTimeError)
    assert not certificate.constants
    assert "Not certified: detectability: the time for this search" in certificate.summary()
    monkeypatch.setattr(observer_bound, "certify_observer", late)
    with pytest.raises(OutOfTimeError, match="more seconds"):
        scalar_certificate(0.8)


def test_time_up_names_no_time_that_nobody_gave():
    system = qpmhe.System(lambda x: 0.8 * x, lambda x: x, n=1, p=1)
    region = qpmhe.Box([-1.0], [1.0])
    with pytest.raises(OutOfTimeError, match=r"no time was left for this search: .*; a smaller"):
        certify(
            system, qpmhe.Luenberger([[0.1]]), ONES, horizon=4,
            region=region, seconds=1e-9,
        )


def test_what_may_help_is_a_sentence_of_its_own():
    for ending in ("", "."):
        error = NotCertifiedError(f"f may jump there{ending}", ("a smaller region",))
        assert str(error) == "f may jump there. What may help: a smaller region."
        assert error.finding == "f may jump there"
