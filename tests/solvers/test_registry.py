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


@pytest.mark.parametrize(
    "name", ["", " ", "a b", "a,b", "-a", "a\n", "a/b", None, 3, ["a"]], ids=repr
)
def test_a_name_that_cannot_be_written_is_refused(name):
    with pytest.raises(BackendError, match=r"the name of a backend is .*; expected letters") as it:
        Backend(name, Nothing, "none at all")
    assert repr(name) in str(it.value)


@pytest.mark.parametrize("name", ["mine", "my_solver-2.0", "qpsolvers:mine", "c++", "2x2"])
def test_names_that_can_be_written(name):
    with registered(Backend(name, Nothing, "none at all")):
        assert isinstance(create(name), Nothing)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("factory", None, "expected a callable"),
        ("factory", Nothing(SolverOptions()), "give the class itself"),
        ("factory", "Nothing", "expected a callable"),
        ("matrices", "weird", "expected one of 'banded', 'csc', 'dense'"),
        ("matrices", None, "expected one of 'banded', 'csc', 'dense'"),
        ("matrices", ["csc"], "expected one of 'banded', 'csc', 'dense'"),
        ("method", "", "expected a text"),
        ("method", 3, "expected a text"),
        ("module", 3, "or None if it needs no package"),
        ("module", "", "or None if it needs no package"),
        ("distribution", b"daqp", "or None if it needs no package"),
        ("iteration_cap", "yes", "expected True or False"),
        ("inequalities", None, "expected True or False"),
    ],
)
def test_an_entry_that_can_never_work_is_refused(field, value, words):
    with pytest.raises(BackendError) as caught:
        Backend(**{"name": "mine", "factory": Nothing, "method": "none", field: value})
    message = str(caught.value)
    assert field in message
    assert repr(value) in message
    assert "'mine'" in message
    assert words in message


def test_a_field_that_there_is_not_is_named():
    with pytest.raises(OptionError, match="Did you mean inequalities"):
        Backend("mine", Nothing, "none", inequality=False)


@pytest.mark.parametrize(
    "thing", [3, None, "mine", Nothing, Nothing(SolverOptions())],
    ids=["number", "none", "name", "class", "solver"],
)
def test_only_a_backend_can_be_registered(thing):
    with pytest.raises(BackendError, match=r"expected a qpmhe\.solvers\.Backend") as caught:
        register(thing)
    assert repr(thing) in str(caught.value)
    assert [entry.name for entry in backends()] == NAMES


class Abstract(Solver):
    pass


class Without(Nothing):
    def __init__(self, options):
        pass


@pytest.mark.parametrize(
    ("factory", "words"),
    [
        (dict, "TypeError: .*; correct the factory"),
        (Abstract, "TypeError: .*abstract.*; correct the factory"),
        (lambda: None, "TypeError: .*; correct the factory"),
        (lambda options: sys.exit(3), "SystemExit: 3; correct the factory"),
        (lambda options: None, "made None; expected an instance of a subclass"),
        (lambda options: Nothing, "made <class .*; expected an instance of a subclass"),
        (Without, r"has no options; call super\(\).__init__\(options\)"),
    ],
)
def test_a_factory_that_makes_no_solver_is_told(factory, words):
    with registered(Backend("mine", factory, "none at all")):
        for ask in (create, qpmhe.solvers.check):
            with pytest.raises(BackendError, match=f"backend 'mine' .*{words}"):
                ask("mine")


def test_a_package_that_does_not_load_is_told():
    def factory(options):
        raise ImportError("broken")

    entry = Backend("mine", factory, "none", "numpy", "numpy")
    words = "ImportError: broken; reinstall numpy"
    with registered(entry), pytest.raises(BackendError, match=words) as caught:
        create("mine")
    assert isinstance(caught.value.__cause__, ImportError)


def test_our_own_errors_leave_a_factory_as_they_are():
    def factory(options):
        raise OptionError("mine")

    with registered(Backend("mine", factory, "none")), pytest.raises(OptionError, match=r"^mine$"):
        create("mine")


@pytest.mark.parametrize("options", [3, {"max_iterations": 3}, "fast", SolverOptions], ids=repr)
@pytest.mark.parametrize("name", ["auto", "banded"])
def test_options_that_are_none_are_refused(name, options):
    with pytest.raises(OptionError, match=r"options is .*; expected qpmhe\.solvers\.SolverOptions"):
        create(name, options)


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
