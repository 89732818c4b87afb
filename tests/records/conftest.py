from pathlib import Path

import pytest

CONTINUOUS = f"{Path(__file__).with_name('oscillator.py')}:continuous"
DISCRETE = f"{Path(__file__).with_name('oscillator.py')}:discrete"
FUSED = f"{Path(__file__).with_name('oscillator.py')}:fused"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder to work in, and to name files in error texts without it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
