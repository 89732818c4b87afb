import inspect
import subprocess
import sys

import pytest

import qpmhe
import qpmhe_solvers

HEAVY = (
    "casadi", "clarabel", "control", "cvxpy", "jax", "matplotlib", "osqp", "proxsuite", "qpsolvers",
    "rich", "sympy", "typer",
)


def test_import_loads_no_solver_and_no_plotting():
    code = f"import sys, qpmhe; print([m for m in {HEAVY!r} if m in sys.modules])"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "[]"


def test_modules_are_imported_when_they_are_named():
    code = """
import sys, types, qpmhe
for name in ("certificates", "models", "plots", "records", "studies", "tune", "tuning"):
    assert name in dir(qpmhe) and name in qpmhe.__all__
    assert name in ("models", "tuning") or f"qpmhe.{name}" not in sys.modules, name
    thing = getattr(qpmhe, name)
    assert thing is getattr(qpmhe, name) and (callable(thing) or thing.__all__)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'plot'"):
        qpmhe.plot()


def test_diagnosis_and_tuning_load_no_statistics():
    """It took 0.7 s of a diagnosis, for quantiles that `scipy.special` has, too."""
    code = "import sys, qpmhe; qpmhe.diagnose, qpmhe.tune; print('scipy.stats' in sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "False"


def public_classes_and_functions():
    for module in (qpmhe, qpmhe_solvers, qpmhe.models, qpmhe.errors):
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                yield pytest.param(thing, id=f"{module.__name__}.{name}")


@pytest.mark.parametrize("thing", list(public_classes_and_functions()))
def test_every_public_parameter_is_documented(thing):
    text = inspect.getdoc(thing) or ""
    assert text
    if inspect.isclass(thing) and (issubclass(thing, Exception) or hasattr(thing, "__members__")):
        return
    callables = [(text, thing)]
    if inspect.isclass(thing):
        for name, member in vars(thing).items():
            wrapped = isinstance(member, (classmethod, staticmethod))
            function = member.__func__ if wrapped else member
            if not name.startswith("_") and inspect.isfunction(function):
                callables.append((inspect.getdoc(function) or "", function))
    for documentation, function in callables:
        if function in (qpmhe.Estimate, qpmhe.Sensitivity, qpmhe_solvers.Solution):
            continue  # made by the library; their attributes are documented instead
        if " `qpmhe." in documentation or "see `" in documentation or "See `" in documentation:
            continue  # refers to the contract that documents them
        for parameter in list(inspect.signature(function).parameters):
            if parameter not in ("self", "cls"):
                assert parameter in documentation, f"{function.__qualname__}: {parameter}"
