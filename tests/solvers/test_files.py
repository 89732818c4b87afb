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

from .problems import ARRAYS, CASES, make

OPTIONS = SolverOptions(max_iterations=7, absolute_tolerance=1e-9, time_limit=0.25)


def same_bits(one, other):
    for name in ("stages", "n", "rows", "size"):
        assert getattr(one, name) == getattr(other, name)
    assert one.bounded is other.bounded
    for name in ARRAYS:
        first, second = getattr(one, name), getattr(other, name)
        assert first.shape == second.shape
        assert first.dtype == second.dtype == np.float64
        assert first.tobytes() == second.tobytes()


def same_answer(one, other):
    assert (one.status, one.iterations, one.message) == (
        other.status, other.iterations, other.message,
    )
    assert repr(one.residuals) == repr(other.residuals)
    for name in ("d", "bound_duals", "row_duals"):
        first, second = getattr(one, name), getattr(other, name)
        assert (first is None) == (second is None)
        if first is not None:
            assert first.tobytes() == second.tobytes()
            assert first.shape == second.shape


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


@pytest.mark.parametrize("case", CASES)
def test_a_qp_comes_back_bit_for_bit(case, tmp_path):
    qp, _ = make(**CASES[case])
    found = load(dump(qp, tmp_path / "qp.npz"))
    same_bits(found.qp, qp)
    assert (found.solution, found.backend, found.options, found.start) == (None, "", None, None)


@pytest.mark.parametrize("seed", range(5))
def test_any_bits_come_back(seed, tmp_path):
    rng = np.random.default_rng(seed)
    stages, n, rows = rng.integers(1, 5), rng.integers(1, 5), rng.integers(0, 3)
    qp = QP(int(stages), int(n), int(rows))
    for name in ARRAYS:
        array = getattr(qp, name)
        bits = rng.integers(0, 2**64, array.shape, dtype=np.uint64)
        array[...] = bits.view(np.float64)  # NaNs with payloads, denormals, infinities
    qp.gradient[0, 0] = -0.0
    same_bits(load(dump(qp, tmp_path / "qp.npz")).qp, qp)


@pytest.mark.parametrize("bounded", [True, False])
def test_a_promise_that_is_kept_comes_back(bounded, tmp_path):
    qp, _ = make(3, 2)
    qp.bounded = bounded
    same_bits(load(dump(qp, tmp_path / "qp.npz")).qp, qp)


@pytest.mark.parametrize("limit", [-5.0, np.nan, -np.inf])
def test_a_promise_that_the_numbers_break_is_not_believed(limit, tmp_path):
    # QPs of earlier versions promised by default that there are no bounds.
    qp, _ = make(3, 2)
    qp.upper[1, 1] = limit
    path = rewritten(dump(qp, tmp_path / "qp.npz"), {"bounded": False})
    found = load(path)
    assert found.qp.bounded
    replayed = solve_qp.replay(found, "auto", SolverOptions(absolute_tolerance=1e-9))
    if limit == -5.0:
        assert replayed.solution.status is SolveStatus.SOLVED
        assert replayed.solution.d[1, 1] == pytest.approx(-5.0)
        assert replayed.solution.bound_duals[3] > 1.0
    else:
        assert replayed.solution.status is not SolveStatus.SOLVED


def test_all_that_was_said_of_it_comes_back(stored):
    path, qp, solution = stored
    found = load(str(path))
    same_bits(found.qp, qp)
    same_answer(found.solution, solution)
    assert found.solution.status is SolveStatus.SOLVED
    assert (found.path, found.backend, found.options) == (path, "quadprog", OPTIONS)
    assert found.start.tolist() == np.ones((qp.stages, qp.n)).tolist()
    assert {"python", "numpy", "qpmhe", "qpsolvers", "quadprog"} <= set(found.versions)
    assert found.versions["numpy"] == np.__version__


@pytest.mark.parametrize("status", SolveStatus)
def test_every_verdict_comes_back(status, tmp_path):
    qp, _ = make(3, 2, bounds="all")
    d = np.full((3, 2), np.pi) if status.usable else None
    residuals = Residuals(0.5, np.nan, np.inf) if status.usable else None
    message = 'said "the" solver: \u2265 \ud800'
    solution = Solution(d, status, np.int64(3), residuals, message=message)
    found = load(dump(qp, tmp_path / "qp.npz", solution=solution)).solution
    same_answer(found, solution)


def test_a_qp_that_was_read_is_solved_as_the_one_that_was_written(stored):
    path, _, solution = stored
    again = create("quadprog").solve(load(path).qp)
    assert again.d.tobytes() == solution.d.tobytes()


def test_a_qp_that_was_read_can_be_overwritten(stored):
    load(stored[0]).qp.band[...] = 0.0


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


def test_a_file_that_ends_early_is_told(stored):
    path, _, _ = stored
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 60).astype(int):
        path.write_bytes(whole[:length])
        with pytest.raises(InvalidInputError, match=r"one.npz is (damaged|no QP file)"):
            load(path)


def test_a_changed_byte_is_told_or_does_not_matter(stored):
    path, qp, solution = stored
    whole, rng, told = path.read_bytes(), np.random.default_rng(0), 0
    for place in rng.integers(0, len(whole), 300):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(spoilt)
        try:
            found = load(path)
        except InvalidInputError as error:
            told += "one.npz" in str(error)
            continue
        same_bits(found.qp, qp)
        assert found.solution.status is solution.status
    assert told > 150


def archive(**members):
    buffer = io.BytesIO()
    np.savez(buffer, **members)
    return buffer.getvalue()


def zipped(name, text):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        opened.writestr(name, text)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        b"", b"P", b"not a QP", b"\x93NUMPY\x01\x00v\x00{}", pickle.dumps({"a": 1}),
        archive(P=np.eye(2)), zipped("a.txt", "text"),
        archive(header=np.array("[1, 2]")), archive(header=np.array('{"format": "other"}')),
    ],
)
def test_files_of_another_kind_are_told(content, tmp_path):
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=r"other.npz is no QP file.*qpmhe.solvers.dump"):
        load(path)


class Trap:
    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


@pytest.mark.parametrize(
    "content",
    [
        archive(header=np.array("no JSON")), archive(header=np.array(Trap(), object)),
        zipped("header.npy", "no array"),
    ],
)
def test_headers_that_cannot_be_read_are_told(content, tmp_path):
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=r"other.npz is damaged"):
        load(path)


def test_a_path_without_a_file_is_told(tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot read .*none.npz: No such file"):
        load(tmp_path / "none.npz")
    with pytest.raises(InvalidInputError, match=r"cannot read .*: Is a directory"):
        load(tmp_path)


def test_a_newer_file_asks_for_an_upgrade(stored):
    path = rewritten(stored[0], header={"version": 2})
    with pytest.raises(InvalidInputError, match=r"one.npz has version 2 .* up to 1; upgrade qpmhe"):
        load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"gradient": None}, {"band": np.zeros((1, 2, 3))}, {"lower": np.zeros((7, 3), np.float32)},
        {"d": None}, {"d": np.zeros(21)}, {"residuals": np.zeros(2)}, {"start": np.zeros(1)},
        {"header": {"version": None}}, {"header": {"version": 0}},
        {"header": {"stages": 10**15}}, {"header": {"n": -3}}, {"header": {"rows": "2"}},
        {"header": {"stages": None}}, {"header": {"bounded": 1}}, {"header": {"versions": 3}},
        {"header": {"options": {"max_iterations": 0}}}, {"header": {"options": {"unknown": 1}}},
        {"header": {"answer": {"status": "SPLENDID"}}}, {"header": {"answer": {}}},
        {"header": {"answer": {"status": "FAILED", "iterations": None, "message": ""}}},
        {"header": {"answer": {"status": "SOLVED", "iterations": "3", "message": ""}}},
    ],
    ids=str,
)
def test_contents_that_do_not_fit_together_are_told(stored, change):
    path = rewritten(stored[0], **change)
    with pytest.raises(InvalidInputError, match=r"one.npz is damaged"):
        load(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"qp": None}, "qp is None; expected a QP"),
        ({"solution": np.zeros(6)}, "expected a Solution"),
        ({"options": {}}, "options is {}; expected a SolverOptions"),
        ({"backend": None}, "backend is None; expected a str"),
        ({"start": np.zeros(5)}, r"start does not fit the QP .*\(3, 2\)"),
        ({"start": "here"}, "start does not fit"),
    ],
)
def test_what_cannot_be_dumped_is_told(tmp_path, change, words):
    arguments = {"qp": QP(3, 2), "path": tmp_path / "qp.npz"} | change
    with pytest.raises(InvalidInputError, match=words):
        dump(**arguments)
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_replaced(tmp_path):
    path = tmp_path / "no ending"
    for stages in (3, 2):
        assert dump(QP(stages, 1), str(path)) == path
    assert load(path).qp.stages == 2
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot write .*qp.npz: No such file .*folder"):
        dump(QP(3, 2), tmp_path / "none" / "qp.npz")


def test_a_full_disk_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = dump(QP(3, 2), tmp_path / "qp.npz")

    def fills(file, **arrays):
        file.write(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", fills)
    with pytest.raises(InvalidInputError, match=r"cannot write .*qp.npz: No space left on device"):
        dump(QP(4, 2), path)
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == [path]
    assert load(path).qp.stages == 3


def test_files_and_folders_are_listed(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(InvalidInputError, match=r"folder holds no .npz file"):
        qp_files([folder])
    paths = [dump(QP(1, 1), folder / name) for name in ("b.npz", "a.npz")]
    single = dump(QP(1, 1), tmp_path / "single")
    (folder / "notes.txt").write_text("")
    assert qp_files([single, str(folder)]) == [single, paths[1], paths[0]]
    with pytest.raises(InvalidInputError, match=r"there is no file .*none.npz"):
        qp_files([tmp_path / "none.npz"])
