"""QPs in files: every bit comes back, and whatever else is in a file is refused by name."""

import errno
import io
import json
import pickle
import zipfile

import numpy as np
import pytest

from qpmhe.cli import solve_qp
from qpmhe_solvers import (
    QP,
    InvalidInputError,
    Residuals,
    Solution,
    SolverOptions,
    SolveStatus,
    create,
)
from qpmhe_solvers.files import dump, load, qp_files
from qpmhe_solvers.qp import ARRAYS

from .problems import CASES, TIGHT, make

OPTIONS = SolverOptions(max_iterations=7, absolute_tolerance=1e-9, time_limit=0.25)


def same_bits(one, other):
    assert (one.sizes, one.bounded) == (other.sizes, other.bounded)
    for name in ARRAYS:
        first, second = getattr(one, name), getattr(other, name)
        assert (first.shape, first.dtype) == (second.shape, second.dtype)
        assert first.tobytes() == second.tobytes()


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
    assert found.solution.status is SolveStatus.SOLVED
    assert (found.path, found.backend, found.options) == (path, "quadprog", OPTIONS)
    assert found.start.tolist() == np.ones((qp.stages, qp.n)).tolist()
    assert {"python", "numpy", "qpmhe", "qpsolvers", "quadprog"} <= set(found.versions)
    assert found.versions["numpy"] == np.__version__
    assert create("quadprog").solve(found.qp).d.tobytes() == solution.d.tobytes()
    found.qp.band[...] = 0.0  # can be overwritten


@pytest.mark.parametrize("case", CASES)
def test_a_qp_comes_back_bit_for_bit(case, tmp_path):
    qp, _ = make(**CASES[case])
    found = load(dump(qp, tmp_path / "qp.npz"))
    same_bits(found.qp, qp)
    assert (found.solution, found.backend, found.options, found.start) == (None, "", None, None)
    rng = np.random.default_rng(0)
    for name in ARRAYS:
        bits = rng.integers(0, 2**64, getattr(qp, name).shape, dtype=np.uint64)
        getattr(qp, name)[...] = bits.view(np.float64)  # NaNs with payloads, denormals, infinities
    qp.gradient[0, 0], qp.bounded = -0.0, True
    same_bits(load(dump(qp, tmp_path / "qp.npz")).qp, qp)


@pytest.mark.parametrize("limit", [-5.0, np.nan, -np.inf])
def test_a_promise_that_the_numbers_break_is_not_believed(limit, tmp_path):
    # QPs of earlier versions promised by default that there are no bounds.
    qp, _ = make(3, 2)
    qp.upper[1, 1] = limit
    found = load(rewritten(dump(qp, tmp_path / "qp.npz"), {"bounded": False}))
    assert found.qp.bounded
    replayed = solve_qp.replay(found, "auto", TIGHT).solution
    assert (replayed.status is SolveStatus.SOLVED) == (limit == -5.0)
    if limit == -5.0:
        assert replayed.d[1, 1] == pytest.approx(-5.0)
        assert replayed.bound_duals[3] > 1.0


@pytest.mark.parametrize("status", SolveStatus)
def test_every_verdict_comes_back(status, tmp_path):
    qp, _ = make(3, 2, bounds="all")
    d = np.full((3, 2), np.pi) if status.usable else None
    residuals = Residuals(0.5, np.nan, np.inf) if status.usable else None
    message = 'said "the" solver: \u2265 \ud800'
    solution = Solution(d, status, np.int64(3), residuals, message=message)
    same_answer(load(dump(qp, tmp_path / "qp.npz", solution=solution)).solution, solution)


def test_numpy_alone_reads_it_by_what_it_says_of_itself(stored):
    path, qp, _ = stored
    with np.load(path, allow_pickle=False) as opened:
        arrays = dict(opened)
    header = json.loads(str(arrays["header"]))
    assert "band[k, c, o] = H[k n + c + o, k n + c]" in header["problem"]
    n, size = header["n"], header["stages"] * header["n"]
    hessian = np.zeros((size, size))
    for (k, c, o), value in np.ndenumerate(arrays["band"]):
        row, column = k * n + c + o, k * n + c
        if c + o < 2 * n and row < size:
            hessian[row, column] = hessian[column, row] = value
    assert (hessian == qp.dense()).all()
    assert (header["format"], header["version"]) == ("qpmhe QP", 1)
    assert header["answer"]["verdict"] == SolveStatus.SOLVED.value


def test_damage_is_reported_or_does_not_matter(stored):
    path, qp, solution = stored
    whole, rng, reported = path.read_bytes(), np.random.default_rng(0), 0
    for length in np.linspace(0, len(whole) - 1, 30).astype(int):
        path.write_bytes(whole[:length])
        with pytest.raises(InvalidInputError, match=r"one.npz is (damaged|not a QP file)"):
            load(path)
    for place in rng.integers(0, len(whole), 150):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(spoilt)
        try:
            found = load(path)
        except InvalidInputError as error:
            reported += "one.npz" in str(error)
            continue
        same_bits(found.qp, qp)
        assert found.solution.status is solution.status
    assert reported > 75


def archive(**members):
    buffer = io.BytesIO()
    np.savez(buffer, **members)
    return buffer.getvalue()


def zipped(name, text):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        opened.writestr(name, text)
    return buffer.getvalue()


class Trap:
    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


FOREIGN, DAMAGED = "not a QP file.*qpmhe.solvers.dump", "damaged"


def test_files_of_another_kind_are_refused(tmp_path):
    for content, fault in [
        *((one, FOREIGN) for one in (
            b"", b"P", b"not a QP", b"\x93NUMPY\x01\x00v\x00{}", pickle.dumps({"a": 1}),
            archive(P=np.eye(2)), zipped("a.txt", "text"),
            archive(header=np.array("[1, 2]")), archive(header=np.array('{"format": "other"}')),
        )),
        (archive(header=np.array("no JSON")), DAMAGED),
        (archive(header=np.array(Trap(), object)), DAMAGED),
        (zipped("header.npy", "no array"), DAMAGED),
    ]:
        path = tmp_path / "other.npz"
        path.write_bytes(content)
        with pytest.raises(InvalidInputError, match=f"other.npz is {fault}"):
            load(path)


ANSWER = {"status": "SOLVED", "iterations": 3, "message": ""}


def test_contents_that_do_not_fit_together_are_refused(stored):
    path, whole = stored[0], stored[0].read_bytes()
    for change in [
        {"gradient": None}, {"band": np.zeros((1, 2, 3))}, {"lower": np.zeros((7, 3), np.float32)},
        {"d": None}, {"d": np.zeros(21)}, {"residuals": np.zeros(2)}, {"start": np.zeros(1)},
        *({"header": header} for header in (
            {"version": None}, {"version": 0}, {"stages": 10**15}, {"n": -3}, {"rows": "2"},
            {"stages": None}, {"bounded": 1}, {"versions": 3}, {"options": {"max_iterations": 0}},
            {"options": {"unknown": 1}}, {"answer": {}}, {"answer": ANSWER | {"status": "GOOD"}},
            {"answer": ANSWER | {"status": "FAILED"}}, {"answer": ANSWER | {"iterations": "3"}},
        )),
    ]:
        path.write_bytes(whole)
        rewritten(path, **change)
        with pytest.raises(InvalidInputError, match=r"one.npz is damaged"):
            load(path)


def test_a_newer_file_asks_for_an_upgrade(stored):
    path = rewritten(stored[0], header={"version": 2})
    with pytest.raises(InvalidInputError, match=r"one.npz has version 2 .* up to 1; upgrade qpmhe"):
        load(path)


def test_what_cannot_be_dumped(tmp_path):
    for change, words in [
        ({"qp": None}, "qp is None; expected a QP"),
        ({"solution": np.zeros(6)}, "expected a Solution"),
        ({"options": {}}, "options is {}; expected a SolverOptions"),
        ({"backend": None}, "backend is None; expected a str"),
        ({"start": np.zeros(5)}, r"start does not fit the QP .*\(3, 2\)"),
        ({"start": "here"}, "start does not fit"),
        ({"path": "none/qp.npz"}, "cannot write .*qp.npz: No such file .*folder"),
    ]:
        arguments = {"qp": QP(3, 2)} | change
        arguments["path"] = tmp_path / arguments.get("path", "qp.npz")
        with pytest.raises(InvalidInputError, match=words):
            dump(**arguments)
        assert not list(tmp_path.iterdir())


def test_what_cannot_be_read(tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot read .*none.npz: No such file"):
        load(tmp_path / "none.npz")
    with pytest.raises(InvalidInputError, match=r"cannot read .*: Is a directory"):
        load(tmp_path)


def test_an_existing_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
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


def test_files_and_folders_are_listed(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(InvalidInputError, match=r"folder holds no .npz file"):
        qp_files([folder])
    paths = [dump(QP(1, 1), folder / name) for name in ("b.npz", "a.npz")]
    single = dump(QP(1, 1), tmp_path / "single")
    (folder / "notes.txt").write_text("")
    assert qp_files([single, str(folder)]) == [single, *paths[::-1]]
    with pytest.raises(InvalidInputError, match=r"there is no file .*none.npz"):
        qp_files([tmp_path / "none.npz"])
