"""A model in a file: which files identify it."""

from pathlib import Path

import pytest

from qpmhe.models import loading


@pytest.fixture
def read(monkeypatch):
    """Names of the modules that are read for fingerprints."""
    names = set()

    class Watched(loading.ModuleFinder):
        def load_module(self, fqname, *rest):
            names.add(fqname)
            return super().load_module(fqname, *rest)

    monkeypatch.setattr(loading, "ModuleFinder", Watched)
    return names


def test_in_a_checkout_this_package_is_not_read_for_a_models_fingerprint(read, tmp_path):
    inside = loading.fingerprint(Path(__file__).parents[1] / "records" / "oscillator.py")
    assert "tests.records.oscillator" in read
    assert not any(name.startswith("qpmhe") for name in read)
    # Elsewhere it has the same one, as it imports no file of its folder.
    text = (Path(__file__).parents[1] / "records" / "oscillator.py").read_text()
    (tmp_path / "oscillator.py").write_text(text)
    assert loading.fingerprint(tmp_path / "oscillator.py") == inside


def test_files_of_a_models_folder_count_at_any_depth(read, tmp_path):
    for name, text in (
        ("model.py", "import beside, qpmhe"), ("beside.py", "from deeper import far"),
        ("far.py", ""),
    ):
        (tmp_path / name).write_text(text)
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "__init__.py").write_text("import far")
    first = loading.fingerprint(tmp_path / "model.py")
    assert read >= {"beside", "deeper", "far"}
    (tmp_path / "far.py").write_text("x = 1")
    assert loading.fingerprint(tmp_path / "model.py") != first


def test_a_model_of_the_package_counts_with_the_files_that_it_imports(read):
    loading.fingerprint(Path(loading.__file__).with_name("pendulum.py"))
    assert "qpmhe.models.example" in read
