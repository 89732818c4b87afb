"""Where a study ran: versions, processor, system, revision."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from qpmhe_solvers import backends

from .._version import __version__

_PACKAGES = ("numpy", "scipy", "qpsolvers", "cvxpy", "casadi", "jax", "joblib")


@lru_cache(maxsize=1)
def environment() -> dict[str, Any]:
    """The software and the machine that this process runs on."""
    packages = {*_PACKAGES, *(entry.distribution for entry in backends() if entry.distribution)}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "versions": {"qpmhe": __version__, **_versions(sorted(packages))},
        "cpu": _processor(),
        "cores": cores or 1,
        "python": platform.python_version(),
        "os": platform.platform(),
        "host": platform.node(),
        "threads": os.environ.get("OMP_NUM_THREADS"),
    }


def environment_words(found: dict[str, Any], names: Iterable[str] = ()) -> str:
    """An environment in a line: versions of qpmhe, NumPy and these backends, and the machine."""
    wanted = ["qpmhe", "numpy", *(
        entry.distribution for entry in backends() if entry.name in set(names)
    )]
    versions = found.get("versions", {})
    packages = [f"{name} {versions[name]}" for name in dict.fromkeys(wanted) if name in versions]
    return (
        f"{', '.join(packages)}; {found.get('cpu')}, {found.get('cores')} cores; "
        f"Python {found.get('python')}, {found.get('os')}"
    )


def _versions(names: list[str]) -> dict[str, str]:
    found = {}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:  # not a Linux
        pass
    return platform.processor() or platform.machine()


def revision() -> str | None:
    """The git revision of the working directory, with ``+`` if files differ; None if none."""
    try:
        head = _git("rev-parse", "HEAD")
        return f"{head}+" if _git("status", "--porcelain", "--untracked-files=no") else head
    except (OSError, subprocess.SubprocessError):
        return None


def _git(*arguments: str) -> str:
    answer = subprocess.run(
        ["git", *arguments], capture_output=True, text=True, check=True, timeout=10
    )
    return answer.stdout.strip()
