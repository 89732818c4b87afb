"""Compilers that make wrong code: less optimisation, and CasADi's interpreter at last."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler, rehearsal
from qpmhe.errors import CompilationError, EngineWarning

from .scripts import Script, needed

ca = pytest.importorskip("casadi")
pytestmark = needed
FAST, MIDDLE, PLAIN = (" ".join(flags) for flags in compiler._LEVELS)
A = np.array([[-0.9, 0.2], [-0.1, -0.8]])
C = np.array([[1.0, 0.3], [0.2, 1.0]])

MODEL_LIES = {
    "residuals": "s/= y\\[j\\] - h\\[j\\]/= y[j] + h[j]/",
    "the next state": "s/= x\\[NX + j\\] - f\\[j\\]/= x[j] - f[j]/",
    "later states of a batch": "s/if (h) mhe_h(x, u, h + k \\* NY)/if (h) mhe_h(x, u, h)/",
    "Jacobian": "s/A\\[j \\* NX + j\\] += 1;/A[j * NX + j] += 1.0001;/",
    "lengths of steps": "s/step ? step\\[k\\] : usual/usual/",
    "NaN": "s/= x\\[NX + j\\] - f\\[j\\]/= NAN/",
}
STEP_LIES = {
    "noises": "s/v\\[j\\] = stage->y\\[j\\] - output/v[j] = stage->y[j] + output/",
    "disturbances": "s/w\\[j\\] = x\\[NX + j\\] - predicted/w[j] = x[NX + j] + predicted/",
    "the candidate": "s/next\\[j\\] = predicted\\[j\\] + w/next[j] = predicted[j] - w/",
    "its cost": "s/return mhe_lost(&s->disturbance_loss.*/return/",
    "discount": "s/trial->cost += k->factors\\[i + 1\\] \\*/trial->cost +=/",
    "prior": "s/cost += factors\\[0\\] \\*/cost += 0 */",
    "missing components": "s/R\\[i \\* NY + j\\] -= share/R[i * NY + j] += share/",
    "a step's length": "s/stage->step = step > 0 ? step :/stage->step =/",
    "a noise weight": "s/stage->has_own_noise ? stage->own_noise_weight : //",
    "failures": "s/int held = !isfinite(stage->cost)/int held = 1/",
}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(folder))
    monkeypatch.setattr(compiler, "_checked", set())
    return folder


@pytest.fixture
def script(tmp_path, monkeypatch):
    return Script(tmp_path, monkeypatch)


def linear(compiled=None, a=A, c=C, dt=0.1):
    return qpmhe.from_casadi(
        lambda x: ca.mtimes(ca.DM(a), x), lambda x: ca.mtimes(ca.DM(c), x), n=len(a), dt=dt,
        method="rk4", compiled=compiled,
    )


def estimator(system, engine="compiled"):
    n, p = system.n, system.p
    cost = qpmhe.QuadraticCost(
        prior=np.eye(n), disturbance=5 * np.eye(n), noise=2 * np.eye(p) + 0.5
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.1 * np.eye(n, p)), cost, horizon=6, initial_state=np.ones(n),
        max_qps=2, engine=engine,
    )


def is_right(system):
    rng, true = np.random.default_rng(3), linear(False)
    for count in (1, 2, 5, 8):
        x, y, u = rng.normal(size=(count + 1, 2)), rng.normal(size=(count, 2)), np.zeros((count, 0))
        assert system.kernel.residuals(x, y, u) == pytest.approx(
            true.kernel.residuals(x, y, u), rel=1e-9, abs=1e-12
        )
        assert system.h(x, None) == pytest.approx(true.h(x, None), rel=1e-9)


def costs_are_right(mhe):
    rng, true = np.random.default_rng(4), estimator(linear(False), "python")
    for t in range(12):
        y = rng.normal(size=2)
        y[t % 2] *= np.nan if t % 5 == 2 else 1.0
        one, two = mhe.update(y), true.update(y)
        assert one.cost == pytest.approx(two.cost, rel=1e-6)
        assert one.candidate_cost == pytest.approx(two.candidate_cost, rel=1e-9)


def notes(cache):
    return [path.read_text() for path in cache.glob("*.level")]


@pytest.mark.parametrize("lie", MODEL_LIES)
def test_a_wrong_model_is_compiled_with_less_optimisation(lie, script, cache, monkeypatch):
    script.lies(MODEL_LIES[lie], [FAST])
    for _ in range(2):
        is_right(linear())
        assert [FAST in call for call in script.calls] == [True, False]
        assert MIDDLE in script.calls[1]
        monkeypatch.setattr(compiler, "_checked", set())  # as in another process
    assert notes(cache)[0].startswith("1\n")
    assert "interpreter" in notes(cache)[0]


@pytest.mark.parametrize("lie", STEP_LIES)
def test_a_wrong_estimator_is_compiled_with_less_optimisation(lie, script, cache, monkeypatch):
    is_found_out(STEP_LIES[lie], script, cache, monkeypatch)


def test_a_wrong_verdict_is_found_out(script, cache, monkeypatch):
    verdict = "s/if (o->spare->cost < target) {/if (1) {/;s/= -k->gradient/= k->gradient/"
    is_found_out(verdict, script, cache, monkeypatch)


def is_found_out(edit, script, cache, monkeypatch):
    script.lies(edit, [FAST, MIDDLE])
    system = linear(False)
    for _ in range(2):
        mhe = estimator(system)
        assert mhe.engine == "compiled"
        costs_are_right(mhe)
        assert [PLAIN in call for call in script.calls] == [False, False, True]
        monkeypatch.setattr(compiler, "_checked", set())
    assert notes(cache)[0].startswith("2\n")


def test_what_is_always_wrong_is_interpreted_or_the_python_step(script, monkeypatch):
    # Of both libraries; the Python step must not use the model's.
    script.lies(f"{STEP_LIES['noises']};{MODEL_LIES['residuals']}", [FAST, MIDDLE, PLAIN])
    for _ in range(2):
        with pytest.warns(EngineWarning, match=r"virtual machine.*residuals"):
            system = linear()
        is_right(system)
        assert len(script.calls) == 3  # what is known to be wrong is not compiled again
        monkeypatch.setattr(compiler, "_checked", set())
    with pytest.raises(CompilationError, match="wrong code"):
        linear(compiled=True)
    for _ in range(2):
        with pytest.warns(EngineWarning, match="Python step"):
            mhe = estimator(system)
        assert mhe.engine == "python"
        costs_are_right(mhe)
        assert len(script.calls) == 6


@pytest.mark.parametrize("level", range(len(compiler._LEVELS)))
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_linear_models_at_every_level(n, level, monkeypatch):
    """The vectoriser of GCC 12.2 gets these wrong where nothing keeps it from masked loads."""
    monkeypatch.setattr(compiler, "_LEVELS", (compiler._LEVELS[level],))
    rng = np.random.default_rng(n)
    for p in range(1, 5):
        a, c = 0.5 * rng.normal(size=(n, n)), rng.normal(size=(p, n))
        system = linear(True, a, c, None)
        for count in range(1, 10):
            x, y = rng.normal(size=(count + 1, n)), rng.normal(size=(count, p))
            true = np.hstack((x[1:] - x[:-1] @ a.T, y - x[:-1] @ c.T))
            found = system.kernel.residuals(x, y, np.zeros((count, 0)))
            assert found == pytest.approx(true, rel=1e-9, abs=1e-12)
            assert system.f(x, None) == pytest.approx(x @ a.T, rel=1e-9, abs=1e-12)
            assert system.h(x, None) == pytest.approx(x @ c.T, rel=1e-9, abs=1e-12)
        if p == n:
            mhe, other = estimator(system), estimator(linear(False, a, c, None), "python")
            for y in rng.normal(size=(10, p)):
                assert mhe.update(y).cost == pytest.approx(other.update(y).cost, rel=1e-6)
            assert mhe.engine == "compiled"


@pytest.mark.parametrize(
    "h", [lambda x: 1e200 * x, lambda x: ca.exp(700.0 * x), lambda x: ca.log(x - 0.99),
          lambda x: ca.exp(45.0 * x) * 1e140],
    ids=["no squares", "overflow", "hardly finite", "beyond the largest"],
)
def test_what_is_not_finite_is_no_fault(h, cache):
    system = qpmhe.from_casadi(lambda x: 0.9 * x, lambda x: h(x[0]), n=2, compiled=True)
    assert estimator(system).engine == "compiled"
    assert not notes(cache)


def test_an_estimator_does_not_make_the_model_anew(monkeypatch):
    system = linear()
    monkeypatch.setattr("qpmhe.adapters.casadi.casadi_model", None)
    assert estimator(system, "python").update([1.0, 2.0]).cost >= 0.0


def test_a_library_is_checked_once(monkeypatch):
    calls, checked = [], rehearsal.estimator_fault
    monkeypatch.setattr(
        rehearsal, "estimator_fault", lambda *given: calls.append(1) or checked(*given)
    )
    system = linear(False)
    for release, count in (("one", 1), ("one", 1), ("two", 2)):
        monkeypatch.setattr(compiler, "_checked_by", lambda release=release: release)
        monkeypatch.setattr(compiler, "_checked", set())  # as in another process
        assert estimator(system).engine == "compiled"
        assert len(calls) == count
