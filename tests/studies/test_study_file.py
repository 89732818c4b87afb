import re

import pytest

from qpmhe.studies import Study, StudyError

GOOD = """\
# every option
models = [
  "batch_reactor",
  "chain_of_masses(masses=1)",
]
backends = ["daqp", "osqp"]
qps = [0, 2,
       "none"]
solver_iterations = [5, "none"]
horizons = ["default", 4]
starts = ["best"]
seeds = 3
steps = 20
measure = "time"
deadline = 0.01
covariances = true
cell_timeout = 5
"""


def written(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def test_a_file_is_the_same_study_as_in_python(tmp_path):
    assert Study.from_toml(written(tmp_path, GOOD)) == Study(
        models=["batch_reactor", "chain_of_masses(masses=1)"], backends=["daqp", "osqp"],
        qps=[0, 2, None], solver_iterations=[5, None], horizons=[None, 4], starts=["best"],
        seeds=3, steps=20, measure="time", deadline=0.01, covariances=True, cell_timeout=5.0,
    )


@pytest.mark.parametrize("text", ["", "# seeds = 3\n"])
def test_an_empty_file_is_refused(tmp_path, text):
    path = written(tmp_path, text)
    with pytest.raises(StudyError, match="is empty; name at least one of models, backends") as told:
        Study.from_toml(path)
    assert str(path) in str(told.value)


def test_what_is_left_out_has_its_default(tmp_path):
    assert Study.from_toml(written(tmp_path, "seeds = 20\n")) == Study()


def test_single_words_stand_for_lists(tmp_path):
    text = 'backends = "osqp"\nqps = "none"\nsolver_iterations = "none"\nseeds = 1\n'
    (cell,) = Study.from_toml(written(tmp_path, text)).cells()
    assert (cell.qps, cell.solver_iterations) == (None, None)


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text("from qpmhe.models import batch_reactor as make\n")
    path = written(tmp_path, 'models = ["mine.py:make"]\nbackends = ["banded"]\nseeds = 1\n')
    monkeypatch.chdir("/")
    assert {cell.model for cell in Study.from_toml(path).cells()} == {"mine.py:make"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seeds = 3", "sedes = 3", "unknown key 'sedes'; expected some of models, backends"),
        ("# every option", "[study]", "unknown key 'study'"),
        ('"batch_reactor"', '"batch_reactr"', "expected one of batch_reactor"),
        ("masses=1", "mases=1", "mases"),
        ('"batch_reactor"', '"missing.py:make"', "missing.py"),
        ('"osqp"', '"osq"', "backend 'osq' is not known; expected one of auto"),
        ('["daqp", "osqp"]', "[]", "backends is empty"),
        ('"none"', '"converged"', '\'converged\'; expected an integer >= 0. "none"'),
        ("[0, 2,", "[0, -2,", "qps is -2"),
        ('[5, "none"]', "[]", "solver_iterations is empty"),
        ("[5, ", "[5, 0, ", "solver_iterations is 0"),
        ('"default"', '"converged"', "horizons is 'converged'"),
        ('"best"', '"bets"', "starts is 'bets'"),
        ("seeds = 3", "seeds = 0", "seeds is 0"),
        ("steps = 20", "steps = 2.5", "steps is 2.5"),
        ('"time"', '"speed"', "measure is 'speed'"),
        ("deadline = 0.01", "deadline = -1", "deadline is -1"),
        ("true", '"yes"', "covariances is 'yes'"),
        ("cell_timeout = 5", "cell_timeout = 0", "cell_timeout is 0"),
        ("seeds = 3", "seeds 3", "no valid TOML"),
        ("cell_timeout = 5", "cell_timeout =", "no valid TOML"),
    ],
)
def test_what_does_not_fit_is_refused_with_file_and_line(tmp_path, old, new, words):
    text = GOOD.replace(old, new)
    path = written(tmp_path, text)
    with pytest.raises(StudyError, match=re.escape(words)) as caught:
        Study.from_toml(path)
    assert str(path) in str(caught.value)
    if "TOML" not in words:
        # Of a list over several lines, the line of its key.
        lines = GOOD.splitlines()
        wrong = next(i for i, line in enumerate(lines) if old in line)
        lines = text.splitlines()
        while not re.match(r"\w+ =|\[", lines[wrong]):
            wrong -= 1
        assert f", line {wrong + 1}:" in str(caught.value)


def test_a_file_that_cannot_be_read_is_told(tmp_path):
    with pytest.raises(StudyError, match="cannot read the study file"):
        Study.from_toml(tmp_path / "nothing.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StudyError, match="no text in UTF-8"):
        Study.from_toml(tmp_path / "binary.toml")
