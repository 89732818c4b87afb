"""What several places state they state alike: versions, lowest versions, the citation."""

import re
import tarfile
import tomllib
import zipfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

import qpmhe
from tests import check_dist

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
# Tools, which are taken as new as they come.
TOOLS = {"test", "docs", "dev"}


def test_minimal_versions_are_those_promised():
    extras = PROJECT["project"]["optional-dependencies"]
    lines = [*PROJECT["project"]["dependencies"]]
    lines += [line for name, more in extras.items() if name not in TOOLS for line in more]
    promised = {}
    for requirement in map(Requirement, lines):
        if requirement.name != "qpmhe":
            (bound,) = [part for part in requirement.specifier if part.operator == ">="]
            promised[requirement.name.lower()] = Version(bound.version)
    lines = (ROOT / "tests" / "minimal-versions.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    assert {pin.name: Version(str(pin.specifier).removeprefix("==")) for pin in pins} == promised


def test_citation_and_changelog_are_of_this_version():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert check_dist.version() == qpmhe.__version__
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", citation, flags=re.MULTILINE) == [qpmhe.__version__]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+)", changelog, flags=re.MULTILINE)[0] == qpmhe.__version__


def test_what_a_wheel_or_an_sdist_lacks_or_has_too_much_is_found(tmp_path):
    version = check_dist.version()
    info, files = f"qpmhe-{version}.dist-info", check_dist.files_of(check_dist.PACKAGES)
    for names, complaints in (
        (files, []),
        (files - {"qpmhe/py.typed"} | {"tests/test_docs.py"},
         ["is missing: qpmhe/py.typed", "does not belong: tests/test_docs.py"]),
    ):
        path = tmp_path / f"qpmhe-{version}-py3-none-any.whl"
        with zipfile.ZipFile(path, "w") as wheel:
            for name in names:
                wheel.writestr(name, "")
            wheel.writestr(f"{info}/METADATA", f"Name: qpmhe\nVersion: {version}\n")
            commands = "[console_scripts]\nqpmhe = qpmhe.cli:main\n"
            wheel.writestr(f"{info}/entry_points.txt", commands)
            wheel.writestr(f"{info}/licenses/LICENSE", "")
        assert check_dist.complaints_of_wheel(path, version) == complaints
    path, data = tmp_path / "sdist.tar.gz", tmp_path / "cell.mat"
    data.write_bytes(b"0")
    with tarfile.open(path, "w:gz") as sdist:
        sdist.add(data, f"qpmhe-{version}/examples/cell.mat")
    found = check_dist.complaints_of_sdist(path, version)
    assert "does not belong: examples/cell.mat" in found
    assert "is missing: README.md" in found
