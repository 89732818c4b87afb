"""Many states: LAPACK's functions in the engine's build, and none in code to take away."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import write
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.estimate import Status

from .cases import CASES, case

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


@pytest.mark.parametrize("name", ["many states", "many states, dense"])
def test_only_the_engine_uses_lapack(name, tmp_path):
    one = case(name)
    compiled = one.estimator("compiled")
    assert compiled._engine._library.layout.lapack
    header, _ = write(compiled, tmp_path)
    assert "#define MHE_LAPACK 0" in header.read_text()
    assert not case("inputs").estimator("compiled")._engine._library.layout.lapack


def test_a_hessian_that_is_not_finite_keeps_the_candidate():
    """LAPACK gets infinities: the factorisation fails, and the step goes on."""
    casadi = pytest.importorskip("casadi")
    n = case("many states").system.n
    system = qpmhe.from_casadi(
        lambda x: 0.5 * x + 1e-3 * casadi.sin(1e150 * x), lambda x: x[:3], n=n, compiled=False
    )
    cost = qpmhe.QuadraticCost(
        prior=np.eye(n), disturbance=1e20 * np.eye(n), noise=np.eye(3)
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.1 * np.eye(n, 3)), cost, horizon=4, initial_state=np.ones(n),
        engine="compiled",
    )
    assert mhe._engine._library.layout.lapack
    for y in np.random.default_rng(1).normal(size=(7, 3)):
        found = mhe.update(y)
        assert found.status == Status.CANDIDATE | Status.SOLVER_FAILED
        assert found.cost == found.candidate_cost
        assert np.isfinite(found.trajectory).all()


@pytest.mark.parametrize("name", CASES)
def test_an_undone_step_leaves_no_trace(name, monkeypatch):
    """Bit for bit: a step is undone from a copy of what it changes, and of no more."""
    one = case(name)
    interrupted, plain = (one.estimator("compiled") for _ in range(2))
    engine = interrupted._engine
    for t, sample in enumerate(one.samples):
        before = _used(engine._memory)
        if t % 4 == 2:
            with monkeypatch.context() as patch:
                patch.setattr(engine, "_collect", _interrupt)
                with pytest.raises(KeyboardInterrupt):
                    interrupted.update(**sample)
            assert _used(engine._memory) == before
        found, expected = interrupted.update(**sample), plain.update(**sample)
        assert np.array_equal(found.trajectory, expected.trajectory)
        assert found.cost == expected.cost


def _used(memory):
    """The bytes of an estimator's memory without the stages outside of the window."""
    record, stages = memory[0], memory.dtype.fields["stages"]
    count = len(record["stages"])
    size = stages[0].itemsize // count
    known = memory.view(np.uint8).copy()
    for k in range(count):
        if (k - int(record["first"])) % count >= int(record["length"]):
            known[stages[1] + k * size :][:size] = 0
    return known.tobytes()


def _interrupt(_time):
    raise KeyboardInterrupt
