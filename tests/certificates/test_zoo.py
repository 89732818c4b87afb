"""Which models of the zoo are proved, on the regions that their records fill, and which are not."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    Evidence,
    NotCertifiedError,
    Sizes,
    certify_detectability,
    search,
    synthesise_gain,
)
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.report import region_of
from qpmhe.errors import ModelError

from .helpers import box, unit_cost


def stated(scenario):
    """Boxes of three standard deviations."""
    return Sizes(*(
        box(-half, half) for half in (
            3.0 * np.sqrt(np.diag(each))
            for each in (scenario.disturbance_covariance, scenario.noise_covariance))
    ))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["batch_reactor", "battery_cell", "cstr", "pendulum", "van_der_pol", "vehicle"])
def test_a_gain_is_found_and_its_bound_is_proved(name):
    """With a bound on each state that is less than the region is wide."""
    made = qpmhe.models.catalogue()[name]()
    system, sizes = made.system, stated(made.scenario)
    region = region_of(system, made.scenario)
    found = synthesise_gain(system, region, sizes=sizes.typical, seconds=600.0)
    bound = bound_observer(
        system, found.observer, unit_cost(system.r, system.p), region, sizes=sizes, seconds=600.0)
    assert bound.evidence is Evidence.PROVED
    assert bound.rate < 1.0
    assert bound.headline.count("guarded, x_hat is within") == 1
    assert (bound.settled.box < bound.widths).all()
    if name == "battery_cell":  # projected at the full charge, it has the box in advance
        ball = bound.components(bound.limit())
        assert bound.rowwise.faces.block.tolist() == [0]
        assert bound.settled.box[1] < 0.4 * ball[1]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["midpoint", "radau"])
def test_an_implicit_step_rests_on_samples_and_says_so(method):
    system = qpmhe.System.from_ode(
        lambda x: -np.sin(x), lambda x: 1.0 * x, dt=0.1, n=1, p=1, method=method)
    bound = bound_observer(
        system, qpmhe.Luenberger([[0.1]]), unit_cost(), box(-1.0, 1.0), sizes=Sizes(0.01, 0.01))
    assert bound.evidence is Evidence.SAMPLED
    assert any("it is an implicit step" in note for note in bound.stability.notes)
    assert "(sampled" in bound.headline
    assert "guarded" not in bound.headline


def test_a_chain_with_a_spring_without_length_is_refused():
    """Two masses may be at the same point of the box: f has no value there."""
    chain = qpmhe.models.chain_of_masses(masses=2).system
    with pytest.raises(ModelError, match=r"f is not finite at x = .*within the region"):
        synthesise_gain(chain, box(-np.ones(chain.n), np.ones(chain.n)))


@pytest.mark.slow
def test_one_mass_is_proved_near_its_rest():
    """For a tenth of the scenario's disturbances and noises."""
    chain = qpmhe.models.chain_of_masses(masses=1)
    system, rest = chain.system, chain.scenario.initial_state
    for _ in range(5000):
        rest = system.f(rest, np.zeros(system.m))
    half = np.repeat([0.05, 0.5], 3)
    region = qpmhe.Box(rest - half, rest + half)
    whole = stated(chain.scenario)
    sizes = Sizes(*(
        qpmhe.Box(0.1 * each.lower, 0.1 * each.upper) for each in (whole.disturbance, whole.noise)))
    found = synthesise_gain(system, region, sizes=sizes.typical, seconds=600.0)
    bound = bound_observer(
        system, found.observer, unit_cost(system.r, system.p), region, sizes=sizes, seconds=600.0)
    assert bound.evidence is Evidence.PROVED
    assert (bound.settled.box < np.repeat([0.025, 0.23], 3)).all()


@pytest.mark.slow
def test_no_constant_gain_contracts_on_the_quadrotors_record():
    """A rate next to 1 is infeasible at some states; so is every smaller one on the region."""
    made = qpmhe.models.catalogue()["quadrotor"]()
    with pytest.raises(NotCertifiedError, match="infeasible for every rate below 1"):
        synthesise_gain(
            made.system, region_of(made.system, made.scenario), rho=0.9999,
            sizes=stated(made.scenario).typical, seconds=3000.0)


@pytest.mark.slow
def test_the_quadrotor_is_detectable_at_samples(monkeypatch):
    """The proof takes more cells than these."""
    monkeypatch.setattr(search, "_MOST_CELLS", 300)
    made = qpmhe.models.catalogue()["quadrotor"]()
    found = certify_detectability(
        made.system, region_of(made.system, made.scenario), seconds=3000.0)
    assert found.evidence is Evidence.SAMPLED
    assert "the proof was given up after dividing the region into" in found.notes[0]
    assert found.eta < 1.0
