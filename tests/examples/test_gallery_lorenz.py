"""Lorenz's forty variables: the model, the errors that are counted, and who is printed as best."""

from importlib import import_module

import numpy as np
import pytest

import qpmhe


@pytest.fixture(scope="module")
def lorenz(gallery):
    return import_module("gallery.lorenz96.lorenz")


def test_model(lorenz):
    integrate = pytest.importorskip("scipy.integrate")
    x = 8.0 + np.random.default_rng(0).standard_normal((3, 40))
    # Advection neither makes nor takes energy.
    rates = lorenz.rate(x) + x - lorenz.FORCING
    np.testing.assert_allclose(np.sum(x * rates, axis=1), 0.0, atol=1e-11)
    exact = integrate.solve_ivp(
        lambda _, at: lorenz.rate(at), (0.0, lorenz.DT), x[0], rtol=1e-10, atol=1e-10
    ).y[:, -1]
    np.testing.assert_allclose(lorenz.step(x)[0], exact, atol=0.02)


def test_settings_are_chosen_on_other_seeds(lorenz):
    assert not set(lorenz.SEEDS) & set(lorenz.CHOOSING)
    for setup in lorenz.SETUPS:
        tried = {
            (one.observer, one.variance, one.horizon, one.qps) for one in lorenz.choices(setup)
        }
        for way in setup.ways:
            # The short horizon has the settings of the long one.
            horizon = way.horizon if way.horizon in (1, *lorenz.HORIZONS) else lorenz.HORIZONS[-1]
            assert (way.observer, way.variance, horizon, way.qps) in tried


def test_errors_table_and_winners(lorenz):
    setup = lorenz.SETUPS[0]
    way = lorenz.Way("EKF", qpmhe.ExtendedKalman, 3e-4)
    found = lorenz.judged(setup, way, [0], 60)
    states, measured, start = setup.record(0, 60)
    run = way.estimator(setup.system(), start).run(measured)
    size = np.sqrt(np.mean((run.filtered - states)[20:] ** 2, axis=1)).mean()
    assert found.of_runs(20) == pytest.approx([size])
    assert 0.15 < size < 0.4
    lines = lorenz.table(setup, [found], 20)
    assert len(lines) == 2 + 1 + len(lorenz.PUBLISHED)
    assert "DAPPER: iEnKS, 40 members" in lorenz.verdict(setup, [found], 20)
    found.errors[:] = 0.1
    assert lorenz.verdict(setup, [found], 20) == "Lowest error, 0.10: EKF."
    assert lorenz.table(setup, [found], 20)[2].startswith("| EKF |")


@pytest.mark.slow
def test_quick(lorenz, tmp_path):
    assert lorenz.main(["--quick", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "lorenz96.md", "lorenz96.png", "lorenz96.svg"
    }
