"""States and outputs that wrap: Jacobians, projections and bounds, and what is refused.

`tests/oracles/test_angles.py` has Ipopt's costs with angles, in sets, too.
"""

import numpy as np
import pytest

import qpmhe
from qpmhe import Box, Polytope, Status
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
PI, INF = np.pi, np.inf
NAMES = ("state_residual", "output_residual")
# A compass needle in degrees, seen directly, with a rate; its bounds lie across the seam.
NEEDLE = {"prior": np.diag([25.0, 1.0]), "disturbance": np.diag([1.0, 0.1]), "noise": [[4.0]]}
HALF = Box([170.0, -INF], [190.0, INF])
ACROSS = Box([170.0, -9.0], [190.0, 9.0])
OBSERVERS = {
    "luenberger": qpmhe.Luenberger([0.5, 0.05]),
    "injection": qpmhe.OutputInjection(lambda z, v: [0.5 * v[0], 0.05 * v[0]]),
    "extended": qpmhe.ExtendedKalman(**NEEDLE), "unscented": qpmhe.UnscentedKalman(**NEEDLE),
}


def degrees(angle):
    return (angle + 180.0) % 360.0 - 180.0


def turned(a, b):
    """Differences whose first component is an angle in degrees."""
    difference = np.array(a - b)
    difference[..., 0] = degrees(difference[..., 0])
    return difference


def compass(states=None, *, turn=0.0, residual=None, **options):
    def f(x):
        return np.stack((degrees(x[..., 0] + x[..., 1] + turn), 0.9 * x[..., 1]), axis=-1)

    angle = dict.fromkeys(NAMES, residual or qpmhe.angles(0, 360.0))
    return qpmhe.System(
        f, lambda x: degrees(x[..., :1]), n=2, p=1, states=states, **angle, **options
    )


def needle(system, observer="luenberger", start=180.0, **options):
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVERS.get(observer, observer),
        qpmhe.QuadraticCost.from_covariances(**NEEDLE), initial_state=[start, 0.0],
        **{"horizon": 6, "max_qps": 3} | options,
    )


@pytest.mark.parametrize("observer", ["injection", "extended", "unscented"])
def test_nothing_is_lost_across_the_seam(observer):
    """Beside an angle that goes on beyond half a turn."""
    def f(x):
        return np.stack((x[..., 0] + x[..., 1] + 180.0, 0.9 * x[..., 1]), axis=-1)

    options = {"candidate": "reinitialized", "arrival": "smoothed"}
    plain = needle(qpmhe.System(f, lambda x: x[..., :1], n=2, p=1), observer, **options)
    noise, t = np.random.default_rng(1).normal(0.0, 2.0, 40), np.arange(40)
    y = (180.0 + 180.0 * t + 12.0 * np.sin(0.2 * t) + noise)[:, None]
    mhe = needle(compass(turn=180.0), observer, **options)
    for t, sample in enumerate(y):
        one, other = mhe.update(degrees(sample)), plain.update(sample)
        if t % 5 == 4:
            one, other = mhe.amend(t - 1, degrees(y[t - 1])), plain.amend(t - 1, y[t - 1])
        error = one.trajectory - other.trajectory
        assert np.abs(turned(error, 0.0)).max() < 1e-6
        assert one.cost == pytest.approx(other.cost, rel=1e-6, abs=1e-12)
    np.testing.assert_allclose(mhe.covariances(), plain.covariances(), rtol=1e-6)
    assert np.abs(error[:, 0]).max() > 360.0


def test_degrees_and_turns_side_by_side():
    residual = qpmhe.angles([0, 2], period=[360.0, 1.0])
    np.testing.assert_allclose(
        residual([[359.0, 7.0, 0.9], [-170.0, 7.0, 0.2]], [1.0, -7.0, 0.1]),
        [[-2.0, 14.0, -0.2], [-171.0, 14.0, 0.1]],
    )
    for half in ([180.0, 0.0, 0.5], [-180.0, 0.0, -0.5]):
        assert residual(half, np.zeros(3)).tolist() == [-180.0, 0.0, -0.5]


def test_jacobians_do_not_see_the_jump():
    """Numerical ones at the seam and inwards from a bound there, and given ones in their check."""
    options = {"n": 1, "p": 1} | {name: qpmhe.angles([0]) for name in NAMES}
    for h in (lambda x: np.arctan2(np.sin(x), np.cos(x)), lambda x: (x + PI) % (2.0 * PI) - PI):
        given = {"h_jacobian": lambda x: [[1.0]], "f_jacobian": lambda x: [[1.0]], "scales": [1.0]}
        qpmhe.System(h, h, **options, **given).at(np.array([PI]), np.zeros(0))
        bounded = qpmhe.System(h, h, states=Box([PI - 1e-9], [PI + 0.1]), **options)
        for system, at in (
            (bounded, PI - 1e-9),
            *((qpmhe.System(h, h, **options), at) for at in (PI, -PI, 3.0 * PI, PI - 1e-7)),
        ):
            for jacobian in (system.f_jacobian, system.h_jacobian):
                found = jacobian(np.array([at]), np.zeros(0))
                np.testing.assert_allclose(found, [[1.0]], rtol=1e-6)


@pytest.mark.filterwarnings("error::qpmhe.ObserverWarning")
def test_a_state_written_in_another_turn_is_in_its_bounds():
    mhe = needle(compass(HALF), start=-175.0)
    for start in (-175.0, 185.0, 545.0):
        mhe.reset([start, 0.0])
        estimate = mhe.update([-175.0])
        assert Status.OBSERVER_PROJECTED not in estimate.status
        np.testing.assert_allclose([*estimate.trajectory[:, 0], estimate.filtered[0]], 185.0)
        assert estimate.cost < 1e-20
    # Beyond them it is not: the nearer bound.
    for start, bound in ((-160.0, 190.0), (20.0, 170.0)):
        with pytest.warns(qpmhe.ObserverWarning, match="outside of the state set"):
            mhe.reset([start, 0.0])
        assert mhe.initial_state.tolist() == [bound, 0.0]


def test_projections_and_corrections_turn_the_short_way():
    def first(y, start, gain, states=None, turn=0.0):
        options = {"observer": qpmhe.Luenberger([gain, 0.0]), "start": start, "max_qps": 0}
        return needle(compass(states, turn=turn), **options).update([y])

    # The prediction, -175 degrees, is inside; with the correction by 10 degrees it is not.
    one = first(-155.0, 185.0, 0.5, HALF)
    assert Status.OBSERVER_PROJECTED in one.status
    assert Status.PREDICTION_OUTSIDE not in one.status
    assert (one.state[0], one.disturbances[0, 0]) == (190.0, 5.0)
    # From 5 degrees over -9 to the bound at 190 the shorter way is backwards.
    assert first(157.0, 185.0, 0.5, HALF, 180.0).disturbances[0, 0] == -175.0
    # A correction by 210 degrees is one by -150.
    one = first(30.0, 0.0, 7.0)
    assert one.disturbances[0, 0] == -150.0
    assert one.cost == pytest.approx(150.0**2 + 30.0**2 / 4.0)


def test_bounds_of_a_period_and_those_that_leave_the_turn():
    for lower, upper in ((-180.0, 180.0), (0.0, 360.0)):
        assert compass(Box([lower, -INF], [upper, INF])).states is None
        partly = compass(Box([lower, -9.0], [upper, 9.0]))
        assert (partly.states.lower.tolist(), partly.turns) == ([-INF, -9.0], None)
    mhe = needle(compass(ACROSS))
    before = mhe.update([-179.0])
    for lower, upper in ((-INF, 190.0), (-20.0, 20.0), (170.0, 500.0)):
        with pytest.raises(SetError, match=r"component 0 of the states, an angle.*from 180\.0"):
            mhe.update([-179.0], bounds={"states": Box([lower, -9.0], [upper, 9.0])})
        assert np.array_equal(mhe.state, before.state)
    mhe.update([-179.0], bounds={"states": Box([-INF, -9.0], [INF, 9.0])})
    # Of W and V they do mean something.
    compass(disturbances=Box([-INF, -1.0], [1.0, 1.0]), noises=Box([-INF], [1.0]))
    for states, text in (
        (Box([-INF, -INF], [1.0, INF]), "component 0, an angle, by lower -inf and upper 1.0"),
        (Polytope([[0.0, 1.0], [2.0, 1.0]], [5.0, 5.0]), "row [01] of the matrix"),
    ):
        for residual in (None, turned):
            with pytest.raises(SetError, match=text):
                compass(states, residual=residual)
    # A snapshot is of one circle, and parameters and errors of inputs are plain beside angles.
    other = needle(compass(residual=qpmhe.angles(0, 90.0), states=None), start=0.0)
    with pytest.raises(InvalidInputError, match="another"):
        other.load_state_dict(mhe.state_dict())
    angle = {name: qpmhe.angles([0]) for name in NAMES}
    driven = qpmhe.System(lambda x, u: x + u, lambda x: x, n=1, p=1, m=1, **angle)
    for larger in (qpmhe.noisy_inputs(driven), qpmhe.augment_parameters(driven, nominal=[2.0])):
        found = larger.state_residual(np.array([[2.0 * PI + 0.5, 7.0]]), np.zeros(2))
        np.testing.assert_allclose(found, [[0.5, 7.0]], atol=1e-14)


@pytest.mark.parametrize("luck", ["raises", "stops", "shape", "nothing", "nan"])
def test_residual_functions_that_fail_at_some_calls_are_bad_luck(luck):
    rng, share = np.random.default_rng(2), 0.0

    def residual(a, b):
        if rng.random() < share:
            if luck in ("raises", "stops"):
                raise ValueError("no more") if luck == "raises" else SystemExit(1)
            return {"shape": np.zeros(3), "nothing": None}.get(luck, (a - b) * np.nan)
        return turned(a, b)

    for observer in OBSERVERS:
        options = {"candidate": "reinitialized"} if luck in ("stops", "nan") else {}
        mhe = needle(compass(HALF, residual=residual), observer, warm_start=True, **options)
        messages = []
        for t in range(50):
            share = 0.1 if 3 <= t < 35 else 0.0
            estimate = mhe.update([degrees(180.0 + 5.0 * np.sin(t))])
            assert np.isfinite(estimate.trajectory).all()
            if np.isfinite(estimate.candidate_cost):
                assert estimate.cost <= estimate.candidate_cost
            if Status.MODEL_FAILED in estimate.status:
                messages.append(estimate.message)
        assert not estimate.status & (Status.MODEL_FAILED | Status.FAILED_STAGE)
        assert luck != "raises" or any("no more" in message for message in messages)
        assert messages


RESIDUALS = [
    (lambda a, b: a - b + 0.1, ModelError, r"\[0.1, .* at a = b = .*expected zeros"),
    (lambda a, b: b - a, ModelError, "expected the same change"),
    (lambda a, b: (a - b)[:1], ModelError, r"shape \(1,\).*expected"),
    (lambda a: a, ModelError, "takes 1 positional argument.*expected the difference a - b"),
    (qpmhe.angles([7]), InvalidInputError, "names component 7"),
]


def test_angles_and_residual_functions_that_are_none():
    for residual, error, text in RESIDUALS:
        for name in NAMES:
            with pytest.raises(error, match=text) as caught:
                qpmhe.System(lambda x: x, lambda x: x, n=2, p=2, **{name: residual})
            assert name in str(caught.value)
    indices = r"indices is .*expected one or more integers >= 0"
    for error, text, *arguments in (
        *((InvalidInputError, indices, one) for one in ([], [-1], [0.5], "x")),
        (InvalidInputError, r"\[2, 0, 2\], which names a component twice", [2, 0, 2]),
        *((OptionError, "period", [0, 1], one) for one in (0.0, INF, [1.0, -2.0])),
    ):
        with pytest.raises(error, match=text):
            qpmhe.angles(*arguments)
