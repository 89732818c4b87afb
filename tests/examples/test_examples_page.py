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
    return sorted([*top, *notebooks])


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
    if not picture.startswith("img/benchmark"):
        assert (DOCS / picture).stat().st_size <= 150_000


FOLDERS = sorted(path.parent.name for path in EXAMPLES.glob("gallery/*/__main__.py"))
PAGES = sorted(path.stem for path in DOCS.glob("gallery/*.md") if path.stem != "index")


@pytest.mark.parametrize("name", FOLDERS)
def test_make_gallery_runs_every_folder(name):
    assert f"-m examples.gallery.{name} " in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PAGES)
def test_every_page_of_the_gallery_has_its_command_and_its_line(name):
    assert name in FOLDERS
    text = (DOCS / "gallery" / f"{name}.md").read_text(encoding="utf-8")
    assert f"python -m examples.gallery.{name} " in text
    assert f"]({name}.md)" in (DOCS / "gallery" / "index.md").read_text(encoding="utf-8")
    for picture in re.findall(r"^!\[.+\]\((.+\.png)\)$", text, flags=re.MULTILINE):
        assert (DOCS / "gallery" / picture).stat().st_size <= 150_000
