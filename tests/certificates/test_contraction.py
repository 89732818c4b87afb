"""What contracts on a region: detectability, observers, gains; known constants and refusals."""

import contextlib
import math
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

import qpmhe
from qpmhe import certificates
from qpmhe.certificates import Evidence, NotCertifiedError, certify_detectability, certify_observer
from qpmhe.certificates import deadline as deadline_module
from qpmhe.certificates import search as search_module
from qpmhe.certificates.observer_bound import ObserverBound
from qpmhe.certificates.regions import bounded_region
from qpmhe.certificates.sdp import SemidefiniteProgram
from qpmhe.errors import ModelError, OptionError, ShapeError

from .helpers import GAIN, PENDULUM, QUESTIONS, REACTOR, box, linear, scalar, unit_box, unit_cost


@pytest.mark.parametrize(("A", "C", "L"), [
    ([[1.1]], [[0.5]], [[0.6]]), (np.diag([0.7, 0.5]), [[1.0, 1.0]], [[0.0], [0.0]]),
    ([[0.9, 0.4], [-0.3, 0.8]], [[1.0, 0.0]], [[0.5], [0.1]]),
    ([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.3], [0.1, 0.0, 0.7]], [[1.0, 0.0, 0.0]],
     [[0.4], [0.1], [0.1]]),
])
def test_rates_of_linear_systems_are_reproduced(A, C, L):
    closed = np.subtract(A, np.matmul(L, C))
    true, region = float(np.abs(np.linalg.eigvals(closed)).max()), unit_box(len(closed))
    unseen, observer = linear(closed, 0.0 * np.array(C)), qpmhe.Luenberger(L)
    for ask in (
        lambda rate: certify_observer(linear(A, C), observer, region, rho=rate),
        lambda rate: certify_detectability(unseen, region, eta=rate),
    ):
        assert ask(true * (1.0 + 1e-6)).evidence is Evidence.PROVED
        with pytest.raises(NotCertifiedError):
            ask(true * (1.0 - 1e-12))


def test_scalar_system_has_the_known_constants_and_limit():
    found, sharp = certify_detectability(linear(1.1, 0.5), unit_box(1), eta=0.8), 0.57**0.5 / 0.4
    assert (found.evidence, found.form) == (Evidence.PROVED, "output weight")
    np.testing.assert_allclose([found.c_p, found.c_w, found.c_v], [1.0, 1.25, sharp], rtol=1e-4)
    assert found.c_v > sharp
    system, observer = linear(1.1, 0.5), qpmhe.Luenberger([[0.6]])  # |1.1 - 0.3| = 0.8
    found = certify_observer(system, observer, unit_box(1), rho=0.81)
    np.testing.assert_allclose(
        [found.C_p, found.C_w, found.C_v, found.kappa], [1.0, 1 / 0.81, 0.6 / 0.81, 0.6], rtol=1e-6
    )
    assert found.kappa >= 0.6
    with pytest.raises(NotCertifiedError) as caught:
        certify_observer(system, observer, unit_box(1), rho=0.79)
    np.testing.assert_allclose(caught.value.smallest_rate, 0.8, atol=2e-3)
    # e+ = 0.8 e + w - 0.6 v tends to (0.3 + 0.6 * 0.2) / 0.2 at most.
    given = {"region": unit_box(1), "sizes": certificates.Sizes(0.3, 0.2)}
    bound = certificates.certify(system, observer, unit_cost(), horizon=1, **given).observer_bound
    assert 2.1 <= bound.components(bound.limit())[0] <= 2.1 * (1.0 + 2e-3)


@pytest.mark.slow
def test_the_inequality_holds_between_any_two_states():
    system, region = qpmhe.models.cstr()[0], box([0.4, 345.0], [0.6, 355.0])
    found = certify_detectability(system, region, eta=0.9, inputs=box(290.0, 310.0))
    assert found.evidence is Evidence.PROVED
    rng, width = np.random.default_rng(0), region.upper - region.lower
    (one, other), u = rng.uniform(region.lower, region.upper, (2, 9000, 2)), np.full((9000, 1), 295)
    w = 10.0 ** rng.uniform(-6.0, 0.0, (9000, 1)) * width * rng.standard_normal(2)
    f, h = (g.batch(one, u) - g.batch(other, u) for g in (system.f, system.h))
    ahead, start, supplied, seen = (
        np.sqrt(np.einsum("ti,ij,tj->t", s, M, s))
        for s, M in ((f + w, found.P), (one - other, found.P), (w, found.P), (h, found.V))
    )
    assert (ahead <= (0.9 * start + supplied + seen) * (1.0 + 1e-12)).all()


@pytest.mark.slow
def test_nonlinear_output_takes_output_injection():
    # C in [0.7, 1.3]: with multipliers any rate is feasible, and R = (1 - eta^2) / 0.7^2.
    found = certify_detectability(
        scalar(lambda x: 1.0 * x, lambda x: x + 0.3 * np.sin(x)), box(-5.0, 5.0), eta=0.6
    )
    assert (found.evidence, found.form) == (Evidence.PROVED, "output injection")
    assert 1.0 < found.c_v / (0.8 / 0.7 / 0.6) < 1.05


def test_what_holds_at_every_state_need_not_hold_for_averages():
    # |C| = 1 everywhere, but x and x + 2 pi have one output, and x grows.
    system = qpmhe.System(
        lambda x: 1.05 * x, lambda x: np.concatenate((np.sin(x), np.cos(x)), -1), n=1, p=2
    )
    with pytest.raises(NotCertifiedError, match="no constant P"):
        certify_detectability(system, box(0.0, 2.0 * np.pi), eta=0.9)
    assert certify_detectability(system, box(0.0, 1.5), eta=0.9).evidence is Evidence.PROVED


def test_no_proof_rests_on_a_given_derivative():
    # h(x) = x, with a derivative that is wrong where the system's own check does not look.
    wrong = scalar(h_jacobian=lambda x: np.array([[1.0 if x[0] < 3.0 else 0.01]]))
    found = [QUESTIONS["certificate"](each, box(4.0, 10.0)) for each in (scalar(), wrong)]
    assert found[1].evidence is Evidence.PROVED
    np.testing.assert_allclose(*(each.of().C for each in found), rtol=1e-6)


def oscillator(drift=0.0):
    """A nonlinear oscillator whose third state is a constant parameter."""

    def f(x):
        a, b, c = np.moveaxis(x, -1, 0)
        ahead = 0.9 * a + 0.2 * b, -0.2 * a + 0.8 * b + 0.1 * c * np.sin(a), c + drift * a
        return np.stack(ahead, -1)

    return qpmhe.System(f, lambda x: x[..., :1], n=3, p=1)


@pytest.mark.slow
def test_a_known_parameter_is_left_out_and_what_moves_it_is_named():
    gain, sizes = np.array([[0.5], [0.2], [0.0]]), ([0.1, 0.1, 0.0], [0.2])
    known = box([-1.0, -1.0, 0.3], [1.0, 1.0, 0.3])
    found = certify_observer(oscillator(), qpmhe.Luenberger(gain), known, rho=0.9, sizes=sizes)
    assert any("x[2] is known" in note for note in found.notes)
    assert not found.P[2, :2].any()
    assert found.P[2, 2] > 0.0
    synthesis = certificates.synthesise_gain(oscillator(), known, rho=0.9, sizes=sizes)
    assert "the error contracts at the rate 0.9 a sample, or faster (proved)" in str(synthesis)
    made = synthesis.stability
    np.testing.assert_array_equal(synthesis.observer.metric, made.P)
    assert not made.gain[2].any()
    seen = certify_detectability(oscillator(), known, eta=0.9)
    assert {each.evidence for each in (found, made, seen)} == {Evidence.PROVED}
    point = box([0.0, 0.0, 0.3], [0.0, 0.0, 0.3])
    for system, L, region, words in (
        (oscillator(1e-14), gain, known, r"no width in x\[2\], but f moves it"),
        (oscillator(), gain + 0.1, known, r"no width in x\[2\], but the observer's gain"),
        (oscillator(), 0.0 * gain, point, "single state"),
    ):
        with pytest.raises(NotCertifiedError, match=words):
            certify_observer(system, qpmhe.Luenberger(L), region, sizes=sizes)


class Odd(qpmhe.Luenberger):
    def correct(self, z, v, sample):
        return self.gain @ v + z, None


@pytest.mark.slow
def test_what_is_refused_says_why():
    hidden, plane = linear(np.diag([1.1, 0.5]), [[0.0, 1.0]]), unit_box(2)
    reactor, paper, _, _ = qpmhe.models.batch_reactor()
    with pytest.raises(NotCertifiedError, match=r"infeasible.*a larger eta") as caught:
        certify_detectability(reactor, REACTOR, eta=0.5)
    assert 0.6 < caught.value.smallest_rate < 0.75
    swinging, observer, _, _ = qpmhe.models.van_der_pol()
    constant = r" has no constant gain.*ObserverStability\.assumed"
    for ask, error, words in (
        (lambda: certify_observer(swinging, observer, box([-2.5, -3.0], [2.5, 3.0])),
         NotCertifiedError, r"radius 1\.0\d* at \[.*synthesise_gain"),
        (lambda: certify_detectability(hidden, plane, eta=1.0), OptionError, "eta is"),
        (lambda: certify_detectability(hidden, plane, seconds=0.0), OptionError, "seconds is"),
        *((lambda each=each: certify_observer(reactor, each, REACTOR),
           certificates.CertificateError, type(each).__name__ + constant) for each in (
               qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
               qpmhe.OutputInjection(lambda z, v: 0.1 * v * z), Odd([0.05, 0.05]))),
        (lambda: certify_observer(reactor, paper, REACTOR, sizes=([1.0] * 3, 1.0)), ShapeError,
         r"size of the disturbance has shape \(3,\)"),
    ):
        with pytest.raises(error, match=words):
            ask()


def test_what_raises_or_is_not_finite_is_named_with_the_state():
    def picky(x):
        if np.any(np.real(x) > 50.0):
            raise ValueError("too large")
        return 0.5 * x

    lost = scalar(lambda x: np.where(np.real(x) > 5.0, np.nan, 0.5 * x))
    for question in QUESTIONS.values():
        for letter in "fh":
            words = rf"{letter} raises ValueError at x = \[100.0\].*too large.*smaller region"
            with pytest.raises(ModelError, match=words):
                question(scalar(**{letter: picky}), box(-100.0, 100.0))
        with pytest.raises(ModelError, match=r"f is not finite at x = .*nan.*smaller region"):
            question(lost, box(-10.0, 5.001))


def test_what_jumps_is_not_certified_from_its_derivatives():
    def compared(place):
        return lambda x: np.array([0.5 * float(x[0]) + (5.0 if x[0] > place else 0.0)])

    between, aside = r"but not between \[.*may jump", box(-0.973, 0.931)
    for f, seen, region, words in (
        # No sample is at a jump; in the middle of the region, one is.
        (lambda x: 0.5 * x + 5.0 * np.sign(x), 0.0, aside, between),
        (compared(0.3), 0.0, aside, between),
        (compared(0.0), 1.0, unit_box(1), r"f jumps at \[0.0\].*changes by 5"),
    ):
        for which in ("detectability", "observer"):
            with pytest.raises(NotCertifiedError, match=words):
                QUESTIONS[which](scalar(f, lambda x, c=seen: c * x), region, seconds=60.0)
    kinked = scalar(lambda x: 0.5 * np.abs(x), lambda x: 0.0 * x)
    assert certify_detectability(kinked, unit_box(1), eta=0.8).evidence is Evidence.PROVED


@pytest.mark.slow
def test_what_cannot_be_enclosed_is_sampled_with_its_name_and_the_remedy(monkeypatch):
    stated = certificates.ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1)
    for h, word in (
        (lambda x: np.where(x > 0.3, 1e-9 + x, x), "h has a choice (numpy.where, if_else) that"),
        (lambda x: x + 1e-9 * np.floor(x), "h has a jump of floor"),
        (lambda x: np.sqrt(np.maximum(x, 0.0)), "a derivative has a division by a value that may"),
    ):
        output = certificates.certify(
            scalar(h=h), GAIN, unit_cost(), horizon=2, region=box(-0.973, 0.931), seconds=2.0,
            stability=stated,
        ).assumptions[0]
        assert output.evidence is Evidence.SAMPLED
        assert word in output.text
    system = scalar(lambda x: np.array([0.5 * math.sin(float(x[0]))]), lambda x: x[:1])
    note = certify_detectability(system, unit_box(1), eta=0.8).notes[0]
    assert "float() of a symbol" in note
    assert "numpy.where in place of branches" in note
    monkeypatch.setattr(search_module, "_MOST_CELLS", 3)
    found = certify_detectability(qpmhe.models.pendulum()[0], PENDULUM, eta=0.9)
    assert found.evidence is Evidence.SAMPLED
    assert "given up" in found.notes[0]


def test_a_mode_is_called_unseen_only_where_it_is():
    hidden = linear(np.diag([1.1, 0.5]), [[0.0, 1.0]])
    for side in (1e-6, 1e6):  # the sizes of the states alone decide nothing either way
        region = box([-side, -1.0], [side, 1.0])
        seen = linear(np.diag([1.1, 0.5]), [[1.0 / side, 1.0]])
        assert certify_detectability(seen, region).evidence is Evidence.PROVED
        with pytest.raises(NotCertifiedError, match=r"eigenvalue 1\.1.*not appear in.*measure an"):
            certify_detectability(hidden, region, seconds=300.0)


@pytest.mark.slow
def test_a_model_that_overflows_may_not_be_meant_to_hold():
    reactor = qpmhe.models.cstr()[0]  # f overflows on its own set of states
    with pytest.raises(NotCertifiedError, match="may not be meant to hold") as caught:
        certify_detectability(reactor, None, inputs=box(287.0, 311.6), seconds=300.0)
    assert "not appear in the output" not in str(caught.value)
    assert "a smaller region" in caught.value.suggestions


@pytest.mark.slow
@pytest.mark.parametrize(("lie", "dimension"), [
    (np.negative, 2), (lambda x: np.nan * x, 2), (None, 2),
    (lambda x: 1e-9 * x, 1),  # what is said to be supplied by disturbances
])
def test_solvers_that_lie_or_raise_prove_nothing(monkeypatch, lie, dimension):
    cvxpy, limits = pytest.importorskip("cvxpy"), []
    solve = cvxpy.Problem.solve

    def lying(problem, **options):
        limits.append(options["time_limit"])
        solve(problem, **options)
        if lie is None:
            raise ValueError("no")
        for each in problem.variables():
            if each.ndim == dimension:
                each.save_value(lie(each.value))

    monkeypatch.setattr(cvxpy.Problem, "solve", lying)
    for which in ("observer", "detectability")[:dimension]:
        with pytest.raises(NotCertifiedError):
            QUESTIONS[which](scalar(lambda x: 0.9 * np.sin(x)), unit_box(1), seconds=2.0)
    assert all(0.0 < each <= 2.0 for each in limits)


def test_proofs_end_with_the_time(monkeypatch):
    now = count()  # a second goes by whenever the clock is looked at
    clock = SimpleNamespace(monotonic=lambda: float(next(now)))
    monkeypatch.setattr(deadline_module, "time", clock)
    for seconds in np.arange(4.0, 20.0, 2.0).tolist():
        with contextlib.suppress(certificates.OutOfTimeError):
            system = qpmhe.models.pendulum()[0]
            found = certify_detectability(system, PENDULUM, eta=0.9, seconds=seconds)
            break
    assert found.evidence is Evidence.SAMPLED
    assert "time was over" in found.notes[0]
    for question in QUESTIONS.values():
        with pytest.raises(certificates.OutOfTimeError, match="more seconds"):
            question(linear(0.5, 1.0), unit_box(1), seconds=0.5)


def test_no_search_is_begun_in_vain():
    with pytest.raises(certificates.OutOfTimeError, match=r"40 states takes about .* s were left"):
        certify_detectability(linear(0.9 * np.eye(40), np.ones((1, 40))), unit_box(40))


def test_no_program_is_solved_that_has_no_solution(monkeypatch):
    solved, solve = [], SemidefiniteProgram.solve
    monkeypatch.setattr(
        SemidefiniteProgram, "solve",
        lambda program, rate, *rest: (solved.append(rate), solve(program, rate, *rest))[1],
    )
    hidden = linear(np.diag([1.1, 0.5]), [[0.0, 1.0]])
    for ask in (certify_detectability, certificates.synthesise_gain):
        with pytest.raises(NotCertifiedError, match=r"eigenvalue 1\.1.*not appear in"):
            ask(hidden, unit_box(2))
    assert not solved
    # |0.9 - 0.1| = 0.8, beyond which there are solutions.
    certify_observer(linear(0.9, 1.0), qpmhe.Luenberger([[0.1]]), unit_box(1))
    assert solved
    assert min(solved) > 0.8 * (1.0 - 1e-9)


def test_a_solver_that_fails_without_room_leaves_the_better_answer(monkeypatch):
    """With the least margin, the program may break down, and the easier one's limit be far more."""
    solve, region, limits = SemidefiniteProgram.solve, unit_box(2), []

    def without_room(self, rate, margin, *rest):
        forms = self._forms
        self._forms = forms[1:] if margin < 1e-5 else forms
        try:
            return solve(self, rate, margin, *rest)
        finally:
            self._forms = forms

    system = linear([[0.97, 0.2], [-0.2, 0.97]], [[1.0, 0.0]])
    for share in (0.0, search_module._BETTER, None):
        with monkeypatch.context() as patch:
            if share is not None:
                patch.setattr(SemidefiniteProgram, "solve", without_room)
                patch.setattr(search_module, "_BETTER", share)
            found = certify_observer(
                system, qpmhe.Luenberger([[0.2], [0.0]]), region, sizes=(0.01, 0.02))
        assert found.evidence is Evidence.PROVED
        limits.append(ObserverBound(found, bounded_region(system, region), certificates.Sizes(
            0.01, 0.02)).limit() * np.sqrt(np.linalg.inv(found.P).diagonal().max()))
    assert limits[0] > 1.5 * limits[2]
    assert limits[1] < 1.1 * limits[2]
