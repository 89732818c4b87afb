"""The folder of examples on the path, as its programs have it."""

import sys
from pathlib import Path

import pytest

EXAMPLES = str(Path(__file__).parents[2] / "examples")


@pytest.fixture(scope="session")
def gallery():
    for package in ("matplotlib", "pandas", "rich"):
        pytest.importorskip(package)
    sys.path.insert(0, EXAMPLES)
    try:
        import gallery

        yield gallery
    finally:
        sys.path.remove(EXAMPLES)
