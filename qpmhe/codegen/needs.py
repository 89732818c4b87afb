"""What generated C needs: QPs, iterations and operations of a step, memory, code and stack."""

from __future__ import annotations

import re
import shlex
import shutil
import struct
import subprocess
import tempfile
from collections import defaultdict
from dataclasses import dataclass, fields
from pathlib import Path
from textwrap import fill
from typing import Any

from qpmhe_solvers.values import shown

from ..errors import CompilationError, OptionError
from ..estimation.limits import ALONG, CORRECTIONS, NEAREST_POINTS, RESTORING
from ..terms.soft import SOFT
from .layout import Layout
from .operations import FLOPS

_PARTS = ("estimator", "workspace", "estimate")
_MARK = b"qpmhe: sizes of\0"
_SECONDS = 300.0
_WIDTH = 98


@dataclass(frozen=True)
class Needs:
    """What a step of a written estimator needs at most.

    The counts are those of the estimate's members. An iteration of a QP is one factorisation, and a
    QP takes another one, or two, without rows.

    Attributes
    ----------
    qps : int
        QPs around the best trajectory: ``max_qps``, and one more where a candidate outside of the
        sets needs one.
    corrections, nearest_points : int
        QPs for second-order corrections, and for feasible trajectories near others.
    iterations : int
        Iterations of all these QPs, 0 without sets: at most ``max_solver_iterations`` in each, and
        as many again where it fails and gets a ridge.
    memory : int or None
        Bytes of one estimator, one workspace and one estimate: all of its static memory.
    code : int or None
        Bytes of code and constants, without ``libm``.
    stack : int or None
        Bytes of stack of ``update``, on its longest chain of calls, without ``libm``.
    frame : int or None
        Bytes of stack of the function that takes most.
    compiler : str
        The command of the compiler that these were measured with; blank without one.
    operations : dict of int or None
        Operations in floating point: ``additions`` (and subtractions), ``multiplications``,
        ``divisions``, ``square_roots``, and calls of other functions of ``libm`` by their names.
        An upper bound, by the source alone: every loop runs as often as its condition allows, every
        branch that may be taken is. None where there is none: see ``unbounded``.
    unbounded : str
        Why there are no ``operations``; else blank.
    """

    qps: int
    corrections: int
    nearest_points: int
    iterations: int
    memory: int | None = None
    code: int | None = None
    stack: int | None = None
    frame: int | None = None
    compiler: str = ""
    operations: dict[str, int] | None = None
    unbounded: str = ""

    @property
    def flops(self) -> int | None:
        """Additions, multiplications, divisions and square roots together."""
        return None if self.operations is None else sum(self.operations[one] for one in FLOPS)

    @classmethod
    def of(cls, layout: Layout, settings: Any) -> Needs:
        """Those of an estimator of this layout, with this ``mhe_settings``."""
        limit, most = int(settings["max_iterations"]), int(settings["max_qps"])
        if not layout.has_rows or not most:
            return cls(most, 0, 0, 0)
        qps = most + 1
        # Where soft rows bend, shorter steps along them are corrected, too.
        corrections = qps * CORRECTIONS * (1 + len(ALONG) * (SOFT in layout.terms))
        nearest = NEAREST_POINTS * (1 + qps) + 2 * RESTORING * layout.restores
        # A QP that fails is solved again with a ridge, unless roots need none.
        solved = (qps + corrections + nearest) * (1 + (layout.free is None))
        return cls(qps, corrections, nearest, solved * limit)

    def header(self, prefix: str) -> str:
        """Lines for the header's comment and its macros."""
        capital = prefix.upper()
        counts = "".join(
            f"#define {capital}_MOST_{one.name.upper()} {getattr(self, one.name)}\n"
            for one in fields(self)[:4]
        )
        sizes = " + ".join(f"sizeof({prefix}_{one})" for one in _PARTS)
        text = "What a step takes at most, in the words of the estimate's members, and the static "
        text += f"memory of one estimator.{self._measured()}"
        text += f" {self._computed()}"
        lines = fill(text, _WIDTH, initial_indent="/* ", subsequent_indent=" * ")
        if self.operations is not None:
            counts += f"#define {capital}_MOST_FLOPS {self.flops}\n"
        return f"{lines} */\n{counts}#define {capital}_MEMORY ({sizes})\n"

    def _computed(self) -> str:
        """A sentence on the operations."""
        if self.operations is None:
            return f"There is no bound of its operations in floating point: {self.unbounded}."
        kinds = [f"{self.operations[one]} {one.replace('_', ' ')}" for one in FLOPS]
        calls = [
            f"{most} calls of {name}" for name, most in self.operations.items() if name not in FLOPS
        ]
        beside = f", and in addition {', '.join(calls)}" if calls else ""
        return (
            f"Operations in floating point with the settings below: at most {', '.join(kinds)}"
            f"{beside}."
        )

    def _measured(self) -> str:
        if not self.compiler:
            return ""
        found = [f"{self.memory} bytes of memory"]
        if self.code is not None:
            found.append(f"{self.code} of code and constants")
        if self.stack is not None:
            found.append(f"{self.stack} of stack, {self.frame} of them in one function")
        command = self.compiler.encode("ascii", "backslashreplace").decode().replace("*/", "* /")
        return f" As `{command}` compiles it: {'; '.join(found)}; without libm."


def measured(files: dict[str, str], name: str, command: str) -> dict[str, Any]:
    """Memory, code and stack of written files, as a compiler's command makes them.

    Parameters
    ----------
    files : dict of str
        Header and source.
    name : str
        Their name.
    command : str
        The compiler with its options.

    Raises
    ------
    OptionError
        If there is no such compiler.
    CompilationError
        If it does not compile the files.
    """
    words = _words(command)
    probe = (
        f'#include <stdint.h>\n#include "{name}.h"\n'
        "const struct { char mark[16]; uint32_t one, sizes[3]; } qpmhe_probe = {"
        + f'"{_MARK[:-1].decode()}", 1, {{' + ", ".join(
            f"(uint32_t)sizeof({name}_{one})" for one in _PARTS
        ) + "}};\n"
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for file, text in {**files, "probe.c": probe}.items():
            (folder / file).write_text(text, encoding="ascii")
        _run(words, folder, "probe.c")
        found: dict[str, Any] = {
            "memory": sum(_sizes((folder / "probe.o").read_bytes())), "compiler": command,
        }
        # Clang knows neither option, older versions of GCC not the second.
        for more in (["-fstack-usage", "-fcallgraph-info=su"], []):
            try:
                _run([*words, *more], folder, f"{name}.c")
                break
            except CompilationError:
                if not more:
                    raise
        found["code"] = _code(words[0], folder / f"{name}.o")
        graph = folder / f"{name}.ci"
        if graph.is_file():
            found |= stack_of(graph.read_text(), f"{name}_update")
    return found


def _words(command: Any) -> list[str]:
    try:
        words = shlex.split(command) if isinstance(command, str) else []
    except ValueError:
        words = []
    path = shutil.which(words[0]) if words else None
    if path is None:
        raise OptionError(
            f"compiler is {shown(command)}; expected the command of a C compiler on this machine, "
            "with options, such as 'arm-none-eabi-gcc -mcpu=cortex-m7 -Os'."
        )
    return [path, *words[1:]]


def _run(words: list[str], folder: Path, file: str) -> None:
    try:
        done = subprocess.run(
            [*words, "-c", file], cwd=folder, capture_output=True, text=True, errors="replace",
            timeout=_SECONDS, check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilationError(f"{words[0]} cannot be run ({error}).") from error
    if done.returncode:
        raise CompilationError(f"{words[0]} does not compile {file}: {done.stderr.strip()[:2000]}")
    if not (folder / file).with_suffix(".o").is_file():
        raise CompilationError(
            f"{words[0]} does not compile {file} to an object file of its name; leave options out "
            "that end before or name its output, such as -E, -S and -o."
        )


def _sizes(content: bytes) -> tuple[int, ...]:
    at = content.find(_MARK)
    if at < 0:
        raise CompilationError(
            "the compiler's object file does not hold its constants; leave -flto out."
        )
    numbers = content[at + len(_MARK) :][:16]
    order = "<" if struct.unpack("<I", numbers[:4])[0] == 1 else ">"
    return struct.unpack(f"{order}4I", numbers)[1:]


def _code(compiler: str, path: Path) -> int | None:
    """Bytes of code and constants, by the ``size`` that belongs to the compiler."""
    folder, name = Path(compiler).parent, Path(compiler).name
    own = re.sub(r"(gcc|clang|cc)(-[\d.]+)?$", "size", name)
    tool = shutil.which(folder / own) or shutil.which("size")
    if tool is None:
        return None
    done = subprocess.run([tool, path], capture_output=True, text=True, check=False)
    rows = done.stdout.splitlines()
    if done.returncode or len(rows) < 2:
        return None
    text, data = rows[1].split()[:2]
    return int(text) + int(data)


def stack_of(graph: str, start: str) -> dict[str, int]:
    """Bytes on the longest chain of calls from a function, and of the largest frame on any.

    A call by a pointer is one of any static function that nobody calls by its name.

    Parameters
    ----------
    graph : str
        What GCC writes by ``-fcallgraph-info=su``.
    start : str
        The function.
    """
    frames = {
        title: int(size) for title, size in re.findall(
            r'^node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes \(', graph, re.M
        )
    }
    calls: dict[str, set[str]] = defaultdict(set)
    for source, target in re.findall(
        r'^edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph, re.M
    ):
        calls[source].add(target)
    named = set().union(*calls.values())
    calls["__indirect_call"] |= {one for one in frames if ":" in one and one not in named}
    depths: dict[str, int] = {}

    def depth(one: str) -> int:
        if one not in depths:
            depths[one] = 0  # of a function that calls itself; there is none
            depths[one] = frames.get(one, 0) + max(map(depth, calls[one]), default=0)
        return depths[one]

    total = depth(start)
    return {"stack": total, "frame": max(frames.get(one, 0) for one in depths)}
