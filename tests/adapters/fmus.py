"""FMUs of two tanks for model exchange, compiled here, and the same model in NumPy."""

import atexit
import re
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

import qpmhe

fmpy = pytest.importorskip("fmpy")
STATES, INPUTS, OUTPUTS = ("upper", "lower"), ("pump", "leak"), ("flow", "total")


@cache
def folder():
    made = Path(tempfile.mkdtemp(prefix="qpmhe-tanks-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


@cache
def library(fmi, nominal):
    """The compiled library. FMPy wants all functions of FMI; those that nobody calls fail."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    module = pytest.importorskip(f"fmpy.fmi{fmi}")
    source, place = Path(__file__).with_name("tanks.c"), folder() / f"tanks{fmi}-{nominal}.so"
    written = {  # IN(name) is a function of both versions
        f"fmi{fmi}{name}"
        for name in re.findall(rf"\b(?:fmi{fmi}|IN\()(\w+)\)?\(", source.read_text())
    }
    missing = [
        name for name in dir(getattr(module, f"FMU{fmi}Model"))
        if name.startswith(f"fmi{fmi}") and name not in written
    ]
    stubs = folder() / f"stubs{fmi}.c"
    stubs.write_text("".join(f"int {name}(void) {{ return 3; }}\n" for name in missing))
    headers = Path(fmpy.__file__).with_name("c-code")
    subprocess.run(
        ["cc", "-O1", "-shared", "-fPIC", f"-DFMI={fmi}", f"-DNOMINAL={nominal}", f"-I{headers}",
         str(source), str(stubs), "-lm", "-o", str(place)],
        check=True, capture_output=True,
    )
    return place.read_bytes()


# Name, reference, attributes in FMI 3's words, unit.
VARIABLES = [
    ("upper", 0, "local", {"start": "1", "initial": "exact"}, "m"),
    ("lower", 1, "local", {"start": "0.5", "initial": "exact"}, "m"),
    ("der(upper)", 2, "local", {"derivative": "upper"}, ""),
    ("der(lower)", 3, "local", {"derivative": "lower"}, ""),
    ("pump", 4, "input", {"start": "1"}, "m3/s"),
    ("leak", 5, "input", {"start": "0"}, "m3/s"),
    ("flow", 6, "output", {}, "m3/s"),
    ("total", 7, "output", {}, "m"),
    ("area", 8, "parameter", {"start": "2"}, "m2"),
    ("outlet", 9, "parameter", {"start": "1"}, ""),
    ("drift", 10, "parameter", {"start": "0"}, ""),
    ("loss", 11, "local", {}, ""),
]
OTHERS = {  # of FMI 2 and 3
    "schedules": ("Boolean", "Boolean", "false", 20), "pipes": ("Integer", "Int32", "1", 21),
    "label": ("String", "String", "plant", 22),
}


def description(fmi, directional, extra=""):
    real, found = {2: "Real", 3: "Float64"}[fmi], []
    places = {name: k + 1 if fmi == 2 else reference for k, (name, reference, *_) in enumerate(
        VARIABLES)}
    for name, reference, causality, given, unit in VARIABLES:
        given = dict(given)
        outer = f'name="{name}" valueReference="{reference}" causality="{causality}"'
        if causality == "parameter":
            outer += ' variability="fixed"'
        if "initial" in given:
            outer += f' initial="{given.pop("initial")}"'
        if "derivative" in given:
            given["derivative"] = places[given["derivative"]]
        if unit:
            given["unit"] = unit
        inner = " ".join(f'{key}="{value}"' for key, value in given.items())
        found.append(
            f"<ScalarVariable {outer}><Real {inner}/></ScalarVariable>" if fmi == 2
            else f"<{real} {outer} {inner}/>"
        )
    for name, (two, three, start, reference) in OTHERS.items():
        outer = f'name="{name}" valueReference="{reference}" causality="parameter" '
        outer += 'variability="fixed"'
        if fmi == 2:
            found.append(f'<ScalarVariable {outer}><{two} start="{start}"/></ScalarVariable>')
        elif three == "String":
            found.append(f'<String {outer}><Start value="{start}"/></String>')
        else:
            found.append(f'<{three} {outer} start="{start}"/>')
    if fmi == 3:
        found.append('<Float64 name="time" valueReference="30" causality="independent"/>')
    offers = "true" if directional else "false"
    if fmi == 2:
        head = 'fmiVersion="2.0" modelName="tanks" guid="tanks" numberOfEventIndicators="0"'
        structure = "".join(
            f"<{group}>" + "".join(f'<Unknown index="{places[name]}"/>' for name in names)
            + f"</{group}>" for group, names in (
                ("Outputs", OUTPUTS), ("Derivatives", ("der(upper)", "der(lower)")),
                ("InitialUnknowns", (*OUTPUTS, "der(upper)", "der(lower)")),
            )
        )
    else:
        head = 'fmiVersion="3.0" modelName="tanks" instantiationToken="tanks"'
        structure = "".join(
            f'<{group} valueReference="{places[name]}"/>' for group, names in (
                ("Output", OUTPUTS), ("ContinuousStateDerivative", ("der(upper)", "der(lower)")),
                ("InitialUnknown", (*OUTPUTS, "der(upper)", "der(lower)")),
            ) for name in names
        )
    listed = "".join(f'<Unit name="{one}"/>' for one in ("m", "m2", "m3/s"))
    plural = "s" if fmi == 3 else ""
    return (
        f'<fmiModelDescription {head}><ModelExchange modelIdentifier="tanks" '
        f'providesDirectionalDerivative{plural}="{offers}"/>'
        f"<UnitDefinitions>{listed}</UnitDefinitions>"
        f"<ModelVariables>{''.join(found)}{extra}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def platform(fmi):
    return fmpy.platform if fmi == 2 else fmpy.platform_tuple


def fmu(fmi=2, directional=True, nominal=1, changes=(), name=None, extra="", others=()):
    """The path of an FMU; ``changes`` replaces texts of its description."""
    text = description(fmi, directional, extra)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    place = Path(tempfile.mkdtemp(dir=folder())) / "tanks.fmu"
    with ZipFile(place, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        binary = name or f"binaries/{platform(fmi)}/tanks{fmpy.sharedLibraryExtension}"
        archive.writestr(binary, library(fmi, nominal))
        for one in others:
            archive.writestr(one, "")
    return place


def rate(x, u, area=2.0, outlet=1.0):
    upper, lower = outlet * np.sqrt(x[0]), outlet * np.sqrt(x[1])
    return np.stack([(u[0] - upper) / area, (upper - lower - u[1]) / area])


def output(x, u, outlet=1.0):
    return np.stack([outlet * np.sqrt(x[1]), x[0] + x[1] + 0.1 * u[0]])


def twin(**options):
    """The same model in NumPy."""
    return qpmhe.System.from_ode(rate, output, n=2, p=2, m=2, **options)


def points(count=6):
    generator = np.random.default_rng(3)
    return generator.uniform(0.3, 2.0, (count, 2)), generator.uniform(0.0, 1.0, (count, 2))
