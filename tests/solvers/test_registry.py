"""The list of backends: what can be on it, what is refused, and what a lookup imports."""

import subprocess
import sys
from importlib import metadata

import pytest

import qpmhe.solvers
import qpmhe_solvers
from qpmhe_solvers import Backend, BackendError, OptionError, Solver, SolverOptions, registry

from .problems import registered

NAMES = [entry.name for entry in registry.backends()]


class Nothing(Solver):
    def _solve(self, qp, start):
        raise NotImplementedError


def test_register_create_unregister():
    options = SolverOptions(max_iterations=3)
    for name in ("mine", "my_solver-2.0", "qpsolvers:mine", "c++"):
        with registered(Backend(name, Nothing, "none at all")) as entry:
            assert registry.backend(name) is registry.backends()[-1] is entry
            assert registry.available()[-1] == name
            assert isinstance(registry.create(name), Nothing)
            assert registry.create(name, options).options is options
            assert registry.create(name).options == SolverOptions()
            with pytest.raises(BackendError, match=r"is registered already.*unregister"):
                registry.register(Backend(name, Nothing, "another"))
            assert registry.backend(name) is entry
        assert [entry.name for entry in registry.backends()] == NAMES


def test_what_can_never_work_is_refused():
    for name in ("osqpp", None, ["osqp"]):
        for function in (registry.backend, registry.create, registry.unregister):
            with pytest.raises(BackendError) as caught:
                function(name)
            expected = f"backend {name!r} is not known; expected one of {', '.join(NAMES)}."
            assert expected in str(caught.value)
    with pytest.raises(BackendError, match=r"expected a qpmhe\.solvers\.Backend"):
        registry.register(Nothing)
    for name in ("auto", "banded"):
        with pytest.raises(OptionError, match=r"options is 'fast'; expected qpmhe\.solvers"):
            registry.create(name, "fast")
    for field, value, words in [
        ("name", "a b", "the name of a backend is 'a b'; expected let"),
        ("factory", "Nothing", "expected a callable"),
        ("factory", Nothing(SolverOptions()), "give the class itself"),
        ("matrices", "weird", "expected one of 'banded', 'csc', 'dense'"),
        ("method", "", "expected a text"), ("iteration_cap", "yes", "expected True or False"),
    ]:
        with pytest.raises(BackendError, match=words) as caught:
            Backend(**{"name": "mine", "factory": Nothing, "method": "none", field: value})
        assert repr(value) in str(caught.value)
    with pytest.raises(OptionError, match="Did you mean inequalities"):
        Backend("mine", Nothing, "none", inequality=False)


class Without(Nothing):
    def __init__(self, options):
        pass


def broken(options):
    raise ImportError("broken")


def test_a_factory_that_makes_no_solver():
    for factory, words in [
        (lambda options: sys.exit(3), "SystemExit: 3; correct the factory"),
        (lambda options: None, "made None; expected an instance of a subclass"),
        (Without, r"has no options; call super\(\).__init__\(options\)"),
        (broken, "ImportError: broken; reinstall numpy"),
    ]:
        package = ("numpy", "numpy") if factory is broken else ()
        with registered(Backend("mine", factory, "none at all", *package)):
            for ask in (registry.create, qpmhe.solvers.check):
                with pytest.raises(BackendError, match=f"backend 'mine' .*{words}"):
                    ask("mine")
    entry = Backend("ghost", broken, "-", module="no_such.part", distribution="no-such-package")
    with registered(entry):
        assert (entry.available, "ghost" in registry.available()) == (False, False)
        with pytest.raises(BackendError, match=r"'ghost' needs .* pip install no-such-package"):
            registry.create("ghost")


def fresh_interpreter(code):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_own_table_is_consistent_and_looking_imports_none():
    for entry in registry.backends():
        assert entry.matrices in ("banded", "csc", "dense")
        assert entry.method
        assert entry.iteration_cap or not entry.iterate_at_cap
        if entry.available and entry.distribution:
            assert entry.version == metadata.version(entry.distribution)
    modules = [entry.module for entry in registry.backends() if entry.module]
    names, imported = fresh_interpreter(
        "import sys, qpmhe_solvers as s\n"
        "names = s.available(); [entry.version for entry in s.backends()]\n"
        "s.create('banded'); s.create('auto')\n"
        f"heavy = ['qpsolvers', 'cvxpy', 'casadi', 'matplotlib', *{modules!r}]\n"
        "print(*names); print(*[name for name in heavy if name in sys.modules])\n"
    ).splitlines()
    assert tuple(names.split()) == registry.available()
    assert imported == ""
    assert set(qpmhe.solvers.__all__) <= set(qpmhe_solvers.__all__)
    for name in qpmhe.solvers.__all__:
        assert getattr(qpmhe.solvers, name) is getattr(qpmhe_solvers, name)


PLUGIN = """
import numpy as np
from qpmhe_solvers import Backend, RawSolution, Solver

class Zero(Solver):
    def _solve(self, qp, start):
        return RawSolution(np.zeros(qp.size), False)

one = Backend("zero", Zero, "none")
def two():
    return [Backend("zero2", Zero, "none")]
def leaving():
    raise SystemExit(3)
"""
SCRIPT = """
import sys, warnings
sys.path.insert(0, "{folder}")
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import qpmhe_solvers as s
    print("plugin" in sys.modules)
    s.backend("zero2"); s.available(); s.backends()
print([name for name in s.available() if "zero" in name])
print(s.create("zero").solve(s.QP(2, 2)).status.name)
for one in caught:
    print(one.category.__name__, one.message)
"""


def test_entry_points(tmp_path):
    (tmp_path / "plugin.py").write_text(PLUGIN)
    info = tmp_path / "plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[qpmhe.backends]\none = plugin:one\ntwo = plugin:two\ngone = nosuch:x\n"
        "leaves = plugin:leaving\n"
    )
    early, names, status, *warned = fresh_interpreter(SCRIPT.format(folder=tmp_path)).splitlines()
    assert early == "False"  # importing the package loads nobody's entry points
    assert (names, status) == ("['zero', 'zero2']", "STOPPED")
    for line, name, words in zip(
        sorted(warned), ("gone", "leaves"), ("ModuleNotFoundError", "SystemExit: 3"), strict=True
    ):
        assert line.startswith("UserWarning")
        assert f"the entry point {name!r}" in line
        assert words in line
