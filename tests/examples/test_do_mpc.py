"""The rotating masses of do-mpc: the program, and do-mpc itself where it is installed."""

import contextlib
import importlib.util
import io
import re
import subprocess
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "examples" / "do_mpc_masses.py"
PAGE = ROOT / "docs" / "do-mpc.md"

pytest.importorskip("casadi")
with_do_mpc = pytest.mark.skipif(find_spec("do_mpc") is None, reason="do-mpc is not installed")


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("do_mpc_masses", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rmse(result, record, settled=20):
    speeds = (result.states - record.states[1:])[settled:, 3:6]
    inertia = result.inertias[settled:] - 2.25
    return np.sqrt(np.mean(speeds**2)), np.sqrt(np.mean(inertia**2))


@pytest.mark.slow
def test_the_program_prints_its_table_and_draws(tmp_path):
    answer = subprocess.run(
        [sys.executable, PROGRAM, "--steps", "25", "--seeds", "1", "--out", tmp_path],
        capture_output=True, text=True, check=True, timeout=300,
    )
    assert "qpmhe, 2 QPs" in answer.stdout
    # Nothing from sample 50 on: three errors and the time, and words for what is not there.
    row = next(line for line in answer.stdout.splitlines() if "qpmhe, 2 QPs" in line)
    assert len(re.findall(r"\d+\.\d+", row)) == 4
    assert "nan" not in answer.stdout
    words = " ".join(answer.stdout.split())
    assert "samples 20 to 24; none from 50 on, whose columns are left out" in words
    assert ("not installed" in answer.stdout) == (find_spec("do_mpc") is None)
    assert (tmp_path / "do_mpc_masses.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("steps", "columns", "words"),
    [
        (21, 5, "samples 20 to 20; none from 50 on"),
        (50, 5, "samples 20 to 49; none from 50 on"),
        (51, 8, "samples 20 to 49, then the rest"),
    ],
)
def test_every_column_has_samples(example, steps, columns, words):
    table, parts = example.error_table(steps, 1)
    assert len(table.columns) == columns
    assert words in table.caption
    assert all(np.arange(steps)[part].size for part in parts)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--steps", "20"], "--steps is 20; expected more than 20"),
        (["--steps", "-5"], "--steps is -5"),
        (["--seeds", "0"], "--seeds is 0; expected at least 1"),
    ],
)
def test_too_short_a_record_is_refused(example, monkeypatch, capsys, options, words):
    monkeypatch.setattr(sys, "argv", [str(PROGRAM), *options])
    with pytest.raises(SystemExit, match="2"):
        example.main()
    assert words in " ".join(capsys.readouterr().err.split())


def test_two_qps_find_speeds_and_inertia(example):
    record = example.simulate(seed=4, steps=80)
    speed, inertia = rmse(example.with_qpmhe(record, 2), record)
    # Differences of measured angles are good to 0.01 sqrt(2) / 0.1 = 0.14 rad/s at best.
    assert speed < 0.1
    assert inertia < 0.15


@with_do_mpc
def test_both_estimate_the_same(example):
    record = example.simulate(seed=4, steps=60)
    ours = example.with_qpmhe(record, None)
    theirs = example.with_do_mpc(record)
    speed, inertia = rmse(ours, record)
    their_speed, their_inertia = rmse(theirs, record)
    assert speed < 1.1 * their_speed
    assert inertia < 1.1 * their_inertia
    # Each differs from the truth by 0.07 rad/s, and the two by their priors only.
    apart = np.sqrt(np.mean((ours.states - theirs.states)[20:, 3:6] ** 2))
    assert apart < 0.5 * min(speed, their_speed)


@with_do_mpc
def test_the_pages_do_mpc_code_runs():
    text = PAGE.read_text(encoding="utf-8")
    fences = re.findall(r"^```(.*?)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    blocks = [(info, code) for info, code in fences if "python" in info]
    theirs = next(k for k, (info, _) in enumerate(blocks) if "do-mpc" in info)
    told = next(body for info, body in fences if info.startswith('text title="Output, with'))
    printed = io.StringIO()
    names: dict[str, object] = {}
    with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
        warnings.simplefilter("ignore")
        for _, code in blocks[: theirs + 1]:
            exec(code, names)
    found, expected = (
        [float(number) for number in re.findall(r"\d+\.\d+", words)]
        for words in (printed.getvalue(), told)
    )
    assert found == pytest.approx(expected, rel=0.05)
