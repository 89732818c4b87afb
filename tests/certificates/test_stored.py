"""A certificate belongs to content: in a file, to a monitor and along a run."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    CertificateError,
    Content,
    Evidence,
    MismatchError,
    Monitor,
    Sizes,
    certify,
    load,
    save,
)
from qpmhe.errors import OptionError

from .helpers import box, unit_cost

GAIN = qpmhe.Luenberger([[0.3], [0.1]])
REGION = qpmhe.Polytope([[1.0, 1.0]], [3.0]) & box([-2.0, -2.0], [2.0, 2.0])
SIZES = Sizes(box([-0.01, -0.02], [0.01, 0.03]), 0.05, "the data sheet")


def made(pull=0.1, scale=1.0, **options):
    """Two states, of which the first pulls at the second by a sine."""
    return qpmhe.System(
        lambda x: np.stack([0.8 * x[..., 0] + 0.1 * x[..., 1],
                            0.7 * x[..., 1] + pull * np.sin(x[..., 0])], axis=-1),
        lambda x: scale * x[..., :1], n=2, p=1, **options,
    )


@pytest.fixture(scope="module")
def bound():
    return certify(made(), GAIN, unit_cost(2), horizon=3, region=REGION, sizes=SIZES).observer_bound


@pytest.fixture
def file(bound, tmp_path):
    save(bound, tmp_path / "two.json")
    return tmp_path / "two.json"


@pytest.mark.slow
def test_what_is_loaded_is_what_was_stored_bit_by_bit(bound, file):
    found = load(file, made(), GAIN)
    assert found.evidence is Evidence.PROVED
    assert (found.headline, found.condition) == (bound.headline, bound.condition)
    assert found.content == bound.content
    assert found.to_dict() == bound.to_dict()
    for name in ("P", "W", "V", "Q", "R", "gain", "room"):
        mine, other = (getattr(each.stability, name) for each in (bound, found))
        assert (mine is None and other is None) or np.array_equal(mine, other), name
    mhe = qpmhe.MovingHorizonEstimator(
        made(), GAIN, unit_cost(2), horizon=3, initial_state=[0.0, 0.0])
    run = mhe.run(0.1 * np.ones((6, 1)))
    bands = [each.along(run, initial_error=0.2) for each in (bound, found)]
    for name in ("radius", "lower", "upper", "error"):
        np.testing.assert_array_equal(*(getattr(each, name) for each in bands))
    again = file.with_name("again.json")
    save(found, again)
    assert again.read_bytes() == file.read_bytes()


OTHERS = {
    "f differs": made(pull=0.1 + 1e-15), "h differs": made(scale=1.0 + 1e-15),
    "the set X differs": made(states=box([-2.0, -2.0], [2.0, 2.0])),
    "disturbance_matrix differs": made(disturbance_matrix=np.diag([1.0, 2.0])),
    "output_residual differs": made(output_residual=qpmhe.angles([0])),
    "f is": made(pull=0.2),
}


@pytest.mark.parametrize("words", OTHERS)
def test_another_content_is_refused_by_name(words, bound, file):
    other = OTHERS[words]
    with pytest.raises(MismatchError, match=f"two.json is for another system: {words}"):
        load(file, other, GAIN)
    mhe = qpmhe.MovingHorizonEstimator(
        other, GAIN, unit_cost(2), horizon=3, initial_state=[0.0, 0.0])
    with pytest.raises(MismatchError, match=f"another than was certified: {words}"):
        Monitor(bound, mhe, initial_error=0.1)
    with pytest.raises(MismatchError, match=f"another than was certified: {words}"):
        bound.along(mhe.run(np.zeros((3, 1))), initial_error=0.1)


def test_another_gain_is_refused(file):
    with pytest.raises(MismatchError, match=r"the gain \[\[0.3\], \[0.1\]\]; the estimator's is"):
        load(file, made(), qpmhe.Luenberger([[0.3], [0.2]]))


def test_files_that_were_changed_or_are_of_another_version_are_refused(file):
    text = file.read_text()
    stated = json.loads(text)
    stated["bound"]["stability"]["rho"] *= 0.5
    for content, words in (
        (json.dumps(stated), "was changed since it was written"),
        (text.replace('"version": 3', '"version": 2'), "has the version 2 .*expected 3.*again"),
        (text.replace("qpmhe certificate", "a recipe"), "is no certificate of an observer"),
        ("[1, 2]", "is no certificate of an observer"), ("{", "it is not JSON"),
        *((text.replace('"version": 3', f'"version": 3, "more": {number}'), "was changed since")
          for number in ("NaN", "1e999")),
    ):
        file.write_text(content)
        with pytest.raises(OptionError, match=words):
            load(file, made(), GAIN)
    with pytest.raises(OptionError, match="cannot read"):
        load(file.with_name("none.json"), made(), GAIN)


def test_what_no_content_belongs_to_is_not_stored(bound, tmp_path):
    by_hand = replace(bound, stability=replace(bound.stability, rho=0.5))
    with pytest.raises(CertificateError, match="stated or changed by hand"):
        save(by_hand, tmp_path / "no.json")

    def hidden(x):
        return np.array([0.5 * float(x[0])])

    system = qpmhe.System(hidden, lambda x: 1.0 * x, n=1, p=1)
    sampled = certify(
        system, qpmhe.Luenberger([[0.1]]), unit_cost(), horizon=2, region=box(-1.0, 1.0)
    ).observer_bound
    assert sampled.evidence is Evidence.SAMPLED
    assert sampled.content.opaque == ("f",)
    with pytest.raises(CertificateError, match="f has no expression"):
        save(sampled, tmp_path / "no.json")
    assert not list(tmp_path.iterdir())
    twin = qpmhe.System(hidden, lambda x: 1.0 * x, n=1, p=1)
    mhe = qpmhe.MovingHorizonEstimator(
        twin, qpmhe.Luenberger([[0.1]]), unit_cost(), horizon=2, initial_state=[0.0])
    with pytest.raises(MismatchError, match=r"f differs \(there is no expression of f"):
        Monitor(sampled, mhe, initial_error=0.1)


def test_the_content_counts_and_not_the_objects(bound):
    """Also what is named, or written, in another way that computes the same."""
    def f(state):
        first, second = state[..., 0], state[..., 1]
        return np.stack((0.8 * first + 0.1 * second, 0.7 * second + 0.1 * np.sin(first)), -1)

    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, lambda x: 1.0 * x[..., :1], n=2, p=1), qpmhe.Luenberger(GAIN.gain),
        unit_cost(2), horizon=3, initial_state=[0.0, 0.0])
    assert Monitor(bound, mhe, initial_error=0.1).check(mhe.update([0.1])).lost is None


DIGESTS = """
import qpmhe
from qpmhe.certificates import Content
for name in ("batch_reactor", "battery_cell", "cstr", "pendulum", "van_der_pol", "vehicle"):
    print(name, Content.of_system(getattr(qpmhe.models, name)().system).digest)
"""


@pytest.mark.slow
def test_digests_are_the_same_in_every_process():
    found = {
        subprocess.run(
            [sys.executable, "-c", DIGESTS], env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        ).stdout for seed in "123"
    }
    assert len(found) == 1
    lines = found.pop().split("\n")
    assert len({line.split()[-1] for line in lines if line}) == len(lines) - 1 > 3
    assert isinstance(Content.of_system(made()).digest, str)
