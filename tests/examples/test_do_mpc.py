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


def test_the_program_prints_its_table_and_draws(tmp_path):
    answer = subprocess.run(
        [sys.executable, PROGRAM, "--steps", "25", "--seeds", "1", "--out", tmp_path],
        capture_output=True, text=True, check=True, timeout=300,
    )
    assert "qpmhe, 2 QPs" in answer.stdout
    assert ("not installed" in answer.stdout) == (find_spec("do_mpc") is None)
    assert (tmp_path / "do_mpc_masses.png").stat().st_size > 1000


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
