"""The options of the command reach what they name."""

import pytest
import typer
from typer.testing import CliRunner

from qpmhe.cli.estimate import estimate
from qpmhe.errors import OptionError
from qpmhe.records import CheckpointError

from .oscillator import lines
from .tools import CONTINUOUS, cut_off, get, put
from .tools import estimate as by_hand


@pytest.fixture
def call(here):
    app = typer.Typer()
    app.command()(estimate)
    put("record.csv", lines(30))

    def invoke(*arguments, record="record.csv", text=None):
        return CliRunner().invoke(app, [CONTINUOUS, record, *arguments], input=text)

    return invoke


def test_standard_output_is_the_default(call):
    answer = call("--no-step-time")
    assert answer.exit_code == 0, answer.exception
    by_hand(CONTINUOUS)
    assert answer.stdout_bytes == get("out.csv")
    assert "30 samples" in answer.stderr
    piped = call("--no-step-time", "--quiet", record="-", text=get("record.csv"))
    assert (piped.stdout_bytes, piped.stderr) == (answer.stdout_bytes, "")


@pytest.mark.parametrize(("arguments", "options"), [
    ("--horizon 3 --backend osqp --max-qps none --max-solver-iterations 7",
     {"horizon": 3, "backend": "osqp", "max_qps": None, "max_solver_iterations": 7}),
    ("--max-qps 0 --max-solver-iterations none --initial-state -0.1,0.25",
     {"max_qps": 0, "max_solver_iterations": None, "initial_state": [-0.1, 0.25]}),
    ("--covariances full --time TIME --outputs y=u --inputs u1=u --skip-repeated",
     {"covariances": "full", "time": "TIME", "outputs": "y=u", "inputs": "u1=u",
      "skip_repeated": True}),
    ("--separator comma --decimal . --encoding latin-1 --checkpoint-every 7 --time-scale 0.5",
     {"separator": ",", "decimal": ".", "encoding": "latin-1", "checkpoint_every": 7,
      "time_scale": 0.5}),
    ("--max-gap 0 --equal-steps --dt 0.1", {"max_gap": 0, "equal_steps": True, "dt": 0.1}),
])
def test_options_are_handed_on(call, arguments, options):
    expected = found = None
    try:
        by_hand(CONTINUOUS, out="expected.csv", **options)
    except Exception as error:
        expected = str(error).replace("expected.csv", "out.csv")
    answer = call("--out", "out.csv", "--no-step-time", *arguments.split())
    if answer.exception is not None:
        found = str(answer.exception)
    assert found == expected
    written = get("out.csv")
    assert written.count(b"\n") > 1
    assert written == get("expected.csv")


def test_options_of_messy_files_are_handed_on(call):
    rows = [f"{k // 10}s{k % 10},{'none given' if k == 3 else 0.5},0" for k in range(12)]
    put("record.csv", ["plant 3", "time,y,u", *rows])
    answer = call("--out", "out.csv", "--skip-lines", "1", "--time-format", "%Ss%f",
                  "--missing", "-999", "--missing", "none given")
    assert answer.exception is None
    assert get("out.csv").splitlines()[-1].startswith(b"1s1,")
    assert get("out.csv").count(b"MISSING") == 1


def test_resume_and_overwrite(call):
    cut_off(lines(30), 20, checkpoint_every=5)
    again = ["--out", "out.csv", "--checkpoint-every", "5", "--no-step-time"]
    assert isinstance(call(*again).exception, CheckpointError)
    assert "15 samples after 15 before" in call(*again, "--resume").stderr
    whole = get("out.csv")
    assert "30 samples" in call(*again, "--overwrite").stderr
    assert get("out.csv") == whole


@pytest.mark.parametrize(("arguments", "words"), [
    (["--max-qps", "many"], "'none'"), (["--max-solver-iterations", "1.5"], "'none'"),
    (["--initial-state", "0;1"], "separated by commas"), (["--engine", "steam"], "steam"),
])
def test_options_that_are_no_numbers(call, arguments, words):
    answer = call(*arguments)
    assert isinstance(answer.exception, OptionError)
    assert words in str(answer.exception)
    assert answer.stdout == ""
