"""No room takes private names of another; `make lint` holds which room may import which."""

import ast
import re
from pathlib import Path

import pytest

import qpmhe
import qpmhe_solvers

ROOTS = [Path(package.__file__).parent for package in (qpmhe, qpmhe_solvers)]
# A private part of a dotted name, other than the modules that all rooms share.
PRIVATE = re.compile(r"^(?!qpmhe\._(checks|linalg|version)\b).*\._(?!_)")


def private_names(file, text):
    """What a file takes of other rooms although it is private there."""
    room = file.parts[:1] if file.parts[0] == "qpmhe_solvers" else file.parts[:2]
    nodes, names = list(ast.walk(ast.parse(text))), {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            base = file.parts[: len(file.parts) - node.level] if node.level else ()
            for alias in node.names:
                whole = (*base, *(node.module or "").split("."), alias.name)
                whole = tuple(part for part in whole if part)
                if whole[0] in ("qpmhe", "qpmhe_solvers") and whole[: len(room)] != room:
                    names[alias.asname or alias.name] = ".".join(whole)
    taken = set(names.values()) | {
        f"{names[node.value.id]}.{node.attr}" for node in nodes
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", None) in names
    }
    return sorted(filter(PRIVATE.match, taken))


@pytest.mark.parametrize("root", ROOTS, ids=lambda root: root.name)
def test_no_room_takes_private_names_of_another(root):
    found = {
        (file := path.relative_to(root.parent)): private_names(file, path.read_text("utf-8"))
        for path in root.rglob("*.py")
    }
    assert len(found) > 20
    assert {str(file): names for file, names in found.items() if names} == {}


@pytest.mark.parametrize(("file", "text", "found"), [
    ("qpmhe/plots/a.py", "from ..model.sets import _norm", ["qpmhe.model.sets._norm"]),
    ("qpmhe/plots/a.py", "from ..model import sets as s\ns._norm()", ["qpmhe.model.sets._norm"]),
    ("qpmhe/plots/a.py", "def f():\n    from qpmhe.model._a import b", ["qpmhe.model._a.b"]),
    ("qpmhe/plots/a.py", "from qpmhe_solvers.qp import _a", ["qpmhe_solvers.qp._a"]),
    ("qpmhe/plots/a.py", "from .._checks import count\nfrom .b import _c\nimport os", []),
    ("qpmhe_solvers/native/a.py", "from ..qp import _a", []),
])  # fmt: skip
def test_the_check_sees_them(file, text, found):
    assert private_names(Path(file), text) == found


def test_the_walk_names_files_that_exist():
    text = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text("utf-8")
    walk = text.partition("## From a measurement")[2].partition("\n## ")[0]
    named = set(re.findall(r"`(\w+\.py)`", walk))
    assert len(named) > 8
    assert named <= {path.name for path in (ROOTS[0] / "estimation").iterdir()}
