import pytest


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder to work in, and to name files in error texts without it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
