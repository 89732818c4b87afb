"""What contracts on a region: detectability, observers, gains; known constants and refusals."""

import math
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    CertificateError,
    DecayingSums,
    Evidence,
    NotCertifiedError,
    ObserverStability,
    OutOfTimeError,
    certify,
    certify_detectability,
    certify_observer,
    synthesise_gain,
)
from qpmhe.certificates import deadline as deadline_module
from qpmhe.certificates import search as search_module
from qpmhe.errors import ModelError, OptionError, QpmheError

from .attacks import RELATIVE, attack_detectability
from .helpers import PENDULUM, QUESTIONS, REACTOR, box, linear, scalar, smooth, unit_box, unit_cost

# Rates and constants that are known


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


@pytest.mark.parametrize(("A", "C", "eta", "sharp"), [
    (1.1, 0.5, 0.8, math.sqrt(1.1**2 - 0.8**2) / 0.5 / 0.8),
    # A normal matrix needs no output above its spectral radius.
    (np.diag([0.7, 0.5]), [[1.0, 1.0]], 0.75, 0.0),
])
def test_linear_systems_have_the_known_detectability(A, C, eta, sharp):
    system = linear(A, C)
    found = certify_detectability(system, unit_box(system.n), eta=eta)
    assert (found.evidence, found.form) == (Evidence.PROVED, "output weight")
    np.testing.assert_allclose([found.c_p, found.c_w], [1.0, 1.0 / eta], rtol=1e-4)
    assert sharp < found.c_v < max(sharp * (1 + 1e-4), 1e-2)


def limit(found, w, v):
    """What the bounds on the components tend to for disturbances and noises within boxes."""
    squares = np.square(w) @ np.diag(found.Q) + np.square(v) @ np.diag(found.R)
    return np.sqrt(squares / (1.0 - found.rho**2) * np.diag(np.linalg.inv(found.P)))


def test_scalar_observer_has_the_known_constants_and_limit():
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
    found = certify_observer(system, observer, unit_box(1), sizes=(0.3, 0.2))
    assert 2.1 * (1.0 - 1e-9) <= limit(found, [0.3], [0.2])[0] <= 2.1 * (1.0 + 2e-3)


def test_sum_of_squares_is_attained_and_disturbances_act_through_their_matrix():
    A, C, L = np.array([[0.9, 0.4], [-0.3, 0.8]]), np.array([[1.0, 0.0]]), np.array([[0.5], [0.1]])
    found = certify_observer(
        linear(A, C), qpmhe.Luenberger(L), unit_box(2), sizes=([0.1, 0.02], [0.3])
    )
    step = np.hstack((A - L @ C, np.eye(2), -L))  # of error, disturbance and noise
    weight = np.zeros((5, 5))
    weight[:2, :2], weight[2:4, 2:4] = found.rho**2 * found.P, found.Q
    weight[4:, 4:] = found.R
    scale = np.linalg.inv(np.linalg.cholesky(weight)).T
    assert 0.99 < np.linalg.eigvalsh(scale.T @ step.T @ found.P @ step @ scale)[-1] <= 1.0
    found = certify_observer(
        linear(np.diag([0.5, 0.9]), C, disturbance_matrix=[[1.0], [0.0]]),
        qpmhe.Luenberger([[0.0], [0.0]]), unit_box(2), sizes=([1.0], [0.0]),
    )
    first, second = limit(found, [1.0], [0.0])
    assert 2.0 <= first < 3.2  # sharp at the rate 0.5 ** 0.5, which the second state excludes
    assert second < 0.2


def test_synthesis_beats_the_paper_observer_and_trades_disturbance_against_noise():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    paper = certify_observer(system, observer, REACTOR, rho=0.94)
    assert (paper.evidence, paper.cells) == (Evidence.PROVED, 1)
    np.testing.assert_allclose(paper.kappa, np.sqrt(2) * 0.05)
    sizes = [0.3, 0.3], [0.6]
    made = synthesise_gain(system, REACTOR, sizes=sizes)
    assert made.stability.evidence is Evidence.PROVED
    assert f"rate {made.stability.rho:.4g} a sample (proved)" in str(made)
    np.testing.assert_array_equal(made.observer.metric, made.stability.P)
    paper = certify_observer(system, observer, REACTOR, sizes=sizes)
    assert (limit(made.stability, *sizes) < 0.7 * limit(paper, *sizes)).all()
    noisy, disturbed = ([0.01, 0.01], [1.0]), ([1.0, 1.0], [0.01])
    quiet, loud = (
        synthesise_gain(
            linear([[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]]), unit_box(2), rho=0.9, sizes=each
        ).stability for each in (noisy, disturbed)
    )
    assert quiet.kappa < loud.kappa
    assert limit(quiet, *noisy).max() < limit(loud, *noisy).max()
    assert limit(quiet, *disturbed).max() > limit(loud, *disturbed).max()


# Pairs of trajectories


# |0.8 - 0.15 * 2| = 0.5: all constants for the rate 0.5 are sharp. The error of the other one
# first grows by 3: c_p must be at least 3 / 0.5.
SCALAR = linear(0.8, 2.0), unit_box(1)
GROWING = linear([[0.0, 3.0], [0.0, 0.0]], [[0.0, 0.0]]), box([-9.0, -1.0], [9.0, 1.0])


@pytest.mark.parametrize(("of", "claim", "ratio"), [
    (SCALAR, (0.5, 1.0, 2.0, 0.3), 1.0), (SCALAR, (0.5, 1.0, 1.6, 0.3), 1.25),
    (SCALAR, (0.5, 1.0, 2.0, 0.24), 1.25), (GROWING, (0.5, 6.0, 12.0, 0.0), 1.0),
    (GROWING, (0.5, 4.8, 12.0, 0.0), 1.25),
])
def test_known_constants_are_reached_and_a_fifth_less_is_caught(of, claim, ratio):
    found = attack_detectability(of[0], smooth(*of)[1], DecayingSums(*claim), trials=300)
    assert found == pytest.approx(ratio, rel=1e-2)
    assert found <= ratio * (1.0 + RELATIVE)


SYSTEMS = {
    "batch_reactor": (REACTOR, None), "pendulum": (PENDULUM, None),
    "van_der_pol": (box([-2.0, -2.0], [2.0, 2.0]), None),
    "cstr": (box([0.4, 345.0], [0.6, 355.0]), box(290.0, 310.0)),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_pairs_of_trajectories_keep_to_the_bound(name):
    region, inputs = SYSTEMS[name]
    system = getattr(qpmhe.models, name)()[0]
    found = certify_detectability(system, region, eta=0.9, inputs=inputs)
    assert found.evidence is Evidence.PROVED
    share = attack_detectability(system, found.region, found.sums, trials=300)
    assert 0.1 < share <= 1.0 + RELATIVE


def test_nonlinear_output_takes_output_injection():
    # C in [0.7, 1.3]: with multipliers any rate is feasible, and R = (1 - eta^2) / 0.7^2.
    system = scalar(lambda x: 1.0 * x, lambda x: x + 0.3 * np.sin(x))
    found = certify_detectability(system, box(-5.0, 5.0), eta=0.6)
    assert (found.evidence, found.form) == (Evidence.PROVED, "output injection")
    assert any("not affine" in note for note in found.notes)
    sharp = 0.8 / 0.7 / 0.6
    assert sharp < found.c_v < 1.05 * sharp
    assert attack_detectability(system, found.region, found.sums, trials=200) <= 1.0 + RELATIVE


def test_what_holds_at_every_state_need_not_hold_for_averages():
    # |C| = 1 everywhere, but x and x + 2 pi have one output, and x grows.
    system = qpmhe.System(
        lambda x: 1.05 * x, lambda x: np.concatenate((np.sin(x), np.cos(x)), -1), n=1, p=2
    )
    with pytest.raises(NotCertifiedError, match="no constant P"):
        certify_detectability(system, box(0.0, 2.0 * np.pi), eta=0.9)
    assert certify_detectability(system, box(0.0, 1.5), eta=0.9).evidence is Evidence.PROVED


def test_polytope_asks_for_less_than_its_box():
    # f grows with x1 where x1 + x2 is large, beyond the triangle.
    system = qpmhe.System(
        lambda x: np.stack((0.5 * x[..., 0] + 0.6 * x[..., 0] * x[..., 1], 0.5 * x[..., 1]), -1),
        lambda x: 0.0 * x[..., :1], n=2, p=1,
    )
    triangle = qpmhe.Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 2.0]], [0.0, 0.0, 1.0])
    assert certify_detectability(system, triangle, eta=0.9).evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError):
        certify_detectability(system, box([0.0, 0.0], [1.0, 1.0]), eta=0.9)


def test_no_proof_rests_on_a_given_derivative():
    # h(x) = x, with a derivative that is wrong where the system's own check does not look.
    wrong = scalar(h_jacobian=lambda x: np.array([[1.0 if x[0] < 3.0 else 0.01]]))
    found = [
        certify(system, qpmhe.Luenberger([[0.4]]), unit_cost(), horizon=3, region=box(4.0, 10.0))
        for system in (scalar(), wrong)
    ]
    assert found[1].evidence is Evidence.PROVED
    np.testing.assert_allclose(*(each.of().C for each in found), rtol=1e-6)


# States that the region fixes, such as known parameters, and inputs of zero width


def oscillator(drift=0.0, parameter=None, way=np.stack):
    """A nonlinear oscillator whose third state is a constant parameter, unless that is given."""

    def f(x):
        a, b = x[..., 0], x[..., 1]
        more = x[..., 2] if parameter is None else parameter
        ahead = [0.9 * a + 0.2 * b, -0.2 * a + 0.8 * b + 0.1 * more * np.sin(a)]
        return way(ahead if parameter is not None else [*ahead, more + drift * a], -1)

    return qpmhe.System(f, lambda x: x[..., :1], n=3 if parameter is None else 2, p=1)


def untraced(parts, axis):
    return np.array([float(part) for part in parts])


def test_a_known_parameter_is_left_out_and_what_moves_it_is_named():
    gain, sizes = np.array([[0.5], [0.2], [0.0]]), ([0.1, 0.1, 0.0], [0.2])
    known = box([-1.0, -1.0, 0.3], [1.0, 1.0, 0.3])
    found = certify_observer(oscillator(), qpmhe.Luenberger(gain), known, rho=0.9, sizes=sizes)
    assert found.evidence is Evidence.PROVED
    assert any("x[2] is known" in note for note in found.notes)
    alone = certify_observer(
        oscillator(parameter=0.3), qpmhe.Luenberger(gain[:2]), unit_box(2),
        rho=0.9, sizes=([0.1, 0.1], [0.2]),
    )
    np.testing.assert_allclose(found.P[:2, :2], alone.P, rtol=1e-3)
    assert not found.P[2, :2].any()
    assert found.P[2, 2] > 0.0
    assert np.array_equal(found.gain, gain)
    made = synthesise_gain(oscillator(), known, rho=0.9, sizes=sizes).stability
    assert not made.gain[2].any()
    seen = certify_detectability(oscillator(), known, eta=0.9)
    assert (made.evidence, seen.evidence) == (Evidence.PROVED, Evidence.PROVED)
    assert (found.Q.shape, made.gain.shape, seen.P.shape) == ((3, 3), (3, 1), (3, 3))
    for system, L, region, words in (
        *((oscillator(drift, way=way), gain, known, r"no width in x\[2\], but f moves it")
          for drift, way in ((0.01, np.stack), (1e-14, np.stack), (0.01, untraced))),
        (oscillator(), gain + 0.1, known, r"no width in x\[2\], but the observer's gain"),
        (oscillator(), 0.0 * gain, box([0.0, 0.0, 0.3], [0.0, 0.0, 0.3]), "single state"),
    ):
        with pytest.raises(NotCertifiedError, match=words):
            certify_observer(system, qpmhe.Luenberger(L), region, sizes=sizes)


def test_input_of_zero_width():
    system = qpmhe.System(
        lambda x, u: 0.5 * x + 0.1 * u * np.sin(x), lambda x, u: x, n=1, p=1, m=1
    )
    known = {"inputs": box(2.0, 2.0)}  # 0.5 - 0.2 + 0.2 cos(x) is at most 0.5
    observer = qpmhe.Luenberger([[0.2]])
    found = certify_observer(system, observer, unit_box(1), rho=0.51, **known)
    assert found.evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError):
        certify_observer(system, observer, unit_box(1), rho=0.49, **known)


# What is refused, and what rests on samples


class Odd(qpmhe.Luenberger):
    def correct(self, z, v, sample):
        return self.gain @ v + z, None


def test_what_is_refused_says_why():
    hidden, plane = linear(np.diag([1.1, 0.5]), [[0.0, 1.0]]), unit_box(2)
    reactor, paper, _, _ = qpmhe.models.batch_reactor()
    with pytest.raises(NotCertifiedError, match=r"infeasible.*a larger eta") as caught:
        certify_detectability(reactor, REACTOR, eta=0.5)
    assert 0.6 < caught.value.smallest_rate < 0.75
    swinging, observer, _, _ = qpmhe.models.van_der_pol()
    constant = r" has no constant gain.*ObserverStability\.assumed"
    for ask, error, words in (
        (lambda: certify_detectability(hidden, plane), NotCertifiedError,
         r"eigenvalue 1\.1.*not appear in.*measure an"),
        (lambda: synthesise_gain(hidden, plane), NotCertifiedError, "no constant gain"),
        (lambda: certify_observer(swinging, observer, box([-2.5, -3.0], [2.5, 3.0])),
         NotCertifiedError, r"radius 1\.0\d* at \[.*synthesise_gain"),
        *((lambda eta=eta: certify_detectability(hidden, plane, eta=eta), OptionError, "eta is")
          for eta in (0.0, 1.0, math.nan, "fast")),
        *((lambda s=s: certify_detectability(hidden, plane, seconds=s), OptionError, "seconds is")
          for s in (0.0, math.nan, True)),
        *((lambda each=each: certify_observer(reactor, each, REACTOR), CertificateError,
           type(each).__name__ + constant) for each in (
               qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
               qpmhe.OutputInjection(lambda z, v: 0.1 * v * z), Odd([0.05, 0.05]))),
        *((lambda options=options: certify_observer(reactor, paper, REACTOR, **options),
           QpmheError, words) for options, words in (
               ({"rho": 1.5}, "rho is"), ({"sizes": (1.0, -1.0)}, "size of the noise is -1.0"),
               ({"sizes": ([1.0] * 3, 1.0)}, r"size of the disturbance has shape \(3,\)"))),
        (lambda: ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=-1.0),
         OptionError, "kappa"),
    ):
        with pytest.raises(error, match=words):
            ask()


def picky(x):
    if np.any(np.real(x) > 50.0):
        raise ValueError("too large")
    return 0.5 * x


@pytest.mark.parametrize("which", QUESTIONS)
def test_what_raises_or_is_not_finite_is_named_with_the_state(which):
    for letter in "fh":
        words = rf"{letter} raises ValueError at x = \[100.0\].*too large.*smaller region"
        with pytest.raises(ModelError, match=words):
            QUESTIONS[which](scalar(**{letter: picky}), box(-100.0, 100.0))
    system = scalar(lambda x: np.where(np.real(x) > 5.0, np.nan, 0.5 * x))
    for place in ((6.0, 10.0), (-10.0, 5.001)):
        with pytest.raises(ModelError, match=r"f is not finite at x = .*nan.*smaller region"):
            QUESTIONS[which](system, box(*place))


def compared(place):
    return lambda x: np.array([0.5 * float(x[0]) + (5.0 if x[0] > place else 0.0)])


def test_what_jumps_is_not_certified_from_its_derivatives():
    between, aside = r"but not between \[.*may jump", box(-0.973, 0.931)
    for f, seen, region, words in (
        # No sample is at a jump; in the middle of the region, one is.
        (lambda x: 0.5 * x + 5.0 * np.sign(x), 0.0, aside, between),
        (lambda x: 0.5 * x + 5.0 * np.floor(x), 0.0, aside, between),
        (compared(0.3), 0.0, aside, between),
        (compared(0.0), 1.0, unit_box(1), r"f jumps at \[0.0\].*changes by 5"),
    ):
        for which in ("detectability", "observer"):
            with pytest.raises(NotCertifiedError, match=words):
                QUESTIONS[which](scalar(f, lambda x, c=seen: c * x), region, seconds=2.0)
    # What is steep or kinked does not jump.
    found = certify_detectability(
        scalar(lambda x: 0.5 * np.abs(x), lambda x: 0.0 * x), unit_box(1), eta=0.8
    )
    assert found.evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError, match="not appear in the output"):
        certify_detectability(scalar(lambda x: 1e6 * x, lambda x: 0.0 * x), unit_box(1))


@pytest.mark.parametrize(("h", "word"), [
    (lambda x: np.where(x > 0.3, 1e-9 + x, x), "h has a choice (numpy.where, if_else) that may"),
    (lambda x: x + 1e-9 * np.floor(x), "h has a jump of floor"),
    (lambda x: np.sqrt(np.maximum(x, 0.0)), "a derivative has a division by a value that may be"),
    (lambda x: np.array([float(x[0])]), "float() of a symbol"),
])
def test_what_cannot_be_enclosed_is_sampled_with_its_name(h, word):
    found = certify(
        scalar(h=h), qpmhe.Luenberger([[0.1]]), unit_cost(), horizon=2, region=box(-0.973, 0.931),
        seconds=2.0,
        stability=ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1),
    )
    output = found.assumptions[0]
    assert output.evidence is Evidence.SAMPLED
    assert word in output.text


def test_what_intervals_cannot_run_is_sampled_with_the_remedy(monkeypatch):
    system = scalar(lambda x: np.array([0.5 * math.sin(float(x[0]))]), lambda x: x[:1])
    found = certify_detectability(system, unit_box(1), eta=0.8)
    assert (found.evidence, found.cells) == (Evidence.SAMPLED, 0)
    for words in ("cannot be run with intervals", "float() of a symbol",
                  "numpy.where in place of branches", "holds at 4"):
        assert words in found.notes[0]
    monkeypatch.setattr(search_module, "_MOST_CELLS", 3)
    found = certify_detectability(qpmhe.models.pendulum()[0], PENDULUM, eta=0.9)
    assert found.evidence is Evidence.SAMPLED
    assert "given up" in found.notes[0]


def test_a_mode_is_called_unseen_only_where_it_is():
    for side in (1e-6, 1e6):  # the sizes of the states alone decide nothing either way
        region = box([-side, -1.0], [side, 1.0])
        seen = linear(np.diag([1.1, 0.5]), [[1.0 / side, 1.0]])
        assert certify_detectability(seen, region).evidence is Evidence.PROVED
        with pytest.raises(NotCertifiedError, match=r"eigenvalue 1\.1.*not appear in the output"):
            certify_detectability(linear(np.diag([1.1, 0.5]), [[0.0, 1.0]]), region)
    reactor = qpmhe.models.cstr()[0]  # f overflows on its own set of states
    for system, region, inputs in (
        (linear(np.diag([1e15, 0.5]), [[1.0, 1.0]]), unit_box(2), None),
        (reactor, None, box(287.0, 311.6)),
    ):
        with pytest.raises(NotCertifiedError, match="may not be meant to hold") as caught:
            certify_detectability(system, region, inputs=inputs)
        assert "not appear in the output" not in str(caught.value)
        assert "a smaller region" in caught.value.suggestions


# Solvers that lie, and time that is over


@pytest.mark.parametrize("lie", [np.negative, lambda x: np.nan * x, None])
def test_solvers_that_lie_or_raise_prove_nothing(monkeypatch, lie):
    cvxpy = pytest.importorskip("cvxpy")
    solve = cvxpy.Problem.solve

    def lying(problem, **options):
        solve(problem, **options)
        if lie is None:
            raise ValueError("no")
        for each in problem.variables():
            if each.ndim == 2:
                each.save_value(lie(each.value))

    monkeypatch.setattr(cvxpy.Problem, "solve", lying)
    system, observer = qpmhe.models.batch_reactor()[:2]
    for ask in (
        lambda: certify_detectability(system, REACTOR, eta=0.9, seconds=2.0),
        lambda: certify_observer(system, observer, REACTOR, rho=0.95, seconds=2.0),
    ):
        with pytest.raises(NotCertifiedError):
            ask()


def test_a_supply_that_is_too_small_for_the_disturbance_proves_nothing(monkeypatch):
    cvxpy = pytest.importorskip("cvxpy")
    solve = cvxpy.Problem.solve

    def lying(problem, **options):
        solve(problem, **options)
        for each in problem.variables():
            if each.ndim == 1:
                each.save_value(1e-9 * each.value)

    monkeypatch.setattr(cvxpy.Problem, "solve", lying)
    with pytest.raises(NotCertifiedError, match="no matrix that passes"):
        certify_observer(linear(0.5, 1.0), qpmhe.Luenberger([[0.0]]), unit_box(1), rho=0.9)


@pytest.fixture
def ticking(monkeypatch):
    """A clock on which a second goes by whenever it is looked at."""
    now = count()
    clock = SimpleNamespace(monotonic=lambda: float(next(now)))
    monkeypatch.setattr(deadline_module, "time", clock)


def test_proofs_end_with_the_time(ticking):
    for seconds in range(4, 20, 2):
        try:
            found = certify_detectability(
                qpmhe.models.pendulum()[0], PENDULUM, eta=0.9, seconds=float(seconds)
            )
        except OutOfTimeError:
            continue
        break
    assert found.evidence is Evidence.SAMPLED
    assert "time was over" in found.notes[0]
    for question in QUESTIONS.values():
        with pytest.raises(OutOfTimeError, match="more seconds"):
            question(linear(0.5, 1.0), unit_box(1), seconds=0.5)


def test_no_search_is_begun_in_vain_and_the_solver_is_told_its_time(monkeypatch):
    cvxpy = pytest.importorskip("cvxpy")
    solve, given = cvxpy.Problem.solve, []

    def noted(problem, **options):
        given.append(options["time_limit"])
        return solve(problem, **options)

    monkeypatch.setattr(cvxpy.Problem, "solve", noted)
    n = 40
    with pytest.raises(OutOfTimeError, match=r"40 states takes about .* s were left"):
        certify_detectability(linear(0.9 * np.eye(n), np.ones((1, n))), unit_box(n))
    system, _, cost, _ = qpmhe.models.cstr()
    observer = qpmhe.OutputInjection(lambda z, v: 0.1 * np.array([0.0, np.tanh(v[0])]))
    with pytest.raises(CertificateError, match="no constant gain"):
        certify(system, observer, cost, horizon=3, inputs=box(290.0, 310.0))
    assert given == []
    certify_detectability(linear(0.5, 1.0), unit_box(1), seconds=5.0)
    assert given
    assert all(0.0 < each <= 5.0 for each in given)


def test_loading_the_solvers_is_not_charged_to_the_search(monkeypatch):
    now, loaded = [0.0], []

    def slow(name, original=search_module.Program.__init__.__globals__["importlib"].import_module):
        if name == "cvxpy" and not loaded:
            loaded.append(name)
            now[0] += 100.0
        return original(name)

    monkeypatch.setattr(deadline_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr("importlib.import_module", slow)
    for question in QUESTIONS.values():
        loaded.clear()
        found = question(linear(0.5, 1.0), unit_box(1), seconds=5.0)
        assert (found.evidence, loaded) == (Evidence.PROVED, ["cvxpy"])
