"""The stiff and algebraic models of the gallery: their steps, their records, and do-mpc's."""

from importlib import import_module

import numpy as np
import pytest

pytest.importorskip("casadi", reason="the plants are simulated by CasADi")


@pytest.fixture(scope="module")
def parts(gallery):
    return {
        name: import_module(f"gallery.stiff_and_algebraic.{name}") for name in ("plants", "compare")
    }


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_step_of_the_model_is_that_of_sundials(parts, which):
    plant = parts["plants"].PLANTS[which]
    still = plant._replace(disturbance=(1e-300,) * len(plant.guess), noise=(1e-300,) * len(
        plant.noise))
    states, measured, inputs = parts["plants"].simulate(still, 0, 12)
    system = parts["compare"].model(plant)
    for t in range(11):
        # What an estimator may neglect.
        error = np.abs(system.f(states[t], inputs[t]) - states[t + 1])
        assert (error < 0.5 * np.array(plant.disturbance)).all(), (t, error)
        there = ~np.isnan(measured[t])
        np.testing.assert_array_equal(there, t % np.array(plant.every) == 0)
        outputs = system.h(states[t], inputs[t])
        np.testing.assert_allclose(outputs[there], measured[t, there], rtol=1e-6, atol=1e-9)


def test_do_mpc_weighs_what_is_measured(parts):
    pytest.importorskip("do_mpc", reason="compares with do-mpc")
    peer = import_module("gallery.stiff_and_algebraic.peer")
    plant = parts["plants"].PLANTS[0]
    states, measured, inputs = parts["plants"].simulate(plant, 0, 9)
    guess, prior = np.array(plant.guess), np.diag(np.square(plant.prior))
    mhe = peer.DoMpc(plant, guess, 4, prior, np.diag(np.square(plant.disturbance[:4])))
    found = mhe.run(measured, inputs).filtered
    assert found.shape == states.shape
    assert abs(found[-1, 3] - states[-1, 3]) < 0.1  # the volume, measured each hour
    # Of a first sample there is one, not N: Kalman's update of the volume.
    gain = prior[3, 3] / (prior[3, 3] + plant.noise[0] ** 2)
    assert found[0, 3] == pytest.approx(guess[3] + gain * (measured[0, 0] - guess[3]), rel=1e-4)
    other = np.where(np.isnan(measured), np.nan, measured)
    other[8, 2:] = np.nan  # the only late sample of biomass and product
    mhe.reset(guess)
    without = mhe.run(other, inputs).filtered
    small = 1e-3 * np.array(plant.prior)  # of a product that is at its bound
    assert np.isclose(without[:8], found[:8], rtol=1e-4, atol=small).all()
    assert np.abs(without[8] - found[8]).max() > 1e-3


def test_a_rate_adds_what_the_fast_state_keeps(parts):
    plants = parts["plants"]
    for plant, fast in ((plants.PLANTS[0], 2), (plants.PLANTS[1], 2), (plants.PLANTS[2], None)):
        states, _, inputs = plants.simulate(plant, 0, 60)
        effect = plants.effect_of_rates(plant, states[40:], inputs[40:]) / plant.dt
        assert (effect > 0.0).all()
        assert (effect < 1.2).all()
        assert fast is None or effect[fast] == min(effect) < 0.1
    feed = plants.PLANTS[0]
    states, _, inputs = plants.simulate(feed, 0, 3)
    assert plants.effect_of_rates(feed, states, inputs)[3] == pytest.approx(feed.dt)  # the volume
