"""JSON lines in and out, memory, and the time from a line in to its line out."""

import json
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from qpmhe.errors import OptionError
from qpmhe.records import Latency, RecordError

from .oscillator import as_json, lines
from .tools import (
    CONTINUOUS,
    DISCRETE,
    STEPS,
    command,
    estimate,
    finish,
    get,
    put,
    rows,
    start,
    talk,
)


def test_json_lines_are_the_record_and_the_rows_of_csv(here):
    text = lines(60)
    put("record.csv", text)
    put("record.jsonl", as_json(text))
    estimate(CONTINUOUS, "record.csv", "expected.csv")
    estimate(CONTINUOUS, "record.jsonl", "out.csv", outputs="y1=y")
    assert get("out.csv") == get("expected.csv")
    estimate(CONTINUOUS, "record.csv", "out.jsonl")
    header, *rows = get("expected.csv").decode().splitlines()
    names = header.split(",")
    found = [json.loads(line, parse_float=str, parse_int=str)
             for line in get("out.jsonl").decode().splitlines()]
    assert [[each[name] or "" for name in names] for each in found] == [
        row.split(",") for row in rows]
    assert isinstance(json.loads(get("out.jsonl").splitlines()[0])["cost"], float)


def test_a_killed_run_of_json_lines_resumes_byte_for_byte(here):
    text = as_json(lines(60))
    put("record.jsonl", [*text[:37], "{"])
    options = {"checkpoint_every": 10, "outputs": "y1=y"}
    with pytest.raises(RecordError, match=r"record.jsonl, line 38: it is no JSON .*--resume"):
        estimate(CONTINUOUS, "record.jsonl", "out.jsonl", **options)
    put("record.jsonl", text)
    assert estimate(CONTINUOUS, "record.jsonl", "out.jsonl", resume=True, **options).before == 30
    estimate(CONTINUOUS, "record.jsonl", "whole.jsonl", **options)
    assert get("out.jsonl") == get("whole.jsonl")


def test_nested_messages_in_a_pipe_with_sensors_that_come_one_at_a_time(here):
    messages = [
        {"header": {"stamp": k}, "pose": {"position": [0.1 * k, 2.0]} if k % 2 else {"other": 1}}
        for k in range(12)
    ]
    text = "".join(json.dumps(each) + "\n" for each in messages)
    words = ["--time", "header.stamp", "--outputs",
             "y1=pose.position[0],y2=pose.position[1]", "--format", "jsonl"]
    answer = command(DISCRETE, "-", *words, text=text)
    assert answer.exit_code == 0, answer.output
    rows = [json.loads(line) for line in answer.stdout.splitlines()]
    assert [row["time"] for row in rows] == list(range(12))
    assert ["MISSING" in row["status"] for row in rows] == [True, False] * 6
    assert command(DISCRETE, "-", *words[:3], "y1=pose.position[0],y2=pose.nowhere", *words[4:],
                   text=text).stderr.count("no line of standard input has 'pose.nowhere'") == 1
    for wrong, part in (("[1, 2]\n", "expected a JSON object"), ("nothing\n", "it is no JSON"),
                        ("\n", "it is empty"), ('{"y1": 1, "y2": 1}\n', "no column for the time"),
                        ('{"time": 0, "y1": "high", "y2": 0}\n', "'high' is not a number"),
                        ('{"time": 0, "y1": 1, "y2"', "may be cut off")):
        answer = command(DISCRETE, "-", "--format", "jsonl", text=wrong)
        assert isinstance(answer.exception, RecordError)
        assert part in str(answer.exception)
    with pytest.raises(OptionError, match="--format is 'xml'"):
        estimate(DISCRETE, "-", format="xml")


def test_quantiles_are_those_of_all_times_to_one_percent():
    times = np.random.default_rng(0).lognormal(-6.0, 1.5, 5000)
    latency = Latency(deadline=float(np.sort(times)[-51]))
    for one in times:
        latency.add(one)
    for share in (0.5, 0.99, 0.999):
        exact = np.quantile(times, share, method="inverted_cdf")
        assert exact <= latency.quantile(share) <= 1.01 * exact
    assert (latency.worst, latency.late, latency.samples) == (times.max(), 50, 5000)
    assert "50 late (1 % over" in str(latency)
    assert str(Latency()) == "line in to line out: no sample so far"
    assert np.isnan(Latency().quantile(0.5))
    with pytest.raises(OptionError, match="--deadline is 0"):
        Latency(deadline=0)


# Its peak, which a process does not take over from the one that starts it.
_PEAK = """
import re, sys
from pathlib import Path
from qpmhe.records import estimate_record

estimate_record(*sys.argv[1:], max_qps=0, engine="python", step_time=False)
print(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="this system does not say")
def test_a_record_of_ten_times_the_size_takes_no_more_memory(here):
    rest, peaks = ",0.123456" * 100, []
    for samples in (5_500, 55_000):
        with open("record.csv", "w") as file:
            file.write("time,y1,y2" + ",c" * 100 + "\n")
            file.writelines(f"{k},{k % 7},{k % 3}{rest}\n" for k in range(samples))
        done = subprocess.run(
            [sys.executable, "-c", _PEAK, DISCRETE, "record.csv", f"{samples}.csv"],
            capture_output=True, text=True, check=True, timeout=300)
        peaks.append(int(done.stdout) / 1024)
        assert rows(f"{samples}.csv") == samples + 1
    assert os.path.getsize("record.csv") > 49e6
    assert peaks[1] - peaks[0] < 4.0, peaks


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="this system has no such signal")
def test_latency_is_reported_on_a_signal_and_at_the_end(here):
    running = start(DISCRETE, "out.csv", equal_steps=True, latency=Latency(deadline=1e-9))
    talk(running, *STEPS[:8], until=8)
    os.kill(running.pid, signal.SIGUSR1)
    code, _, error = finish(running, "\n".join([*STEPS[8:12], ""]))
    assert code == 0, error
    found = re.findall(r"line in to line out, (\d+) samples: median .*, 99 % .*, 99.9 % .*, worst "
                       r".*, (\d+) late \(100 % over 0.001 us\)", error)
    assert found[-1] == ("11", "11")
    assert len(found) == 2
    put("record.csv", STEPS[:12])
    answer = command(DISCRETE, "record.csv", "--deadline", "60", "--out", "by-command.csv")
    assert ", 0 late (0 % over 60 s)" in " ".join(answer.stderr.split())
