"""The certificate as a whole: what it is made of, what it bounds, and what it says."""

import json
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.audit import audit
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability, certify_observer, synthesise_gain
from qpmhe.certificates.evidence import CertificateError, Evidence, NotCertifiedError
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.certificates.report import LABELS
from qpmhe.certificates.theorem import DecayingSums, TheoremConstants
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError

SLACK = 1 + 1e-9
KINDS = ("paper", "weighted", "measured")


def test_the_reactors_constants_are_the_theorems(reactor):
    certificate, _ = reactor
    assert certificate.evidence is Evidence.PROVED
    detected, observed = certificate.detectability, certificate.stability
    assert (detected.eta, observed.rho) == (0.9, 0.95)
    assert observed.C_p == pytest.approx(1.0, abs=1e-6)  # it contracts with P = I
    for N in (1, 5, 10):
        paper = certificate.of(N).paper
        again = TheoremConstants(
            DecayingSums(0.9, detected.c_p, detected.c_w, detected.c_v),
            DecayingSums(0.95, observed.C_p, observed.C_w, np.sqrt(0.5)),  # 1 / L_h
            certificate.audit.constants, kappa=np.sqrt(0.005), lipschitz=np.sqrt(2.0), horizon=N,
        )
        assert pytest.approx(again.C, rel=1e-9) == paper.C


def test_each_kind_is_sharper_than_the_one_before(reactor):
    certificate, _ = reactor
    assert certificate.kinds == KINDS
    for N in certificate.horizons:
        paper, weighted = (
            certificate.limit(0.3, 0.6, horizon=N, kind=kind) for kind in KINDS[:2]
        )
        assert paper > 5 * weighted


def test_growth_with_the_horizon_is_that_of_the_observers_rate(reactor):
    certificate, _ = reactor
    grown = [certificate.of(N).paper.C[0] for N in certificate.horizons]
    assert grown == sorted(grown)
    limits = [certificate.limit(0.3, 0.6, horizon=N, kind="weighted") for N in (5, 10)]
    # Beyond the paper, lasting noise costs no power of 1 / rho.
    assert limits[1] < 1.2 * limits[0]


def test_the_paper_bound_is_called_vacuous_and_the_measured_one_is_not(reactor):
    certificate, scenario = reactor
    assert all(certificate.vacuous(horizon=N) for N in certificate.horizons)
    assert not certificate.vacuous(0.0, 0.0, horizon=10)
    states, _ = scenario.simulate(0)
    run, w, v, mhe = played(certificate, scenario, 0, 10)
    measured = certificate.bound(
        run, w, v, initial_error=states[0] - run.states[0], kind="measured", source=mhe
    )
    assert measured.max() < certificate.diameter


def played(certificate, scenario, seed, horizon, **options):
    states, measurements = scenario.simulate(seed)
    mhe = qpmhe.MovingHorizonEstimator(
        certificate.system, certificate.observer, certificate.cost, horizon=horizon,
        initial_state=scenario.initial_estimate, **options,
    )
    run = mhe.run(measurements)
    w = states[1:] - certificate.system.f.batch(states[:-1], np.zeros((len(states) - 1, 0)))
    return run, w, measurements - states[:-1].sum(axis=1, keepdims=True), mhe


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("max_qps", [0, 2])
def test_no_bound_is_below_the_error(reactor, kind, max_qps):
    certificate, scenario = reactor
    for seed in range(3):
        states, _ = scenario.simulate(seed)
        run, w, v, mhe = played(certificate, scenario, seed, 5, max_qps=max_qps)
        error = np.linalg.norm(states - run.states, axis=1)
        bound = certificate.bound(
            run, w, v, initial_error=states[0] - run.states[0], horizon=5, kind=kind,
            source=mhe,
        )
        assert (error <= bound).all()


def test_bounded_disturbances_give_the_funnel(reactor):
    certificate, scenario = reactor
    run, w, v, _ = played(certificate, scenario, 0, 5)
    w_max, v_max = np.linalg.norm(w, axis=1).max(), np.abs(v).max()
    for kind in KINDS[:2]:
        funnel = certificate.funnel(
            w_max, v_max, initial_error=np.sqrt(8.0), steps=len(run), horizon=5, kind=kind
        )
        same = certificate.bound(
            run, w_max, v_max, initial_error=np.sqrt(8.0), horizon=5, kind=kind
        )
        np.testing.assert_array_equal(funnel, same)
        along = certificate.bound(run, w, v, initial_error=[2.0, 2.0], horizon=5, kind=kind)
        assert (along <= SLACK * funnel).all()
        late = certificate.funnel(
            w_max, v_max, initial_error=0.0, steps=900, horizon=5, kind=kind
        )[-1]
        assert certificate.limit(w_max, v_max, horizon=5, kind=kind) == pytest.approx(late)


def test_the_paper_bound_is_the_right_hand_side(reactor):
    certificate, scenario = reactor
    run, w, v, _ = played(certificate, scenario, 0, 5)
    C, lam = certificate.of(5).paper.C, certificate.of(5).paper.lam
    found = certificate.bound(run, w, v, initial_error=[2.0, 2.0], horizon=5)
    for t in (0, 3, 60):
        expected = C[0] * np.sqrt(8.0) * lam**t + sum(
            lam**tau * (C[1] * np.linalg.norm(w[t - tau]) + C[2] * abs(v[t - tau, 0]))
            for tau in range(1, t + 1)
        )
        assert found[t] == pytest.approx(expected, rel=1e-8)


def test_a_linear_system_with_free_rates(linear):
    assert linear.evidence is Evidence.PROVED
    sizes = linear.sizes.disturbance, linear.sizes.noise
    assert sizes == pytest.approx((0.5, 1 / np.sqrt(3.0)))
    assert linear.of() is linear.of(4)


def test_assumed_constants_give_the_plain_bounds_and_say_so():
    system = qpmhe.System(
        lambda x: 0.8 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-1.0], [1.0])
    )
    cost = qpmhe.RobustCost(
        prior=qpmhe.Power(1.0, 1.5), disturbance=qpmhe.Power(1.0, 1.5),
        noise=qpmhe.Power(1.0, 1.5),
    )
    observer = qpmhe.OutputInjection(lambda z, v: 0.3 * v)
    certificate = certify(
        system, observer, cost, horizon=3,
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.1),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
    )
    assert certificate.evidence is Evidence.ASSUMED
    assert certificate.kinds == ("paper", "summed", "measured")
    with pytest.raises(OptionError, match=r"kind is 'weighted'.*'summed'"):
        certificate.limit(1.0, 1.0, kind="weighted")
    assert certificate.of().paper.cost.exponent == 1.5


def test_json_holds_everything(reactor):
    certificate, _ = reactor
    told = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert told["evidence"] == "proved"
    assert [each["horizon"] for each in told["horizons"]] == [1, 5, 10]
    for each in told["horizons"]:
        paper = certificate.of(each["horizon"]).paper
        assert each["paper"]["C"] == list(paper.C)
        assert each["paper"]["lambda"] == paper.lam
        assert each["weighted"]["limit"] == pytest.approx(
            certificate.limit(0.3, 0.6, horizon=each["horizon"], kind="weighted")
        )
        assert each["weighted"]["beyond_the_paper"] is True
    assert told["vacuous"]["paper"]["10"] is True
    assert told["detectability"]["evidence"] == "proved"
    assert len(told["assumed"]) == 2


def test_infinite_constants_are_vacuous_and_fit_into_json(reactor):
    certificate, _ = reactor
    system, observer, cost = certificate.system, certificate.observer, certificate.cost
    far = certify(
        system, observer, cost, horizon=80, region=certificate.region,
        detectability=Detectability.assumed(eta=1e-5, c_p=1.0, c_w=1.0, c_v=1.0),
        stability=ObserverStability.assumed(rho=1e-5, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1),
    )
    assert math.isinf(far.of().paper.C[0])
    assert far.vacuous()
    told = json.loads(json.dumps(far.to_dict(), allow_nan=False))
    assert told["horizons"][0]["paper"]["C"][0] is None
    assert math.isfinite(told["horizons"][0]["summed"]["limit"])


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"horizon": 0}, OptionError, "horizon"),
        ({"horizon": ()}, OptionError, "horizon"),
        ({"region": None}, SetError, "region"),
        ({"region": qpmhe.Box([0.1, -np.inf], [9.0, np.inf])}, SetError, "unbounded"),
        ({"cost": qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0,
                                      discount=0.9)}, CertificateError, "discount"),
        ({"cost": qpmhe.RobustCost(prior=np.eye(2), disturbance=np.eye(2),
                                   noise=qpmhe.Huber(1.0))}, CertificateError, "no constants"),
        ({"observer": qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)},
         CertificateError, "constant gain"),
        ({"observer": qpmhe.Luenberger([[-0.5], [0.5]])}, NotCertifiedError, "gain"),
    ],
)
def test_what_cannot_be_certified_is_told(reactor, arguments, error, words):
    certificate, _ = reactor
    given = {
        "system": certificate.system, "observer": certificate.observer,
        "cost": certificate.cost, "horizon": 5, "region": certificate.region,
        "detectability": certificate.detectability,
    } | arguments
    with pytest.raises(error, match=words):
        certify(given.pop("system"), given.pop("observer"), given.pop("cost"), **given)


def test_an_undetectable_system_is_named_with_its_mode():
    system = qpmhe.System(
        lambda x: x * np.array([0.5, 1.1]), lambda x: x[..., :1], n=2, p=1,
        states=qpmhe.Box([-1.0, -1.0], [1.0, 1.0]),
    )
    with pytest.raises(NotCertifiedError, match=r"1\.1.*not in the output"):
        certify(
            system, qpmhe.Luenberger([[0.2], [0.0]]),
            qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0), horizon=3,
        )


def test_bad_arguments_of_a_bound_are_named(reactor):
    certificate, _ = reactor
    with pytest.raises(OptionError, match="horizon"):
        certificate.of(7)
    with pytest.raises(OptionError, match="horizon"):
        certificate.of()
    with pytest.raises(ShapeError, match="run"):
        certificate.bound(None, 0.1, 0.1, initial_error=1.0, horizon=5)
    with pytest.raises(ShapeError, match="noises"):
        certificate.bound(None, np.zeros(4), np.zeros((4, 2)), initial_error=1.0, horizon=5)
    with pytest.raises(ShapeError, match="initial_error"):
        certificate.bound(None, np.zeros(4), 0.1, initial_error=np.zeros(3), horizon=5)
    with pytest.raises(OptionError, match="kind"):
        certificate.bound(None, np.zeros(4), 0.1, initial_error=1.0, horizon=5, kind="best")
    with pytest.raises(qpmhe.errors.InvalidInputError, match="source"):
        certificate.bound(None, np.zeros(4), 0.1, initial_error=1.0, horizon=5, kind="measured")


@pytest.mark.parametrize("value", [-1, -1.0, math.nan, math.inf, "1", True, None, [1.0]])
def test_lengths_out_of_range_are_named(reactor, value):
    certificate, _ = reactor
    for kind in ("paper", "weighted"):
        with pytest.raises(OptionError, match="w_max is"):
            certificate.limit(value, 0.1, horizon=5, kind=kind)
        with pytest.raises(OptionError, match="v_max is"):
            certificate.funnel(0.1, value, initial_error=1.0, steps=3, horizon=5, kind=kind)
        with pytest.raises(OptionError, match="initial_error is"):
            certificate.funnel(0.1, 0.1, initial_error=value, steps=3, horizon=5, kind=kind)
        if value is not None:
            with pytest.raises(OptionError, match="w_max is"):
                certificate.vacuous(value, 0.1, horizon=5, kind=kind)
    with pytest.raises(OptionError, match="noise is"):
        certificate.of(5).paper.result.limit(1.0, value)


def test_a_funnel_needs_steps_and_nothing_measured(reactor):
    certificate, _ = reactor
    for steps in (2.5, 0, -1, True, "3"):
        with pytest.raises(OptionError, match="steps is"):
            certificate.funnel(0.1, 0.1, initial_error=1.0, steps=steps, horizon=5)
    with pytest.raises(OptionError, match="nothing is measured yet"):
        certificate.funnel(0.1, 0.1, initial_error=1.0, steps=3, horizon=5, kind="measured")
    with pytest.raises(OptionError, match="initial_error is"):
        certificate.bound(None, np.zeros(4), 0.1, initial_error=-1.0, horizon=5)


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"horizon": 1.5}, OptionError, "horizon is 1.5"),
        ({"horizon": "5"}, OptionError, "horizon is '5'"),
        ({"horizon": None}, OptionError, "horizon is None"),
        ({"horizon": [1, 2.5]}, OptionError, "horizon is 2.5"),
        ({"observer": None}, InvalidInputError, "observer is None"),
        ({"cost": None}, InvalidInputError, "cost is None"),
        ({"system": None}, ModelError, "system is None"),
        ({"region": ([-1], [1])}, SetError, "region is"),
        ({"cost": qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)}, ShapeError,
         "cost is for 1 states and 1 outputs; expected 2 and 1"),
    ],
)
def test_what_is_no_ingredient_is_named(reactor, arguments, error, words):
    certificate, _ = reactor
    given = {
        "system": certificate.system, "observer": certificate.observer,
        "cost": certificate.cost, "horizon": 5, "region": certificate.region,
    } | arguments
    with pytest.raises(error, match=words):
        certify(given.pop("system"), given.pop("observer"), given.pop("cost"), **given)
    if "horizon" not in arguments:
        given = {
            "system": certificate.system, "observer": certificate.observer,
            "cost": certificate.cost, "region": certificate.region,
        } | arguments
        with pytest.raises(error, match=words):
            audit(*given.values())


@pytest.mark.parametrize("question", [certify_detectability, synthesise_gain])
def test_no_system_is_named_by_the_parts_as_well(question):
    with pytest.raises(ModelError, match="system is None"):
        question(None, qpmhe.Box([-1.0], [1.0]))
    with pytest.raises(ModelError, match="system is None"):
        certify_observer(None, qpmhe.Luenberger([[0.1]]), qpmhe.Box([-1.0], [1.0]))


def test_no_observer_is_named_by_its_certification(reactor):
    certificate, _ = reactor
    with pytest.raises(InvalidInputError, match="observer is None"):
        certify_observer(certificate.system, None, certificate.region)


def test_figure_shows_error_and_bounds():
    times = np.arange(5.0)
    axes = qpmhe.plots.error_and_bounds(
        times, np.array([1.0, 0.5, 0.0, 0.2, 0.1]),
        {LABELS["paper"]: np.full(5, 30.0), LABELS["weighted"]: np.full(5, np.inf)},
        diameter=3.0, time_label="t (s)",
    )
    assert axes.get_yscale() == "log"
    labels = [text.get_text() for text in axes.get_figure().legends[0].get_texts()]
    assert labels == ["error", LABELS["paper"], LABELS["weighted"]]
    assert axes.get_ylim()[1] > 30.0
    with pytest.raises(ShapeError, match="error"):
        qpmhe.plots.error_and_bounds(times, np.ones(4), {})
