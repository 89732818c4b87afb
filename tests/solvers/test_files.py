"""QPs in files: every bit comes back, and whatever else is in a file is refused by name."""

import errno
import json
import pickle

import numpy as np
import pytest

from qpmhe_solvers import QP, InvalidInputError, Solution, SolverOptions, SolveStatus, create
from qpmhe_solvers.files import dump, load
from qpmhe_solvers.qp import ARRAYS

from .problems import CASES, TIGHT, make

OPTIONS = SolverOptions(max_iterations=7, absolute_tolerance=1e-9, time_limit=0.25)


def same_bits(one, other):
    assert (one.sizes, one.bounded) == (other.sizes, other.bounded)
    for name in ARRAYS:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def same_answer(one, other):
    for name in ("status", "iterations", "message"):
        assert getattr(one, name) == getattr(other, name)
    assert repr(one.residuals) == repr(other.residuals)
    for name in ("d", "bound_duals", "row_duals"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def rewritten(path, header=None, **arrays):
    """The file with other arrays (None drops one) or other entries of its header."""
    with np.load(path) as opened:
        held = dict(opened)
    if header is not None:
        held["header"] = np.array(json.dumps(json.loads(str(held["header"])) | header))
    held = {name: array for name, array in (held | arrays).items() if array is not None}
    np.savez(path, **held)
    return path


@pytest.fixture
def stored(tmp_path):
    """A file with everything in it, and what is in it."""
    qp, _ = make(**CASES["all kinds"])
    solution = create("quadprog").solve(qp)
    path = dump(
        qp, tmp_path / "one.npz", solution=solution, backend="quadprog", options=OPTIONS,
        start=np.ones((qp.stages, qp.n)),
    )
    return path, qp, solution


def test_everything_comes_back(stored):
    path, qp, solution = stored
    found = load(str(path))
    same_bits(found.qp, qp)
    same_answer(found.solution, solution)
    assert (found.path, found.backend, found.options) == (path, "quadprog", OPTIONS)
    assert found.start.tolist() == np.ones((qp.stages, qp.n)).tolist()
    assert found.versions["numpy"] == np.__version__
    found.qp.band[...] = 0.0  # can be overwritten
    for case in CASES.values():
        qp, _ = make(**case)
        rng = np.random.default_rng(0)
        for name in ARRAYS:  # NaNs with payloads, denormals, infinities
            bits = rng.integers(0, 2**64, getattr(qp, name).shape, dtype=np.uint64)
            getattr(qp, name)[...] = bits.view(np.float64)
        qp.gradient[0, 0], qp.bounded = -0.0, True
        found = load(dump(qp, path))
        same_bits(found.qp, qp)
        assert (found.solution, found.backend, found.options, found.start) == (None, "", None, None)
    with np.load(path) as opened:  # NumPy alone reads it, by what the header says
        header, band = json.loads(str(opened["header"])), opened["band"]
    assert "band[k, c, o] = H[k n + c + o, k n + c]" in header["problem"]
    assert (header["format"], header["version"]) == ("qpmhe QP", 1)
    assert band.tobytes() == qp.band.tobytes()
    for status in SolveStatus:
        d = np.full((qp.stages, qp.n), np.pi) if status.usable else None
        solution = Solution(d, status, np.int64(3), message='said "the" solver: \u2265 \ud800')
        same_answer(load(dump(qp, path, solution=solution)).solution, solution)


def test_a_promise_that_the_numbers_break_is_not_believed(tmp_path):
    # QPs of earlier versions promised by default that there are no bounds.
    for limit in (-5.0, np.nan, -np.inf):
        qp, _ = make(3, 2)
        qp.upper[1, 1] = limit
        found = load(rewritten(dump(qp, tmp_path / "qp.npz"), {"bounded": False})).qp
        assert found.bounded
        assert (create("auto", TIGHT).solve(found).status is SolveStatus.SOLVED) == (limit == -5.0)


def test_damage_is_reported_or_does_not_matter(stored):
    path, qp, solution = stored
    whole, rng, reported = path.read_bytes(), np.random.default_rng(0), 0
    for place in rng.integers(0, len(whole), 100):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(spoilt if place % 4 else whole[:place])
        try:
            found = load(path)
        except InvalidInputError as error:
            reported += "one.npz" in str(error)
            continue
        same_bits(found.qp, qp)
        assert found.solution.status is solution.status
    assert reported > 50


class Trap:
    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


ANSWER = {"status": "SOLVED", "iterations": 3, "message": ""}


def test_what_cannot_be_read_is_refused(stored, tmp_path):
    path, whole = stored[0], stored[0].read_bytes()
    foreign = "not a QP file.*qpmhe.solvers.dump"
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(InvalidInputError, match=foreign):
        load(path)
    for header, fault in [
        ("[1, 2]", foreign), ('{"format": "other"}', foreign), ([Trap()], "damaged")
    ]:
        np.savez(path, header=np.array(header))
        with pytest.raises(InvalidInputError, match=f"one.npz is {fault}"):
            load(path)
    for change in [
        {"gradient": None}, {"lower": np.zeros((7, 3), np.float32)}, {"start": np.zeros(1)},
        *({"header": header} for header in (
            {"version": None}, {"stages": 10**15}, {"bounded": 1}, {"versions": 3},
            {"options": {"max_iterations": 0}}, {"options": {"unknown": 1}}, {"answer": {}},
            {"answer": ANSWER | {"status": "FAILED"}}, {"answer": ANSWER | {"iterations": "3"}},
        )),
    ]:
        path.write_bytes(whole)
        with pytest.raises(InvalidInputError, match=r"one.npz is damaged"):
            load(rewritten(path, **change))
    path.write_bytes(whole)
    with pytest.raises(InvalidInputError, match=r"one.npz has version 2 .* up to 1; upgrade qpmhe"):
        load(rewritten(path, header={"version": 2}))
    with pytest.raises(InvalidInputError, match=r"cannot read .*none.npz: No such file"):
        load(tmp_path / "none.npz")


def test_what_cannot_be_dumped_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for change, words in [
        ({"qp": None}, "qp is None; expected a QP"),
        ({"solution": np.zeros(6)}, "expected a Solution"),
        ({"options": {}}, "options is {}; expected a SolverOptions"),
        ({"backend": None}, "backend is None; expected a str"),
        ({"start": np.zeros(5)}, r"start does not fit the QP .*\(3, 2\)"),
        ({"path": "none/qp.npz"}, "cannot write .*qp.npz: No such file .*folder"),
    ]:
        arguments = {"qp": QP(3, 2), "path": "qp.npz"} | change
        with pytest.raises(InvalidInputError, match=words):
            dump(**arguments)
        assert not list(tmp_path.iterdir())
    path = tmp_path / "no ending"
    for stages in (3, 2):
        assert dump(QP(stages, 1), str(path)) == path

    def fills(file, **arrays):
        file.write(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", fills)
        with pytest.raises(InvalidInputError, match=r"cannot write .*: No space left"):
            dump(QP(4, 2), path)
    assert load(path).qp.stages == 2
    assert list(tmp_path.iterdir()) == [path]
