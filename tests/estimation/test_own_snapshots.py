"""Estimators with few disturbances and a robust cost take their own snapshots."""

import copy

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

from .same import assert_same

COMPILED = pytest.param("compiled", marks=pytest.mark.skipif(
    find_compiler() is None, reason="there is no C compiler"
))


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("engine", ["python", COMPILED])
@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("robust", [False, True])
def test_few_disturbances_and_robust_costs_take_their_own_snapshots(robust, still, engine):
    """The correction of the observer has a part in directions without disturbances."""
    def model(x):
        return np.stack([0.9 * x[..., 0] + 0.1 * x[..., 1],
                         0.8 * x[..., 1] + 0.1 * np.sin(x[..., 0])], -1)

    system = qpmhe.System(
        model, lambda x: x[..., :1], n=2, p=1, disturbance_matrix=[[1.0], [0.02]],
        disturbances=qpmhe.Box([0.0], [0.0]) if still else None,
    )
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=[[0.002]], noise=[[0.1]])
    weights = {"prior": np.diag([1.0, 1e4]), "disturbance": [[500.0]]}
    cost = (
        qpmhe.RobustCost(**weights, noise=qpmhe.Cauchy([[10.0]])) if robust
        else qpmhe.QuadraticCost(**weights, noise=[[10.0]])
    )

    def fresh():
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=[1.0, 0.0], engine=engine,
        )

    for change in (None, "set", "own"):
        one, restored = fresh(), fresh()
        assert one.engine == engine
        for t in range(12):
            own = {"disturbance_weight": [[20.0]]} if change == "own" and t == 9 else {}
            one.update([np.sin(0.3 * t)], **own)
        if change == "set":
            one.set(disturbance_weight=[[50.0]])
        one.forget_warm_start()
        restored.load_state_dict(one.state_dict())
        copied = copy.deepcopy(one)
        expected = one.update([0.5])
        assert_same(restored.update([0.5]), expected)
        assert_same(copied.update([0.5]), expected)


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
def test_a_snapshot_has_nothing_of_the_memory_beside_it():
    """C aligns the sides of sets: the bytes between them are zero, not what was there before."""
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x[..., :1], n=3, p=1,
        **dict.fromkeys(("states", "disturbances"), qpmhe.Box(np.full(3, -9.0), np.full(3, 9.0))),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.full((3, 1), 0.1)),
        qpmhe.QuadraticCost(prior=np.eye(3), disturbance=np.eye(3), noise=[[1.0]]),
        horizon=15, initial_state=np.zeros(3), engine="compiled",
    )
    for t in range(20):
        mhe.update([1.0], bounds={"states": qpmhe.Box(np.full(3, -8.0), np.full(3, 8.0 + t))})
    first = mhe.state_dict()
    for byte in (0, 85, 170):
        # Memory that NumPy takes next is full of that byte.
        dirt = [
            np.full(array.nbytes, byte, np.uint8)
            for array in first.values() if isinstance(array, np.ndarray) for _ in range(5)
        ]
        del dirt
        again = mhe.state_dict()
        assert again["structure"] == first["structure"], byte  # with the digest of all bytes
