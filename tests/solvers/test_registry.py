"""The list of backends: what can be on it, what is refused, and what a lookup imports."""

import subprocess
import sys
from importlib import metadata

import pytest

import qpmhe.solvers
import qpmhe_solvers
from qpmhe_solvers import (
    Backend,
    BackendError,
    InvalidInputError,
    OptionError,
    RawSolution,
    Solver,
    SolverOptions,
    available,
    backend,
    backends,
    create,
    register,
    unregister,
)

from .problems import registered

NAMES = [entry.name for entry in backends()]


class Nothing(Solver):
    def _solve(self, qp, start):
        return RawSolution(None, False)


@pytest.mark.parametrize("function", [backend, create, unregister])
def test_unknown_name_lists_the_known_ones(function):
    for name in ("osqpp", "OSQP", "", None, 3, ["osqp"]):
        with pytest.raises(BackendError) as caught:
            function(name)
        expected = f"backend {name!r} is not known; expected one of {', '.join(NAMES)}."
        assert expected in str(caught.value)
        assert isinstance(caught.value, InvalidInputError)


def test_register_create_unregister():
    options = SolverOptions(max_iterations=3)
    with registered(Backend("mine", Nothing, "none at all")) as entry:
        assert backend("mine") is entry
        assert backends()[-1] is entry
        assert available()[-1] == "mine"
        assert isinstance(create("mine"), Nothing)
        assert create("mine", options).options is options
        assert create("mine").options == SolverOptions()
        with pytest.raises(BackendError, match=r"backend 'mine' is registered already.*unregister"):
            register(Backend("mine", Nothing, "another"))
        assert backend("mine") is entry
    assert "mine" not in available()
    assert [entry.name for entry in backends()] == NAMES
    for thing in (3, None, "mine", Nothing, Nothing(SolverOptions())):
        with pytest.raises(BackendError, match=r"expected a qpmhe\.solvers\.Backend") as caught:
            register(thing)
        assert repr(thing) in str(caught.value)


def test_names_that_can_be_written_and_others():
    for name in ("mine", "my_solver-2.0", "qpsolvers:mine", "c++", "2x2"):
        with registered(Backend(name, Nothing, "none at all")):
            assert isinstance(create(name), Nothing)
    for name in ("", " ", "a b", "a,b", "-a", "a\n", "a/b", None, 3, ["a"]):
        with pytest.raises(BackendError, match=r"the name of a backend is .*; expected let") as it:
            Backend(name, Nothing, "none at all")
        assert repr(name) in str(it.value)


KINDS = "expected one of 'banded', 'csc', 'dense'"
PACKAGE = "or None if it needs no package"


def test_an_entry_that_can_never_work_is_refused():
    for field, values, words in [
        ("factory", [None, "Nothing"], "expected a callable"),
        ("factory", [Nothing(SolverOptions())], "give the class itself"),
        ("matrices", ["weird", None, ["csc"]], KINDS),
        ("method", ["", 3], "expected a text"),
        ("module", [3, ""], PACKAGE), ("distribution", [b"daqp"], PACKAGE),
        ("iteration_cap", ["yes"], "expected True or False"),
        ("inequalities", [None], "expected True or False"),
    ]:
        for value in values:
            with pytest.raises(BackendError) as caught:
                Backend(**{"name": "mine", "factory": Nothing, "method": "none", field: value})
            for part in (field, repr(value), "'mine'", words):
                assert part in str(caught.value)
        with pytest.raises(OptionError, match="Did you mean inequalities"):
            Backend("mine", Nothing, "none", inequality=False)


class Abstract(Solver):
    pass


class Without(Nothing):
    def __init__(self, options):
        pass


def broken(options):
    raise ImportError("broken")


def test_a_factory_that_makes_no_solver():
    for factory, words in [
        (dict, "TypeError: .*; correct the factory"),
        (Abstract, "TypeError: .*abstract.*; correct the factory"),
        (lambda: None, "TypeError: .*; correct the factory"),
        (lambda options: sys.exit(3), "SystemExit: 3; correct the factory"),
        (lambda options: None, "made None; expected an instance of a subclass"),
        (lambda options: Nothing, "made <class .*; expected an instance of a subclass"),
        (Without, r"has no options; call super\(\).__init__\(options\)"),
        (broken, "ImportError: broken; reinstall numpy"),
    ]:
        package = ("numpy", "numpy") if factory is broken else ()
        with registered(Backend("mine", factory, "none at all", *package)):
            for ask in (create, qpmhe.solvers.check):
                with pytest.raises(BackendError, match=f"backend 'mine' .*{words}") as caught:
                    ask("mine")
        if factory is broken:
            assert isinstance(caught.value.__cause__, ImportError)


def test_our_own_errors_leave_a_factory_as_they_are():
    def factory(options):
        raise OptionError("mine")

    with registered(Backend("mine", factory, "none")), pytest.raises(OptionError, match=r"^mine$"):
        create("mine")


def test_options_that_are_none_are_refused():
    for options in [3, {"max_iterations": 3}, "fast", SolverOptions]:
        for name in ("auto", "banded"):
            with pytest.raises(OptionError, match=r"options is .*; expected qpmhe\.solvers"):
                create(name, options)


def test_an_absent_package_is_named():
    for module, distribution in [
        ("no_such_module", "no-such-package"), ("no_such_module", None), ("no_such.part", None),
    ]:
        entry = Backend("ghost", broken, "none at all", module=module, distribution=distribution)
        with registered(entry):
            assert not entry.available
            assert entry.version == ""
            assert "ghost" not in available()
            assert entry in backends()
            with pytest.raises(BackendError) as caught:
                create("ghost")
        package = distribution or module
        for part in (
            f"backend 'ghost' needs the package {package}", f"pip install {package}",
            ", ".join(available()),
        ):
            assert part in str(caught.value)


@pytest.mark.parametrize("entry", backends(), ids=NAMES)
def test_own_table_is_consistent(entry):
    assert entry.matrices in ("banded", "csc", "dense")
    assert entry.method
    assert (entry.module is None) == (entry.distribution is None)
    assert entry.iteration_cap or not entry.iterate_at_cap
    if entry.available and entry.distribution:
        assert entry.version == metadata.version(entry.distribution)


def fresh_interpreter(code):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout


def test_looking_for_backends_imports_none():
    modules = [entry.module for entry in backends() if entry.module]
    names, imported = fresh_interpreter(
        "import sys, qpmhe_solvers as s\n"
        "names = s.available(); [entry.version for entry in s.backends()]\n"
        "s.create('banded'); s.create('auto')\n"
        f"heavy = ['qpsolvers', 'cvxpy', 'casadi', 'matplotlib', *{modules!r}]\n"
        "print(*names); print(*[name for name in heavy if name in sys.modules])\n"
    ).splitlines()
    assert tuple(names.split()) == available()
    assert imported == ""


PLUGIN = """
import numpy as np
from qpmhe_solvers import Backend, RawSolution, Solver

class Zero(Solver):
    def _solve(self, qp, start):
        return RawSolution(np.zeros(qp.size), False)

one = Backend("zero", Zero, "none")
def two():
    return [Backend("zero2", Zero, "none"), Backend("zero3", Zero, "none")]
def nothing():
    return 3
def taken():
    return Backend("osqp", Zero, "none")
def mixed():
    return [3]
def leaving():
    raise SystemExit(3)
"""
SCRIPT = """
import sys, warnings
sys.path.insert(0, {folder!r})
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import qpmhe_solvers as s
    print("plugin" in sys.modules)
    names = {lookup}
    s.available(); s.backends()
print([name for name in s.available() if "zero" in name])
print(s.create("zero").solve(s.QP(2, 2)).status.name)
for one in caught:
    print(one.category.__name__, one.message)
"""


@pytest.mark.parametrize("lookup", ["s.available()", "s.backends()", "s.backend('zero2')"])
def test_entry_points(tmp_path, lookup):
    (tmp_path / "plugin.py").write_text(PLUGIN)
    info = tmp_path / "plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[qpmhe.backends]\none = plugin:one\ntwo = plugin:two\nodd = plugin:nothing\n"
        "gone = nosuch:x\nclash = plugin:taken\nmixed = plugin:mixed\nleaves = plugin:leaving\n"
    )
    told = fresh_interpreter(SCRIPT.format(folder=str(tmp_path), lookup=lookup))
    early, names, status, *warned = told.splitlines()
    assert early == "False"  # importing the package loads nobody's entry points
    assert names == "['zero', 'zero2', 'zero3']"
    assert status == "STOPPED"
    assert len(warned) == 5
    for name, words in (
        ("odd", "TypeError"), ("gone", "ModuleNotFoundError"), ("clash", "registered already"),
        ("mixed", "cannot register 3"), ("leaves", "SystemExit: 3"),
    ):
        (line,) = (one for one in warned if f"the entry point {name!r}" in one)
        assert words in line
        assert line.startswith("UserWarning")


def test_the_facade_hands_on_the_same_objects():
    assert set(qpmhe.solvers.__all__) <= set(qpmhe_solvers.__all__)
    for name in qpmhe.solvers.__all__:
        assert getattr(qpmhe.solvers, name) is getattr(qpmhe_solvers, name)
