"""Searches end: by the clock, by the size of a program, and with what is known by then."""

import io
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

import qpmhe
from qpmhe.certificates import deadline as deadline_module
from qpmhe.certificates import sdp
from qpmhe.certificates.audit import Finding
from qpmhe.certificates.branch_and_bound import cover, output_lipschitz
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability, certify_observer, synthesise_gain
from qpmhe.certificates.deadline import Deadline
from qpmhe.certificates.enclosures import Enclosure, SmoothModel
from qpmhe.certificates.evidence import (
    CertificateError,
    Evidence,
    NotCertifiedError,
    OutOfTimeError,
)
from qpmhe.certificates.inequalities import OutputWeight
from qpmhe.certificates.regions import bounded_region
from qpmhe.certificates.sdp import Program, Scales
from qpmhe.certificates.search import Search
from qpmhe.cli.certify import certify as certify_command
from qpmhe.errors import OptionError

PENDULUM = qpmhe.Box([-3.0, -10.0], [3.0, 10.0])


@pytest.fixture
def ticking(monkeypatch):
    """A clock on which a second goes by whenever it is looked at."""
    now = iter(range(10**6))
    clock = SimpleNamespace(monotonic=lambda: float(next(now)))
    monkeypatch.setattr(deadline_module, "time", clock)


def wide_reactor():
    """The exothermic reactor on all its states, where f overflows."""
    system = qpmhe.models.cstr()[0]
    return system, bounded_region(system, None, qpmhe.Box([287.0], [311.6]))


def linear(A, C):
    A, C = np.atleast_2d(A), np.atleast_2d(C)
    return qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=A.shape[0], p=C.shape[0])


def waves():
    """An output whose gradient takes many cells to bound; f cannot be enclosed."""
    system = qpmhe.System(
        lambda x: np.array([math.floor(float(each)) for each in x]),
        lambda x: x[..., :1] + 3.0 * np.sin(x[..., :1]) + 0.1 * x[..., 1:] ** 2,
        n=2, p=1,
    )
    return system, bounded_region(system, qpmhe.Box([-9.0, -9.0], [9.0, 9.0]))


def test_affine_output_is_exact_where_f_is_not_defined():
    found = output_lipschitz(*wide_reactor())
    assert found.evidence is Evidence.PROVED
    assert found.value == pytest.approx(1.0, rel=1e-9)
    assert found.note == "h is affine"


def test_output_alone_is_enclosed_where_it_alone_matters():
    system, region = waves()
    model = SmoothModel(system, region)
    assert model.reason
    assert model.output_reason == ""
    found = output_lipschitz(system, region, model)
    assert found.evidence is Evidence.PROVED
    assert found.attained <= found.value <= 1.002 * found.attained


def test_output_of_a_casadi_model_is_enclosed_alone():
    pytest.importorskip("casadi")
    from qpmhe.models.batch_reactor import casadi_output, casadi_rate

    system = qpmhe.from_casadi(
        casadi_rate, casadi_output, dt=0.1, method="rk4", n=2, compiled=False
    )
    region = bounded_region(system, qpmhe.Box([0.1, 0.0], [3.0, 3.0]))
    model = SmoothModel(system, region)
    whole, part = (
        model.enclose(region.lower[None], region.upper[None], output_only=alone)
        for alone in (False, True)
    )
    np.testing.assert_array_equal(part.centre, whole.centre[:, 2:])
    np.testing.assert_array_equal(part.error, whole.error[:, 2:])


def test_bound_on_the_output_in_time_is_loose_but_one(ticking):
    system, region = waves()
    model = SmoothModel(system, region)
    found = output_lipschitz(system, region, model, seconds=4.0)
    assert found.evidence is Evidence.PROVED
    assert "time was over" in found.note
    assert 1.002 * found.attained < found.value < 100.0


def test_output_without_a_bound_in_time_is_sampled(ticking):
    # The root is smooth on the box, but its argument, enclosed on all of it, may be negative.
    system = qpmhe.System(
        lambda x: 0.5 * x, lambda x: np.sqrt(1.0 + 0.9 * (x * np.sin(x) - x * np.sin(x + 1e-3))),
        n=1, p=1,
    )
    region = bounded_region(system, qpmhe.Box([-9.0], [9.0]))
    found = output_lipschitz(system, region, seconds=2.0)
    assert found.evidence is Evidence.SAMPLED
    assert "cells, when its time was over" in found.note
    assert output_lipschitz(system, region, seconds=math.inf).evidence is Evidence.PROVED


def test_infinite_derivatives_make_no_warning_and_no_proof():
    system = qpmhe.System(lambda x: (1e154 * x) ** 2, lambda x: x, n=1, p=1)
    region = bounded_region(system, qpmhe.Box([0.0], [1.0]))
    enclosure = SmoothModel(system, region).enclose(region.lower[None], region.upper[None])
    assert np.isnan(enclosure.error).all()
    found = cover(
        SmoothModel(system, region), region, OutputWeight(np.eye(1), np.eye(1), 0.9), 50
    )
    assert not found.proved


def test_a_cell_of_which_nothing_is_known_hides_nothing_of_the_others():
    nothing = np.full((1, 1, 1), np.nan)
    enclosure = Enclosure(
        np.concatenate((np.ones((1, 1, 1)), nothing)),
        np.concatenate((np.full((1, 1, 1, 1), 0.5), nothing[None])),
        np.concatenate((np.zeros((1, 1, 1)), nothing)),
        np.zeros((2, 1)),
        np.concatenate((np.ones((1, 1, 1)), nothing)),
    )
    corners, error = enclosure.corners()
    assert corners[0].min() - error[0].max() <= 0.5
    assert corners[0].max() + error[0].max() >= 1.5
    assert np.isnan(error[1]).all()


def test_cover_ends_with_the_time(ticking):
    system = qpmhe.models.pendulum()[0]
    region = bounded_region(system, PENDULUM)
    found = certify_detectability(system, PENDULUM, eta=0.9, seconds=math.inf)
    form = OutputWeight(found.P, found.V, found.eta)
    model = SmoothModel(system, region)
    whole = cover(model, region, form, seconds=math.inf)
    assert whole.proved
    assert not whole.late
    part = cover(model, region, form, seconds=2.0)
    assert part.late
    assert not part.proved
    assert 1 <= part.cells < whole.cells


def test_proof_without_time_is_sampled_with_the_reason(ticking):
    system = qpmhe.models.pendulum()[0]
    for seconds in (8.0, 12.0, 16.0):
        try:
            found = certify_detectability(system, PENDULUM, eta=0.9, seconds=seconds)
        except OutOfTimeError:
            continue
        break
    assert found.evidence is Evidence.SAMPLED
    assert "time was over" in found.notes[0]


def test_search_without_time_says_so(ticking):
    system = qpmhe.models.pendulum()[0]
    observer = qpmhe.Luenberger([[0.1], [0.1]])
    for question in (
        lambda: certify_detectability(system, PENDULUM, seconds=0.5),
        lambda: synthesise_gain(system, PENDULUM, seconds=0.5),
        lambda: certify_observer(
            linear(0.5, 1.0), qpmhe.Luenberger([[0.1]]), qpmhe.Box([-1.0], [1.0]), seconds=0.5
        ),
        lambda: certify(
            system, observer, qpmhe.QuadraticCost(
                prior=np.eye(2), disturbance=np.eye(2), noise=1.0
            ), horizon=3, region=PENDULUM, seconds=0.5,
        ),
    ):
        with pytest.raises(OutOfTimeError, match="more seconds"):
            question()


def test_program_too_large_for_the_time_is_not_begun(monkeypatch):
    monkeypatch.setattr(Program, "solve", lambda *_, **__: pytest.fail("it was begun"))
    n = 40
    with pytest.raises(OutOfTimeError, match=r"40 states takes about .* s were left"):
        certify_detectability(
            linear(0.9 * np.eye(n), np.ones((1, n))), qpmhe.Box(-np.ones(n), np.ones(n))
        )


def test_solver_keeps_to_its_time():
    n = 6
    A = 0.9 * np.eye(n) + 0.1 * np.random.default_rng(2).standard_normal((n, n))
    J = np.vstack((A, np.eye(n)[:2]))[None].repeat(4, axis=0)
    program = Program("output weight", J, Scales(np.ones(n), np.ones(2)), (1.0, 1.0))
    assert program.solve(0.9, 1e-6).form is not None
    assert program.solve(0.9, 1e-6, seconds=1e-4).status == "user_limit"


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan, True, "long", None])
def test_seconds_out_of_range(seconds):
    with pytest.raises(OptionError, match="seconds is"):
        certify_detectability(linear(0.5, 1.0), qpmhe.Box([-1.0], [1.0]), seconds=seconds)


def test_parts_of_a_deadline_leave_the_rest(ticking):
    whole = Deadline(100.0)
    half = whole.part(0.5)
    assert 40.0 < half.seconds < 50.0
    assert Deadline.of(half) is half
    assert not half.passed
    assert Deadline(math.inf).part(0.1).left == math.inf
    for _ in range(100):
        _ = whole.left
    assert whole.passed
    assert half.passed
    assert whole.part(0.5).passed


def test_measured_mode_is_not_called_unseen_however_fast_it_is():
    region = bounded_region(linear(np.eye(2), np.eye(2)), qpmhe.Box([-1.0, -1.0], [1.0, 1.0]))
    from qpmhe.certificates.contraction import _undetected

    fast = np.diag([1e15, 0.5])
    assert _undetected(Search(linear(fast, [[1.0, 1.0]]), region, None, (1.0, 1.0))) is None
    unseen = _undetected(Search(linear(fast, [[0.0, 1.0]]), region, None, (1.0, 1.0)))
    assert unseen is not None
    assert "1e+15" in unseen
    # The sizes of the states alone decide nothing either way.
    for scale in (1e-6, 1.0, 1e6):
        place = bounded_region(
            linear(np.eye(2), np.eye(2)), qpmhe.Box([-scale, -1.0], [scale, 1.0])
        )
        C = [[1.0 / scale, 1.0]]
        mixed = [[1.1, 0.0], [0.0, 0.5]]
        assert _undetected(Search(linear(mixed, C), place, None, (1.0, 1.0))) is None
        hidden = _undetected(Search(linear(mixed, [[0.0, 1.0]]), place, None, (1.0, 1.0)))
        assert hidden is not None
        assert "eigenvalue 1.1" in hidden


def test_reactor_on_all_its_states_is_not_said_to_hide_its_temperature():
    system, region = wide_reactor()
    with pytest.raises(NotCertifiedError, match="may not be meant to hold") as caught:
        certify_detectability(system, region)
    assert "not in the output" not in str(caught.value)
    assert "a smaller region" in caught.value.suggestions


def test_command_on_the_reactor_ends_with_a_table():
    text = io.StringIO()
    assert not certify_command(Console(file=text, width=200, color_system=None), "cstr")
    assert "L_h = 1 (h is affine)" in text.getvalue()
    assert "a smaller region" in text.getvalue()


def test_observer_without_a_gain_is_named_before_any_search(monkeypatch):
    monkeypatch.setattr(Program, "solve", lambda *_, **__: pytest.fail("it was begun"))
    system, _, cost, _ = qpmhe.models.cstr()
    observer = qpmhe.OutputInjection(lambda z, v: 0.1 * np.array([0.0, np.tanh(v[0])]))
    with pytest.raises(CertificateError, match="no constant gain"):
        certify(system, observer, cost, horizon=3, inputs=qpmhe.Box([290.0], [310.0]))


def test_findings_with_infinite_numbers_can_be_written():
    finding = Finding(
        "a", "b", False, None, "c", math.inf, {"x": np.array([1.0, -math.inf]), "missed": math.nan}
    )
    told = json.loads(json.dumps(finding.to_dict(), allow_nan=False))
    assert told["value"] is None
    assert told["counterexample"] == {"x": [1.0, None], "missed": None}


def test_loading_the_solvers_is_not_charged_to_the_search(monkeypatch):
    now, loaded = [0.0], []
    clock = SimpleNamespace(monotonic=lambda: now[0])
    original = sdp.importlib.import_module

    def slow(name):
        if name not in loaded:
            loaded.append(name)
            now[0] += 100.0
        return original(name)

    monkeypatch.setattr(deadline_module, "time", clock)
    monkeypatch.setattr(sdp, "importlib", SimpleNamespace(import_module=slow))
    system, region = linear(0.5, 1.0), qpmhe.Box([-1.0], [1.0])
    observer = qpmhe.Luenberger([[0.1]])
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    for question in (
        lambda: certify_detectability(system, region, seconds=5.0),
        lambda: certify_observer(system, observer, region, seconds=5.0),
        lambda: synthesise_gain(system, region, seconds=5.0).stability,
        lambda: certify(system, observer, cost, horizon=2, region=region, seconds=5.0),
    ):
        loaded.clear()
        assert question().evidence is Evidence.PROVED
        assert "cvxpy" in loaded
