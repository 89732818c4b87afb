"""``qpmhe doctor``: what this machine has, and the engine that each model would run."""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from timeit import repeat
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qpmhe_solvers import backends

from .. import codegen
from ..adapters.casadi import from_casadi
from ..codegen.compiler import find_compiler, optimisation
from ..codegen.folders import cache_directory, cache_folders, refusal
from ..costs import QuadraticCost
from ..errors import QpmheError
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.step_length import step_errors
from ..model.discretize import Discretization
from ..models import catalogue
from ..observers import Luenberger
from ..records.record_model import load_record_model
from ..studies.environment import environment

# Steps that are timed; the least time counts.
_TRIALS = 20
_GOOD, _BAD = "[green]ok[/]", "[yellow]--[/]"


def doctor(
    models: Annotated[
        list[str] | None,
        typer.Argument(help="Models of the zoo, package.module:function or file.py:function; "
                       "the zoo if left out."),
    ] = None,
) -> None:
    """Show what this machine has, and which engine each model would run, and why."""
    console = Console()
    with console.status("trying the compiler"):
        machine = _machine()
    console.print(machine)
    console.print()
    table = _plain("Models with engine=\"auto\"")
    for name in ("model", "n", "form", "engine"):
        table.add_column(name, no_wrap=name != "model", overflow="fold")
    table.add_column("because")
    steps = _plain("Steps of models in continuous time, and their errors in sigma of w")
    for name in ("model", "method", "substeps", "error", "expected", "time in Python"):
        steps.add_column(name, no_wrap=name != "model", overflow="fold")
    for model in models or catalogue():
        with console.status(f"trying {escape(model)}"):
            try:
                estimator = load_record_model(model).estimator
            except QpmheError as error:
                table.add_row(escape(model), "", "", "[red]none[/]", escape(str(error)))
                continue
            table.add_row(escape(model), *_row(estimator))
            if estimator.system.dt is not None:
                for row in _steps(estimator):
                    steps.add_row(escape(model), *row)
    console.print(table)
    if steps.row_count:
        console.print()
        console.print(steps)


def _plain(title: str) -> Table:
    return Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 1, 0, 0))


def _row(estimator: MovingHorizonEstimator) -> tuple[str, ...]:
    """Size, form, engine and reason of a model."""
    system = estimator.system
    engine, reason = codegen.engine_choice(estimator)
    form = "as written"
    if system.symbolic is not None:
        form = "CasADi" if system.tracing is None else "traced"
    color = "green" if engine == "compiled" else "default"
    return str(system.n), form, f"[{color}]{engine}[/]", escape(reason)


def _steps(estimator: MovingHorizonEstimator) -> list[tuple[str, ...]]:
    """Method, substeps, error and the largest one that does no harm; others if it does harm."""
    system = estimator.system
    rows: list[tuple[str, ...]] = []
    for how, error in step_errors(
        system, estimator.cost, estimator.observer.initial_covariance(), estimator.initial_state,
        np.zeros(system.m),
    ):
        color = "default" if error.is_harmless else "yellow"
        own = how == system.origin.how
        rows.append((
            how.method, str(how.steps), f"[{color}]{error.deviations:.2g}[/]",
            f"at most {error.most:g}",
            _time(estimator, None if own else how),
        ))
    return rows or [(
        f"{system.method}", f"{system.steps}", "unknown", "", _time(estimator, None)
    )]


def _time(estimator: MovingHorizonEstimator, how: Discretization | None) -> str:
    """How long one step takes by another discretisation, or its own; blank where it fails."""
    with suppress(Exception), np.errstate(all="ignore"):
        own = estimator.system
        system = own if how is None else own.discretized(*how)
        if system is None:
            return ""
        made, x = system.evaluated_by(system.model()), estimator.initial_state
        u = np.zeros(system.m)
        u[estimator.inputs :] = estimator.settings.parameters
        best = min(repeat(lambda: made.f(x, u), number=1, repeat=_TRIALS))
        return f"{1e6 * best:.3g} us"
    return ""


def _machine() -> Table:
    """One row for each thing that is there, or is missing."""
    table = _plain("This machine")
    for _ in range(2):
        table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    found = environment()
    versions = found["versions"]
    table.show_header = False

    def add(good: bool, name: str, text: str) -> None:
        table.add_row(_GOOD if good else _BAD, name, escape(text))

    add(True, "qpmhe", f"{versions['qpmhe']}, Python {found['python']}, {found['os']}")
    threads = found["threads"]
    add(True, "processor", f"{found['cpu']}, {found['cores']} usable, "
        + (f"OMP_NUM_THREADS={threads}" if threads else "OMP_NUM_THREADS is not set"))
    add(True, "NumPy", f"{versions['numpy']}, BLAS: {_blas()}; SciPy {versions['scipy']}")
    casadi = versions.get("casadi")
    add(casadi is not None, "CasADi", casadi or "not installed: pip install casadi")
    command = find_compiler()
    if command is None:
        wanted = os.environ.get("CC")
        add(False, "C compiler", "none (cc, gcc, clang): install one, or set CC to its path"
            if wanted is None else f"CC is {wanted!r}, which does not exist")
    else:
        add(True, "C compiler", f"{' '.join(command)}: {_compiler_version(command)}")
        if casadi is not None:
            add(*_code())
    add(*_cache())
    wanted = os.environ.get("QPMHE_ENGINE")
    if wanted is not None:
        add(wanted == "auto", "QPMHE_ENGINE", f"{wanted}: replaces engine=\"auto\"")
    entries = [entry for entry in backends() if ":" not in entry.name]
    missing = [entry.name for entry in entries if not entry.available]
    add(not missing, "QP solvers", f"{len(entries) - len(missing)} of {len(entries)}"
        + (f"; not installed: {', '.join(missing)}" if missing else "")
        + "; see qpmhe solvers")
    return table


def _blas() -> str:
    try:
        found = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
        return f"{found['name']} {found['version']}"
    except (KeyError, TypeError):
        return "unknown"


def _compiler_version(command: list[str]) -> str:
    try:
        answer = subprocess.run(
            [command[0], "--version"], capture_output=True, text=True, errors="replace",
            timeout=10, check=False, stdin=subprocess.DEVNULL,
        ).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"gives no version ({error})"
    return answer.strip().partition("\n")[0] or "gives no version"


def _code() -> tuple[bool, str, str]:
    """Whether the compiler's code for a small estimator is right."""
    system = from_casadi(
        lambda x: x - 0.1 * x**3, lambda x: x, n=1, compiled=False
    )
    cost = QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    try:
        made = codegen.compile(
            MovingHorizonEstimator(
                system, Luenberger([0.3]), cost, horizon=3, initial_state=[0.0], engine="python"
            )
        )
    except QpmheError as error:
        return False, "its code", str(error)
    text = f"correct with {optimisation(made.path)}; a small step took {made.seconds:.2g} s"
    return True, "its code", text + ("" if made.is_new else ", from the cache")


def _cache() -> tuple[bool, str, str]:
    """Where libraries are kept, and how many."""
    wanted, texts = cache_directory(), []
    for folder in cache_folders():
        files = [path for path in folder.glob("*.so") if path.is_file()]
        steps = sum(path.name.startswith("mhe-") for path in files)
        models = len(files) - steps
        size = sum(path.stat().st_size for path in files) / 2**20
        texts.append(
            f"{folder}: {steps} step{'s' * (steps != 1)}, {models} model{'s' * (models != 1)}, "
            f"{size:.1f} MiB"
            + ("" if os.access(folder, os.W_OK) else ", read-only")
        )
    refused = refusal(wanted)
    if refused:
        texts.append(f"code in {wanted} is not used, since {refused}")
    return (
        bool(texts) and not refused, "cache", "; ".join(texts) or f"{wanted}, not there yet"
    )
