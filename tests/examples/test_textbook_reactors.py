"""The textbook reactors are estimated as the gallery says."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("rich")

SEEDS = 4


@pytest.fixture(scope="module")
def example():
    folder = str(Path(__file__).parents[2] / "examples")
    sys.path.insert(0, folder)
    try:
        import textbook_reactors

        yield textbook_reactors
    finally:
        sys.path.remove(folder)


def settled(example, reactor, **options):
    """Median of the settled errors; every estimate is in X, and no inequality is dropped."""
    errors = []
    for seed in range(SEEDS):
        states, pressures = example.simulate(reactor, seed)
        estimates, dropped = example.estimate(reactor, pressures, **options)
        assert (estimates >= 0.0).all()
        assert dropped == 0.0
        errors.append(np.sqrt(np.mean((estimates - states)[reactor.steps // 2 :] ** 2)))
    return np.median(errors)


@pytest.mark.parametrize(("which", "most"), [(0, 0.04), (1, 0.005)])
@pytest.mark.parametrize("max_qps", [0, 1, 2, 5, None])
def test_a_projected_filter_and_mhe_on_it_settle_on_the_truth(example, which, most, max_qps):
    assert settled(example, example.REACTORS[which], max_qps=max_qps) < most


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("gain", [0.001, 0.01])
def test_two_qps_improve_on_a_projected_constant_gain(example, which, gain):
    reactor = example.REACTORS[which]
    alone, two = (settled(example, reactor, kind=gain, max_qps=i) for i in (0, 2))
    assert two < alone / 1.5
