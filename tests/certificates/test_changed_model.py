"""A certificate of a model that changed afterwards, in the same System object, is refused."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe import certificates
from qpmhe.certificates import Monitor, Sizes, certify, certify_observer
from qpmhe.certificates.evidence import MismatchError
from qpmhe.certificates.model_values import ModelValues
from qpmhe.certificates.regions import bounded_region
from qpmhe.errors import OptionError

from .helpers import box, unit_cost

GAIN = qpmhe.Luenberger([[0.1]])
SMALL = {"disturbances": box(-0.01, 0.01), "noises": box(-0.01, 0.01)}


class Plant:
    """0.8 x + c u, seen through h: all in arrays that a user may change."""

    def __init__(self, inputs=0, region=2.0):
        self.a, self.c, self.bend = np.array([[0.8]]), np.ones(1), np.zeros(1)
        if inputs:
            self.system = qpmhe.System(
                lambda x, u: x @ self.a.T + self.c * u, lambda x, u: self.c * x, n=1, p=1, m=1,
                **SMALL,
            )
        else:
            self.system = qpmhe.System(
                lambda x: x @ self.a.T, lambda x: self.c * x + self.bend * x**2, n=1, p=1, **SMALL
            )
        self.certificate = certify(
            self.system, GAIN, unit_cost(), horizon=3, region=box(-region, region),
            inputs=box(-1.0, 1.0) if inputs else None,
        )

    def estimator(self, **options):
        return qpmhe.MovingHorizonEstimator(
            self.system, GAIN, self.certificate.cost, horizon=3, initial_state=[0.0], max_qps=1,
            **options,
        )


def to_one(plant):
    plant.a[0, 0] = 1.0


def scaled_output(plant):
    plant.c[0] = 1.05


def bent_output(plant):
    plant.bend[0] = 1e-4


def broken(plant):
    plant.a = None


CHANGES = {
    to_one: "f is .* and was .* when it was certified", scaled_output: "h is", bent_output: "h is",
    broken: "f or h raises",
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_use_that_begins_after_the_change_is_refused(change):
    plant, words = Plant(), CHANGES[change]
    run = plant.estimator().run(np.zeros((5, 1)))
    bound = plant.certificate.observer_bound
    Monitor(bound, mhe := plant.estimator(), initial_error=0.1)
    assert bound.along(run, initial_error=0.1).lost is None
    assert plant.certificate.bound(run, initial_error=0.1).shape == (6,)
    change(plant)
    for use in (
        lambda: Monitor(plant.certificate, mhe, initial_error=0.1),
        lambda: Monitor(bound, mhe, initial_error=0.1),
        lambda: bound.along(run, initial_error=0.1),
        lambda: plant.certificate.bound(run, initial_error=0.1),
    ):
        with pytest.raises(MismatchError, match=f"another than was certified: {words}"):
            use()


@pytest.mark.filterwarnings("ignore::qpmhe.errors.EngineWarning")  # the estimator sees it, too
@pytest.mark.parametrize("change", [to_one, scaled_output, bent_output])
def test_a_change_while_the_monitor_watches_ends_the_bound(change):
    plant = Plant()
    mhe, certificate = plant.estimator(), plant.certificate
    watch = Monitor(certificate, mhe, initial_error=0.1)
    for _ in range(20):
        assert watch.check(mhe.update([0.0])).lost is None
    assert watch.applies
    change(plant)
    for _ in range(9):
        reading = watch.check(mhe.update([0.0]))
    assert 20 <= reading.lost < 28
    assert reading.reason.startswith("the system is another than was certified: ")
    assert np.isnan([reading.radius, *reading.lower, *reading.upper, reading.error]).all()
    assert not watch.applies
    with pytest.raises(MismatchError, match="another than was certified"):
        Monitor(certificate, mhe, initial_error=0.1)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.EngineWarning")  # the estimator sees it, too
def test_no_true_state_is_outside_of_a_box_after_the_change():
    """The plant is identified again: without the check, it leaves the box at most samples."""
    plant = Plant()
    mhe, x = plant.estimator(), np.array([0.05])
    watch = Monitor(plant.certificate, mhe, initial_error=0.1)
    # The box that the certificate goes on with, from the observer's own recursion.
    bound = plant.certificate.observer_bound
    entering, outside, old = bound.entering(), 0, bound.initial(0.1)
    for t in range(60):
        if t == 5:
            to_one(plant)
        reading = watch.check(mhe.update(x - 0.01))
        x, old = plant.a[0] * x + 0.01, bound.advanced(old, entering)
        lower, upper = bound.around(old, mhe.observer_state)
        outside += bool(((x < lower) | (x > upper)).any())
        assert not ((x < reading.lower) | (x > reading.upper)).any()
    assert outside > 40


def test_parts_and_copies_are_for_the_certified_values():
    plant = Plant()
    system, region = plant.system, box(-2.0, 2.0)
    parts = {
        "stability": certify_observer(system, GAIN, region),
        "detectability": certificates.certify_detectability(system, region),
    }
    asked = {"horizon": 3, "region": region}
    assert certify(system, GAIN, unit_cost(), **asked, **parts).holds
    # A copy has lost the System, and has the values.
    copied = pickle.loads(pickle.dumps(plant.certificate.observer_bound))
    assert copied.stability.system is None
    twin, other = Plant(), Plant()
    to_one(other)
    assert Monitor(copied, twin.estimator(), initial_error=0.1).lost is None
    with pytest.raises(MismatchError, match="another than was certified: f is"):
        Monitor(copied, other.estimator(), initial_error=0.1)
    to_one(plant)
    for name, part in parts.items():
        with pytest.raises(MismatchError, match=f"changed since the {name} that was passed"):
            certify(system, GAIN, unit_cost(), **asked, **{name: part})


def test_a_design_is_for_the_certified_values():
    plant = Plant()
    made = certificates.design(plant.system, box(-2.0, 2.0), horizon=5)
    mhe = qpmhe.MovingHorizonEstimator(
        plant.system, GAIN, made.cost(), horizon=5, initial_state=[0.0],
        candidate="reinitialized",
    )
    run = mhe.run(np.zeros((4, 1)))
    assert np.isfinite(made.along(run, mhe, initial_error=0.1)).all()
    scaled_output(plant)
    with pytest.raises(MismatchError, match=r"another than was certified: h is .*make a design"):
        made.along(run, mhe, initial_error=0.1)


def test_inputs_count_and_so_does_the_last_bit_of_an_expression():
    plant = Plant(inputs=1)
    assert plant.certificate.stability.model.points.shape == (8, 2)
    run = plant.estimator().run(np.zeros((4, 1)), np.zeros((4, 1)))
    assert plant.certificate.observer_bound.along(run, initial_error=0.1).lost is None
    for factor, words in ((1.0 + 1e-13, "f, h differ"), (1.0 + 1e-6, "f is")):
        plant.c[0] = factor
        with pytest.raises(MismatchError, match=f"another than was certified: {words}"):
            plant.certificate.observer_bound.along(run, initial_error=0.1)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_differences_count_in_any_unit(unit):
    scale = np.array([unit, 1.0])

    def made(factor):
        return qpmhe.System(
            lambda x: scale * (factor * x / scale), lambda x: x[:1], n=2, p=1
        )

    values = ModelValues.of(made(0.5), bounded_region(made(0.5), box(-scale, scale)))
    assert values.difference(made(0.5 * (1.0 + 1e-12))) == ""
    for other, words in (
        (made(np.array([0.5 + 1e-6, 0.5])), "f is"), (made(np.array([0.5, 0.5 + 1e-6])), "f is"),
        (made(np.nan), "f is"),
        (qpmhe.System(lambda x: x, lambda x: x, n=2, p=2), r"\(n, p, m\) is \(2, 2, 0\)"),
    ):
        assert values.difference(other).startswith(words.replace("\\", ""))


def test_noises_with_which_an_angle_wraps_are_refused():
    """Certified for |v| < pi - 2; with more, an innovation may wrap, and no bound follows."""
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: 1.0 * x, n=1, p=1, output_residual=qpmhe.angles([0])
    )
    observer = qpmhe.Luenberger([[0.5]])
    asked = {"horizon": 3, "region": box(-1.0, 1.0)}
    certificate = certify(system, observer, unit_cost(), sizes=Sizes(0.01, 0.5), **asked)
    bound = certificate.observer_bound
    assert bound.stability.room == pytest.approx([np.pi - 2.0])
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, certificate.cost, horizon=3, initial_state=[0.0]
    )
    run, words = mhe.run(np.zeros((4, 1))), "noise of the angle .* expected less than 1.14159"
    assert np.isfinite(bound.along(run, noises=1.1, initial_error=0.1).radius).all()
    for use in (
        lambda: bound.along(run, noises=1.2, initial_error=0.1),
        lambda: bound.along(run, noises=np.full((4, 1), -1.2), initial_error=0.1),
        lambda: Monitor(bound, mhe, initial_error=0.1, sizes=Sizes(0.01, box(-3.0, 0.1))),
        lambda: certify(
            system, observer, unit_cost(), sizes=Sizes(0.01, 2.0), stability=bound.stability,
            **asked,
        ),
    ):
        with pytest.raises(OptionError, match=words):
            use()
