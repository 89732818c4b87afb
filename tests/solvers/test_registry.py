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
SOLVER_MODULES = [entry.module for entry in backends() if entry.module]


class Nothing(Solver):
    def _solve(self, qp, start):
        return RawSolution(None, False)


@pytest.mark.parametrize("name", ["osqpp", "OSQP", "", None, 3, ["osqp"]], ids=repr)
@pytest.mark.parametrize("function", [backend, create, unregister])
def test_unknown_name_lists_the_known_ones(function, name):
    with pytest.raises(BackendError) as caught:
        function(name)
    assert f"backend {name!r} is not known; expected one of {', '.join(NAMES)}." in str(
        caught.value
    )
    assert isinstance(caught.value, InvalidInputError)


def test_register_create_unregister():
    with registered(Backend("mine", Nothing, "none at all")) as entry:
        assert backend("mine") is entry
        assert backends()[-1] is entry
        assert available()[-1] == "mine"
        assert isinstance(create("mine"), Nothing)
    assert "mine" not in available()
    assert [entry.name for entry in backends()] == NAMES
    with pytest.raises(BackendError, match="backend 'mine' is not known"):
        create("mine")


def test_a_name_is_registered_once():
    with registered(Backend("mine", Nothing, "none at all")) as entry:
        with pytest.raises(BackendError, match=r"backend 'mine' is registered already.*unregister"):
            register(Backend("mine", Nothing, "another"))
        assert backend("mine") is entry


def test_the_factory_gets_the_options():
    options = SolverOptions(max_iterations=3)
    with registered(Backend("mine", Nothing, "none at all")):
        assert create("mine", options).options is options
        assert create("mine").options == SolverOptions()


def test_an_absent_package_is_named():
    def factory(options):
        raise AssertionError("called although its module is absent")

    entry = Backend(
        "ghost", factory, "none at all", module="no_such_module", distribution="no-such-package"
    )
    with registered(entry):
        assert not entry.available
        assert entry.version == ""
        assert "ghost" not in available()
        assert entry in backends()
        with pytest.raises(BackendError) as caught:
            create("ghost")
    message = str(caught.value)
    assert "backend 'ghost' needs the package no-such-package" in message
    assert "pip install no-such-package" in message
    assert ", ".join(available()) in message


def test_an_absent_package_without_distribution_is_named_by_its_module():
    entry = Backend("ghost", Nothing, "none at all", module="no_such_module")
    with registered(entry), pytest.raises(BackendError, match="pip install no_such_module"):
        create("ghost")


def test_an_absent_submodule_is_absent():
    entry = Backend("ghost", Nothing, "none at all", module="no_such_package.part")
    with registered(entry):
        assert "ghost" not in available()


@pytest.mark.parametrize("entry", backends(), ids=NAMES)
def test_own_table_is_consistent(entry):
    assert entry.matrices in ("banded", "csc", "dense")
    assert entry.method
    assert (entry.module is None) == (entry.distribution is None)
    assert entry.iteration_cap or not entry.iterate_at_cap
    if entry.available and entry.distribution:
        assert entry.version == metadata.version(entry.distribution)


def fresh_interpreter(code):
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_looking_for_backends_imports_none():
    out = fresh_interpreter(
        "import sys, qpmhe_solvers as s\n"
        "names = s.available(); [entry.version for entry in s.backends()]\n"
        "s.create('banded'); s.create('auto')\n"
        f"heavy = ['qpsolvers', 'cvxpy', 'casadi', 'matplotlib', *{SOLVER_MODULES!r}]\n"
        "print(*names); print(*[name for name in heavy if name in sys.modules])\n"
    )
    names, imported = out.split("\n")[:2]
    assert tuple(names.split()) == available()
    assert imported == ""


def test_the_facade_hands_on_the_same_objects():
    assert set(qpmhe.solvers.__all__) <= set(qpmhe_solvers.__all__)
    for name in qpmhe.solvers.__all__:
        assert getattr(qpmhe.solvers, name) is getattr(qpmhe_solvers, name)
