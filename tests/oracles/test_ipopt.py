"""The converged sequence of QPs against Ipopt, an independent solver of the same program."""

import numpy as np
import pytest

import qpmhe
from qpmhe.studies import PaperStudy

pytest.importorskip("casadi")


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_converged_sequence_reaches_ipopts_minimum_on_every_window(seed, method):
    study = PaperStudy(seed, 40, method)
    system, observer, cost, scenario = study.model
    ipopt = study.ipopt(None)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate, max_qps=None
    )
    for y in study.record().measurements:
        ours, theirs = mhe.update(y), ipopt.update(y)
        assert theirs.message == "Solve_Succeeded"
        assert ours.candidate_cost == pytest.approx(theirs.candidate_cost, rel=1e-13)
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-6)
        np.testing.assert_allclose(ours.trajectory, theirs.trajectory, atol=1e-4)


def test_statistics_of_the_papers_example():
    """As computed independently: about 0.59, 0.313, 0.311; 0.29 and 0.209 after 3 s."""
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    errors = {i: [] for i in (0, 1, 2, None)}
    for seed in range(20):
        states, measurements = scenario.simulate(seed)
        for i, collected in errors.items():
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, cost, horizon=10,
                initial_state=scenario.initial_estimate, max_qps=i,
            )
            squares = np.sum((mhe.run(measurements).states - states) ** 2, axis=1)
            collected.append((np.sqrt(squares.mean()), np.sqrt(squares[30:].mean())))
    rmse = {i: np.mean(values, axis=0) for i, values in errors.items()}
    np.testing.assert_allclose(rmse[0], [0.59, 0.29], rtol=0.06)
    np.testing.assert_allclose(rmse[1], [0.313, 0.209], rtol=0.06)
    np.testing.assert_allclose(rmse[2], [0.311, 0.209], rtol=0.06)
    np.testing.assert_allclose(rmse[1], rmse[None], rtol=0.02)
