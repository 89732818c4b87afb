"""`qpmhe estimate` in a process of its own, to be talked to, interrupted and killed."""

import subprocess
import sys

_CODE = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
from rich.console import Console
from qpmhe.cli.estimate import run
from qpmhe.errors import QpmheError

try:
    run(Console(stderr=True, width=1000), *sys.argv[1:4], **eval(sys.argv[4]))
except QpmheError as error:
    print(error, file=sys.stderr)
    sys.exit(2)
"""


def start(model, record, out, **options):
    return subprocess.Popen(
        [sys.executable, "-c", _CODE, model, str(record), str(out), repr(options)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )


def finish(process, text=""):
    """What it answers: exit code, standard output and standard error."""
    out, error = process.communicate(text.encode(), timeout=60)
    return process.returncode, (out or b"").decode(), error.decode()


def shell(line):
    """Exit code, standard output and standard error of a line with `qpmhe` in it."""
    call = f'{sys.executable} -c "from qpmhe.cli import main; main()"'
    done = subprocess.run(
        ["sh", "-c", line.replace("qpmhe ", f"{call} ", 1)], capture_output=True, text=True,
        stdin=subprocess.DEVNULL, timeout=120, check=False,
    )
    return done.returncode, done.stdout, done.stderr
