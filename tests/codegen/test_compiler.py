"""The compiler, the cache and engine="auto": who compiles, how often, bad luck and wrong code."""

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler, fingerprint, folders, library, rehearsal
from qpmhe.codegen.compiler import compiled_library, find_compiler
from qpmhe.errors import CompilationError, EngineWarning, InvalidInputError, OptionError
from qpmhe.memory.snapshot import read, written

from ..properties.campaign.cases import Case
from .cases import CASES, case

CC = os.environ.get("CC") or shutil.which("cc")  # usually without optimisation
RIGHT = f'exec {CC} "$@"'
FAST, MIDDLE, PLAIN = (" ".join(flags) for flags in compiler._LEVELS)
ANSWER = {
    "a.c": '#include "a.h"\nint answer(void) { return NUMBER; }\n', "a.h": "#define NUMBER 42\n"
}
pytestmark = pytest.mark.skipif(
    CC is None or os.name != "posix", reason="there is no C compiler, or none that is a script"
)


class Script:
    """A compiler whose body is in the environment: the same one for the cache, whatever it does."""

    def __init__(self, folder, monkeypatch):
        self.path, self.log, self.monkeypatch = folder / "my cc", folder / "calls", monkeypatch
        self.path.write_text('#!/bin/sh\necho "$*" >> "$COMPILER_LOG"\neval "$COMPILER_BODY"\n')
        self.path.chmod(0o755)
        monkeypatch.setenv("COMPILER_LOG", str(self.log))
        self.does(RIGHT)

    def does(self, body, arguments=""):
        """Have it do this, and be named with these arguments."""
        self.monkeypatch.setenv("COMPILER_BODY", body)
        self.monkeypatch.setenv("CC", f"'{self.path}' {arguments}".strip())

    def lies(self, edit, levels):
        """Have it compile another text at some levels of optimisation."""
        cases = "|".join(f"*'{level}'*" for level in levels)
        self.does(
            f"case \"$*\" in {cases})\n"
            "for source; do case \"$source\" in *.c) break;; esac; done\n"
            f"cp \"$source\" \"$source.true\"\nsed '{edit}' \"$source.true\" > \"$source\"\n"
            "cmp -s \"$source\" \"$source.true\" && { echo 'no lie' >&2; exit 1; }\n;; esac\n"
            f"{RIGHT}"
        )

    @property
    def calls(self):
        return self.log.read_text().splitlines() if self.log.exists() else []


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


def counting_script(tmp_path, cache, monkeypatch):
    """An empty cache, the usual "auto", and a compiler that counts its calls."""
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(cache))
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return Script(tmp_path, monkeypatch)


@pytest.fixture(autouse=True)
def script(tmp_path, cache, monkeypatch):
    monkeypatch.setattr(compiler, "_checked", set())
    return counting_script(tmp_path, cache, monkeypatch)


def answer(files=ANSWER, **options):
    return compiled_library(files, "a.c", **options).answer()


def system(compiled=False, factor=-0.9, **options):
    a, c = ca.DM([[factor, 0.2], [-0.1, -0.8]]), ca.DM([[1.0, 0.3], [0.2, 1.0]])
    usual = {"dt": 0.1, "method": "rk4", "compiled": compiled}
    return qpmhe.from_casadi(lambda x: a @ x, lambda x: c @ x, n=2, **usual | options)


def arguments(weight=1.0, horizon=4):
    cost = qpmhe.QuadraticCost(
        prior=weight * np.eye(2), disturbance=5 * np.eye(2), noise=2 * np.eye(2) + 0.5
    )
    parts = system(), qpmhe.Luenberger(0.1 * weight * np.eye(2)), cost
    return parts, {"horizon": horizon, "initial_state": np.ones(2)}


def estimator(weight=1.0, horizon=4, parts=None, **options):
    usual, shared = arguments(weight, horizon)
    return qpmhe.MovingHorizonEstimator(*(parts or usual), **shared | options)


def compile_it(**options):
    return qpmhe.compile(estimator(engine="python", **options))


def in_processes(program, count=1):
    """What so many processes print that run a program at once."""
    found = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
        for _ in range(count)
    ]
    return {one.communicate(timeout=120)[0] for one in found}


def elsewhere(count=1):
    """Ask for the answer in processes: a library that is cut kills the one that maps it."""
    program = (
        "from qpmhe.codegen.compiler import compiled_library\n"
        f"print(compiled_library({ANSWER!r}, 'a.c').answer())"
    )
    assert in_processes(program, count) == {"42\n"}


def test_what_makes_another_library(script, tmp_path, monkeypatch, capfd):
    script.does(RIGHT, "-DNUMBER_TWO=7 '-DTEXT=a b'")
    assert find_compiler() == [str(script.path), "-DNUMBER_TWO=7", "-DTEXT=a b"]
    changed = {**ANSWER, "a.h": "#define NUMBER 43\n"}
    for count, (files, options, expected) in enumerate((
        ({"a.c": "int answer(void) { return NUMBER_TWO; }\n"}, {}, 7), (ANSWER, {}, 42),
        (changed, {}, 43), (ANSWER, {"key": "one"}, 42), (ANSWER, {"key": "two"}, 42),
    ), start=1):
        assert [answer(files, **options) for _ in range(2)] == [expected] * 2
        assert len(script.calls) == count
    assert answer(changed, key="one") == 42  # as the caller says
    elsewhere()
    script.does(RIGHT, "-DEXTRA")
    assert answer(key="two") == 42
    with script.path.open("a") as file:  # a compiler that was replaced
        file.write("\n")
    assert answer(key="two") == 42
    assert len(script.calls) == 7
    monkeypatch.chdir(tmp_path)
    for place in ("below/here", "with space \u00e9"):
        monkeypatch.setenv("QPMHE_CACHE_DIR", place)
        assert [answer(), answer()] == [42, 42]
        assert list(Path(place).glob("*.so"))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("body", "words"), [
    ("echo 'out of cheese' >&2\nexit 1", "out of cheese"),
    ("exec sleep 600", "did not end within"),
    ("printf '\\377\\376 m\\303' >&2; exit 1", "."),  # words in no encoding
    ("for last; do true; done\nwhile [ $# -gt 1 ]; do [ \"$1\" = -o ] && out=\"$2\"; shift; done\n"
     "echo nonsense > \"$out\"", "."),  # for another machine
    (None, "no C compiler.*CC"),
], ids=["fails", "hangs", "no encoding", "no library", "missing"])
def test_compilers_of_all_sorts_raise_our_error(body, words, script, cache, monkeypatch):
    monkeypatch.setattr(compiler, "_PATIENCE", 0.2)
    script.does(body or "")
    if body is None:
        monkeypatch.setenv("CC", "/nowhere/cc 'open")
    for ask in (answer, compile_it, lambda: system(compiled=True)):
        with pytest.raises(CompilationError, match=words):
            ask()
    assert estimator().engine == "python"
    with pytest.warns(EngineWarning, match=words):
        assert estimator(engine="compiled").engine == "python"
    assert not any(path.is_dir() for path in cache.glob("*"))


def test_a_compiler_without_fast_flags_and_none(script, monkeypatch, tmp_path):
    script.does(f'case "$*" in *march*) exit 1;; esac\n{RIGHT}')
    assert [answer(), answer()] == [42, 42]
    assert len(script.calls) == 2
    monkeypatch.delenv("CC")
    assert find_compiler() is not None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_compiler() is None
    assert np.isfinite(system(None).f(np.ones(2), None)).all()  # by CasADi's virtual machine


@pytest.mark.slow
def test_damaged_files_in_the_cache(script, cache):
    for damage in (
        lambda data: data[: len(data) // 2], lambda data: data.replace(b"answer", b"anxwer"),
    ):
        shutil.rmtree(cache, ignore_errors=True)
        script.log.unlink(missing_ok=True)
        elsewhere()
        path = next(cache.glob("*.so"))
        path.write_bytes(damage(path.read_bytes()))
        elsewhere()
        elsewhere()
        assert len(script.calls) == 2
    judge, notes = compiler._checked_by(), cache / f"{path.stem[:-2]}.level"
    for note in (
        "", "x", f"-1\n{judge}\n", "1", f"1\n{judge}", "99\nright by qpmhe 0.1\nof another version",
        f"99\n{judge}\nall of it",
    ):
        assert answer() == 42
        notes.write_text(note)
    with pytest.raises(compiler.WrongCodeError, match="all of it"):
        answer()


def test_two_processes_at_once_and_remains_of_killed_ones(script, cache):
    for name in ("qpmhe-making-old", "qpmhe-making-new", "tmpold"):  # the last may be anyone's
        (cache / name).mkdir(parents=True)
        (cache / name / "library.so").write_text("half")
        if name.endswith("old"):
            os.utime(cache / name, 2 * (os.stat(cache).st_mtime - 2 * 86400,))
    script.does(f"sleep 0.5\n{RIGHT}")
    elsewhere(2)
    before = len(script.calls)
    assert answer() == 42
    assert len(script.calls) == before <= 2
    left = sorted(path.name for path in cache.iterdir() if path.is_dir())
    assert left == ["qpmhe-making-new", "tmpold"]


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX only")
def test_folders_that_cannot_be_used_and_a_full_disk(cache, tmp_path, monkeypatch):
    cache.mkdir(mode=0o777)
    if os.geteuid() == 0:  # someone else's
        os.chown(cache, 12345, 12345)
    else:
        cache.chmod(0o500)
    (tmp_path / "file").write_text("")
    for place in (cache, tmp_path / "file" / "below"):
        monkeypatch.setenv("QPMHE_CACHE_DIR", str(place))
        assert answer() == 42
        private = next(tmp_path.glob("qpmhe-*"))
        assert list(private.glob("*.so"))
        assert private.stat().st_mode & 0o077 == 0
        # And where that one is another's, too.
        shutil.rmtree(private)
        private.write_text("")
        with pytest.raises(CompilationError, match="QPMHE_CACHE_DIR"):
            answer()
        private.unlink()
    assert not list(cache.iterdir())
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "full"))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    for place in ((tempfile, "TemporaryDirectory"), (os, "replace"), (Path, "write_text")):
        with monkeypatch.context() as patch:
            patch.setattr(*place, full)
            with pytest.raises(CompilationError, match="space left"):
                answer()


def refuses(folder, reason):
    """Whether code of a folder is neither loaded nor written there, and says why."""
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert answer() == 42  # in the private folder
    after = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    return before == after and reason in folders.refusal(folder)


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX only")
def test_libraries_are_loaded_only_from_places_that_nobody_else_can_fill(
    script, cache, tmp_path, monkeypatch
):
    assert answer() == 42
    (made,), right = cache.glob("*.so"), ANSWER["a.h"]
    assert (cache.stat().st_mode | made.stat().st_mode) & 0o077 == 0
    seal = made.with_suffix(".sha256")

    # Whoever can write a folder, or one on the way to it, could put a library there.
    place, link = tmp_path / "place", tmp_path / "link"
    place.mkdir(mode=0o755)
    kept = place / "kept"
    shutil.copytree(cache, kept)
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(kept))
    calls = len(script.calls)
    for folder, mode, reason in (
        (kept, 0o777, "open to others"), (kept, 0o1777, "open to others"),
        (place, 0o777, "can be changed"), (place, 0o1777, ""),
    ):
        usual = folder.stat().st_mode & 0o7777
        folder.chmod(mode)
        if reason:
            assert refuses(kept, reason)
        else:
            assert folders.cache_folders() == [kept]
        folder.chmod(usual)
    assert len(script.calls) == calls + 1  # once, into the private folder
    shutil.rmtree(next(tmp_path.glob("qpmhe-*")))
    link.symlink_to(place)
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(link / "kept"))
    assert answer() == 42
    assert folders.refusal(link / "kept") == ""
    assert len(script.calls) == calls + 1
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    assert "link" in folders.refusal(circle / "kept")

    if os.geteuid() == 0:
        monkeypatch.setenv("QPMHE_CACHE_DIR", str(link / "kept"))
        os.lchown(link, 12345, 12345)
        assert refuses(kept, "")
        assert "somebody else's link" in folders.refusal(link / "kept")
        monkeypatch.setenv("QPMHE_CACHE_DIR", str(kept))
        for one, reason in ((place, "can be changed"), (kept, "another user")):
            os.chown(one, 12345, 12345)
            assert refuses(kept, reason)
            os.chown(one, 0, 0)

    # Files: of another name, writable, linked, or another's are made again. The planted ones are
    # harmless: they answer 43.
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "other"))
    monkeypatch.setitem(ANSWER, "a.h", "#define NUMBER 43\n")
    assert answer() == 43
    (planted,) = (tmp_path / "other").glob("*.so")
    monkeypatch.setitem(ANSWER, "a.h", right)
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(cache))

    def plant(of, to):
        to.unlink()
        shutil.copy2(of, to)

    def renamed():
        plant(planted, made)
        plant(planted.with_suffix(".sha256"), seal)

    def linked():
        made.unlink()
        made.symlink_to(planted)
        seal.unlink()
        seal.symlink_to(planted.with_suffix(".sha256"))

    ways = [renamed, linked, lambda: made.chmod(0o777), lambda: seal.chmod(0o666)]
    if os.geteuid() == 0:
        ways += [lambda: os.chown(made, 12345, 12345), lambda: os.chown(seal, 12345, 12345)]
    for way in ways:
        way()
        calls = len(script.calls)
        assert answer() == 42
        assert len(script.calls) == calls + 1, way
    assert not (made.is_symlink())
    assert not (seal.is_symlink())


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX only")
def test_the_temporary_folder_is_private_and_not_searched_where_the_cache_works(
    script, cache, tmp_path, monkeypatch
):
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "file" / "below"))
    (tmp_path / "file").write_text("")
    assert answer() == 42
    private = next(tmp_path.glob("qpmhe-*"))
    assert folders.cache_folders() == [private]
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(cache))
    cache.mkdir()
    assert folders.cache_folders() == [cache]
    calls = len(script.calls)
    assert answer() == 42
    assert len(script.calls) == calls + 1  # it did not take the one in the temporary folder
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "file" / "below"))
    for open_to_others in (0o755, 0o770, 0o777):
        private.chmod(open_to_others)
        assert folders.cache_folders() == []
        with pytest.raises(CompilationError, match=r"open to others.*set QPMHE_CACHE_DIR"):
            answer()
    target = tmp_path / "elsewhere"
    private.rename(target)
    target.chmod(0o700)
    private.symlink_to(target)
    assert folders.cache_folders() == [private]  # a link of our own
    if os.geteuid() == 0:
        os.lchown(private, 12345, 12345)
        assert folders.cache_folders() == []


@pytest.mark.slow
def test_auto_takes_what_was_compiled_without_generating_it_again(script, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(library, "estimator_files", None)
        before = estimator()
        assert (before.engine, before.update([1.0, 2.0]).engine) == ("python",) * 2
    assert not script.calls
    made, calls = compile_it(), script.calls
    assert (made.is_new, made.path.is_file(), made.engine) == (True, True, "compiled")
    before.reset()
    assert before.update([1.0, 2.0]).engine == "python"  # it keeps its engine
    monkeypatch.setattr(library, "estimator_files", None)
    (usual, observer, cost), _ = arguments()
    plain = qpmhe.System(lambda x: [0.9 * x[0], 0.8 * float(x[1])], lambda x: x, n=2, p=2)
    kalman = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
    for engine, options in (
        ("compiled", {}), ("compiled", {"weight": 2.0, "max_qps": 3, "backend": "banded"}),
        ("compiled", {"candidate": "reinitialized"}), ("python", {"engine": "python"}),
        ("python", {"horizon": 5}), ("python", {"backend": "osqp"}), ("python", {"isolated": True}),
        ("python", {"time_budget": 1.0}), ("python", {"parts": (usual, kalman, cost)}),
        ("python", {"parts": (plain, observer, cost)}),
    ):
        mhe = estimator(**options)
        assert np.isfinite(mhe.update([1.0, 2.0]).cost)
        assert (mhe.engine, mhe.run(np.ones((2, 2))).engine) == (engine, engine)
    with pytest.raises(InvalidInputError, match="leave them out"):
        qpmhe.compile(estimator(), horizon=3)
    with pytest.raises(OptionError, match="horizn"):
        qpmhe.compile(*arguments()[0], horizn=3)
    again = qpmhe.compile(estimator())
    assert (again.is_new, again.path) == (False, made.path)
    options = {"members": 2, "horizon": 4, "initial_states": np.ones(2)}
    batch = pickle.loads(pickle.dumps(qpmhe.BatchEstimator(usual, observer, cost, **options)))
    assert (batch.engine, batch.mode) == ("compiled", "compiled")
    program = (
        "from tests.codegen.test_compiler import estimator\nmhe = estimator()\n"
        "print(mhe.engine, mhe.update([1.0, 2.0]).cost.hex())"
    )
    expected = estimator().update([1.0, 2.0]).cost.hex()
    assert in_processes(program) == {f"compiled {expected}\n"}
    assert script.calls == calls
    for wanted, engine in (("python", "python"), ("auto", "compiled")):
        monkeypatch.setenv("QPMHE_ENGINE", wanted)
        assert estimator().engine == engine
    monkeypatch.setenv("QPMHE_ENGINE", "fast")
    with pytest.raises(OptionError, match="QPMHE_ENGINE is 'fast'; expected 'python'"):
        estimator()


@pytest.mark.slow
def test_auto_is_the_python_step_where_the_library_is_of_no_use(script, monkeypatch):
    path = compile_it().path
    script.log.unlink()
    for patches in (
        {(library, "planned"): lambda *_: 1 / 0}, {
            (compiler, "_checked"): set(), (compiler, "_checked_by"): lambda: "another release",
            (rehearsal, "estimator_fault"): lambda *_: "J of the estimate is 2",
        },
    ):
        with monkeypatch.context() as patch:
            for place, value in patches.items():
                patch.setattr(*place, value)
            assert estimator().engine == "python"
    plain = os.access  # as it reports no folder to be writable: the tests may run as root
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and plain(path, mode))
        assert estimator().engine == estimator(engine="compiled").engine == "compiled"
        with pytest.raises(CompilationError, match="cannot be written; set QPMHE_CACHE_DIR"):
            compile_it(horizon=5)
    path.with_suffix(".sha256").write_text("nonsense")
    assert estimator().engine == "python"
    shutil.rmtree(path.parent)
    path.parent.write_text("a file")
    assert estimator().engine == "python"
    assert not script.calls
    # What lies beside a cache that cannot be made is found, unless its model has no key.
    assert compile_it().path.parent.parent == path.parent.parent
    assert estimator().engine == "compiled"
    monkeypatch.setattr(library, "source_key", lambda *_: None)
    assert (estimator().engine, estimator(engine="compiled").engine) == ("python", "compiled")
    with pytest.raises(CompilationError, match="cannot serialize"):
        compile_it()


def key_and_source(mhe, monkeypatch):
    """The key of an estimator's library, and its source without the data at its end."""
    found = []

    def capture(files, main, key, check, patience):
        code, mark, _ = files()["mhe.c"].partition("/* Weights, gain, sets")
        assert mark
        found.append((key, files()["mhe.h"] + code))
        raise CompilationError("it is not compiled")

    monkeypatch.setattr(library, "compiled_library", capture)
    with pytest.raises(CompilationError, match="it is not compiled"):
        qpmhe.compile(mhe)
    return found[0]


@pytest.mark.shortened
def test_keys_differ_where_the_source_does(monkeypatch, pytestconfig):
    box, rows = qpmhe.Box([-1.0, -1.0], [1.0, 1.0]), qpmhe.Polytope([[1.0, 1.0]], [1.0])
    wide, (parts, _) = qpmhe.Box([-2.0, -np.inf], [2.0, 9.0]), arguments()
    options = (
        {}, {"factor": 0.8}, {"factor": -0.9 + 1e-15}, {"disturbances": box},
        {"disturbances": rows}, {"disturbances": wide}, {"noises": box}, {"dt": 0.2},
        {"method": "euler"}, {"dt": None},
    )
    estimators = [
        estimator(parts=(system(**given), *parts[1:]), engine="python") for given in options
    ]
    every = 3 if pytestconfig.option.all else 15
    others = [case(name).estimator("python") for name in list(CASES)[::every]]
    estimators += [estimator(horizon=5), *others]
    found = [key_and_source(one, monkeypatch) for one in estimators]
    keys, sources = zip(*found, strict=True)
    assert None not in keys
    for key, text in found:
        assert [one == key for one in keys] == [one == text for one in sources]
    assert len(set(keys)) < len(keys)  # sampling times, weights and options are data


@pytest.mark.parametrize("name", ["c/step.c", "source.py"])
def test_keys_change_with_the_generator(name, tmp_path, monkeypatch):
    before = fingerprint.source_key(system().symbolic)
    copy = shutil.copytree(os.path.dirname(fingerprint.__file__), tmp_path / "codegen")
    monkeypatch.setattr(fingerprint, "files", lambda _: copy)
    monkeypatch.setattr(fingerprint, "_generator", fingerprint._generator.__wrapped__)
    assert fingerprint.source_key(system().symbolic) == before
    with (copy / name).open("a") as file:
        file.write("\n")
    assert fingerprint.source_key(system().symbolic) != before


def test_a_snapshot_pins_its_engine(tmp_path, monkeypatch):
    compile_it()
    ways = {"python": "python", "compiled": "auto"}
    for engine, other in (("python", "compiled"), ("compiled", "python")):
        monkeypatch.setenv("QPMHE_ENGINE", ways[engine])
        mhe = estimator()
        mhe.run([[1.0, 2.0], [2.0, np.nan], [np.nan, 1.5]])
        snapshot, kept = mhe.state_dict(), pickle.dumps(mhe)
        wanted = mhe.update([1.0, 1.0])
        monkeypatch.setenv("QPMHE_ENGINE", ways[other])
        one = estimator()
        assert (one.engine, read(snapshot)["engine"]) == (other, engine)
        one.load_state_dict(snapshot)
        for mhe in (one, pickle.loads(kept)):
            found = mhe.update([1.0, 1.0])
            assert (mhe.engine, found.engine) == (engine, engine)
            np.testing.assert_array_equal(found.trajectory, wanted.trajectory)
        if engine == "python":
            with pytest.raises(InvalidInputError, match="engine='python'; expected 'compiled'"):
                estimator(engine="compiled").load_state_dict(snapshot)
    # Without its library the snapshot is refused, and the estimator stays as it was.
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "empty"))
    mhe = estimator()
    mhe.update([1.0, 2.0])
    for one, state, words in (
        (mhe, snapshot, "not in the cache"), (mhe, snapshot, r"qpmhe\.compile"),
        (estimator(backend="osqp"), snapshot, "which is not ready here"),
        (mhe, written(read(snapshot) | {"engine": "fast"}), "engine"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            one.load_state_dict(state)
    assert (mhe.engine, mhe.time) == ("python", 1)
    # An estimator that was pickled waits for the compiler, as it was made to run it.
    assert pickle.loads(kept).engine == "compiled"


MODEL_LIES = {
    "residuals": "s/= y\\[j\\] - h\\[j\\]/= y[j] + h[j]/",
    "Jacobian": "s/A\\[j \\* NX + j\\] += 1;/A[j * NX + j] += 1.0001;/",
    "lengths of steps": "s/step ? step\\[k\\] : usual/usual/",
}
STEP_LIES = {
    "noises": "s/v\\[j\\] = stage->y\\[j\\] - output/v[j] = stage->y[j] + output/",
    "discount": "s/trial->cost += k->factors\\[i + 1\\] \\*/trial->cost +=/",
    "prior": "s/cost += factors\\[0\\] \\*/cost += 0 */",
    "missing components": "s/R\\[i \\* NY + j\\] -= share/R[i * NY + j] += share/",
    "a noise weight": "s/stage->has_own_noise ? stage->own_noise_weight : //",
    "the verdict": (  # of a step that leads upwards, without shorter ones
        "s/if (o->spare->cost < target) {/if (1) {/;s/= -k->gradient/= k->gradient/;"
        "s/if (!mhe_try_part(e, k, o, &path)) return;/return;/"
    ),
}


def is_right(one):
    """Whether a model's functions, or an estimator's steps, are those of the interpreter."""
    rng, true, mhe = np.random.default_rng(3), system(), estimator(engine="python")
    for count in (1, 2, 5, 8):
        x, y = rng.normal(size=(count + 1, 2)), rng.normal(size=(count, 2))
        if isinstance(one, qpmhe.System):
            found, expected = (
                each.evaluation.residuals(x, y, np.zeros((count, 0))) for each in (one, true)
            )
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
            continue
        y[0, count % 2] = np.nan
        for each in y:
            found, expected = one.update(each), mhe.update(each)
            assert found.cost == pytest.approx(expected.cost, rel=1e-6)
            assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)


@pytest.mark.parametrize(("lie", "wrong"), [
    *((lie, [FAST]) for lie in MODEL_LIES), *((lie, [FAST, MIDDLE]) for lie in STEP_LIES)
])
def test_wrong_code_is_compiled_with_less_optimisation(lie, wrong, script, cache, monkeypatch):
    script.lies((MODEL_LIES | STEP_LIES)[lie], wrong)
    for _ in range(2):
        one = system(None) if lie in MODEL_LIES else estimator(engine="compiled")
        assert lie in MODEL_LIES or one.engine == "compiled"
        is_right(one)
        levels = [FAST, MIDDLE, PLAIN][: len(wrong) + 1]
        assert len(script.calls) == len(levels)
        assert all(level in call for level, call in zip(levels, script.calls, strict=True))
        monkeypatch.setattr(compiler, "_checked", set())  # as in another process
    (note,) = (path.read_text() for path in cache.glob("*.level"))
    assert note.startswith(f"{len(wrong)}\n")


def arrhenius(x, u):
    """A stirred tank with a jacket, which runs away with large inputs, and below 0 K."""
    reaction = 1.2e9 * ca.exp(-8750.0 / x[1]) * x[0]
    return ca.vertcat(
        (1000.0 - x[0]) / 60.0 - reaction,
        (350.0 - x[1]) / 60.0 + 0.2 * reaction - 0.14 * (x[1] - x[2]),
        50.0 * u[0] * (u[1] - x[2]) + 0.04 * (x[1] - x[2]),
    )


@pytest.mark.slow
def test_a_model_that_runs_away_is_not_taken_for_wrong_code(script):
    weights = {
        "prior": np.diag([1e4, 25.0, 9.0]), "disturbance": np.diag([4.0, 0.01, 0.0025]),
        "noise": np.diag([0.25, 0.09]),
    }
    for states in (None, qpmhe.Box([0.0, 280.0, 270.0], [1100.0, 460.0, 400.0])):
        x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
        f, h = ca.Function("f", [x, u], [arrhenius(x, u)]), ca.Function("h", [x], [x[1:]])
        system = qpmhe.from_casadi(f, h, dt=2.0, states=states)
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(**weights),
            qpmhe.QuadraticCost.from_covariances(**weights), horizon=15,
            initial_state=[600.0, 350.0, 300.0], engine="compiled",
        )
        assert mhe.engine == "compiled"


def test_a_covariance_that_runs_away_is_not_taken_for_wrong_code(script):
    """Sigma points of a quadratic rate, far apart from the start: P grows to 1e85 in six steps.

    The observer's states may still be small then, and twice as large by another rounding.
    """

    def f(x):
        rate = 0.016 * x[..., 0] * x[..., 0] - 0.0064 * x[..., 1]
        return np.stack([x[..., 0] - 2.0 * rate, x[..., 1] + rate], axis=-1)

    system = qpmhe.System(f, lambda x: x[..., :1] + x[..., 1:], n=2, p=1, m=0)
    Q, R = [[0.0232, 0.005], [0.005, 0.0218]], [[0.2]]
    observer = qpmhe.UnscentedKalman(
        prior=[[130470.0, 2468.0], [2468.0, 10151.0]], disturbance=Q, noise=R,
        innovation=qpmhe.HuberInnovation(),
    )
    cost = qpmhe.QuadraticCost.from_covariances(disturbance=Q, noise=R, discount=0.02)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, initial_state=[2.9, 1.0], horizon=30, max_qps=1,
        candidate="reinitialized", engine="compiled",
    )
    assert mhe.engine == "compiled"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [12000077, 12000093, 12000098, 21000020, 21000031])
@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.filterwarnings("ignore::qpmhe.errors.PriorWarning")
def test_rounding_in_a_covariance_is_not_taken_for_wrong_code(seed, script):
    """Extended filters whose covariances have deviations of 1e9 in one direction, 1e-3 in another.

    In the second one a derivative of f is missing at the newest state: neither engine then
    corrects z(t) by a measurement update. The fourth one has a gain, and a metric that settles. In
    the last one, the covariance of a steady filter is the prior's, and correlated to 1 - 1e-9.
    """
    script.does('exec cc "$@"')  # optimised: rounding differs most
    assert Case(seed, "compiled").estimator().engine == "compiled"


@pytest.mark.parametrize(("prior", "lie"), [
    (1e10, "s/mhe_gained(&seen, gain, out);/{ & out[1] *= 1.01; }/"),
    (1e20, "s/mhe_gained(&seen, gain, out);/{ & out[1] *= 1.01; }/"),
    (1e14, "s/mhe_add_disturbance(s, stage, following);//"),
    (1.0, "s/mhe_moved(stage, &seen, gain, out);/& out[1] *= 1.00001;/"),
])
def test_a_vague_prior_hides_no_wrong_code(prior, lie, script, monkeypatch):
    """Position and velocity are correlated to 1 - 1e-12 and more, but a root has their digits."""

    def f(x):
        a, b = x[..., 0], x[..., 1]
        return np.stack([a + 0.1 * b, 0.99 * b - 0.1 * np.sin(a)], axis=-1)

    weights = {"prior": prior * np.eye(2), "disturbance": 0.01 * np.eye(2), "noise": [[0.01]]}
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, lambda x: x[..., :1], n=2, p=1, m=0), qpmhe.ExtendedKalman(**weights),
        qpmhe.QuadraticCost.from_covariances(**weights), horizon=6, initial_state=[0.5, 0.1],
        engine="python",
    )
    monkeypatch.setattr(compiler, "_LEVELS", compiler._LEVELS[-1:])
    script.lies(lie, [PLAIN])
    with pytest.raises(compiler.WrongCodeError, match="pass its check"):
        qpmhe.compile(mhe)
    script.does(RIGHT, "-DTRUE")
    assert qpmhe.compile(mhe).is_new


def test_sigma_points_far_apart_are_not_taken_for_wrong_code(script):
    """Of a state of size 1 with a prior deviation of 1e9, differences of f lose nine digits."""

    def f(x):
        a, b = x[..., 0], x[..., 1]
        return np.stack([0.9 * a + 0.1 * b, 0.8 * b + np.where(a > 0.5, 0.1, -0.1)], axis=-1)

    system = qpmhe.System(
        f, lambda x: x[..., :1] * np.abs(x[..., :1]), n=2, p=1, m=0,
        disturbance_matrix=[[1.08], [2.77]],
    )
    Q, R = [[6.7e-5]], [[9.5e-4]]
    prior = np.array([[5.8e17, 6.4e16], [6.4e16, 4.5e17]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.UnscentedKalman(prior=prior, disturbance=Q, noise=R),
        qpmhe.QuadraticCost.from_covariances(disturbance=Q, noise=R),
        initial_state=[0.63, 0.24], horizon=5, max_qps=1, engine="compiled",
    )
    assert mhe.engine == "compiled"


@pytest.mark.slow
def test_what_is_always_wrong_is_interpreted_or_the_python_step(script, monkeypatch):
    # Of both libraries; the Python step must not use the model's.
    script.lies(f"{STEP_LIES['noises']};{MODEL_LIES['residuals']}", [FAST, MIDDLE, PLAIN])
    for _ in range(2):
        with pytest.warns(EngineWarning, match=r"virtual machine.*residuals"):
            interpreted = system(None)
        with pytest.raises(CompilationError, match="not pass its check at any level"):
            system(compiled=True)
        with pytest.warns(EngineWarning, match="Python step"):
            mhe = estimator(parts=(interpreted, *arguments()[0][1:]), engine="compiled")
        assert mhe.engine == "python"
        is_right(interpreted)
        is_right(mhe)
        assert len(script.calls) == 6  # what is known to be wrong is not compiled again
        monkeypatch.setattr(compiler, "_checked", set())
