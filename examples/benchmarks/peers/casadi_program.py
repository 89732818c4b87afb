"""The window's problem as a nonlinear program of CasADi, built once and called in place."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from abc import abstractmethod
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
from problems import Problem

from qpmhe.codegen.compiler import find_compiler
from qpmhe.codegen.folders import cache_directory

from .base import Array, Peer, UnavailableError, WindowData

__all__ = ["CasadiProgram", "InPlace", "compile_library"]

# Those with which qpmhe compiles its own.
FLAGS = (
    "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math",
)


class CasadiProgram(Peer):
    """A solver of CasADi on (eq:optiMHE).

    It starts at its own previous solution, shifted by one stage, with the model's prediction
    at the end; in a record's first window at the observer's trajectory.

    Parameters
    ----------
    form : {"states", "shooting"}
        ``states``: the state trajectory as variables, w and v eliminated. ``shooting``: w as
        variables beside it, stage by stage, the dynamics as constraints.
    compiled : bool
        Whether the functions are generated in C and compiled; with w as variables, the
        discretised model is one function then, called by all stages. Else all is expanded to
        scalar operations, which is the fastest for CasADi's virtual machine.
    start : {"shifted", "candidate"}
        ``candidate`` starts at the observer's trajectory in all windows.
    """

    package = "casadi"
    plugin = ""
    label = ""
    #: Whether the solver itself can be generated in C, not only the functions it calls.
    whole = False
    #: Whether it starts with the multipliers it is given.
    multipliers = False

    def __init__(self, form: str, compiled: bool = False, start: str = "shifted") -> None:
        self.form, self.compiled, self.start = form, compiled, start
        words = "x" if form == "states" else "x, w"
        self.name = f"CasADi {self.label} ({words}{'; C' if compiled else ''})"
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    @abstractmethod
    def options(self, problem: Problem) -> dict[str, Any]:
        """Options of ``casadi.nlpsol``."""

    def setup(self, problem: Problem) -> None:
        """State the program, compile it if wanted, and prepare the call."""
        try:
            import casadi as ca
        except ImportError as error:
            raise UnavailableError("CasADi is not installed: pip install casadi") from error
        self._n, self._count, self._m = problem.n, problem.horizon, problem.m
        if not ca.has_nlpsol(self.plugin):
            raise UnavailableError(f"this CasADi comes without {self.plugin}")
        options = self.options(problem)
        solver = ca.nlpsol("mhe", self.plugin, self._program(ca, problem), options)
        if self.compiled:
            solver = self._compile(ca, solver, options)
        self._prepare(solver)
        x, u = ca.SX.sym("x", problem.n), ca.SX.sym("u", problem.m)
        self._model = InPlace(ca.Function("f", [x, u], [problem.step(x, u)]))

    def _program(self, ca: Any, problem: Problem) -> dict[str, Any]:
        n, p, count, cost = problem.n, problem.p, problem.horizon, problem.cost
        by_stage = self.compiled and self.form == "shooting"
        kind = ca.MX if by_stage else ca.SX
        step, output = problem.step, problem.output
        if by_stage:
            x, u = ca.SX.sym("x", n), ca.SX.sym("u", problem.m)
            step = ca.Function("f", [x, u], [step(x, u)])
            output = ca.Function("h", [x], [output(x)])
        states = [kind.sym(f"x{i}", n) for i in range(count + 1)]
        prior, measured = kind.sym("prior", n), kind.sym("y", p, count)
        inputs = kind.sym("u", problem.m, count)
        offset = states[0] - prior
        objective = offset.T @ cost.prior @ offset
        variables, gaps = [], []
        for i in range(count):
            moved = step(states[i], inputs[:, i])
            variables.append(states[i])
            if self.form == "states":
                w = states[i + 1] - moved
            else:
                w = kind.sym(f"w{i}", n)
                variables.append(w)
                gaps.append(states[i + 1] - moved - w)
            v = measured[:, i] - output(states[i])
            objective += w.T @ cost.disturbance @ w + v.T @ cost.noise @ v
        return {
            "x": ca.vertcat(*variables, states[count]),
            "p": ca.veccat(prior, measured, inputs),
            "f": objective,
            "g": ca.vertcat(*gaps),
        }

    def _compile(self, ca: Any, solver: Any, options: dict[str, Any]) -> Any:
        self._folder = tempfile.TemporaryDirectory(prefix="mhe_")
        with chdir(self._folder.name):  # CasADi takes names of files, but not of folders
            write = solver.generate if self.whole else solver.generate_dependencies
            library = str(compile_library(Path(write("mhe.c")).absolute()))
        if self.whole:
            return ca.external("mhe", library)
        return ca.nlpsol("mhe", self.plugin, library, options)

    def _prepare(self, solver: Any) -> None:
        """Views on the parts of the solver's arguments and results."""
        call = self._call = InPlace(solver)
        call.arguments["lbx"].fill(-np.inf)
        call.arguments["ubx"].fill(np.inf)
        n, count = self._n, self._count
        width = n if self.form == "states" else 2 * n
        start, answer = call.arguments["x0"], call.results["x"]
        self._start_stages = start[: count * width].reshape(count, width)
        self._start_end = start[count * width :]
        self._stages = answer[: count * width].reshape(count, width)
        self._end = answer[count * width :]
        parameters = call.arguments["p"]
        self._prior, first = parameters[:n], parameters.size - self._m * count
        self._measured = parameters[n:first].reshape(count, -1)
        self._inputs = parameters[first:].reshape(count, self._m)
        self._continues = False

    def restart(self) -> None:
        """Do not start at another record's solution."""
        self._continues = False

    def _shift(self, newest_input: Array) -> None:
        n, model = self._n, self._model
        self._start_stages[:-1] = self._stages[1:]
        self._start_stages[-1, :n] = self._end
        self._start_stages[-1, n:] = 0.0
        model.arguments["i0"][:], model.arguments["i1"][:] = self._end, newest_input
        model()
        self._start_end[:] = model.results["o0"]
        if self.multipliers and self.form == "shooting":
            ours, last = self._call.arguments["lam_g0"], self._call.results["lam_g"]
            ours[:-n], ours[-n:] = last[n:], 0.0

    def update(self, window: WindowData) -> Array:
        """Solve, and hand out the states."""
        n = self._n
        if self._continues and self.start == "shifted" and np.isfinite(self._end).all():
            self._shift(window.newest_input)
        else:
            self._start_stages[:, :n] = window.candidate[:-1]
            if self.form == "shooting":
                self._start_stages[:, n:] = window.disturbances
            self._start_end[:] = window.candidate[-1]
            self._call.arguments["lam_g0"].fill(0.0)
        self._continues = True
        self._prior[:] = window.prior
        self._measured[:] = window.measurements
        self._inputs[:] = window.inputs
        self._call()
        trajectory = np.empty((self._count + 1, n))
        trajectory[:-1] = self._stages[:, :n]
        trajectory[-1] = self._end
        return trajectory

    def close(self) -> None:
        """Remove generated files."""
        if self._folder is not None:
            self._folder.cleanup()


class InPlace:
    """A function of CasADi on fixed buffers, as its manual advises against call overhead.

    Parameters
    ----------
    function : casadi.Function
        Its dense arguments and results.

    Attributes
    ----------
    arguments, results : dict of str to array
        By CasADi's names; matrices column by column.
    """

    def __init__(self, function: Any) -> None:
        self._buffer, self._trigger = function.buffer()
        self.arguments = {
            function.name_in(i): np.zeros(function.nnz_in(i)) for i in range(function.n_in())
        }
        self.results = {
            function.name_out(i): np.zeros(function.nnz_out(i)) for i in range(function.n_out())
        }
        for i, argument in enumerate(self.arguments.values()):
            self._buffer.set_arg(i, memoryview(argument))
        for i, result in enumerate(self.results.values()):
            self._buffer.set_res(i, memoryview(result))

    def __call__(self) -> None:
        """Evaluate from the arguments to the results."""
        self._trigger()


def compile_library(source: Path, further: tuple[str, ...] = ()) -> Path:
    """A C file made into a shared library, which is kept in qpmhe's cache on disk.

    Further arguments of the compiler name headers and libraries.

    Raises
    ------
    UnavailableError
        If there is no C compiler, or it fails.
    """
    compiler = find_compiler()
    if compiler is None:
        raise UnavailableError("no C compiler (cc, gcc or clang) found")
    command = [*compiler, *FLAGS, "-fPIC", "-shared"]
    key = source.read_bytes() + " ".join((*command, *further)).encode()
    digest = hashlib.sha256(key).hexdigest()[:32]
    folder = cache_directory() / "benchmarks"
    folder.mkdir(parents=True, exist_ok=True)
    library = folder / f"{digest}.so"
    if not library.exists():
        made = source.with_suffix(".so")
        done = subprocess.run(
            [*command, str(source), "-o", str(made), *further, "-lm"],
            capture_output=True, text=True, check=False,
        )
        if done.returncode:
            raise UnavailableError(f"the C compiler failed: {done.stderr.strip()[:200]}")
        shutil.move(made, library)
    return library
