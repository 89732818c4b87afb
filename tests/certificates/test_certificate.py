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

from .helpers import linear, scalar, unit_box, unit_cost

SLACK = 1 + 1e-9
KINDS = ("paper", "weighted", "measured")


def test_the_reactors_constants_are_the_theorems(reactor):
    certificate, _ = reactor
    assert certificate.evidence is Evidence.PROVED
    detected, observed = certificate.detectability, certificate.stability
    assert (detected.eta, observed.rho) == (0.9, 0.95)
    assert 1.0 <= observed.C_p < 1.6
    for N in (1, 5, 10):
        again = TheoremConstants(
            DecayingSums(0.9, detected.c_p, detected.c_w, detected.c_v),
            DecayingSums(0.95, observed.C_p, observed.C_w, np.sqrt(0.5)),  # 1 / L_h
            certificate.audit.constants, kappa=np.sqrt(0.005), lipschitz=np.sqrt(2.0), horizon=N,
        )
        assert pytest.approx(again.C, rel=1e-9) == certificate.of(N).paper.C


def test_kinds_limits_and_their_growth(reactor):
    certificate, _ = reactor
    assert set(KINDS) <= set(certificate.kinds)
    paper, weighted = (
        [certificate.limit(0.3, 0.6, horizon=N, kind=kind) for N in certificate.horizons]
        for kind in KINDS[:2]
    )
    assert all(a > 5 * b for a, b in zip(paper, weighted, strict=True))
    assert paper == sorted(paper)
    assert weighted[2] < 1.2 * weighted[1]  # no power of 1 / rho
    for N in certificate.horizons:
        assert certificate.vacuous(horizon=N, kind="paper")
    assert not certificate.vacuous(0.0, 0.0, horizon=10, kind="paper")
    record, given, _ = played(*reactor, 0, 10)
    assert certificate.bound(*record, **given, kind="measured").max() < certificate.diameter


def played(certificate, scenario, seed, horizon, **options):
    """A run, the arguments of its bounds, and its error."""
    states, measurements = scenario.simulate(seed)
    system = certificate.system
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, certificate.cost, horizon=horizon,
        initial_state=scenario.initial_estimate, **options,
    )
    run = mhe.run(measurements)
    w = states[1:] - system.f.batch(states[:-1], np.zeros((len(states) - 1, 0)))
    v = measurements - states[:-1].sum(axis=1, keepdims=True)
    given = {"initial_error": states[0] - run.states[0], "source": mhe, "horizon": horizon}
    return (run, w, v), given, np.linalg.norm(states - run.states, axis=1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("max_qps", [0, 2])
def test_no_bound_is_below_the_error(reactor, kind, max_qps):
    for seed in range(3):
        record, given, error = played(*reactor, seed, 5, max_qps=max_qps)
        bound = reactor[0].bound(*record, **given, kind=kind)
        assert (error <= bound).all()


def test_the_paper_bound_is_the_right_hand_side(reactor):
    certificate, _ = reactor
    (run, w, v), given, _ = played(*reactor, 0, 5)
    C, lam = certificate.of(5).paper.C, certificate.of(5).paper.lam
    found = certificate.bound(run, w, v, **given, kind="paper")
    for t in (0, 3, 60):
        expected = C[0] * np.sqrt(8.0) * lam**t + sum(
            lam**tau * (C[1] * np.linalg.norm(w[t - tau]) + C[2] * abs(v[t - tau, 0]))
            for tau in range(1, t + 1)
        )
        assert found[t] == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("kind", KINDS[:2])
def test_bounded_disturbances_give_the_funnel(reactor, kind):
    certificate, _ = reactor
    (run, w, v), given, _ = played(*reactor, 0, 5)
    w_max, v_max = np.linalg.norm(w, axis=1).max(), np.abs(v).max()

    def funnel(start, steps):
        return certificate.funnel(
            w_max, v_max, initial_error=start, steps=steps, horizon=5, kind=kind
        )

    start = np.sqrt(8.0)
    same = certificate.bound(run, w_max, v_max, initial_error=start, horizon=5, kind=kind)
    np.testing.assert_array_equal(funnel(start, len(run)), same)
    assert (certificate.bound(run, w, v, **given, kind=kind) <= SLACK * same).all()
    limit = certificate.limit(w_max, v_max, horizon=5, kind=kind)
    assert limit == pytest.approx(funnel(0.0, 900)[-1])


def test_a_linear_system_with_free_rates(linear):
    assert linear.evidence is Evidence.PROVED
    np.testing.assert_allclose(linear.sizes.disturbances.upper, [1.5, 1.0])
    np.testing.assert_allclose(linear.sizes.noises.upper, np.sqrt(3.0))
    assert "three standard deviations of the cost's inverse weights" in str(linear.sizes)
    assert linear.of() is linear.of(4)


def test_assumed_constants_give_the_plain_bounds_and_say_so():
    power = qpmhe.Power(1.0, 1.5)
    certificate = certify(
        scalar(lambda x: 0.8 * x, states=unit_box(1)),
        qpmhe.OutputInjection(lambda z, v: 0.3 * v),
        qpmhe.RobustCost(prior=power, disturbance=power, noise=power), horizon=3,
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.1),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
    )
    assert certificate.evidence is Evidence.ASSUMED
    assert "summed" in certificate.kinds
    with pytest.raises(OptionError, match=r"kind is 'weighted'.*'summed'"):
        certificate.limit(1.0, 1.0, kind="weighted")
    assert certificate.of().paper.cost.exponent == 1.5


def test_json_holds_everything(reactor):
    certificate, _ = reactor
    content = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert content["evidence"] == content["detectability"]["evidence"] == "proved"
    assert [each["horizon"] for each in content["horizons"]] == [1, 5, 10]
    for each in content["horizons"]:
        paper = certificate.of(each["horizon"]).paper
        assert (each["paper"]["C"], each["paper"]["lambda"]) == (list(paper.C), paper.lam)
        limit = certificate.limit(0.3, 0.6, horizon=each["horizon"], kind="weighted")
        assert each["weighted"]["limit"] == pytest.approx(limit)
        assert each["weighted"]["beyond_the_paper"] is True
    assert content["vacuous"]["paper"]["10"] is True
    assert len(content["assumed"]) >= 2


def test_infinite_constants_are_vacuous_and_fit_into_json(reactor):
    certificate, _ = reactor
    far = certify(
        certificate.system, certificate.observer, certificate.cost, horizon=80,
        region=certificate.region,
        detectability=Detectability.assumed(eta=1e-5, c_p=1.0, c_w=1.0, c_v=1.0),
        stability=ObserverStability.assumed(rho=1e-5, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1),
    )
    assert math.isinf(far.of().paper.C[0])
    assert far.vacuous(kind="paper")
    content = json.loads(json.dumps(far.to_dict(), allow_nan=False))
    assert content["horizons"][0]["paper"]["C"][0] is None
    assert math.isfinite(content["horizons"][0]["summed"]["limit"])


HUBER = qpmhe.RobustCost(prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber(1.0))
DISCOUNTED = qpmhe.QuadraticCost(
    prior=np.eye(2), disturbance=np.eye(2), noise=1.0, discount=0.9
)
KALMAN = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)


@pytest.mark.parametrize(
    ("arguments", "error", "words", "audited"),
    [
        ({"horizon": 0}, OptionError, "horizon", False),
        ({"horizon": ()}, OptionError, "horizon", False),
        ({"horizon": 1.5}, OptionError, "horizon is 1.5", False),
        ({"horizon": "5"}, OptionError, "horizon is '5'", False),
        ({"horizon": None}, OptionError, "horizon is None", False),
        ({"horizon": [1, 2.5]}, OptionError, "horizon is 2.5", False),
        ({"region": None}, SetError, "region", True),
        ({"region": qpmhe.Box([0.1, -np.inf], [9.0, np.inf])}, SetError, "unbounded", True),
        ({"region": ([-1], [1])}, SetError, "region is", True),
        ({"cost": None}, InvalidInputError, "cost is None", True),
        ({"cost": unit_cost()}, ShapeError, "for 1 states and 1 outputs; expected 2 and 1", True),
        ({"observer": KALMAN}, CertificateError, "constant gain", False),
        ({"observer": qpmhe.Luenberger([[-0.5], [0.5]])}, NotCertifiedError, "gain", False),
        ({"observer": None}, InvalidInputError, "observer is None", True),
        ({"system": None}, ModelError, "system is None", True),
    ],
)
def test_what_cannot_be_certified_is_named(reactor, arguments, error, words, audited):
    certificate, _ = reactor
    parts = {name: getattr(certificate, name) for name in ("system", "observer", "cost", "region")}
    given = parts | {"horizon": 5, "detectability": certificate.detectability} | arguments
    with pytest.raises(error, match=words):
        certify(given.pop("system"), given.pop("observer"), given.pop("cost"), **given)
    if audited:
        with pytest.raises(error, match=words):
            audit(*(parts | arguments).values())


@pytest.mark.parametrize(("cost", "words"), [(DISCOUNTED, "discount"), (HUBER, "no constants")])
def test_a_cost_without_constants_leaves_the_observers_bound(reactor, cost, words):
    certificate, _ = reactor
    found = certify(
        certificate.system, certificate.observer, cost, horizon=5, region=certificate.region,
        detectability=certificate.detectability, stability=certificate.stability,
    )
    assert found.observer_bound is not None
    assert not found.bounds
    assert words in str(found.errors["the theorem"])


def test_an_undetectable_system_is_named_with_its_mode():
    with pytest.raises(NotCertifiedError, match=r"1\.1.*not in the output"):
        certify(
            linear(np.diag([0.5, 1.1]), [[1.0, 0.0]], states=unit_box(2)),
            qpmhe.Luenberger([[0.2], [0.0]]), unit_cost(2), horizon=3,
        )


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"horizon": 7}, OptionError, "horizon"),
        ({"horizon": None}, OptionError, "horizon"),
        ({"disturbances": 0.1}, ShapeError, "run"),
        ({"noises": np.zeros((4, 2))}, ShapeError, "noises"),
        ({"initial_error": np.zeros(3)}, ShapeError, "initial_error"),
        ({"initial_error": -1.0}, OptionError, "initial_error is"),
        ({"kind": "best"}, OptionError, "kind"),
        ({"kind": "measured"}, InvalidInputError, "source"),
    ],
)
def test_bad_arguments_of_a_bound_are_named(reactor, arguments, error, words):
    given = {
        "disturbances": np.zeros(4), "noises": 0.1, "initial_error": 1.0, "horizon": 5,
        "kind": "paper",
    } | arguments
    with pytest.raises(error, match=words):
        reactor[0].bound(None, **given)


@pytest.mark.parametrize("value", [-1, -1.0, math.nan, math.inf, "1", True, [1.0]])
@pytest.mark.parametrize("kind", KINDS[:2])
def test_lengths_out_of_range_are_named(reactor, value, kind):
    certificate, options = reactor[0], {"horizon": 5, "kind": kind}
    with pytest.raises(OptionError, match="w_max is"):
        certificate.limit(value, 0.1, **options)
    with pytest.raises(OptionError, match="v_max is"):
        certificate.funnel(0.1, value, initial_error=1.0, steps=3, **options)
    with pytest.raises(OptionError, match="initial_error is"):
        certificate.funnel(0.1, 0.1, initial_error=value, steps=3, **options)
    with pytest.raises(OptionError, match="w_max is"):
        certificate.vacuous(value, 0.1, **options)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [*(({"steps": steps}, "steps is") for steps in (2.5, 0, -1, True, "3")),
     ({"kind": "measured"}, "nothing is measured yet")],
)
def test_a_funnel_needs_steps_and_nothing_measured(reactor, arguments, words):
    given = {"initial_error": 1.0, "steps": 3, "horizon": 5, "kind": "paper"} | arguments
    with pytest.raises(OptionError, match=words):
        reactor[0].funnel(0.1, 0.1, **given)


def test_no_ingredient_is_named_by_the_parts_as_well(reactor):
    for question in (
        lambda: certify_detectability(None, unit_box(1)),
        lambda: synthesise_gain(None, unit_box(1)),
        lambda: certify_observer(None, qpmhe.Luenberger([[0.1]]), unit_box(1)),
    ):
        with pytest.raises(ModelError, match="system is None"):
            question()
    with pytest.raises(InvalidInputError, match="observer is None"):
        certify_observer(reactor[0].system, None, reactor[0].region)


def test_figure_shows_error_and_bounds():
    axes = qpmhe.plots.error_and_bounds(
        np.arange(5.0), np.array([1.0, 0.5, 0.0, 0.2, 0.1]),
        {LABELS["paper"]: np.full(5, 30.0), LABELS["weighted"]: np.full(5, np.inf)},
        diameter=3.0, time_label="t (s)",
    )
    assert axes.get_yscale() == "log"
    labels = [text.get_text() for text in axes.get_figure().legends[0].get_texts()]
    assert labels == ["error", LABELS["paper"], LABELS["weighted"]]
    assert axes.get_ylim()[1] > 30.0
    with pytest.raises(ShapeError, match="error"):
        qpmhe.plots.error_and_bounds(np.arange(5.0), np.ones(4), {})
