"""Observers with covariances in C: the Kalman filter, weights of the prior, written code."""

import ctypes
import functools

import numpy as np
import pytest
from oracles.test_kalman import Plant, distance, kalman

import qpmhe
from qpmhe import codegen
from qpmhe.codegen.compiler import compiled_library, find_compiler
from qpmhe.codegen.layout import Layout
from qpmhe.codegen.source import estimator_files
from qpmhe.errors import InvalidInputError

from .cases import case
from .test_write import STRICT, WATCHED, check, compiled, play, record

ca = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
FILTERS = [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman]


def linear(plant):
    """The plant's system by CasADi."""
    x, u = ca.SX.sym("x", len(plant.A)), ca.SX.sym("u", plant.B.shape[1])
    f, h = (
        ca.DM(M) @ x + ca.DM(N) @ u if u.numel() else ca.DM(M) @ x
        for M, N in ((plant.A, plant.B), (plant.C, plant.D))
    )
    given = [x, u] if u.numel() else [x]
    return qpmhe.from_casadi(
        ca.Function("f", given, [f]), ca.Function("h", given, [h]), compiled=False
    )


@pytest.mark.parametrize("make", FILTERS)
@pytest.mark.parametrize("horizon", [1, 2, 5, 20])
@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
@pytest.mark.parametrize("radius", [0.8, 1.15], ids=["stable", "unstable"])
def test_every_horizon_gives_the_kalman_predictor_and_filter(make, radius, missing, horizon):
    for n, p in ((1, 2), (2, 2), (3, 1)):
        plant = Plant(100 * n + p, n, p, radius, m=n % 3, missing=missing)
        predicted, filtered, _ = kalman(plant)
        covariances = {"disturbance": plant.Q, "noise": plant.R}
        mhe = qpmhe.MovingHorizonEstimator(
            linear(plant), make(prior=plant.P, **covariances),
            qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **covariances),
            horizon=horizon, initial_state=plant.z0, engine="compiled",
        )
        assert mhe.engine == "compiled"
        run = mhe.run(plant.Y, plant.inputs())
        assert distance(run.states, np.array([x for x, _ in predicted])) < 1e-9
        assert distance(run.filtered, np.array([x for x, _ in filtered])) < 1e-9
        P = predicted[-1][1]
        np.testing.assert_allclose(mhe.covariances()[-1], P, rtol=0.0, atol=1e-8 * np.abs(P).max())


HOOK = """
void weigh(const mhe_covariances *o, const real *covariance, real *weight)
{
    real P[NX * NX];
    memcpy(P, covariance, sizeof P);
    mhe_weight_of(o, P, weight);
}
"""


@functools.cache
def weighing(n):
    """The function of prior.c that weighs a covariance (n, n), and its settings."""
    x = ca.SX.sym("x", n)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [x]), ca.Function("h", [x], [x[0]]), compiled=False
    )
    sets = ((False, 0),) * 3
    layout = Layout(n, 1, 0, 1, sets, 0, observer=1, covariance=True, observer_prior=True)
    settings = np.zeros((), layout.settings_type())
    files = estimator_files(system.symbolic, layout, settings)
    files["mhe.c"] += HOOK
    return compiled_library(files, "mhe.c"), settings["covariances"].copy()


def weight(covariance, rule):
    """The weight of the prior in C."""
    n = len(covariance)
    library, own = weighing(n)
    own["least"] = 1e-12
    own["minimum"], own["maximum"] = rule.bounds or (0.0, 0.0)
    found, given = np.zeros((n, n)), np.ascontiguousarray(covariance)
    library.weigh(*(ctypes.c_void_p(one.ctypes.data) for one in (own, given, found)))
    return found


def correlated(rng, n, smallest):
    """Correlations with eigenvalues from about one down to ``smallest``."""
    values = np.append(np.geomspace(1.0, max(smallest, 0.1), n - 1), smallest if n > 1 else 1.0)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    matrix = (basis * values) @ basis.T
    deviations = np.sqrt(matrix.diagonal())
    return matrix / np.outer(deviations, deviations)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
@pytest.mark.parametrize("smallest", [0.1, 1e-4, 1e-9, 1e-11, 0.0])
def test_the_weight_of_the_prior(n, smallest):
    """Whatever the units; as exact as the covariance's own rounding lets it be."""
    rng = np.random.default_rng([n, int(1e12 * smallest)])
    for _ in range(30):
        units = 10.0 ** rng.uniform(-6.0, 6.0, n)
        covariance = np.outer(units, units) * correlated(rng, n, smallest)
        covariance = 0.5 * (covariance + covariance.T)
        rule = qpmhe.ObserverPrior()
        found, expected = weight(covariance, rule), rule.weight(covariance)
        np.testing.assert_array_equal(found, found.T)
        scale = np.outer(1.0 / units, 1.0 / units)
        size = np.abs(expected / scale).max()
        least = max(smallest, 1e-12) if n > 1 else 1.0
        allowed = max(1e-12, 200.0 * np.finfo(float).eps / least) * size
        np.testing.assert_allclose(found / scale, expected / scale, rtol=0.0, atol=allowed)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
@pytest.mark.parametrize("bounds", [(1e-3, 1e3), (0.5, 2.0), (1e-9, 1e9), (1.0, 1.0001)])
def test_the_weight_of_the_prior_in_bounds(n, bounds):
    rng, rule = np.random.default_rng(n), qpmhe.ObserverPrior(*bounds)
    for smallest in (0.5, 1e-2, 1e-6, 0.0):
        for size in (1e-4, 1.0, 1e4):
            covariance = size * correlated(rng, n, smallest)
            found = weight(covariance, rule)
            np.testing.assert_allclose(
                found, rule.weight(covariance), rtol=0.0, atol=1e-9 * bounds[1]
            )
            values = np.linalg.eigvalsh(found)
            assert values[0] >= bounds[0] * (1.0 - 1e-6) - 1e-12 * bounds[1]
            assert values[-1] <= bounds[1] * (1.0 + 1e-9)


WRITTEN = [
    "extended", "extended prior", "extended prior bounded", "extended irregular",
    "extended singular", "unscented prior", "unscented irregular", "injection", "smoothed",
    "steady prior", "gated prior", "unscented gated", "weighted smoothed",
]


@pytest.mark.parametrize("name", WRITTEN)
def test_written_code_gives_what_python_gives(name, tmp_path):
    """Under sanitizers, without a warning, with late samples, weights of samples and gaps."""
    one = case(name)
    mhe = one.estimator("python")
    program = compiled(mhe, tmp_path, [*WATCHED, *STRICT])
    commands, expected = record(mhe)
    check(play(program, mhe, commands), expected, max(1e-9, one.tolerance))


@pytest.mark.parametrize("name", ["extended prior", "unscented prior", "injection", "steady prior"])
def test_single_precision_keeps_the_promise(name, tmp_path):
    one = case(name)
    mhe = one.estimator("python")
    program = compiled(mhe, tmp_path, [*WATCHED, *STRICT], real="float")
    commands, expected = record(mhe, special=False)
    found = play(program, mhe, commands)
    check(found, expected, 1e-2, statuses=False)


def test_the_header_names_the_observer(tmp_path):
    header, source = codegen.write(case("unscented prior").estimator("python"), tmp_path)
    text = header.read_text()
    assert "MHE_OBSERVER 2" in text
    assert "MHE_COVARIANCE 1" in text
    assert ".spread = 1.7320508" in source.read_text()
    header, _ = codegen.write(case("reactor").estimator("python"), tmp_path)
    assert "MHE_COVARIANCE 0" in header.read_text()


@pytest.mark.parametrize("name", ["extended prior", "unscented prior", "steady prior with gaps"])
def test_a_snapshot_with_another_covariance_is_refused(name):
    one = case(name)
    mhe = one.estimator("compiled")
    for sample in one.samples[:8]:
        mhe.update(**sample)
    state = mhe.state_dict()
    one.estimator("compiled").load_state_dict(state)
    kind = mhe._engine._memory.dtype
    for field, what in (
        ("covariance_end", "observer"), ("stages", "observer"), ("last_good_covariance", "finite")
    ):
        damaged = state | {"memory": state["memory"].copy()}
        record = damaged["memory"].view(kind)[0]
        if field == "stages":
            record["stages"]["covariance"][1] *= 1.001
        else:
            record[field] *= 1.001 if what == "observer" else np.nan
        with pytest.raises(InvalidInputError, match=what):
            one.estimator("compiled").load_state_dict(damaged)


@pytest.mark.parametrize("name", ["extended prior", "unscented", "injection"])
def test_each_member_of_a_batch_is_a_single_estimator(name):
    one = case(name)
    Y = np.array([sample["y"] for sample in one.samples])
    U = np.array([sample["u"] for sample in one.samples])
    Y = np.stack((Y, Y + 0.05))
    batch = qpmhe.BatchEstimator(
        one.system, one.observer, one.cost, members=2, initial_states=one.start,
        engine="compiled", **one.options,
    )
    assert batch.mode == "compiled"
    run = batch.run(Y, np.stack((U, U)))
    for k in range(2):
        alone = one.estimator("compiled").run(Y[k], U)
        np.testing.assert_array_equal(run.states[k], alone.states)
        np.testing.assert_array_equal(run.filtered[k], alone.filtered)
