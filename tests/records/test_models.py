"""A user's model: what its function may return, and the errors where it does not fit."""

import sys
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError
from qpmhe.models.loading import code_place as place
from qpmhe.records.record_model import load_record_model as load_model

BEGIN = """
import numpy as np, qpmhe
system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
observer = qpmhe.Luenberger([0.3])
cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
"""


@pytest.fixture
def make(here):
    numbers = iter(range(100))

    def write(function, begin=BEGIN):
        path = here / f"model{next(numbers)}.py"  # files are imported once
        path.write_text(f"{begin}\ndef make():\n    {function}\n")
        return f"{path.name}:make"

    return write


@pytest.mark.parametrize(
    "given",
    [
        "return system, observer, cost, dict(horizon=4, initial_state=[2.0])",
        "return [system, observer, cost, dict(horizon=4, initial_state=2.0, dt=0.5, states='a')]",
        "return qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=4, initial_state=[2])",
        "return system, observer, cost, qpmhe.models.Scenario(system=system, initial_state=[0.0],"
        " initial_estimate=[2.0], disturbance_covariance=1.0, noise_covariance=1.0, dt=0.5,"
        " horizon=4, steps=9, labels=('a',))",
    ],
)
def test_matrices(make, given):
    found = load_model(make(given))
    assert (found.estimator.horizon, found.estimator.initial_state.tolist()) == (4, [2.0])
    has_names = "'a'" in given
    assert found.states == (("a",) if has_names else ("x1",))
    assert found.dt == (0.5 if has_names else None)
    changed = load_model(make(given), horizon=7, max_qps=None, initial_state=[1.0])
    assert changed.estimator.settings.max_qps is None
    assert (changed.estimator.horizon, changed.estimator.initial_state.tolist()) == (7, [1.0])


def test_scenario_and_options_together():
    path = Path("both.py")
    found = load_model("battery_cell")
    assert not path.exists()
    assert found.estimator.horizon == 60
    assert found.states == ("state of charge", "v1 (V)", "v2 (V)")


def test_bare_parts_need_options(make):
    model = make("return system, observer, cost")
    with pytest.raises(OptionError, match="--horizon"):
        load_model(model)
    with pytest.raises(OptionError, match="--initial-state"):
        load_model(model, horizon=3)
    assert load_model(model, horizon=3, initial_state=np.zeros(1)).estimator.horizon == 3


def test_modules(make, monkeypatch, here):
    monkeypatch.syspath_prepend(here)
    name = make("return system, observer, cost, dict(horizon=4, initial_state=2.0)")
    found = load_model(name.replace(".py", ""))
    assert found.identity["model"] == name.replace(".py", "")


@pytest.mark.parametrize(
    ("function", "words"),
    [
        ("return 3", ["gave a int", "(system, observer, cost)"]),
        ("return system, observer", ["gave a tuple of 2"]),
        ("return observer, system, cost", ["gave a Luenberger for its system"]),
        ("return system, observer, cost, 3", ["gave a int after its cost"]),
        ("return system, observer, cost, dict(horzon=3)", ["'horzon'", "horizon"]),
        ("return system, observer, cost, dict(horizon=3, initial_state=[0, 1])", ["(2,)", "(1,)"]),
        ("return system, observer, cost, dict(horizon=3, initial_state=0, states=['a', 'b'])",
         ["names its states", "1 different names"]),
        ("raise SystemExit(0)", ["line 8: ", "ends the program"]),
        ("return 1 / 0", ["line 8: ", "ZeroDivisionError: division by zero"]),
        ("return qpmhe.System(lambda x: x[:0], lambda x: x, n=1, p=1)",
         ["line 8: ", "f returned shape (0,)", "expected (1,)"]),
        ("return qpmhe.System(lambda x: x, lambda x: x, n=2, p=1)",
         ["line 8: ", "h returned shape (2,)"]),
    ],
)
def test_models_that_do_not_fit(make, function, words):
    model = make(function)
    with pytest.raises(InvalidInputError) as caught:
        load_model(model)
    for word in words:
        assert word in str(caught.value)
    assert model in str(caught.value)


@pytest.mark.parametrize(
    ("begin", "words"),
    [
        ("x = 1\ny = (", ["line 2", "SyntaxError"]),
        ("x = 1\nimport nowhere_to_be_found", ["line 2", "nowhere_to_be_found"]),
        ("def f():\n    return 1 / 0\nf()", ["line 2", "ZeroDivisionError"]),
    ],
)
def test_files_that_cannot_be_imported(make, begin, words):
    model = make("return 1", begin=begin)
    with pytest.raises(ModelError) as caught:
        load_model(model)
    for word in [model.partition(":")[0], *words]:
        assert word in str(caught.value)


def test_no_such_function(make):
    model = make("return 1")
    with pytest.raises(ModelError, match="has no function other"):
        load_model(model.replace(":make", ":other"))
    with pytest.raises(ModelError, match="cannot read"):
        load_model("nowhere.py:make")
    assert qpmhe.models.catalogue()  # and a name without a colon is one of these
    with pytest.raises(ModelError, match="battery_cell"):
        load_model("nowhere")


def test_a_file_imports_those_beside_it(make, here):
    folder = here / "sub"
    folder.mkdir()
    (folder / "helper_of_sib.py").write_text("HORIZON = 6\n")
    (folder / "second_helper_of_sib.py").write_text("START = [3.0]\n")
    name = make(
        "from second_helper_of_sib import START\n"
        "    return system, observer, cost, dict(horizon=helper_of_sib.HORIZON, "
        "initial_state=START)",
        begin=f"import helper_of_sib\n{BEGIN}",
    )
    before = list(sys.path)
    (folder / "sib.py").write_text(Path(name.partition(":")[0]).read_text())
    found = load_model("sub/sib.py:make")
    assert (found.estimator.horizon, found.estimator.initial_state.tolist()) == (6, [3.0])
    assert sys.path == before


@pytest.mark.parametrize(
    ("f", "h", "line", "words"),
    [
        ("x * gain", "x", 10, "f raised NameError: name 'gain' is not defined"),
        ("0.9 * x", "x.first()", 13, "h raised AttributeError"),
    ],
)
@pytest.mark.parametrize("form", ["{}.py:make", "{}:make"])
def test_the_line_of_a_mistake_in_the_model(here, monkeypatch, form, f, h, line, words):
    monkeypatch.syspath_prepend(here)
    name = f"typo{line}{form[2:3] == '.'}"
    Path(f"{name}.py").write_text(
        "import numpy as np\nimport qpmhe\n\n\n"
        "def make():\n    return system(), qpmhe.Luenberger([0.3]), qpmhe.QuadraticCost(\n"
        "        prior=1.0, disturbance=10.0, noise=1.0), dict(horizon=3, initial_state=[1.0])\n"
        f"\ndef f(x):\n    return {f}\n\ndef h(x):\n    return {h}\n\n"
        "def system():\n    return qpmhe.System(f, h, n=1, p=1)\n"
    )
    with pytest.raises(ModelError) as caught:
        load_model(form.format(name))
    assert f"{here / name}.py, line {line}: " in str(caught.value)
    assert words in str(caught.value)


def test_places_are_in_the_users_own_files(here):
    """A model beside the package's own folder must not be told lines of that one."""
    package = Path(qpmhe.__file__).parent
    with pytest.raises(InvalidInputError) as caught:
        qpmhe.Luenberger("what")
    for file in (package.parent / "model.py", Path(__file__)):
        assert place(caught.value, file).startswith(f"{__file__}, line ")
    assert place(caught.value, None) == ""
