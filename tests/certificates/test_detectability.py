"""Detectability: known constants, the paper's reactor, pairs of trajectories, refusals."""

import contextlib
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import search as search_module
from qpmhe.certificates.contraction import certify_detectability, certify_observer
from qpmhe.certificates.evidence import Evidence, NotCertifiedError
from qpmhe.certificates.inequalities import Form, Matrices, definite
from qpmhe.certificates.sdp import Answer, Program
from qpmhe.errors import OptionError

from .attacks import RELATIVE, attack_detectability
from .helpers import PENDULUM, REACTOR, linear, scalar, unit_box

TRIANGLE = qpmhe.Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 2.0]], [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("A", "C", "eta", "sharp"),
    [
        (1.1, 0.5, 0.8, math.sqrt(1.1**2 - 0.8**2) / 0.5 / 0.8),
        # A normal matrix needs no output above its spectral radius.
        (np.diag([0.7, 0.5]), [[1.0, 1.0]], 0.75, 0.0),
    ],
)
def test_linear_systems_have_the_known_constants(A, C, eta, sharp):
    system = linear(A, C)
    found = certify_detectability(system, unit_box(system.n), eta=eta)
    assert (found.evidence, found.form) == (Evidence.PROVED, "output weight")
    np.testing.assert_allclose([found.c_p, found.c_w], [1.0, 1.0 / eta], rtol=1e-4)
    assert sharp < found.c_v < max(sharp * (1 + 1e-4), 1e-2)


SYSTEMS = {
    "batch_reactor": (REACTOR, None),
    "pendulum": (PENDULUM, None),
    "van_der_pol": (qpmhe.Box([-2.0, -2.0], [2.0, 2.0]), None),
    "cstr": (qpmhe.Box([0.4, 345.0], [0.6, 355.0]), qpmhe.Box([290.0], [310.0])),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_pairs_of_trajectories_keep_to_the_bound(name):
    box, inputs = SYSTEMS[name]
    system = getattr(qpmhe.models, name)()[0]
    found = certify_detectability(system, box, eta=0.9, inputs=inputs)
    assert found.evidence is Evidence.PROVED
    assert 0.1 < attack_detectability(
        system, found.region, found.sums, trials=100, steps=15, polish=4
    ) <= 1.0 + RELATIVE


def test_nonlinear_output_takes_output_injection():
    # C in [0.7, 1.3]: with multipliers any rate is feasible, and R = (1 - eta^2) / 0.7^2.
    system = scalar(lambda x: 1.0 * x, lambda x: x + 0.3 * np.sin(x))
    found = certify_detectability(system, qpmhe.Box([-5.0], [5.0]), eta=0.6)
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
    weight = Form(np.eye(1), 0.9, 2.0 * np.eye(2))
    x = np.linspace(0.0, 2.0 * np.pi, 50)
    J = np.stack((1.05 + 0.0 * x, np.cos(x), -np.sin(x)), 1)[..., None]
    assert definite(weight.matrices(Matrices.exact(J))).all()
    with pytest.raises(NotCertifiedError, match="no constant P"):
        certify_detectability(system, qpmhe.Box([0.0], [2.0 * np.pi]), eta=0.9)
    half = certify_detectability(system, qpmhe.Box([0.0], [1.5]), eta=0.9)
    assert half.evidence is Evidence.PROVED


def test_polytope_asks_for_less_than_its_box():
    # f grows with x1 where x1 + x2 is large, beyond the triangle.
    system = qpmhe.System(
        lambda x: np.stack((0.5 * x[..., 0] + 0.6 * x[..., 0] * x[..., 1], 0.5 * x[..., 1]), -1),
        lambda x: 0.0 * x[..., :1], n=2, p=1,
    )
    assert certify_detectability(system, TRIANGLE, eta=0.9).evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError):
        certify_detectability(system, qpmhe.Box([0.0, 0.0], [1.0, 1.0]), eta=0.9)


def test_what_is_refused_says_why():
    with pytest.raises(NotCertifiedError, match=r"infeasible.*a larger eta") as caught:
        certify_detectability(qpmhe.models.batch_reactor()[0], REACTOR, eta=0.5)
    assert 0.6 < caught.value.smallest_rate < 0.75
    hidden = linear(np.diag([1.1, 0.5]), [[0.0, 1.0]])
    with pytest.raises(NotCertifiedError, match=r"eigenvalue 1\.1.*not appear in.*measure an"):
        certify_detectability(hidden, unit_box(2))
    for eta in (0.0, 1.0, math.nan, True, "fast"):
        with pytest.raises(OptionError, match="eta is"):
            certify_detectability(hidden, unit_box(2), eta=eta)
    for seconds in (0.0, math.nan, True, "long"):
        with pytest.raises(OptionError, match="seconds is"):
            certify_detectability(hidden, unit_box(2), seconds=seconds)


def test_what_intervals_cannot_run_is_sampled_with_the_reason():
    system = scalar(lambda x: np.array([0.5 * math.sin(float(x[0]))]), lambda x: x[:1])
    found = certify_detectability(system, unit_box(1), eta=0.8)
    assert (found.evidence, found.cells) == (Evidence.SAMPLED, 0)
    for words in ("cannot be run with intervals", "float() of a symbol",
                  "numpy.where in place of branches", "holds at 4"):
        assert words in found.notes[0]


def test_too_many_cells_are_sampled(monkeypatch):
    full = search_module.cover
    monkeypatch.setattr(search_module, "cover", lambda *most: full(*most[:3], 3, most[4]))
    found = certify_detectability(qpmhe.models.pendulum()[0], PENDULUM, eta=0.9)
    assert found.evidence is Evidence.SAMPLED
    assert "given up" in found.notes[0]


@pytest.mark.parametrize("answer", [
    Answer("user_limit"), *(
        Answer("solved", 1.0, Form(P, 0.9, 1e-3 * np.eye(1)))
        for P in (np.eye(2), -np.eye(2), np.full((2, 2), np.nan))
    ),
])
def test_solvers_that_lie_or_stop_early_prove_nothing(monkeypatch, answer):
    monkeypatch.setattr(Program, "solve", lambda *_, **__: answer)
    words = "user_limit" if answer.form is None else "no matrix that passes"
    with pytest.raises(NotCertifiedError, match=words):
        certify_detectability(qpmhe.models.batch_reactor()[0], REACTOR, eta=0.9)


def test_a_supply_that_is_too_small_for_the_disturbance_proves_nothing(monkeypatch):
    one = np.eye(1)
    for Q, holds in ((3.0 * one, True), (1e-9 * one, False)):
        form = Form(one, 0.9, one, 0.0 * one, X=0.5 * one, B=np.array([[1.0, 0.0]]), Q=Q)
        answer = Answer("solved", 1.0, form)
        monkeypatch.setattr(Program, "solve", lambda *_, answer=answer, **__: answer)
        refused = pytest.raises(NotCertifiedError, match="no matrix that passes")
        with contextlib.nullcontext() if holds else refused:
            found = certify_observer(
                linear(0.5, 1.0), qpmhe.Luenberger(0.0 * one), unit_box(1), rho=0.9
            )
            assert found.evidence is Evidence.PROVED


@pytest.mark.parametrize(("A", "C", "L"), [
    ([[1.1]], [[0.5]], [[0.6]]), (np.diag([0.7, 0.5]), [[1.0, 1.0]], [[0.0], [0.0]]),
    ([[0.9, 0.4], [-0.3, 0.8]], [[1.0, 0.0]], [[0.5], [0.1]]),
    ([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.3], [0.1, 0.0, 0.7]], [[1.0, 0.0, 0.0]],
     [[0.4], [0.1], [0.1]]),
])
def test_rates_of_linear_systems_are_reproduced(A, C, L):
    closed = np.subtract(A, np.matmul(L, C))
    true, box = float(np.abs(np.linalg.eigvals(closed)).max()), unit_box(len(closed))
    unseen, observer = linear(closed, 0.0 * np.array(C)), qpmhe.Luenberger(L)
    for ask in (
        lambda rate: certify_observer(linear(A, C), observer, box, rho=rate),
        lambda rate: certify_detectability(unseen, box, eta=rate),
    ):
        assert ask(true * (1.0 + 1e-6)).evidence is Evidence.PROVED
        with pytest.raises(NotCertifiedError):
            ask(true * (1.0 - 1e-12))
