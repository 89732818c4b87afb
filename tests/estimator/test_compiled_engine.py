"""Where the compiled engine comes from, and what has no C form."""

from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.codegen.library import planned
from qpmhe.codegen.rehearsal import checked_library
from qpmhe.errors import EngineWarning, OptionError

from .test_compiled import system_of

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
ONES = {"prior": 1.0, "disturbance": 1.0, "noise": 1.0}


def symbolic(**sets):
    return system_of(lambda x: 0.9 * x, lambda x: x, n=1, **sets)


def estimator(**given):
    arguments = {
        "system": given.pop("system", symbolic)(),
        "observer": given.pop("observer", lambda: qpmhe.Luenberger([0.3]))(),
        "cost": given.pop("cost", lambda: qpmhe.QuadraticCost(**ONES))(),
    }
    return qpmhe.MovingHorizonEstimator(
        **arguments, **({"horizon": 2, "initial_state": [0.0], "engine": "compiled"} | given)
    )


@pytest.mark.parametrize(("command", "cache", "match"), [
    ("", "cache", "falls back to the Python step: there is no C compiler.*install"),
    ("/nowhere/cc -O2", "cache", "there is no C compiler"),
    ('gcc "', "cache", "falls back to the Python step"),
    ("{folder}/failing", "cache", "failed: out of order"),
    (None, "file/cache", "cannot be written; set QPMHE_CACHE_DIR"),
])
def test_without_a_library_it_is_the_python_step_with_a_warning(
    monkeypatch, tmp_path, command, cache, match
):
    failing = tmp_path / "failing"
    failing.write_text("#!/bin/sh\necho out of order >&2\nexit 3\n")
    failing.chmod(0o700)
    (tmp_path / "file").touch()
    if command is not None:
        monkeypatch.setenv("CC", command.format(folder=tmp_path))
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / cache))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "file"))
    with pytest.warns(EngineWarning, match=match) as caught:
        mhe = estimator()
    assert [Path(w.filename) for w in caught] == [Path(__file__)]
    assert mhe.engine == "python"
    assert cache == "file/cache" or not list(tmp_path.glob("cache/*"))
    twin = estimator(engine="python")
    for y in ([1.0], [0.5], [2.0]):
        np.testing.assert_array_equal(mhe.update(y).trajectory, twin.update(y).trajectory)


class OwnGain(qpmhe.Luenberger):
    def correct(self, z, v, sample):
        return 2.0 * super().correct(z, v, sample)[0], None


class OwnFilter(qpmhe.ExtendedKalman):
    def filter(self, z, v, sample):
        return z + v, np.eye(z.size)


class OwnSteady(qpmhe.SteadyStateKalman):
    def initial_covariance(self):
        return 2.0 * super().initial_covariance()


class OwnCost(qpmhe.QuadraticCost):
    pass


class Whole(qpmhe.Huber):
    def cost(self, s, weight):
        return 2.0 * super().cost(s, weight)


class Branching(qpmhe.Huber):
    def _value(self, q):
        return np.array([one if one < 1.0 else 2.0 * one for one in q])


class Together(qpmhe.Huber):
    def _value(self, q):
        return q / (1.0 + q.sum())


def steady():
    plain = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    return OwnSteady(plain, [0.0], disturbance=[[1.0]], noise=[[1.0]])


LOSSES = {Whole: "overrides its cost", Branching: "", Together: "depends on others"}


WITHOUT_FORM = [
    ("from_casadi", {"system": lambda: qpmhe.System(
        lambda x: x if x[0] > 12.0 else 0.9 * x, lambda x: x, n=1, p=1)}),
    ("OwnGain has no C form; take an observer of qpmhe", {"observer": lambda: OwnGain([0.3])}),
    (r"the correction of OutputInjection has no C form \(.*asks for .*\); change that",
     {"observer": lambda: qpmhe.OutputInjection(lambda z, v: 0.3 * v if v[0] > 0 else v)}),
    *((rf"{kind.__name__}, the loss of noise, has no C form \(.*{why}.*\); take Quadratic, "
       "Huber, Power or Barron",
       {"cost": lambda kind=kind: qpmhe.RobustCost(**(ONES | {"noise": kind(1.0)}))})
      for kind, why in LOSSES.items()),
    ("OwnCost has no C form; take a QuadraticCost", {"cost": lambda: OwnCost(**ONES)}),
    ("OwnFilter has no C form", {"observer": lambda: OwnFilter(**ONES)}),
    ("covariance of OwnSteady has no C form, and is the metric",
     {"system": lambda: symbolic(states=qpmhe.Box(-5.0, 5.0)), "observer": steady}),
    ("covariance of OwnSteady has no C form.*take a constant weight",
     {"cost": lambda: qpmhe.QuadraticCost(**(ONES | {"prior": qpmhe.ObserverPrior()})),
      "observer": steady}),
    ("not by 'osqp'; take backend='auto'", {"backend": "osqp"}),
]


def test_what_has_no_c_form_is_an_error_with_a_remedy():
    for remedy, given in WITHOUT_FORM:
        with pytest.raises(OptionError, match=f"no C code for this estimator: .*{remedy}"):
            estimator(**given)


def test_one_library_serves_other_losses():
    layouts = set()
    for name, loss in (("noise", qpmhe.Huber(1.0, 2.0)), ("noise", qpmhe.Huber(1.0, 3.0)),
                       ("prior", qpmhe.Power(2.0, 1.5, per_component=True))):
        mhe = estimator(cost=lambda given=ONES | {name: loss}: qpmhe.RobustCost(**given))
        layouts.add(planned(mhe.system, mhe.observer, mhe.cost, mhe.settings)[0])
    assert len(layouts) == 1


def test_sizes_and_caps_beyond_all_bounds():
    for option in ("max_qps", "max_solver_iterations"):
        assert estimator(**{option: 2**31}).update([1.0]).improved
    for horizon in (5 * 10**7, 2 * 10**9):
        with pytest.raises(OptionError, match=rf"a horizon of {horizon} .* bytes .* shorter one"):
            estimator(horizon=horizon)
    mhe = estimator()
    library = checked_library(mhe.system, mhe.observer, mhe.cost, mhe.settings)
    with pytest.raises(OptionError, match=r"memory of 1000000000000 estimators needs .* bytes"):
        library.estimators(np.broadcast_to(np.zeros(1), (10**12, 1)))
