"""The estimator as an FMU: one file that Simulink, Modelica tools and test benches import."""

from __future__ import annotations

import hashlib
import platform
import struct
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from string import Template
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from .._checks import Array
from .._version import __version__
from ..errors import CompilationError
from ..model.system import System
from .compiler import shared_library
from .templates import renamed, template

_FOLDERS = {"Linux": "linux", "Windows": "win", "Darwin": "darwin"}
_SUFFIXES = {"Linux": ".so", "Windows": ".dll", "Darwin": ".dylib"}
# So that equal estimators make equal files.
_DATE = (1980, 1, 1, 0, 0, 0)
# What fmu.c has of a guard.
_GUARD = {
    "reals": "    ERROR, LAST_ERROR = ERROR + MHE_NX - 1,\n",
    "integers": ", MOVED, GUARD_OFF",
    "members": "    mhe_guard guard;\n",
    "begin": """    mhe_guard_start(&m->guard, &m->estimator);
    for (int j = 0; j < MHE_NX; j++) m->reals[ERROR + j] = m->guard.error[j];
""",
    "check": """    mhe_guard_check(&m->guard, &m->estimator, &m->estimate);
    for (int j = 0; j < MHE_NX; j++) {
        m->reals[STATE + j] = m->guard.state[j];
        m->reals[FILTERED + j] = m->guard.filtered[j];
        m->reals[ERROR + j] = m->guard.error[j];
    }
    m->integers[MOVED] = m->guard.moved;
    m->integers[GUARD_OFF] = m->guard.off;
""",
}


def write_fmu(
    target: Path, name: str, files: dict[str, str], system: System, initial_state: Array,
    guarded: bool = False,
) -> None:
    """Write an FMU for co-simulation by FMI 2.0, with the C sources and a library for this machine.

    Parameters
    ----------
    target : Path
        The file.
    name : str
        Prefix of the generated code, and name of the model.
    files : dict of str
        Header and source of the estimator.
    system, initial_state : System and (n,) array
        Those of the estimator.
    guarded : bool
        Whether the source has a guard.
    """
    step = system.dt or 1.0
    guid = hashlib.sha256("\0".join((*files.values(), repr(step))).encode()).hexdigest()[:32]
    values = {
        "start": ", ".join(map(repr, initial_state.tolist())), "step": repr(step), "guid": guid,
        **{place: text * guarded for place, text in _GUARD.items()},
    }
    unit = renamed(Template(template("fmu.c")).substitute(values), name)
    sources = {**files, f"{name}_fmu.c": unit.replace('"mhe.h"', f'"{name}.h"')}
    description = _description(name, guid, system, initial_state, step, guarded)
    machine = platform.system()
    if machine not in _FOLDERS:
        raise CompilationError(f"FMI has no name for the platform {machine!r}.")
    binary = f"{name}{_SUFFIXES[machine]}"
    with tempfile.TemporaryDirectory() as scratch:
        for file, text in sources.items():
            Path(scratch, file).write_text(text, encoding="ascii")
        made = Path(scratch, binary)
        shared_library([Path(scratch, file) for file in sources if file.endswith(".c")], made)
        library = made.read_bytes()
    folder = f"{_FOLDERS[machine]}{8 * struct.calcsize('P')}"
    contents = {
        "modelDescription.xml": description,
        **{f"sources/{file}": text.encode() for file, text in sources.items()},
        f"binaries/{folder}/{binary}": library,
    }
    with ZipFile(target, "w") as archive:
        for path, content in contents.items():
            archive.writestr(ZipInfo(path, _DATE), content, ZIP_DEFLATED)


def _description(
    name: str, guid: str, system: System, initial_state: Array, step: float, guarded: bool
) -> bytes:
    """The text of modelDescription.xml; variables in the order of fmu.c."""
    root = ET.Element("fmiModelDescription", {
        "fmiVersion": "2.0", "modelName": name, "guid": guid,
        "description": "Moving horizon estimator", "generationTool": f"qpmhe {__version__}",
        "variableNamingConvention": "structured",
    })
    unit = ET.SubElement(root, "CoSimulation", {
        "modelIdentifier": name, "canHandleVariableCommunicationStepSize": "false",
        "canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true",
    })
    listed = ET.SubElement(unit, "SourceFiles")
    for file in (f"{name}.c", f"{name}_fmu.c"):
        ET.SubElement(listed, "File", {"name": file})
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", {"name": "logStatusError"})
    ET.SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": repr(step)})
    variables = ET.SubElement(root, "ModelVariables")
    outputs: list[int] = []

    def add(
        label: str, kind: str, reference: int, causality: str, start: float | None, text: str
    ) -> None:
        attributes = {
            "name": label, "valueReference": str(reference), "causality": causality,
            "variability": "fixed" if causality == "parameter" else "discrete",
            "description": text,
        }
        if causality == "parameter":
            attributes["initial"] = "exact"
        variable = ET.SubElement(variables, "ScalarVariable", attributes)
        ET.SubElement(variable, kind, {} if start is None else {"start": repr(start)})
        if causality == "output":
            outputs.append(len(variables))

    no_start: list[float | None] = [None] * system.n
    vectors: tuple[tuple[str, str, Sequence[float | None], str], ...] = (
        ("initial_state", "parameter", initial_state.tolist(), "guess of the first state"),
        ("y", "input", [0.0] * system.p, "measured output, NaN where it is missing"),
        ("u", "input", [0.0] * system.m, "known input"),
        ("state", "output", no_start, "estimate of the state after this step"),
        ("filtered", "output", no_start, "estimate of the state at this sample"),
    )
    reference = 0
    for label, causality, starts, text in vectors:
        for j, value in enumerate(starts):
            add(f"{label}[{j + 1}]", "Real", reference, causality, value, text)
            reference += 1
    for label, text in (
        ("cost", "true cost of the estimate"), ("candidate_cost", "true cost of the candidate"),
        ("restored_cost", "limit of the cost of a restored candidate; NaN for any other"),
    ):
        add(label, "Real", reference, "output", None, text)
        reference += 1
    for j in range(system.n if guarded else 0):
        add(f"error[{j + 1}]", "Real", reference + j, "output", None,
            "proved bound on the error of state, NaN when the guard is off")
    integers = [("status", "bits of qpmhe.Status"), ("qps", "quadratic programs solved")]
    if guarded:
        integers += [
            ("moved", "whether the guard moved the state (1) and the filtered state (2)"),
            ("guard_off", "why the guard is off, 0 while it is on"),
        ]
    for k, (label, text) in enumerate(integers):
        add(label, "Integer", k, "output", None, text)
    structure = ET.SubElement(root, "ModelStructure")
    for element in ("Outputs", "InitialUnknowns"):
        group = ET.SubElement(structure, element)
        for index in outputs:
            ET.SubElement(group, "Unknown", {"index": str(index)})
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True))
