"""Searches end: by the clock, by the size of a program, and with what is known by then."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import deadline as deadline_module
from qpmhe.certificates import sdp
from qpmhe.certificates.branch_and_bound import cover
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import _undetectable, certify_detectability
from qpmhe.certificates.deadline import Deadline
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.evidence import (
    CertificateError,
    Evidence,
    NotCertifiedError,
    OutOfTimeError,
)
from qpmhe.certificates.inequalities import Form
from qpmhe.certificates.regions import bounded_region
from qpmhe.certificates.sdp import Program, Scales
from qpmhe.certificates.search import Search

from .helpers import PENDULUM, QUESTIONS, box, linear, unit_box


@pytest.fixture
def ticking(monkeypatch):
    """A clock on which a second goes by whenever it is looked at."""
    now = iter(range(10**6))
    clock = SimpleNamespace(monotonic=lambda: float(next(now)))
    monkeypatch.setattr(deadline_module, "time", clock)


def test_proofs_end_with_the_time(ticking):
    system = qpmhe.models.pendulum()[0]
    region = bounded_region(system, PENDULUM)
    found = certify_detectability(system, PENDULUM, eta=0.9, seconds=math.inf)
    form, model = Form(found.P, found.eta, found.V), SmoothModel(system, region)
    whole = cover(model, region, form, seconds=math.inf)
    part = cover(model, region, form, seconds=2.0)
    assert (whole.proved, whole.late) == (True, False)
    assert (part.proved, part.late) == (False, True)
    assert 1 <= part.cells < whole.cells
    for seconds in (8.0, 12.0, 16.0):
        try:
            found = certify_detectability(system, PENDULUM, eta=0.9, seconds=seconds)
        except OutOfTimeError:
            continue
        break
    assert found.evidence is Evidence.SAMPLED
    assert "time was over" in found.notes[0]


def test_search_without_time_says_so(ticking):
    for question in QUESTIONS.values():
        with pytest.raises(OutOfTimeError, match="more seconds"):
            question(linear(0.5, 1.0), unit_box(1), seconds=0.5)


def test_loading_the_solvers_is_not_charged_to_the_search(monkeypatch):
    now, loaded = [0.0], []
    original = sdp.importlib.import_module

    def slow(name):
        if name not in loaded:
            loaded.append(name)
            now[0] += 100.0
        return original(name)

    monkeypatch.setattr(deadline_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(sdp, "importlib", SimpleNamespace(import_module=slow))
    for question in QUESTIONS.values():
        loaded.clear()
        found = question(linear(0.5, 1.0), unit_box(1), seconds=5.0)
        assert found.evidence is Evidence.PROVED
        assert "cvxpy" in loaded


def test_no_search_is_begun_in_vain(monkeypatch):
    monkeypatch.setattr(Program, "solve", lambda *_, **__: pytest.fail("it was begun"))
    n = 40
    with pytest.raises(OutOfTimeError, match=r"40 states takes about .* s were left"):
        certify_detectability(linear(0.9 * np.eye(n), np.ones((1, n))), unit_box(n))
    system, _, cost, _ = qpmhe.models.cstr()
    observer = qpmhe.OutputInjection(lambda z, v: 0.1 * np.array([0.0, np.tanh(v[0])]))
    with pytest.raises(CertificateError, match="no constant gain"):
        certify(system, observer, cost, horizon=3, inputs=qpmhe.Box([290.0], [310.0]))


def test_solver_keeps_to_its_time():
    n = 6
    A = 0.9 * np.eye(n) + 0.1 * np.random.default_rng(2).standard_normal((n, n))
    J = np.vstack((A, np.eye(n)[:2]))[None].repeat(4, axis=0)
    program = Program(
        "output weight", J, Scales(np.ones(n), np.ones(2)), (1.0, 1.0), np.eye(n), triangle=True
    )
    assert program.solve(0.9, 1e-6).form is not None
    assert program.solve(0.9, 1e-6, seconds=1e-4).status == "user_limit"


def test_parts_of_a_deadline_leave_the_rest(ticking):
    whole = Deadline(100.0)
    half = whole.part(0.5)
    assert 40.0 < half.seconds < 50.0
    assert Deadline.of(half) is half
    assert Deadline(math.inf).part(0.1).left == math.inf
    for _ in range(100):
        _ = whole.left
    assert all(each.passed for each in (whole, half, whole.part(0.5)))


@pytest.mark.parametrize(
    ("A", "C", "side", "words"),
    [
        (np.diag([1e15, 0.5]), [[1.0, 1.0]], 1.0, None),
        (np.diag([1e15, 0.5]), [[0.0, 1.0]], 1.0, "1e+15"),
        # The sizes of the states alone decide nothing either way.
        *((np.diag([1.1, 0.5]), [[1.0 / side, 1.0]], side, None) for side in (1e-6, 1.0, 1e6)),
        *((np.diag([1.1, 0.5]), [[0.0, 1.0]], side, "eigenvalue 1.1") for side in (1e-6, 1e6)),
    ],
)
def test_a_mode_is_called_unseen_only_where_it_is(A, C, side, words):
    system = linear(A, C)
    region = bounded_region(system, box([-side, -1.0], [side, 1.0]))
    text = str(_undetectable(Search(system, region, None, (1.0, 1.0)), "none"))
    assert ("not appear in the output" in text) is (words is not None)
    assert words is None or words in text


def test_reactor_on_all_its_states_is_not_said_to_hide_its_temperature():
    system = qpmhe.models.cstr()[0]  # f overflows there
    region = bounded_region(system, None, qpmhe.Box([287.0], [311.6]))
    with pytest.raises(NotCertifiedError, match="may not be meant to hold") as caught:
        certify_detectability(system, region)
    assert "not appear in the output" not in str(caught.value)
    assert "a smaller region" in caught.value.suggestions
