"""`qpmhe.codegen.write`: its arguments, its files, and what it refuses."""

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest

import qpmhe
from qpmhe import codegen
from qpmhe.codegen.library import generated
from qpmhe.errors import InvalidInputError, OptionError, QpmheError

from .cases import case
from .driver import STRICT

ca = pytest.importorskip("casadi")
CC = shutil.which("cc")


def linear(n=3, **options):
    """A system with a CasADi form, of any size, and parts that go with it."""
    system = qpmhe.from_casadi(lambda x: 0.9 * x, lambda x: x[0], n=n, compiled=False)
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=[[1.0]])
    return made(system, qpmhe.Luenberger(np.full(n, 0.1)), cost, **options)


def made(*parts, **options):
    options = {"horizon": 2, "initial_state": np.zeros(parts[0].n)} | options
    return qpmhe.MovingHorizonEstimator(*parts, **options)


def test_default_settings_are_all_there_is_of_weights_and_options(tmp_path):
    """Sources of estimators that differ in weights and options only differ in the data only."""
    texts = []
    for options in ({"max_qps": 1}, {"max_qps": None, "delay": 1}):
        _, source = codegen.write(linear(**options), tmp_path)
        texts.append(source.read_text().split("const mhe_settings mhe_default_settings"))
    assert texts[0][0] == texts[1][0]
    assert texts[0][1] != texts[1][1]


@pytest.mark.skipif(CC is None, reason="there is no C compiler")
@pytest.mark.parametrize(
    "name", ["mhe_tank", "MHE_tank", "MHE", "casadi", "real", "size", 60 * "a"]
)
def test_names(name, tmp_path):
    header, source = codegen.write(case("tank").estimator("python"), tmp_path, name=name)
    assert (header, source) == (tmp_path / f"{name}.h", tmp_path / f"{name}.c")
    for language, file in (("c", source), ("c++", header)):
        standard = ["-std=c99", *STRICT] if language == "c" else ["-Werror"]
        if shutil.which(language.replace("c", "cc", 1)[:2] if language == "c" else "c++"):
            command = ["cc" if language == "c" else "c++", *standard, "-fsyntax-only", "-x"]
            subprocess.run([*command, language, file], check=True)
    comment = header.read_text().split("*/")[0]
    assert f"{name}.c with" in comment
    assert f"{name}_update(&estimator" in comment


def test_a_time_budget_needs_a_clock(tmp_path):
    header, _ = codegen.write(linear(time_budget=1e-9), tmp_path)
    assert "clock" in header.read_text()


def test_bad_options(tmp_path):
    for options, text in (
        *(({"name": name}, f"name is {re.escape(repr(name))}") for name in (
            "9a", "a-b", "", "a\n", "\u00e9tat", None, "../a",
        )),
        ({"real": "half"}, "real is 'half'.*'double' or 'float'"), ({"real": ["float"]}, "real is"),
        ({"name": "math"}, "<math.h> is a header of the system.*'mhe_math'"),
        *(({"name": name}, f"<{name.lower()}.h> is a header") for name in (
            "string", "Stdint", "features",
        )),
        ({"name": 300 * "a"}, "name has 300 letters; expected at most 60"),
        ({"fmu": 1}, "fmu is 1"),
    ):
        with pytest.raises(OptionError, match=text):
            codegen.write(linear(), tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()
    with pytest.raises(InvalidInputError, match="estimator is"):
        codegen.write(linear().system, tmp_path)


def test_bad_directories(tmp_path):
    (tmp_path / "file").write_text("")
    for place in ("file", "file/below", "null\0byte", None, 3):
        with pytest.raises(InvalidInputError, match="directory is"):
            codegen.write(linear(), tmp_path / place if isinstance(place, str) else place)


def test_directories_are_made_and_files_replaced(tmp_path):
    folder = tmp_path / "a" / "b"
    first = codegen.write(linear(), str(folder))
    texts = [path.read_text() for path in first]
    codegen.write(linear(4), folder)
    assert [path.read_text() for path in first] != texts
    assert sorted(path.name for path in folder.iterdir()) == ["mhe.c", "mhe.h"]


class OwnCost(qpmhe.QuadraticCost):
    """May weigh in another way."""


class OwnGain(qpmhe.Luenberger):
    """Corrects in another way."""

    def correct(self, z, v, sample):
        correction, covariance = super().correct(z, v, sample)
        return 0.5 * correction, covariance


def branching(x):
    return 0.9 * x if float(x[0]) > 9.0 else x


def rooted(x):
    """CasADi writes an #error in the place of a root finder."""
    z, q = ca.SX.sym("z"), ca.SX.sym("q")
    root = ca.rootfinder("root", "newton", {"x": z, "p": q, "g": z + 0.1 * ca.sin(z) - q})
    return ca.vertcat(root(0, x[0]), 0.5 * x[1], x[2])


def test_what_has_no_c_form_names_the_remedy(tmp_path):
    usual = linear()
    weights = {"prior": np.eye(3), "disturbance": np.eye(3), "noise": [[1.0]]}
    x = ca.MX.sym("x", 3)
    for changes, options, remedy in (
        ({"system": qpmhe.System(branching, lambda x: x[:1], n=3, p=1)}, {}, "from_casadi"),
        ({"observer": OwnGain(np.full((3, 1), 0.1))}, {}, "of qpmhe's own"),
        ({"cost": OwnCost(**weights)}, {}, "QuadraticCost"),
        ({}, {"backend": "osqp"}, "backend='auto'"),
        ({"system": qpmhe.from_casadi(
            ca.Function("f", [x], [rooted(x)]), ca.Function("h", [x], [x[0]]), compiled=False
        )}, {}, "code"),
    ):
        parts = (
            changes.get(name, getattr(usual, name)) for name in ("system", "observer", "cost")
        )
        with pytest.raises(QpmheError, match=remedy):
            codegen.write(made(*parts, **options), tmp_path)
        assert not list(tmp_path.iterdir())


def test_what_does_not_fit_into_c_is_refused(tmp_path):
    large = linear(257, max_qps=0)
    with pytest.raises(QpmheError, match=r"257 states; .* at most 256"):
        codegen.write(large, tmp_path)
    assert large.system.symbolic is not None  # CasADi evaluates it instead
    large = linear(50, max_qps=0)
    with pytest.raises(OptionError, match=r"a horizon of 800000 with 50 states .* shorter one"):
        generated(
            large.system, large.observer, large.cost,
            dataclasses.replace(large.settings, horizon=800000),
        )
    assert not list(tmp_path.iterdir())
    codegen.write(linear(max_qps=2**40), tmp_path)
    assert ".max_qps = 2147483647" in (tmp_path / "mhe.c").read_text()
