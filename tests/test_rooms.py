"""No room takes private names of another; `make lint` holds which room may import which."""

import ast
import re
from pathlib import Path

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


def test_no_room_takes_private_names_of_another():
    for root in ROOTS:
        found = {
            (file := path.relative_to(root.parent)): private_names(file, path.read_text("utf-8"))
            for path in root.rglob("*.py")
        }
        assert len(found) > 20
        assert {str(file): names for file, names in found.items() if names} == {}
    text = "from ..model import sets as s\ns._norm()\nfrom .b import _c"  # the check sees them
    assert private_names(Path("qpmhe/plots/a.py"), text) == ["qpmhe.model.sets._norm"]


def test_the_walk_names_files_that_exist():
    text = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text("utf-8")
    walk = text.partition("## From a measurement")[2].partition("\n## ")[0]
    named = set(re.findall(r"`(\w+\.py)`", walk))
    assert len(named) > 8
    assert named <= {path.name for path in (ROOTS[0] / "estimation").iterdir()}
