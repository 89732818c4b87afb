import warnings
from contextlib import contextmanager

import numpy as np
import pytest

from qpmhe_solvers import (
    QP,
    Backend,
    BackendError,
    InvalidInputError,
    OptionError,
    RawSolution,
    Solution,
    Solver,
    SolverOptions,
    SolveStatus,
    backend,
    backends,
    create,
)
from qpmhe_solvers import recorder as module
from qpmhe_solvers.files import dump, load
from qpmhe_solvers.recorder import Recording, RecordingWarning

from .problems import ARRAYS, CASES, EVERY, make, registered

QPS = [make(**CASES[case])[0] for case in ("no inequality", "boxes", "all kinds", "one unknown")]


class Told(Solver):
    """Answers with the statuses it is told, one after the other."""

    statuses: tuple[SolveStatus, ...] = ()

    def __init__(self, options):
        super().__init__(options)
        self.left = list(self.statuses)
        self.work = None
        self.calls = []

    def _solve(self, qp, start):
        raise NotImplementedError

    def solve(self, qp, start=None):
        status = self.left.pop(0)
        if not status.usable:
            return Solution(None, status, message="gave up")
        if self.work is None:
            self.work = np.zeros((qp.stages, qp.n))  # used again and again, as banded's is
        self.work += 1.0
        return Solution(self.work, status)

    def prepare(self, size):
        self.calls.append(("prepare", size))

    def shift(self):
        self.calls.append("shift")


def told(*statuses, **capabilities):
    return Backend("told", type("Told", (Told,), {"statuses": statuses}), "-", **capabilities)


@contextmanager
def recorded(folder, entry, **arguments):
    with registered(entry), Recording(folder, entry.name, **arguments) as recording:
        yield recording


def told_the_same(one, other):
    return (one.status, one.iterations, one.message) == (
        other.status, other.iterations, other.message,
    )


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
            assert told_the_same(stored.solution, found)
            for array in ("d", "bound_duals", "row_duals"):
                one, other = getattr(stored.solution, array), getattr(found, array)
                np.testing.assert_array_equal(one, other)
            # proxqp rounds as its memory happens to be aligned.
            np.testing.assert_allclose(found.d, expected.d, rtol=1e-9, atol=1e-12)
            assert found.status is expected.status
            for array in ARRAYS:
                assert getattr(stored.qp, array).tobytes() == getattr(qp, array).tobytes()
            assert (stored.backend, stored.options) == (name, watched.options)
            assert (stored.start == start).all()
    assert (recording.seen, recording.wanted, len(recording.files)) == (4, 4, 4)


def test_answers_are_handed_on_as_they_are(tmp_path):
    answer = Solution(np.full((5, 2), 3.0), SolveStatus.STOPPED, message="as far as I got")

    class Same(Told):
        def solve(self, qp, start=None):
            self.calls += [qp, start]
            return answer

    made = []
    entry = Backend("same", lambda options: made.append(Same(options)) or made[0], "-")
    start = np.zeros((5, 2))
    with recorded(tmp_path, entry) as recording:
        found = create(recording.backend).solve(QPS[0], start)
    assert (found.status, found.message) == (SolveStatus.STOPPED, "as far as I got")
    assert (found.d == 3.0).all()
    assert made[0].calls[0].band.tobytes() == QPS[0].band.tobytes()
    assert (made[0].calls[1] == start).all()


ALL = tuple(SolveStatus)


@pytest.mark.parametrize(
    ("only", "options", "capabilities", "kept"),
    [
        ("all", {}, {}, {"SOLVED", "STOPPED", "INACCURATE", "UNCONSTRAINED", "FAILED"}),
        ("failed", {}, {}, {"FAILED"}),
        ("suspicious", {}, {}, {"STOPPED", "INACCURATE", "UNCONSTRAINED", "FAILED"}),
        ("suspicious", {"max_iterations": 5}, {}, {"INACCURATE", "UNCONSTRAINED", "FAILED"}),
        ("suspicious", {"time_limit": 1.0}, {}, {"INACCURATE", "UNCONSTRAINED", "FAILED"}),
        ("suspicious", {}, {"inequalities": False}, {"STOPPED", "INACCURATE", "FAILED"}),
    ],
)
def test_what_is_kept(tmp_path, only, options, capabilities, kept):
    with recorded(tmp_path, told(*ALL, **capabilities), only=only) as recording:
        solver = create(recording.backend, SolverOptions(**options))
        for _ in ALL:
            solver.solve(QPS[0])
    found = [load(path) for path in recording.files]
    assert {one.solution.status.name for one in found} == kept
    assert recording.files == sorted(tmp_path.iterdir())
    assert (recording.seen, recording.wanted) == (len(ALL), len(kept))


def test_a_solver_that_gives_no_duals_and_claims_nothing_can_be_recorded(tmp_path):
    class Plain(Solver):
        def _solve(self, qp, start):
            return RawSolution(np.zeros(qp.size), False)

    with recorded(tmp_path, Backend("plain", Plain, "-")) as recording:
        create(recording.backend).solve(QPS[1])
    assert load(recording.files[0]).solution.status is SolveStatus.STOPPED


def test_no_more_than_the_limit_is_written(tmp_path):
    with recorded(tmp_path, told(*[SolveStatus.FAILED] * 5), limit=2) as recording:
        solver = create(recording.backend)
        for _ in range(5):
            solver.solve(QPS[0])
    assert (len(recording.files), recording.wanted, recording.seen) == (2, 5, 5)
    assert len(list(tmp_path.iterdir())) == 2
    assert "2 files" in repr(recording)


def test_numbers_go_on_behind_those_that_are_there(tmp_path):
    dump(QPS[0], tmp_path / "qp-000041-failed.npz")
    dump(QPS[0], tmp_path / "qp-other.npz")
    with recorded(str(tmp_path / "."), told(SolveStatus.SOLVED, SolveStatus.FAILED)) as recording:
        solver = create(recording.backend)
        solver.solve(QPS[0])
        solver.solve(QPS[0])
    assert [path.name for path in recording.files] == ["qp-000043-failed.npz"]


def test_with_a_time_limit_files_wait_for_the_end_and_hold_what_was_then(tmp_path):
    qp, _ = make(3, 2, bounds="all")
    gradient = qp.gradient.copy()
    with recorded(tmp_path, told(SolveStatus.SOLVED, SolveStatus.SOLVED), only="all") as recording:
        solver = create(recording.backend, SolverOptions(time_limit=9.0))
        for _ in range(2):
            solver.solve(qp, qp.lower)
            assert not list(tmp_path.iterdir())
            qp.gradient += 1.0
    first, second = map(load, recording.files)
    assert (first.qp.gradient == gradient).all()
    assert (second.qp.gradient == gradient + 1.0).all()
    assert (first.solution.d == 1.0).all()
    assert (second.solution.d == 2.0).all()
    assert (first.start == qp.lower).all()
    assert first.options.time_limit == 9.0


def test_with_a_time_limit_no_more_than_the_limit_is_held(tmp_path):
    with recorded(tmp_path, told(*[SolveStatus.FAILED] * 3), limit=2) as recording:
        solver = create(recording.backend, SolverOptions(time_limit=9.0))
        for _ in range(3):
            solver.solve(QPS[0])
    assert len(recording.files) == 2


@pytest.mark.parametrize("time_limit", [None, 9.0])
def test_a_full_disk_ends_the_recording_and_is_told_once(tmp_path, monkeypatch, time_limit):
    calls = []

    def fills(*arguments, **options):
        calls.append(arguments)
        if len(calls) > 1:
            raise InvalidInputError("cannot write: No space left on device")
        return dump(*arguments, **options)

    monkeypatch.setattr(module, "dump", fills)

    def record():
        with recorded(tmp_path, told(*[SolveStatus.SOLVED] * 5), only="all") as recording:
            solver = create(recording.backend, SolverOptions(time_limit=time_limit))
            assert [solver.solve(QPS[0]).d[0, 0] for _ in range(5)] == [1, 2, 3, 4, 5]
        return recording

    with pytest.warns(RecordingWarning, match=r"after 1 files in .*No space left") as caught:
        recording = record()
    assert len(caught) == 1
    assert len(calls) == 2
    assert (len(recording.files), recording.seen) == (1, 5)


def test_an_answer_of_another_shape_is_recorded_as_a_failure(tmp_path):
    class Odd(Told):
        def solve(self, qp, start=None):
            return Solution(np.zeros((99, 2)), SolveStatus.SOLVED)

    with recorded(tmp_path, Backend("odd", Odd, "-")) as recording:
        found = create(recording.backend).solve(QPS[0])
    stored = load(recording.files[0]).solution
    assert found.status is stored.status is SolveStatus.FAILED
    assert found.message == stored.message == "the solver returned 198 numbers for 10 unknowns"


def test_a_solver_that_raises_is_recorded_as_a_failure(tmp_path):
    with recorded(tmp_path, told()) as recording:
        found = create(recording.backend).solve(QPS[0])
    assert found.message == "IndexError: pop from empty list"
    stored = load(recording.files[0])
    assert stored.solution.status is SolveStatus.FAILED
    assert stored.solution.message == "IndexError: pop from empty list"


def test_the_rest_of_the_contract_reaches_the_solver(tmp_path):
    made = []

    def make_one(options):
        made.append(Told(options))
        return made[-1]

    options = SolverOptions(max_iterations=3)
    with recorded(tmp_path, Backend("told", make_one, "-")) as recording:
        solver = create(recording.backend, options)
        solver.prepare(12)
        solver.shift()
    assert made[0].calls == [("prepare", 12), "shift"]
    assert made[0].options is solver.options is options
    public = {name for name in vars(Solver) if not name.startswith("_")}
    public -= {"time_limit", "solve"}
    assert public <= set(vars(type(solver)))  # none that a later contract adds is forgotten


def test_what_remains_of_the_time_reaches_the_solver(tmp_path):
    made = []

    def make_one(options):
        made.append(Told(options))
        return made[-1]

    with recorded(tmp_path, Backend("told", make_one, "-")) as recording:
        solver = create(recording.backend, SolverOptions(time_limit=9.0))
        assert made[0].time_limit == 9.0
        solver.time_limit = 2.0
        solver.solve(QPS[0])
    assert made[0].time_limit == 2.0


def test_outside_of_the_block_nothing_is_left_of_it(tmp_path):
    before = backends()
    recording = Recording(tmp_path, "banded", only="all")
    with pytest.raises(InvalidInputError, match="within"):
        _ = recording.backend
    with recording:
        name = recording.backend
        solver = create(name)
        with pytest.raises(InvalidInputError, match="begun already"):
            recording.__enter__()
    assert backends() == before
    with pytest.raises(InvalidInputError, match="within"):
        _ = recording.backend
    assert solver.solve(QPS[0]).status is SolveStatus.SOLVED  # an estimator outlives the block
    assert (recording.seen, recording.files) == (0, [])


def test_an_error_in_the_block_passes(tmp_path):
    with pytest.raises(ZeroDivisionError), Recording(tmp_path, "banded"):
        _ = 1 / 0
    assert not [entry.name for entry in backends() if "recorded" in entry.name]


def test_two_recordings_of_one_backend_do_not_mix(tmp_path):
    with (
        Recording(tmp_path / "a", "banded", only="all") as first,
        Recording(tmp_path / "b", "banded", only="all") as second,
    ):
        create(second.backend).solve(QPS[0])
        create(first.backend).solve(QPS[0])
        create(first.backend).solve(QPS[0])
    assert (first.seen, second.seen) == (2, 1)
    assert len(list((tmp_path / "a").iterdir())) == 2


def test_it_can_do_what_the_backend_can(tmp_path):
    for name in EVERY:
        with Recording(tmp_path, name) as recording:
            found, expected = vars(backend(recording.backend)), vars(backend(name))
            changed = {key for key in expected if found[key] != expected[key]}
            assert changed == {"name", "factory"}


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"backend": "nonsense"}, BackendError, "'nonsense' is not known"),
        ({"only": "bad"}, OptionError, "only is 'bad'; expected one of 'suspicious', 'failed'"),
        ({"limit": 0}, OptionError, "limit is 0"),
        ({"limit": True}, OptionError, "limit is True"),
    ],
)
def test_bad_arguments_are_told(tmp_path, arguments, error, words):
    with pytest.raises(error, match=words):
        Recording(tmp_path / "folder", **arguments)
    assert not (tmp_path / "folder").exists()


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in ("file", "file/below"):
        with pytest.raises(InvalidInputError, match="cannot make the folder"):
            Recording(tmp_path / folder)


def test_a_recording_without_a_fault_warns_of_nothing(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with Recording(tmp_path / "new", "banded") as recording:
            create(recording.backend).solve(QP(1, 1))
    assert recording.wanted == 1  # a Hessian of zeros
