"""Recording the QPs that a backend meets: it sees all of them, and changes nothing."""

from contextlib import contextmanager

import numpy as np
import pytest

from qpmhe_solvers import Backend, BackendError, InvalidInputError, OptionError, SolverOptions
from qpmhe_solvers import recorder as module
from qpmhe_solvers.files import dump, load
from qpmhe_solvers.recorder import Recording, RecordingWarning
from qpmhe_solvers.registry import backend, backends, create
from qpmhe_solvers.solution import Solution, SolveStatus
from qpmhe_solvers.solver import Solver

from .problems import CASES, EVERY, make, registered

QPS = [make(**CASES[case])[0] for case in ("no inequality", "boxes", "all kinds", "one unknown")]
ALL = tuple(SolveStatus)
FAILED, SOLVED = SolveStatus.FAILED, SolveStatus.SOLVED
CLOCKED = SolverOptions(time_limit=9.0)


class Prompted(Solver):
    """Answers with these statuses, one after the other, and remembers what it was given."""

    def __init__(self, statuses, options):
        super().__init__(options)
        self.left, self.work, self.calls = list(statuses), np.zeros((5, 2)), []

    def _solve(self, qp, start):
        raise NotImplementedError

    def solve(self, qp, start=None):
        self.calls += [self.time_limit, qp.band.tobytes(), start]
        status = self.left.pop(0)
        self.work += 1.0  # used again and again, as banded's is
        return Solution(self.work if status.usable else None, status, message="as far as I got")

    def prepare(self, size):
        self.calls.append(size)


@contextmanager
def recorded(folder, *statuses, capabilities=None, **arguments):
    """A recording of a backend that answers so."""
    own = capabilities or {}
    one = Backend("prompted", lambda options: Prompted(statuses, options), "-", **own)
    with registered(one), Recording(folder, one.name, **arguments) as recording:
        yield recording


@pytest.mark.parametrize("name", EVERY)
def test_every_backend_is_seen_and_left_alone(name, tmp_path):
    plain = create(name)
    with Recording(tmp_path, name, only="all") as recording:
        watched = create(recording.backend)
        for number, qp in enumerate(QPS, start=1):
            start = np.full((qp.stages, qp.n), 0.125)
            expected, found = plain.solve(qp, start), watched.solve(qp, start)
            stored = load(recording.files[-1])
            assert stored.path.name == f"qp-{number:06d}-{found.status.name.lower()}.npz"
            np.testing.assert_array_equal(stored.solution.d, found.d)
            # proxqp rounds as its memory happens to be aligned.
            np.testing.assert_allclose(found.d, expected.d, rtol=1e-9, atol=1e-12)
            assert found.status is expected.status
            assert stored.qp.numbers.tobytes() == qp.numbers.tobytes()
            assert (stored.backend, stored.options) == (name, watched.options)
            assert (stored.start == start).all()
        one, other = vars(backend(recording.backend)), vars(backend(name))
        assert {key for key in one if one[key] != other[key]} == {"name", "factory"}
    assert (recording.seen, recording.wanted, len(recording.files)) == (4, 4, 4)


def test_the_whole_contract_reaches_the_solver(tmp_path):
    with recorded(tmp_path, SolveStatus.STOPPED) as recording:
        solver = create(recording.backend, CLOCKED)
        solver.prepare(12)
        solver.time_limit = 2.0
        found = solver.solve(QPS[0], QPS[0].gradient)
    assert (found.status, found.message) == (SolveStatus.STOPPED, "as far as I got")
    *calls, start = solver._inner.solver.calls
    assert calls == [12, 2.0, QPS[0].band.tobytes()]
    assert (start == QPS[0].gradient).all()
    public = {name for name in vars(Solver) if not name.startswith("_")}
    # None that a later contract adds is forgotten.
    assert public - {"time_limit", "solve"} <= set(vars(type(solver)))


@pytest.mark.parametrize(
    ("only", "options", "capabilities", "left_out"),
    [
        ("failed", {}, {}, {"SOLVED", "STOPPED", "INACCURATE", "UNCONSTRAINED"}),
        ("suspicious", {}, {}, {"SOLVED"}),
        ("suspicious", {"time_limit": 1.0}, {}, {"SOLVED", "STOPPED"}),
        ("suspicious", {}, {"inequalities": False}, {"SOLVED", "UNCONSTRAINED"}),
    ],
)
def test_what_is_kept(tmp_path, only, options, capabilities, left_out):
    with recorded(tmp_path, *ALL, capabilities=capabilities, only=only) as recording:
        solver = create(recording.backend, SolverOptions(**options))
        for _ in ALL:
            solver.solve(QPS[0])
    kept = {status.name for status in ALL} - left_out
    assert {load(path).solution.status.name for path in recording.files} == kept
    assert recording.files == sorted(tmp_path.iterdir())
    assert (recording.seen, recording.wanted) == (len(ALL), len(kept))


def test_no_more_than_the_limit_is_written_with_numbers_that_go_on(tmp_path):
    dump(QPS[0], tmp_path / "qp-000041-failed.npz")
    dump(QPS[0], tmp_path / "qp-other.npz")
    with recorded(tmp_path, SOLVED, *[FAILED] * 4, limit=2) as recording:
        solver = create(recording.backend)
        for _ in range(5):
            solver.solve(QPS[0])
    names = [path.name for path in recording.files]
    assert names == ["qp-000043-failed.npz", "qp-000044-failed.npz"]
    assert (recording.wanted, recording.seen, len(list(tmp_path.iterdir()))) == (4, 5, 4)
    assert "2 files" in repr(recording)


def test_with_a_time_limit_files_wait_for_the_end_and_hold_what_was_then(tmp_path):
    qp = QPS[0].copy()
    gradient = qp.gradient.copy()
    with recorded(tmp_path, *[SOLVED] * 3, only="all", limit=2) as recording:
        solver = create(recording.backend, CLOCKED)
        for _ in range(3):
            solver.solve(qp, gradient)
            assert not list(tmp_path.iterdir())
            qp.gradient += 1.0
    assert len(recording.files) == 2
    for k, one in enumerate(map(load, recording.files)):
        assert (one.qp.gradient == gradient + k).all()
        assert (one.solution.d == 1.0 + k).all()
        assert (one.start == gradient).all()
        assert one.options == CLOCKED


def test_a_full_disk_ends_the_recording_with_one_warning(tmp_path, monkeypatch):
    calls = []

    def fills(*arguments, **options):
        calls.append(arguments)
        if len(calls) > 1:
            raise InvalidInputError("cannot write: No space left on device")
        return dump(*arguments, **options)

    monkeypatch.setattr(module, "dump", fills)
    recording = Recording(tmp_path, "banded", only="all")
    recording.__enter__()
    solver = create(recording.backend)
    for _ in range(5):
        assert solver.solve(QPS[0]).status is SOLVED
    with pytest.warns(RecordingWarning, match=r"after 1 files in .*No space left") as caught:
        recording.__exit__(None, None, None)
    assert (len(caught), len(calls)) == (1, 2)
    assert (len(recording.files), recording.seen) == (1, 5)


def test_outside_of_the_block_nothing_is_left_of_it(tmp_path):
    before, recording = backends(), Recording(tmp_path / "a", "banded", only="all")
    with pytest.raises(InvalidInputError, match="within"):
        _ = recording.backend
    with recording, Recording(tmp_path / "b", "banded", only="all") as second:
        solver = create(recording.backend)
        for one in (second, recording, recording):  # they do not mix
            create(one.backend).solve(QPS[0])
        with pytest.raises(InvalidInputError, match="already started"):
            recording.__enter__()
    assert backends() == before
    assert solver.solve(QPS[0]).status is SOLVED  # an estimator outlives the block
    assert (recording.seen, second.seen, len(list((tmp_path / "a").iterdir()))) == (2, 1, 2)
    with pytest.raises(ZeroDivisionError), Recording(tmp_path, "banded"):
        _ = 1 / 0
    assert backends() == before
    (tmp_path / "file").write_text("")
    for arguments, error, words in [
        ({"backend": "nonsense"}, BackendError, "'nonsense' is not known"),
        ({"only": "bad"}, OptionError, "only is 'bad'; expected one of 'suspicious', 'failed'"),
        ({"folder": tmp_path / "file"}, InvalidInputError, "cannot make the folder"),
    ]:
        with pytest.raises(error, match=words):
            Recording(**{"folder": tmp_path / "folder", **arguments})
        assert not (tmp_path / "folder").exists()
