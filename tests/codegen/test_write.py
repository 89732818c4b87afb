"""`qpmhe.codegen.write`: its arguments, its files, and what it refuses."""

import re
import shutil
import subprocess

import numpy as np
import pytest

import qpmhe
from qpmhe import codegen
from qpmhe.errors import InvalidInputError, OptionError, QpmheError
from qpmhe.model import constraint

from .cases import case
from .test_written import STRICT


def linear(n=3, constraints=None, **options):
    """An estimator of any size."""
    system = qpmhe.from_casadi(
        lambda x: 0.9 * x, lambda x: x[0], n=n, compiled=False, constraints=constraints
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=[[1.0]])
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.full(n, 0.1)), cost,
        **{"horizon": 2, "initial_state": np.zeros(n)} | options,
    )


def test_sources_with_other_weights_and_options_differ_in_the_data_only(tmp_path):
    texts, folder = [], tmp_path / "a" / "b"
    for options in ({"max_qps": 1}, {"max_qps": 2**40}):
        _, source = codegen.write(linear(**options), str(folder))
        texts.append(source.read_text().split("const mhe_settings mhe_default_settings"))
    assert sorted(path.name for path in folder.iterdir()) == ["mhe.c", "mhe.h"]
    assert texts[0][0] == texts[1][0]
    assert ".max_qps = 1," in texts[0][1]
    assert ".max_qps = 2147483647," in texts[1][1]


def test_constraints_are_traced_again_only_where_they_have_changed(monkeypatch):
    traces, trace = [], constraint.traced
    monkeypatch.setattr(
        constraint, "traced", lambda *args, **options: traces.append(1) or trace(*args, **options)
    )
    limit = [1.0]
    mhe = linear(constraints=[
        qpmhe.Constraint(lambda x: x[0] ** 2 - limit[0]), qpmhe.Constraint(lambda v: v - 3.0),
    ])
    assert len(traces) == 2
    functions = codegen.system_of(mhe).constraints
    values, numbers = functions.expression()(np.zeros(7), 0.0, []), functions.numbers()
    assert len(traces) == 2
    assert values[0] == -1.0
    assert numbers["touched"].tolist() == [0, 1]
    limit[0] = 2.0
    assert codegen.system_of(mhe).constraints.expression()(np.zeros(7), 0.0, [])[0] == -2.0
    assert len(traces) == 4


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize("name", ["MHE_tank", "casadi", "real", 60 * "a"])
def test_names(name, tmp_path):
    mhe = case("tank conditions").estimator("python")
    header, source = codegen.write(mhe, tmp_path, name=name)
    assert (header, source) == (tmp_path / f"{name}.h", tmp_path / f"{name}.c")
    for command in (["cc", "-std=c99", "-x", "c", source], ["c++", "-x", "c++", header]):
        if shutil.which(command[0]):
            subprocess.run([*command, *STRICT, "-fsyntax-only"], check=True)
    assert f"{name}_update(&estimator" in header.read_text().split("*/")[0]


def test_what_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for options, text in (
        *(({"name": name}, f"name is {re.escape(repr(name))}") for name in (
            "9a", "a-b", "", "a\n", "\u00e9tat", None, "../a",
        )),
        ({"real": "half"}, "real is 'half'.*'double' or 'float'"), ({"real": ["float"]}, "real is"),
        ({"name": "math"}, "<math.h> is a header of the system.*'mhe_math'"),
        ({"name": "Stdint"}, "<stdint.h> is a header"), ({"fmu": 1}, "fmu is 1"),
        ({"name": 300 * "a"}, "name has 300 letters; expected at most 60"),
    ):
        with pytest.raises(OptionError, match=text):
            codegen.write(linear(), tmp_path / "out", **options)
    for place in (tmp_path / "file", tmp_path / "file" / "below", "null\0byte", None, 3):
        with pytest.raises(InvalidInputError, match="directory is"):
            codegen.write(linear(), place)
    with pytest.raises(InvalidInputError, match="estimator is"):
        codegen.write(linear().system, tmp_path / "out")
    with pytest.raises(QpmheError, match="backend='auto'"):
        codegen.write(linear(backend="osqp"), tmp_path / "out")
    with pytest.raises(QpmheError, match=r"257 states; .* at most 256"):
        codegen.write(linear(257, max_qps=0), tmp_path / "out")
    assert not (tmp_path / "out").exists()


class Wider(qpmhe.Gate):
    """A rule of a user's own: C would compute the gate's verdicts in its place."""

    def judge(self, prediction, noise, v, observed, rejections):
        return super().judge(prediction, noise, 0.5 * v, observed, rejections)


class Counting(qpmhe.Luenberger):
    """An observer that counts failures in its own way."""

    sensors = ((0,),)


class Own(qpmhe.Observer):
    """A user's own, with a correction that a test says."""

    def __init__(self, correction, **attributes):
        self.correction = correction
        vars(self).update(attributes)

    def check(self, system, initial_state):
        pass

    def correct(self, z, v, sample):
        return self.correction(z, v, sample), None


class Filtered(Own):
    """With an estimate of x(t) that has used y(t)."""

    def filter(self, z, v, sample):
        return z, np.eye(3)


def _branching(z, v, sample):
    return 0.1 * v[0] * np.ones(3) if v[0] > 0.0 else 0.2 * v[0] * np.ones(3)


def _listening(z, v, sample):
    return np.full(3, 0.1) * v[0] * (1.0 if getattr(sample, "observed", None) is None else 0.5)


@pytest.mark.parametrize(("observer", "text"), [
    (Own(_branching), r"the correction of Own has no C form \(.*branch"),
    (Own(_listening), r"the correction of Own has no C form \(it reads sample.observed\)"),
    (Own(lambda z, v, sample: np.full(3, 0.1) * v, needs_jacobians=True),
     "Own has no C form: .* without a covariance, Jacobians"),
    (Filtered(lambda z, v, sample: np.full(3, 0.1) * v), "Filtered has no C form"),
    (qpmhe.ExtendedKalman(
        prior=np.eye(3), disturbance=np.eye(3), noise=[[1.0]], innovation=Wider(0.9)
    ), "Wider, the rule for innovations of ExtendedKalman, has no C form; take qpmhe.Gate"),
    (Counting(np.full(3, 0.1)), "Counting counts its sensors' failures by a rule of its own"),
])
def test_rules_of_ones_own_are_refused(observer, text, tmp_path):
    one = linear()
    mhe = qpmhe.MovingHorizonEstimator(
        one.system, observer, one.cost, horizon=2, initial_state=np.zeros(3)
    )
    with pytest.raises(OptionError, match=text):
        codegen.write(mhe, tmp_path)
