"""The page of examples shows every one, with a picture that is not too large."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS, EXAMPLES = ROOT / "docs", ROOT / "examples"
PAGE = (DOCS / "examples.md").read_text(encoding="utf-8")
SECTIONS = PAGE.split("\n## ")[1:]


def programs():
    top = [path.name for path in EXAMPLES.glob("*.py")]
    notebooks = [f"notebooks/{path.name}" for path in EXAMPLES.glob("notebooks/*.ipynb")]
    return sorted([*top, *notebooks, "battery_soc/study.py"])


@pytest.mark.parametrize("name", programs())
def test_every_example_is_shown(name):
    assert f"examples/{name}" in PAGE


@pytest.mark.parametrize("section", SECTIONS, ids=lambda text: text.partition("\n")[0])
def test_every_section_has_a_command_and_a_picture(section):
    commands = re.search(r"^```sh\n(.*?)^```$", section, flags=re.MULTILINE | re.DOTALL)[1]
    for program in re.findall(r"examples/([\w/.]+)", commands):
        assert (EXAMPLES / program).is_file(), program
    (picture,) = re.findall(r"^!\[.+\]\((img/[\w-]+\.png)\)$", section, flags=re.MULTILINE)
    assert (DOCS / picture).is_file()
    # Those of docs/img/gallery.py; others have pages of their own.
    if not picture.startswith(("img/battery", "img/benchmark")):
        assert (DOCS / picture).stat().st_size <= 150_000
