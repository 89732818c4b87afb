"""Backends in a process of their own: what they do there ends nothing here."""

import copy
import gc
import os
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

import qpmhe_solvers.isolated
from qpmhe_solvers import QP, Backend, BackendError, OptionError, SolverOptions, SolveStatus, create

from .hostile_backend import Crashing, Hanging, Hostile, Overriding, Printing, Unmakeable, entry
from .problems import CASES, EVERY, make, registered

POSIX = pytest.mark.skipif(os.name != "posix", reason="signals")
FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED


def small(sign=-1.0):
    qp = QP(2, 1)
    qp.bounded = False
    qp.band[:, :, 0], qp.gradient[...] = 1.0, sign
    return qp


def isolated(kind, options=None):
    with registered(entry(kind)):
        return create(kind.__name__.lower(), options, isolated=True)


def program(text, *options):
    """Run a program of its own."""
    command = [sys.executable, *options, "-c", textwrap.dedent(text)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def gone(pid):
    for _ in range(200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("name", sorted({"auto", "daqp", "osqp"} & set(EVERY)))
def test_the_numbers_are_those_of_the_same_process(name):
    apart, here = create(name, isolated=True), create(name)
    for seed in range(4):
        qp, _ = make(**CASES["all kinds"], seed=seed)
        start = np.full((qp.stages, qp.n), 0.1)
        one, two = apart.solve(qp, start), here.solve(qp, start)
        np.testing.assert_array_equal(one.d, two.d)
        for what in ("status", "iterations", "residuals"):
            assert getattr(one, what) == getattr(two, what)
        apart.shift(), here.shift()


@POSIX
def test_a_crash_is_a_failed_qp_and_the_next_one_is_solved():
    solver, counts = isolated(Crashing, SolverOptions(absolute_tolerance=1e-5)), []
    for call in (solver.shift, solver.shift, solver.forget, lambda: solver.prepare(7)):
        counts.append(solver.solve(small()).iterations)
        call()
    assert counts == [1, 102, 203, 1]  # what is not `solve` is forwarded
    for _ in range(2):
        solution = solver.solve(small(1.0))
        assert solution.status is FAILED
        assert solution.message == "crashing: its process died: SIGSEGV"
        solution = solver.solve(small())  # by another process, prepared as the first one
        assert (solution.status, solution.iterations) == (SOLVED, 7001)
        np.testing.assert_array_equal(solution.d, np.ones((2, 1)))
    copied = copy.deepcopy(solver)
    assert (copied.options, copied.solve(small()).status) == (solver.options, SOLVED)
    assert copied._child._process.pid != solver._child._process.pid


def test_the_time_limit_ends_a_solver_that_hangs():
    solver = isolated(Hanging, SolverOptions(time_limit=1.0))
    began = time.monotonic()
    solution = solver.solve(small(1.0))
    assert time.monotonic() - began < 30.0
    assert (solution.status, "time limit" in solution.message) == (FAILED, True)
    for _ in range(100):  # within its limit each QP waits for the process that starts
        solution = solver.solve(small())
        if solution.status is SOLVED:
            break
    assert solution.status is SOLVED


def test_what_it_prints_and_overrides_is_contained(capfd):
    assert isolated(Printing).solve(small(1.0)).status is SOLVED
    out, err = capfd.readouterr()
    assert (out, "words of a solver" in err) == ("", True)
    solver = isolated(Overriding)
    assert "returned int, not a Solution" in solver.solve(small(1.0)).message
    assert solver.solve(small()).message == "ValueError: what it says"


@pytest.mark.slow
@POSIX
def test_the_process_ends_with_the_solver_an_interrupt_and_its_parent(monkeypatch):
    solver = isolated(Hostile)
    first = solver._child._process.pid

    def interrupted(child, message):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(qpmhe_solvers.isolated._Child, "send", interrupted)
        with pytest.raises(KeyboardInterrupt):
            solver.solve(small())
    assert gone(first)
    assert solver.solve(small()).iterations == 1  # a solver that goes on
    second = solver._child._process.pid
    del solver
    gc.collect()
    assert gone(second)
    for how in ("", "os.kill(os.getpid(), 9)"):
        ended = program(f"""
            import os
            from qpmhe_solvers import create
            solver = create("banded", isolated=True)
            print(solver._child._process.pid, flush=True)
            {how}
        """)
        assert (ended.stderr, gone(int(ended.stdout))) == ("", True)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_does_not_end_or_use_that_of_its_parent():
    # In a program of its own: other libraries of this one, such as JAX, warn of any fork.
    ended = program("""
        import os
        from qpmhe_solvers import QP, create
        qp = QP(1, 1)
        qp.band[...], qp.gradient[...] = [[[1.0, 0.0]]], -2.0
        solver = create("banded", isolated=True)
        child = solver._child
        pid = os.fork()
        if pid == 0:
            fine = solver.solve(qp).d == 2.0 and solver._child is not child
            solver._child.end()
            os._exit(0 if fine else 1)
        _, status = os.waitpid(pid, 0)
        print(status, solver.solve(qp).d == 2.0, solver._child is child)
    """, "-W", "ignore")
    assert (ended.stdout, ended.stderr) == ("0 [[ True]] True\n", "")


MAIN = """
import numpy as np
from qpmhe_solvers import QP, Backend, RawSolution, Solver, create, register

class Mine(Solver):
    def _solve(self, qp, start):
        return RawSolution(np.zeros(qp.size), False)

register(Backend("mine", Mine, "theatre"))
print(create("mine", isolated=True).solve(QP(2, 1)).status.name)
"""


def test_what_cannot_be_made_or_sent_is_refused_at_construction():
    with pytest.raises(BackendError, match=r"cannot be isolated: .*no licence"):
        isolated(Unmakeable)
    lock = threading.Lock()
    stuck = Backend("stuck", lambda options, lock=lock: Hostile(options), "theatre")
    with registered(stuck), pytest.raises(BackendError, match=r"sent .*importable module"):
        create("stuck", isolated=True)
    with pytest.raises(OptionError, match="isolated is 1; expected True or False"):
        create("banded", isolated=1)
    # A class of the main script needs cloudpickle.
    hidden = "import sys; sys.modules['cloudpickle'] = sys.modules['joblib'] = None"
    assert "its factory is in the main script" in program(hidden + MAIN).stderr
    pytest.importorskip("joblib")
    assert program(MAIN).stdout == "STOPPED\n"
