"""A new term of J: it enters the estimate, and who states J without its sum refuses it by name."""

import inspect

import numpy as np
import pytest

import qpmhe
from qpmhe import certificates
from qpmhe.certificates import Sizes, certify, design
from qpmhe.certificates.monitor import _barred
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.model import augmentation
from qpmhe.model.system_arguments import SystemOptions
from qpmhe.terms import sum as terms
from qpmhe.terms.base import FirstStateTerm

STIFFNESS, NAME = 7.0, "a ridge"
MEASUREMENTS = np.array([[1.0], [0.5], [1.5], [0.2]])
REGION, SIZES = qpmhe.Box([-9.0], [9.0]), Sizes(0.1, 0.1)


class Ridge(FirstStateTerm):
    """7 |x_0|^2 in every window of a cost with this mark."""

    name = NAME

    @staticmethod
    def belongs(system, cost):
        return system.n == 1 and getattr(cost, "ridged", False)

    @classmethod
    def of(cls, *_):
        return cls()

    @property
    def c_form(self):
        return None

    def of_window(self, window, view):
        return self

    def cost(self, trial):
        return STIFFNESS * float(trial.trajectory[0] @ trial.trajectory[0])

    def magnitude(self, trial):
        return self.cost(trial)

    def weight_of_first(self, trial):
        return STIFFNESS * np.eye(trial.trajectory.shape[1])

    def force(self, trial):
        return STIFFNESS * trial.trajectory[0]


@pytest.fixture
def known(monkeypatch):
    monkeypatch.setattr(terms, "KINDS", [*terms.KINDS, Ridge])


def system(**options):
    return qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1, states=REGION, **options)


def cost(ridged, **options):
    options = {"prior": 1.0, "disturbance": 10.0, "noise": 1.0} | options
    made = qpmhe.QuadraticCost(**options)
    made.ridged = ridged
    return made


def estimator(ridged, parts=None, **options):
    usual = {"horizon": 5, "initial_state": [0.0], "engine": "python", "max_qps": None}
    one, loss = parts or (system(), cost(ridged))
    return qpmhe.MovingHorizonEstimator(one, qpmhe.Luenberger([0.3]), loss, **usual | options)


def test_a_new_term_is_part_of_every_estimate(known):
    ys = MEASUREMENTS[:, 0]
    found = estimator(True).run(MEASUREMENTS)
    # The same as dense least squares: prior, disturbances, noises, and the ridge of x(0).
    rows, values = [], []
    for weight, row, value in (
        (1.0, np.eye(5)[0], 0.0), (STIFFNESS, np.eye(5)[0], 0.0),
        *((10.0, np.eye(5)[k + 1] - 0.9 * np.eye(5)[k], 0.0) for k in range(4)),
        *((1.0, np.eye(5)[k], ys[k]) for k in range(4)),
    ):
        rows.append(np.sqrt(weight) * row)
        values.append(np.sqrt(weight) * value)
    x, square, *_ = np.linalg.lstsq(np.array(rows), np.array(values))
    np.testing.assert_allclose(found.states[-1], x[-1:], rtol=1e-9)
    np.testing.assert_allclose(found.costs[-1], square[0], rtol=1e-9)
    assert abs(estimator(False).run(MEASUREMENTS).states[-1] - x[-1]) > 1e-3


def test_it_is_there_with_a_disturbance_matrix_too(known):
    """The cost in the dimension of the states stands in for the user's."""
    found = []
    for ridged in (True, False):
        lifted = system(disturbance_matrix=[[2.0]]), cost(ridged)
        plain = system(), cost(ridged, disturbance=2.5)  # of d = 2 w
        one, other = (estimator(ridged, parts).run(MEASUREMENTS) for parts in (lifted, plain))
        np.testing.assert_allclose(one.states, other.states, rtol=1e-9)
        np.testing.assert_allclose(one.costs, other.costs, rtol=1e-9)
        found.append(one.states[-1])
    assert abs(found[0] - found[1]) > 1e-3


def test_the_compiled_step_refuses_it_by_name(known):
    with pytest.raises(OptionError, match="Ridge"):
        estimator(True, engine="compiled")


def test_certificates_refuse_it_by_name(known):
    observer = qpmhe.Luenberger([0.3])
    asked = {"horizon": 5, "region": REGION, "sizes": SIZES}
    assert 5 in certify(system(), observer, cost(False), **asked).constants
    found = certify(system(), observer, cost(True), **asked)
    assert not found.constants  # the observer's bound says nothing of J, and stays
    assert NAME in "".join(found.failures)


def test_the_monitor_bars_the_theorem_by_name(known):
    assert _barred(estimator(False)) == ""
    assert NAME in _barred(estimator(True))


def test_a_design_is_for_no_estimator_that_has_it(known):
    plan = design(system(), REGION, sizes=SIZES, horizon=5)
    for ridged in (False, True):
        own = cost(
            ridged, prior=plan.prior, disturbance=plan.disturbance, noise=plan.noise,
            discount=plan.discount,
        )
        mhe = estimator(ridged, (plan.system, own), candidate="reinitialized")
        run = mhe.run(MEASUREMENTS)
        if ridged:
            with pytest.raises(certificates.MismatchError, match=NAME):
                plan.along(run, mhe, initial_error=1.0)
        else:
            assert np.isfinite(plan.along(run, mhe, initial_error=1.0)).all()


def test_ipopt_refuses_it_by_name(known):
    pytest.importorskip("casadi")
    from qpmhe.studies.ipopt import IpoptEstimator

    given = {"f": lambda x: 0.9 * x, "h": lambda x: x, "horizon": 5, "initial_state": np.zeros(1)}
    IpoptEstimator(system(), qpmhe.Luenberger([0.3]), cost(False), **given)
    with pytest.raises(InvalidInputError, match=NAME):
        IpoptEstimator(system(), qpmhe.Luenberger([0.3]), cost(True), **given)


def test_held_parameters_are_no_part_of_a_certificate():
    plant = qpmhe.System(
        lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1, states=REGION,
        disturbances=qpmhe.Box([-0.1], [0.1]), noises=qpmhe.Box([-0.1], [0.1]),
    )
    held = qpmhe.augment_parameters(plant, nominal=[0.0], hold=0.1)
    gain, weights = qpmhe.Luenberger([[0.3], [0.1]]), qpmhe.QuadraticCost(
        prior=np.eye(2), disturbance=np.eye(2), noise=1.0
    )
    region = qpmhe.Box([-9.0, -1.0], [9.0, 1.0])
    found = certify(held, gain, weights, horizon=5, region=region, sizes=SIZES)
    assert not found.constants
    assert "held parameters" in "".join(found.failures)


def test_an_augmented_model_refuses_an_option_that_it_does_not_know(monkeypatch):
    plant = qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1)
    monkeypatch.setattr(qpmhe.System, "ridge", None, raising=False)
    monkeypatch.setitem(SystemOptions.__annotations__, "ridge", float)
    assert qpmhe.noisy_inputs(plant).n == 2
    monkeypatch.setattr(qpmhe.System, "ridge", STIFFNESS)
    for change in (
        lambda: qpmhe.noisy_inputs(plant),
        lambda: qpmhe.augment_parameters(plant, nominal=[0.0]),
    ):
        with pytest.raises(InvalidInputError, match="the system has ridge, which"):
            change()


def test_all_options_of_a_system_are_among_those_that_an_augmented_model_asks_for():
    given = set(inspect.signature(qpmhe.System.__init__).parameters)
    functions = {"self", "f", "h", "n", "p", "m", "f_jacobian", "h_jacobian"}
    assert given - functions == set(SystemOptions.__annotations__)
    assert set(SystemOptions.__annotations__) == augmentation._KNOWN
