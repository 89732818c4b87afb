import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError


def spd(generator, n):
    root = generator.standard_normal((n, n))
    return root @ root.T + 0.5 * np.eye(n)


def linear_system(a, c, b=None):
    if b is None:
        return qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=len(a), p=len(c))
    return qpmhe.System(
        lambda x, u: x @ a.T + u @ b.T, lambda x: x @ c.T, n=len(a), p=len(c), m=b.shape[1]
    )


def observer_alone(system, observer, start, **options):
    n, p = system.n, system.p
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=np.eye(p))
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, initial_state=start, max_qps=0, **{"horizon": 3, **options}
    )


# Luenberger


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (3, 2), (2, 3)])
def test_kappa_is_the_least_bound_of_the_correction(shape):
    generator = np.random.default_rng(1)
    observer = qpmhe.Luenberger(generator.standard_normal(shape))
    n, p = shape
    sample = qpmhe.Sample(linear_system(np.eye(n), np.ones((p, n))), np.zeros(0))
    ratios = []
    for _ in range(2000):
        v = generator.standard_normal(p)
        correction, covariance = observer.correct(np.zeros(n), v, sample)
        assert covariance is None
        ratios.append(np.linalg.norm(correction) / np.linalg.norm(v))
    assert max(ratios) <= observer.kappa * (1 + 1e-12)
    worst = np.linalg.svd(observer.gain)[2][0]
    correction, _ = observer.correct(np.zeros(n), worst, sample)
    assert np.linalg.norm(correction) == pytest.approx(observer.kappa, rel=1e-12)


@pytest.mark.parametrize(
    ("gain", "shape"),
    [
        (0.3, (1, 1)),
        ([0.3], (1, 1)),
        ([[0.3]], (1, 1)),
        ([0.3, 0.1], (2, 1)),
        ([[0.3], [0.1]], (2, 1)),
        ([[0.3, 0.2]], (1, 2)),
        (np.ones((3, 2), dtype=int), (3, 2)),
    ],
    ids=str,
)
def test_gain_shapes(gain, shape):
    n, p = shape
    observer = qpmhe.Luenberger(gain)
    assert observer.gain.shape == shape
    mhe = observer_alone(linear_system(0.5 * np.eye(n), np.ones((p, n))), observer, np.zeros(n))
    y = np.arange(1.0, p + 1.0)
    expected = np.array(gain, dtype=float).reshape(shape) @ y
    np.testing.assert_allclose(mhe.update(y).state, expected, rtol=1e-15)


def test_the_gain_is_a_copy():
    gain = np.array([[0.3], [0.1]])
    observer = qpmhe.Luenberger(gain)
    gain[0, 0] = 9.0
    assert observer.gain[0, 0] == 0.3


# Output injection


def injection_case(correction, start=(1.0, -2.0)):
    system = linear_system(0.5 * np.eye(2), np.eye(2))
    return observer_alone(system, qpmhe.OutputInjection(correction), start)


@pytest.mark.parametrize(
    ("correction", "value"),
    [
        pytest.param(lambda z, v: v + 1e-9, "1e-09", id="offset"),
        pytest.param(lambda z, v: v + 0.01 * z, "0.01", id="of the state"),
        pytest.param(lambda z, v: np.array([v[0], z[0] - 1.0]), "[0.0, ", id="not at the start"),
        pytest.param(lambda z, v: v / np.linalg.norm(v), "nan", id="undefined at zero"),
        pytest.param(lambda z, v: np.array([np.inf, 0.0]), "inf", id="infinite"),
    ],
)
def test_a_correction_that_does_not_vanish_is_refused(correction, value):
    with pytest.raises(ModelError) as caught:
        injection_case(correction)
    text = str(caught.value)
    assert value in text
    assert "L(z, 0) = 0" in text


@pytest.mark.parametrize(
    ("correction", "shape"),
    [
        pytest.param(lambda z, v: 0.1 * v[:1], "(1,)", id="short"),
        pytest.param(lambda z, v: 0.1 * v[:, None], "(2, 1)", id="column"),
        pytest.param(lambda z, v: 0.1 * v[0], "()", id="scalar"),
    ],
)
def test_a_correction_of_the_wrong_shape_is_refused(correction, shape):
    with pytest.raises(ModelError) as caught:
        injection_case(correction)
    assert f"correction returned shape {shape}" in str(caught.value)
    assert "(2,)" in str(caught.value)


def test_a_correction_that_raises_is_refused():
    def correction(z, v):
        raise ZeroDivisionError("no luck")

    with pytest.raises(ModelError, match=r"ZeroDivisionError: no luck at z = \[1.0, -2.0\]"):
        injection_case(correction)


def test_a_correction_that_is_no_function_is_refused():
    with pytest.raises(ModelError, match=r"correction is 0.3; expected a function"):
        qpmhe.OutputInjection(0.3)


@pytest.mark.parametrize("which", ["z", "v"])
def test_a_correction_that_changes_its_argument_is_refused(which):
    def correction(z, v):
        written = z if which == "z" else v
        written *= 0.5
        return 0.1 * v

    with pytest.raises(ModelError, match="in place"):
        injection_case(correction)


@pytest.mark.parametrize(
    "correction",
    [
        pytest.param(lambda z, v: np.array([0.1 * v[0] - v[1], 0.3 * v[1]]), id="array"),
        pytest.param(lambda z, v: [0.1 * v[0] - v[1], 0.3 * v[1]], id="list"),
        pytest.param(lambda z, v: np.array([[0.1, -1.0], [0.0, 0.3]]) @ v, id="matrix"),
    ],
)
def test_a_linear_correction_equals_luenberger(correction):
    system = linear_system(0.5 * np.eye(2), np.eye(2))
    gain = qpmhe.Luenberger([[0.1, -1.0], [0.0, 0.3]])
    ys = np.random.default_rng(2).standard_normal((20, 2))
    runs = [
        observer_alone(system, observer, [1.0, -2.0]).run(ys)
        for observer in (gain, qpmhe.OutputInjection(correction))
    ]
    np.testing.assert_allclose(runs[0].states, runs[1].states, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(runs[0].costs, runs[1].costs, rtol=1e-13)


def test_a_nonlinear_correction_drives_the_observer():
    def correction(z, v):
        return 0.1 * np.tanh(v) * (1.0 + z**2)

    mhe = injection_case(correction)
    z = np.array([1.0, -2.0])
    for y in np.random.default_rng(3).uniform(-1.0, 1.0, (10, 2)):
        z = 0.5 * z + 0.1 * np.tanh(y - z) * (1.0 + z**2)
        np.testing.assert_allclose(mhe.update(y).state, z, rtol=1e-13)


# Extended Kalman


def kalman_predictor(a, c, prior, q, r, start, ys, drive):
    """Textbook filter in measurement and time update; rows of y may be NaN in part."""
    x, covariance, states, covariances = np.array(start), prior, [np.array(start)], [prior]
    for y, shift in zip(ys, drive, strict=True):
        there = ~np.isnan(y)
        if there.any():
            cy, ry = c[there], r[np.ix_(there, there)]
            gain = covariance @ cy.T @ np.linalg.inv(cy @ covariance @ cy.T + ry)
            x = x + gain @ (y[there] - cy @ x)
            rest = np.eye(len(x)) - gain @ cy
            covariance = rest @ covariance @ rest.T + gain @ ry @ gain.T
        x, covariance = a @ x + shift, a @ covariance @ a.T + q
        states.append(x)
        covariances.append(covariance)
    return np.array(states), np.array(covariances)


@pytest.mark.parametrize("missing", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("n", "p", "m"), [(1, 1, 0), (2, 1, 0), (3, 2, 0), (2, 3, 1), (4, 2, 2)])
def test_extended_kalman_is_the_kalman_predictor_on_linear_systems(n, p, m, missing):
    generator = np.random.default_rng(10 * n + p)
    a = generator.standard_normal((n, n))
    a /= 1.05 * np.abs(np.linalg.eigvals(a)).max()
    c, b = generator.standard_normal((p, n)), generator.standard_normal((n, m))
    prior, q, r = spd(generator, n), spd(generator, n), spd(generator, p)
    start = generator.standard_normal(n)
    ys, us = generator.standard_normal((40, p)), generator.standard_normal((40, m))
    ys[generator.random((40, p)) < missing] = np.nan
    states, covariances = kalman_predictor(a, c, prior, q, r, start, ys, us @ b.T)

    observer = qpmhe.ExtendedKalman(prior=prior, disturbance=q, noise=r)
    system = linear_system(a, c, b if m else None)
    run = observer_alone(system, observer, start).run(ys, us if m else None)
    np.testing.assert_allclose(run.states, states, rtol=1e-9, atol=1e-10)

    covariance = observer.initial_covariance()
    for t, y in enumerate(ys):
        there = ~np.isnan(y)
        sample = qpmhe.Sample(
            system, us[t], f_jacobian=a, h_jacobian=c,
            observed=None if there.all() else there, covariance=covariance,
        )
        _, covariance = observer.correct(
            states[t], np.where(there, y - c @ states[t], 0.0), sample
        )
        np.testing.assert_allclose(covariance, covariances[t + 1], rtol=1e-9, atol=1e-10)


def test_extended_kalman_linearises_at_its_own_state():
    system = qpmhe.System(
        lambda x: np.stack([x[..., 0] * x[..., 1], np.sin(x[..., 0])], axis=-1),
        lambda x: x[..., :1] ** 2, n=2, p=1,
    )
    prior, q, r = np.array([[2.0, 0.3], [0.3, 1.0]]), 0.1 * np.eye(2), np.array([[0.5]])
    observer = qpmhe.ExtendedKalman(prior=prior, disturbance=q, noise=r)
    mhe = observer_alone(system, observer, [1.2, 0.7])
    z, covariance = np.array([1.2, 0.7]), prior
    for y in (1.0, 1.5, 0.3, 0.8):
        a = np.array([[z[1], z[0]], [np.cos(z[0]), 0.0]])
        c = np.array([[2.0 * z[0], 0.0]])
        spread = c @ covariance @ c.T + r
        gain = a @ covariance @ c.T / spread
        z = np.array([z[0] * z[1], np.sin(z[0])]) + gain[:, 0] * (y - z[0] ** 2)
        covariance = a @ covariance @ a.T + q - spread * gain @ gain.T
        np.testing.assert_allclose(mhe.update([y]).state, z, rtol=1e-11)


@pytest.mark.parametrize(
    ("prior", "disturbance", "noise"),
    [(1.0, 1e-2, 1e-2), (1e-6, 1.0, 1e3), (1e6, 1e-6, 1e-4), (1e8, 1e-4, 1e-4)],
)
def test_the_covariance_stays_symmetric_and_positive(prior, disturbance, noise):
    generator = np.random.default_rng(5)
    n, p = 4, 2
    for share in (1.0, 0.8) * 5:
        a = generator.standard_normal((n, n))
        a /= np.abs(np.linalg.eigvals(a)).max()
        c = generator.standard_normal((p, n))
        observer = qpmhe.ExtendedKalman(
            prior=prior * np.eye(n), disturbance=disturbance * np.eye(n), noise=noise * np.eye(p)
        )
        covariance = observer.initial_covariance()
        system = linear_system(a, c)
        for _ in range(50):
            there = generator.random(p) < share
            sample = qpmhe.Sample(
                system, np.zeros(0), f_jacobian=a, h_jacobian=c,
                observed=None if there.all() else there, covariance=covariance,
            )
            _, covariance = observer.correct(np.zeros(n), np.zeros(p), sample)
            eigenvalues = np.linalg.eigvalsh(covariance)
            assert np.abs(covariance - covariance.T).max() <= 1e-14 * eigenvalues[-1]
            # P+ >= Q, up to the rounding of P+ itself.
            assert eigenvalues[0] >= 0.99 * disturbance - 1e-12 * eigenvalues[-1]


def test_the_initial_covariance_survives_a_run():
    prior = np.array([[2.0, 0.3], [0.3, 1.0]])
    observer = qpmhe.ExtendedKalman(prior=prior, disturbance=np.eye(2), noise=[[1.0]])
    mhe = observer_alone(linear_system(0.9 * np.eye(2), np.ones((1, 2))), observer, [0.0, 0.0])
    first = mhe.run([[1.0], [2.0], [3.0]]).states
    np.testing.assert_array_equal(observer.initial_covariance(), prior)
    mhe.reset([0.0, 0.0])
    np.testing.assert_array_equal(mhe.run([[1.0], [2.0], [3.0]]).states, first)


def test_covariances_are_copies_and_scalars_will_do():
    prior = np.array([[2.0]])
    observer = qpmhe.ExtendedKalman(prior=prior, disturbance=0.5, noise=1)
    prior[0, 0] = 9.0
    np.testing.assert_array_equal(observer.initial_covariance(), [[2.0]])
    a, c = np.array([[0.5]]), np.array([[1.0]])
    sample = qpmhe.Sample(
        linear_system(a, c), np.zeros(0), f_jacobian=a, h_jacobian=c, covariance=np.array([[2.0]])
    )
    correction, covariance = observer.correct(np.zeros(1), np.array([3.0]), sample)
    np.testing.assert_allclose(correction, [3.0 * 0.5 * 2.0 / 3.0])
    np.testing.assert_allclose(covariance, [[0.5 * 2.0 * 0.5 + 0.5 - (1.0 / 3.0) ** 2 * 3.0]])
