"""Weights in a TOML file, and the commands that write and read it."""

import gzip
import textwrap

import numpy as np
import pytest
from typer.testing import CliRunner

import qpmhe
from qpmhe.cli.app import app
from qpmhe.errors import InvalidInputError, ModelError, OptionError
from qpmhe.records import RecordError
from qpmhe.tuning import TuningCheckpointError, Weights, WeightsError, load

MODEL = """
    import numpy as np
    import qpmhe

    def f(x, u):
        return np.stack((x[..., 0] + 0.1 * x[..., 1], 0.9 * x[..., 1] + gain * u[..., 0]), axis=-1)

    gain = 1.0

    def make(k=0.5):
        system = qpmhe.System(
            lambda x, u: np.stack(
                (x[..., 0] + 0.1 * x[..., 1], 0.9 * x[..., 1] + k * u[..., 0]), axis=-1),
            lambda x: x[..., :1], n=2, p=1, m=1)
        return (
            system, qpmhe.Luenberger([[0.3], [0.3]]),
            qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100 * np.eye(2), noise=[[1.0]]),
            {"horizon": 4, "initial_state": [0.0, 0.0], "dt": 0.5},
        )
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.py").write_text(textwrap.dedent(MODEL))
    generator = np.random.default_rng(0)
    x, rows = np.zeros(2), ["time,y1,u1,position"]
    for t in range(250):
        u = np.sign(np.sin(t / 9.0))
        y = x[0] + 0.2 * generator.standard_normal()
        if t != 40:
            rows.append(f"{0.5 * t},{'' if t == 60 else y},{u},{x[0]}")
        x = np.array([x[0] + 0.1 * x[1], 0.9 * x[1] + 0.8 * u])
        x += 0.05 * generator.standard_normal(2)
    (tmp_path / "record.csv").write_text("\n".join(rows) + "\n")
    return tmp_path


def call(*arguments):
    found = CliRunner().invoke(app, list(map(str, arguments)))
    if found.exception is not None and not isinstance(found.exception, SystemExit):
        raise found.exception
    assert found.exit_code == 0, found.output
    return found.output


def test_what_is_saved_is_loaded(tmp_path):
    path = tmp_path / "weights.toml"
    made = Weights(
        np.diag([1.0, 1e-30]), np.array([[1 / 3, 0.1], [0.1, 2.0]]), np.array([[1e20]]), 7, 0.99,
        2.5, "constant", {"mass": 0.1 + 0.2},
    )
    made.save(path, "two\nlines")
    found = load(path)
    for kind in ("prior", "disturbance", "noise"):
        np.testing.assert_array_equal(getattr(found, kind), getattr(made, kind))
    for name in ("horizon", "discount", "threshold", "arrival", "parameters"):
        assert getattr(found, name) == getattr(made, name)
    assert isinstance(found.cost(), qpmhe.RobustCost)
    assert isinstance(found.observer(), qpmhe.ExtendedKalman)
    assert isinstance(found.observer(qpmhe.UnscentedKalman), qpmhe.UnscentedKalman)


@pytest.mark.parametrize("text", [
    "", "nonsense", "format = 1\n", "format = 2\n[covariances]\nprior = [[1]]\n",
    "format = 1\n[covariances]\nprior = [[1]]\ndisturbance = [[1]]\nnoise = [[-1]]\n",
    "format = 1\nhorison = 3\n[covariances]\nprior = [[1]]\ndisturbance = [[1]]\nnoise = [[1]]\n",
])  # fmt: skip
def test_a_file_without_weights_is_refused(tmp_path, text):
    path = tmp_path / "weights.toml"
    path.write_text(text)
    with pytest.raises(WeightsError, match="save"):
        load(path)


@pytest.mark.parametrize(("line", "text"), [
    ('arrival = "smoothed"', "arrival is 'smoothed'; expected one of 'observer'"),
    ("horizon = 0", "horizon is 0; expected an integer"),
    ("horizon = 2.5", r"horizon is 2\.5; expected an integer"),
    ("discount = 3", "discount is 3; expected a number"),
    ("horison = 3", r"it has 'horison', which weights do not have\)"),
    ("threshold = -1", "threshold"),
])  # fmt: skip
def test_a_field_that_is_wrong_is_named_with_the_file(tmp_path, line, text):
    path = tmp_path / "weights.toml"
    path.write_text(
        f"format = 1\n{line}\n[covariances]\nprior = [[1]]\ndisturbance = [[1]]\nnoise = [[1]]\n"
    )
    with pytest.raises(WeightsError, match=rf"weights\.toml holds no weights .*{text}"):
        load(path)
    path.write_text("format = 1\n[covariances]\nprior = [[1]]\ndisturbance = [[1]]\n")
    with pytest.raises(WeightsError, match="'noise' is missing"):
        load(path)


def test_the_folder_of_the_weights_is_made(folder):
    call(
        "tune", "model.py:make", "record.csv", "--objective", "likelihood", "--structure", "scalar",
        "--out", "new/weights.toml",
    )
    assert [one.name for one in (folder / "new").iterdir()] == ["weights.toml"]


def test_a_missing_file_and_a_missing_folder(tmp_path):
    with pytest.raises(WeightsError, match="qpmhe tune"):
        load(tmp_path / "none.toml")
    weights = Weights(np.eye(1), np.eye(1), np.eye(1))
    with pytest.raises(WeightsError, match="cannot write"):
        weights.save(tmp_path / "none" / "weights.toml")


def test_tune_then_estimate(folder):
    shown = call(
        "tune", "model.py:make", "record.csv", "--objective", "likelihood", "--parameter", "k=0.6",
        "--picture", "weights.png", "--horizons", "2,4",
    )
    assert "noise y1" in shown
    assert "N = 2" in shown
    weights = load("weights.toml")
    assert weights.parameters["k"] == pytest.approx(0.8, abs=0.1)
    assert weights.horizon == 4
    assert (folder / "weights.png").exists()
    assert not (folder / "weights.toml.search").exists()
    call(
        "estimate", "model.py:make", "record.csv", "--weights", "weights.toml", "--out",
        "estimates.csv", "--no-step-time",
    )
    found = np.genfromtxt("estimates.csv", delimiter=",", names=True, usecols=(0, 1, 2))
    truth = np.genfromtxt("record.csv", delimiter=",", names=True)["position"]
    assert np.sqrt(np.mean((found["filtered_x1"] - truth)[50:] ** 2)) < 0.15
    with pytest.raises(OptionError, match="--overwrite"):
        call("tune", "model.py:make", "record.csv")


def test_truth_and_several_records(folder):
    text = (folder / "record.csv").read_text()
    with gzip.open(folder / "again.csv.gz", "wt") as file:
        file.write(text)
    shown = call(
        "tune", "model.py:make", "record.csv", "again.csv.gz", "--truth", "x1=position",
        "--structure", "scalar", "--prior", "--out", "two.toml",
    )
    assert "error of x1" in shown
    assert "prior level" in shown


@pytest.mark.parametrize(("arguments", "error", "text"), [
    (["--truth", "position"], OptionError, "--truth has 'position'.* a name of x1, x2"),
    (["--truth", "x3=position"], OptionError, "--truth has 'x3=position'.* a name of x1, x2"),
    (["--truth", "x1=WRONG"], RecordError,
     r"name it with --truth x1=COLUMN, or leave it out: then"),
    (["--truth", "x1="], OptionError, "--truth leaves all true states out"),
    (["--held-out", "0.9"], OptionError, r"--held-out is 0\.9"),
    (["--parameter", "k=0"], InvalidInputError, "--parameter k starts at 0"),
    (["--parameter", "k"], OptionError, "NAME=START"),
    (["--horizons", "2;3"], OptionError, "--horizons"),
    (["--parameter", "q=1"], ModelError, "cannot be made"),
])  # fmt: skip
def test_wrong_options(folder, arguments, error, text):
    with pytest.raises(error, match=text):
        call("tune", "model.py:make", "record.csv", *arguments)


def test_messages_name_the_file_and_the_option(folder):
    lines = (folder / "record.csv").read_text().splitlines()
    (folder / "short.csv").write_text("\n".join(lines[:15]))
    with pytest.raises(InvalidInputError, match=r"or give --held-out 0: then nothing"):
        call("tune", "model.py:make", "short.csv")
    with pytest.raises(InvalidInputError, match="take --structure scalar or groups"):
        call("tune", "model.py:make", "short.csv", "--held-out", "0")
    (folder / "blank.csv").write_text("time,y1,u1\n0,,1\n0.5,,1\n1,,1\n")
    with pytest.raises(InvalidInputError, match=r"all measurements of blank\.csv are missing"):
        call("tune", "model.py:make", "blank.csv")


@pytest.mark.parametrize(("size", "parameters", "text"), [
    (3, {}, "3 states, 3 disturbances and 1 outputs, and model 'model.py:make' has 2, 2 and 1"),
    (2, {"mass": 2.0}, "holds the parameters mass, .*mass"),
])  # fmt: skip
def test_weights_of_another_model_are_named(folder, size, parameters, text):
    Weights(np.eye(size), np.eye(size), np.eye(1), parameters=parameters).save("other.toml")
    with pytest.raises(WeightsError, match=rf"^other\.toml .*{text}.* qpmhe tune model"):
        call("estimate", "model.py:make", "record.csv", "--weights", "other.toml", "--out", "x.csv")


def test_a_file_in_the_place_of_the_checkpoint(folder):
    for text in ("{", "[]", "{}", '{"format": 7, "identity": "", "searches": {}}'):
        (folder / "weights.toml.search").write_text(text)
        with pytest.raises(TuningCheckpointError, match=r"search is no checkpoint .*; remove it"):
            call("tune", "model.py:make", "record.csv", "--objective", "likelihood")


def test_make_may_read_the_weights(folder):
    Weights(4.0 * np.eye(2), np.eye(2), np.eye(1), 3).save("weights.toml")
    # Other tests import modules of the name "model".
    (folder / "plant_with_weights.py").write_text((folder / "model.py").read_text())
    (folder / "own.py").write_text(textwrap.dedent("""
        from pathlib import Path
        import qpmhe
        from plant_with_weights import make as model

        def make():
            weights = qpmhe.tuning.load(Path(__file__).with_name("weights.toml"))
            return model()[0], weights.observer(), weights.cost(), {
                "horizon": weights.horizon, "initial_state": [0.0, 0.0], "dt": 0.5}
    """))
    call("estimate", "own.py:make", "record.csv", "--out", "estimates.csv")
