"""What an installed wheel must be able to do; run away from the source tree."""

from importlib.resources import files
from pathlib import Path

import numpy as np

import qpmhe
import qpmhe_solvers

for package in (qpmhe, qpmhe_solvers):
    assert "site-packages" in str(Path(package.__file__)), package.__file__
    assert files(package).joinpath("py.typed").is_file(), package

system, observer, cost, scenario = qpmhe.models.batch_reactor()
states, measurements = scenario.simulate(0, 40)
for backend in qpmhe.solvers.available():
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=[3.0, 0.0], backend=backend, max_qps=2
    )
    run = mhe.run(measurements)
    assert run.states.shape == (41, 2)
    assert np.all(run.costs <= run.candidate_costs)
    assert run.share(qpmhe.Status.IMPROVED) > 0.5, backend
    print(f"{backend}: {run.share(qpmhe.Status.IMPROVED):.0%} of the steps improved")
