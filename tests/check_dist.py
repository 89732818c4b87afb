"""What a wheel and an sdist must hold, and what not: ``python tests/check_dist.py dist``."""

from __future__ import annotations

import re
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = {"qpmhe": ROOT / "qpmhe", "qpmhe_solvers": ROOT / "solvers" / "qpmhe_solvers"}
WRONG = re.compile(
    r"(^|/)(\.venv|\.mypy_cache|\.pytest_cache|\.ruff_cache|\.hypothesis|__pycache__|results|dist|site)/"
    r"|\.(pyc|so|mat|sqlite|parquet|log)$"
)
LARGEST, LARGEST_FILE = 8_000_000, 400_000  # bytes


def files_of(packages: dict[str, Path]) -> set[str]:
    """Names in a wheel of all that a clone has in the packages."""
    return {
        f"{name}/{path.relative_to(folder).as_posix()}"
        for name, folder in packages.items() for path in folder.rglob("*")
        if path.is_file() and not WRONG.search(path.relative_to(ROOT).as_posix())
    }


def complaints_of_wheel(path: Path, version: str) -> list[str]:
    """What is wrong with a wheel."""
    with zipfile.ZipFile(path) as wheel:
        names = set(wheel.namelist())
        info = f"qpmhe-{version}.dist-info"
        metadata = Parser().parsestr(wheel.read(f"{info}/METADATA").decode())
        commands = wheel.read(f"{info}/entry_points.txt").decode()
    inside = {name for name in names if not name.startswith(f"{info}/")}
    wanted = files_of(PACKAGES)
    found = [f"is missing: {name}" for name in sorted(wanted - inside)]
    found += [f"does not belong: {name}" for name in sorted(inside - wanted)]
    if f"{info}/licenses/LICENSE" not in names:
        found.append("has no licence")
    if metadata["Version"] != version:
        found.append(f"says version {metadata['Version']}")
    if "qpmhe = qpmhe.cli:main" not in commands:
        found.append("has no command qpmhe")
    return found


def complaints_of_sdist(path: Path, version: str) -> list[str]:
    """What is wrong with an sdist."""
    top = f"qpmhe-{version}/"
    with tarfile.open(path) as sdist:
        sizes = {
            member.name.removeprefix(top): member.size for member in sdist.getmembers()
            if member.isfile()
        }
    found = [f"does not belong: {name}" for name in sorted(sizes) if WRONG.search(name)]
    found += [f"is large: {name}" for name, size in sizes.items() if size > LARGEST_FILE]
    for wanted in (
        "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile",
        "mkdocs.yml", "docs/index.md", "examples/quickstart.py", "tests/smoke.py",
        "qpmhe/py.typed", "solvers/qpmhe_solvers/py.typed",
    ):
        if wanted not in sizes:
            found.append(f"is missing: {wanted}")
    if path.stat().st_size > LARGEST:
        found.append(f"has {path.stat().st_size} bytes; at most {LARGEST} are wanted")
    return found


def version() -> str:
    """The one in the source, which all others are made of."""
    source = (ROOT / "qpmhe" / "_version.py").read_text(encoding="utf-8")
    (found,) = re.findall(r'^__version__ = "(.+)"$', source, flags=re.MULTILINE)
    return str(found)


def main(folder: Path) -> int:
    """Check the one wheel and the one sdist of a folder; the number of complaints."""
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    found = [f"{wheel.name} {what}" for what in complaints_of_wheel(wheel, version())]
    found += [f"{sdist.name} {what}" for what in complaints_of_sdist(sdist, version())]
    print("\n".join(found) or f"{wheel.name} and {sdist.name} hold what they should")
    return len(found)


if __name__ == "__main__":
    sys.exit(min(1, main(Path(sys.argv[1]))))
