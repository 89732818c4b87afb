import numpy as np
import pytest

import qpmhe

SYSTEM, OBSERVER, COST, _ = qpmhe.models.batch_reactor()
MAKERS = {
    "MovingHorizonEstimator": lambda **options: qpmhe.MovingHorizonEstimator(
        SYSTEM, OBSERVER, COST, horizon=3, initial_state=[3, 0], **options
    ),
    "System": lambda **options: qpmhe.System(lambda x: x, lambda x: x, n=1, p=1, **options),
    "QuadraticCost": lambda **options: qpmhe.QuadraticCost(
        prior=1.0, disturbance=1.0, noise=1.0, **options
    ),
    "RobustCost": lambda **options: qpmhe.RobustCost(
        prior=np.eye(1), disturbance=np.eye(1), noise=np.eye(1), **options
    ),
    "SolverOptions": lambda **options: qpmhe.solvers.SolverOptions(**options),
}


@pytest.mark.parametrize("name", MAKERS)
def test_an_unknown_option_is_told_with_the_known_ones(name):
    with pytest.raises(qpmhe.errors.OptionError, match=f"{name} has no option 'nonsense'; expect"):
        MAKERS[name](nonsense=1)
    with pytest.raises(TypeError):
        MAKERS[name](nonsense=1)


def test_a_misspelt_option_is_guessed():
    with pytest.raises(qpmhe.errors.OptionError, match="Did you mean max_qps"):
        MAKERS["MovingHorizonEstimator"](max_qp=2)
