"""The options of the command reach what they name."""

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from qpmhe.cli.estimate import estimate
from qpmhe.errors import OptionError
from qpmhe.records import CheckpointError, estimate_record

from .conftest import CONTINUOUS
from .oscillator import lines


@pytest.fixture
def call(here):
    app = typer.Typer()
    app.command()(estimate)
    Path("record.csv").write_text("\n".join(lines(30)) + "\n")

    def invoke(*arguments, model=CONTINUOUS, record="record.csv", text=None):
        return CliRunner().invoke(app, [model, record, *arguments], input=text)

    return invoke


def test_standard_output_is_the_default(call):
    answer = call("--no-step-time")
    assert answer.exit_code == 0, answer.exception
    estimate_record(CONTINUOUS, "record.csv", "out.csv", step_time=False)
    assert answer.stdout_bytes == Path("out.csv").read_bytes()
    assert "30 samples" in answer.stderr
    piped = call("--no-step-time", "--quiet", record="-", text=Path("record.csv").read_bytes())
    assert (piped.stdout_bytes, piped.stderr) == (answer.stdout_bytes, "")


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
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
    ],
)
def test_options_are_handed_on(call, arguments, options):
    expected = found = None
    try:
        estimate_record(CONTINUOUS, "record.csv", "expected.csv", step_time=False, **options)
    except Exception as error:
        expected = str(error).replace("expected.csv", "out.csv")
    answer = call("--out", "out.csv", "--no-step-time", *arguments.split())
    if answer.exception is not None:
        found = str(answer.exception)
    assert found == expected
    written = Path("out.csv").read_bytes()
    assert written.count(b"\n") > 1
    assert written == Path("expected.csv").read_bytes()


def test_options_of_messy_files_are_handed_on(call):
    rows = [f"{k // 10}s{k % 10},0.5,0" for k in range(12)]
    Path("record.csv").write_text("\n".join(["plant 3", "time,y,u", *rows, ""]))
    answer = call("--out", "out.csv", "--skip-lines", "1", "--time-format", "%Ss%f")
    assert answer.exception is None
    assert Path("out.csv").read_text().splitlines()[-1].startswith("1s1,")


def test_resume_and_overwrite(call):
    Path("record.csv").write_text("\n".join([*lines(30)[:20], "x"]))
    cut = ["--out", "out.csv", "--checkpoint-every", "5", "--no-step-time"]
    assert call(*cut).exit_code == 1  # main makes 2 of our errors
    Path("record.csv").write_text("\n".join(lines(30)) + "\n")
    assert isinstance(call(*cut).exception, CheckpointError)
    assert "15 samples after 15 before" in call(*cut, "--resume").stderr
    whole = Path("out.csv").read_bytes()
    assert "30 samples" in call(*cut, "--overwrite").stderr
    assert Path("out.csv").read_bytes() == whole


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--max-qps", "many"], "'none'"),
        (["--max-solver-iterations", "1.5"], "'none'"),
        (["--initial-state", "0;1"], "between commas"),
        (["--engine", "steam"], "steam"),
    ],
)
def test_options_that_are_no_numbers(call, arguments, words):
    answer = call(*arguments)
    assert isinstance(answer.exception, OptionError)
    assert words in str(answer.exception)
    assert answer.stdout == ""
