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

# Other tests import modules of the name "model".
MODEL = """
    from pathlib import Path
    import numpy as np
    import qpmhe

    def make(k=0.5):
        system = qpmhe.System(
            lambda x, u: np.stack(
                (x[..., 0] + 0.1 * x[..., 1], 0.9 * x[..., 1] + k * u[..., 0]), axis=-1),
            lambda x: x[..., :1], n=2, p=1, m=1)
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100 * np.eye(2), noise=[[1.0]])
        settings = {"horizon": 4, "initial_state": [0.0, 0.0], "dt": 0.5}
        return system, qpmhe.Luenberger([[0.3], [0.3]]), cost, settings

    def weighted():
        weights = qpmhe.tuning.load(Path(__file__).with_name("weights.toml"))
        return make()[0], weights.observer(), weights.cost(), make()[3] | {"horizon": 3}
"""
TUNE = ("tune", "tuned_plant.py:make", "record.csv")
SHORT = ("tune", "tuned_plant.py:make", "short.csv")
ESTIMATE = ("estimate", "tuned_plant.py:make", "record.csv", "--out", "estimates.csv")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tuned_plant.py").write_text(textwrap.dedent(MODEL))
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
    (tmp_path / "short.csv").write_text("\n".join(rows[:15]))
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
    assert isinstance(found.observer(qpmhe.UnscentedKalman), qpmhe.UnscentedKalman)
    with pytest.raises(WeightsError, match="cannot write"):
        made.save(tmp_path / "none" / "weights.toml")
    with pytest.raises(WeightsError, match="qpmhe tune"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize(("text", "words"), [
    ("nonsense", "is no TOML file"),
    ("format = 2\nCOVARIANCES", "its format is not 1"),
    ("format = 1\n[covariances]\nprior = [[1]]\ndisturbance = [[1]]", "'noise' is missing"),
    ("format = 1\nhorizon = 2.5\nCOVARIANCES", r"horizon is 2\.5; expected an integer"),
    ("format = 1\nobserver_name = 'nkf'\nCOVARIANCES", "observer 'nkf' is not known"),
    ("format = 1\nmax_qps = -1\nCOVARIANCES", "max_qps is -1"),
    ("format = 1\nhorison = 3\nCOVARIANCES", "it has 'horison', which weights do not have"),
])  # fmt: skip
def test_a_file_without_weights_is_refused_by_name(tmp_path, text, words):
    path = tmp_path / "weights.toml"
    covariances = "[covariances]\nprior = [[1]]\ndisturbance = [[1]]\nnoise = [[1]]\n"
    path.write_text(text.replace("COVARIANCES", covariances))
    with pytest.raises(WeightsError, match=rf"weights\.toml .*{words}.*; save"):
        load(path)


@pytest.mark.slow
def test_tune_then_estimate(folder):
    shown = call(
        *TUNE, "--objective", "likelihood", "--parameter", "k=0.6", "--picture", "weights.png",
        "--horizons", "2,4",
    )
    assert "noise y1" in shown
    assert "N = 2" in shown
    weights = load("weights.toml")
    assert weights.parameters["k"] == pytest.approx(0.8, abs=0.1)
    assert weights.horizon == 4
    assert (folder / "weights.png").exists()
    assert not (folder / "weights.toml.search").exists()
    call(*ESTIMATE, "--weights", "weights.toml", "--no-step-time")
    found = np.genfromtxt("estimates.csv", delimiter=",", names=True, usecols=(0, 1, 2))
    truth = np.genfromtxt("record.csv", delimiter=",", names=True)["position"]
    assert np.sqrt(np.mean((found["filtered_x1"] - truth)[50:] ** 2)) < 0.15
    with pytest.raises(OptionError, match="--overwrite"):
        call(*TUNE)
    # The model may read them itself.
    Weights(4.0 * np.eye(2), np.eye(2), np.eye(1), 3).save("weights.toml")
    call("estimate", "tuned_plant.py:weighted", "record.csv", "--out", "others.csv")


@pytest.mark.slow
def test_truth_several_records_and_a_new_folder(folder):
    (folder / "again.csv.gz").write_bytes(gzip.compress((folder / "record.csv").read_bytes()))
    shown = call(
        *TUNE, "again.csv.gz", "--truth", "x1=position", "--structure", "scalar", "--prior",
        "--out", "new/two.toml",
    )
    assert "error of x1" in shown
    assert "prior level" in shown
    assert [one.name for one in (folder / "new").iterdir()] == ["two.toml"]


def test_the_best_observer_goes_into_the_file_and_from_there_to_estimate(folder):
    shown = call(*TUNE, "--observers", "steady(at=[0,0],u=[0]), ukf", "--objective", "likelihood",
                 "--structure", "scalar")
    assert "MHE, 2 QPs on ukf" in shown
    weights = load("weights.toml")
    assert weights.observer_name in ("steady(at=[0, 0], u=[0])", "ukf")
    assert weights.max_qps == 0
    call(*ESTIMATE, "--weights", "weights.toml")
    found = np.genfromtxt("estimates.csv", delimiter=",", names=True, dtype=None, encoding=None)
    assert set(found["qps"]) == {0}
    call(*ESTIMATE, "--weights", "weights.toml", "--max-qps", "1", "--overwrite")
    found = np.genfromtxt("estimates.csv", delimiter=",", names=True, dtype=None, encoding=None)
    assert 1 in found["qps"]


def test_a_function_makes_the_observer_for_the_same_problem_in_tune_and_from_the_file(tmp_path):
    seen, system = tmp_path / "seen.txt", qpmhe.models.van_der_pol()[0]
    (tmp_path / "own.py").write_text(textwrap.dedent(f"""
        import qpmhe

        def own(problem):
            with open({str(seen)!r}, "a") as file:
                file.write(f"{{problem.initial_state.tolist()}}\\n")
            return qpmhe.ExtendedKalman(**problem.covariances)
    """), "utf-8")
    record = qpmhe.models.van_der_pol().scenario.simulate(seed=0, steps=120)
    tuning = qpmhe.tune(
        system, [record.measurements], prior=np.eye(2), disturbance=0.01 * np.eye(2),
        noise=[[0.04]], initial_state=[0.5, -0.5], objective="likelihood", structure="scalar",
        observers=[f"{tmp_path / 'own.py'}:own"], max_qps=0, starts=1, progress=False)
    tuning.save(tmp_path / "weights.toml")
    made = len(seen.read_text("utf-8").splitlines())
    load(tmp_path / "weights.toml").observer(system=system)
    problems = seen.read_text("utf-8").splitlines()
    assert 2 <= made < len(problems)
    assert set(problems) == {"[0.0, 0.0]"}


@pytest.mark.parametrize(("arguments", "error", "text"), [
    ([*TUNE, "--observers", "ukff"], ModelError, "observer 'ukff' is not known.*Did you mean ukf"),
    ([*TUNE, "--observers", ","], OptionError, "--observers is empty"),
    ([*TUNE, "--truth", "x3=position"], OptionError, "--truth has 'x3=position'.* of x1, x2"),
    ([*TUNE, "--truth", "x1=WRONG"], RecordError, "with --truth x1=COLUMN, or leave it out: then"),
    ([*TUNE, "--held-out", "0.9"], OptionError, r"--held-out is 0\.9"),
    ([*TUNE, "--parameter", "k=0"], InvalidInputError, "--parameter k starts at 0"),
    ([*TUNE, "--parameter", "q=1"], ModelError, "cannot be made"),
    ([*TUNE, "--horizons", "2;3"], OptionError, "--horizons"),
    (SHORT, InvalidInputError, "or give --held-out 0: then nothing"),
    ([*SHORT, "--held-out", "0"], InvalidInputError, "take --structure scalar or groups"),
    ([*TUNE, "--out", "other.toml"], TuningCheckpointError, "no checkpoint .*; remove it"),
    ([*ESTIMATE, "--weights", "large.toml"], WeightsError,
     r"^large\.toml .*3 states, 3 disturb.* and model .* has 2, 2 and 1.* qpmhe tune tuned_plant"),
    ([*ESTIMATE, "--weights", "heavy.toml"], WeightsError, r"^heavy\.toml .* parameters mass, .*"),
])  # fmt: skip
def test_wrong_options_and_files_are_named(folder, arguments, error, text):
    Weights(np.eye(3), np.eye(3), np.eye(1)).save("large.toml")
    Weights(np.eye(2), np.eye(2), np.eye(1), parameters={"mass": 2.0}).save("heavy.toml")
    (folder / "other.toml.search").write_text('{"format": 7, "identity": "", "searches": {}}')
    with pytest.raises(error, match=text):
        call(*arguments)
