"""What is told in several places is told alike: versions, lowest versions, the citation."""

import re
import tarfile
import tomllib
import zipfile
from pathlib import Path

import check_dist
import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import qpmhe

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
# Tools, which are taken as new as they come.
TOOLS = {"test", "docs", "dev"}


def promised():
    """Lowest version of each package that a user may install."""
    extras = PROJECT["project"]["optional-dependencies"]
    lines = [*PROJECT["project"]["dependencies"]]
    lines += [line for name, more in extras.items() if name not in TOOLS for line in more]
    lowest = {}
    for requirement in map(Requirement, lines):
        if requirement.name != "qpmhe":
            (bound,) = [part for part in requirement.specifier if part.operator == ">="]
            lowest[requirement.name.lower()] = Version(bound.version)
    return lowest


def test_minimal_versions_are_those_promised():
    lines = (ROOT / "tests" / "minimal-versions.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    held = {pin.name: Version(str(pin.specifier).removeprefix("==")) for pin in pins}
    assert held == promised()


def test_the_version_is_told_once():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert "version" not in PROJECT["project"]
    assert check_dist.version() == qpmhe.__version__


def test_citation_and_changelog_are_of_this_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", citation, flags=re.MULTILINE) == [qpmhe.__version__]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+)", changelog, flags=re.MULTILINE)[0] == qpmhe.__version__


@pytest.fixture
def made(tmp_path):
    """A wheel as it should be."""
    version = check_dist.version()
    path = tmp_path / f"qpmhe-{version}-py3-none-any.whl"
    info = f"qpmhe-{version}.dist-info"
    with zipfile.ZipFile(path, "w") as wheel:
        for name in check_dist.files_of(check_dist.PACKAGES):
            wheel.writestr(name, "")
        wheel.writestr(f"{info}/METADATA", f"Name: qpmhe\nVersion: {version}\n")
        wheel.writestr(f"{info}/entry_points.txt", "[console_scripts]\nqpmhe = qpmhe.cli:main\n")
        wheel.writestr(f"{info}/licenses/LICENSE", "")
    return path


def test_a_good_wheel_is_good(made):
    assert check_dist.complaints_of_wheel(made, check_dist.version()) == []


def test_what_a_wheel_lacks_or_has_too_much_is_told(made, tmp_path):
    other = tmp_path / made.name.replace("py3", "py4")
    with zipfile.ZipFile(made) as good, zipfile.ZipFile(other, "w") as bad:
        for name in good.namelist():
            if name != "qpmhe/py.typed":
                bad.writestr(name, good.read(name))
        bad.writestr("tests/test_docs.py", "")
    assert check_dist.complaints_of_wheel(other, check_dist.version()) == [
        "is missing: qpmhe/py.typed", "does not belong: tests/test_docs.py",
    ]


def test_what_an_sdist_has_too_much_is_told(tmp_path):
    path, data = tmp_path / "sdist.tar.gz", tmp_path / "cell.mat"
    data.write_bytes(b"0")
    with tarfile.open(path, "w:gz") as sdist:
        sdist.add(data, f"qpmhe-{check_dist.version()}/examples/cell.mat")
    found = check_dist.complaints_of_sdist(path, check_dist.version())
    assert "does not belong: examples/cell.mat" in found
    assert "is missing: README.md" in found
