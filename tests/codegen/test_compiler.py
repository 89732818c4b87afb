"""The compiler and the cache: who compiles, how often, and what becomes of bad luck."""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler
from qpmhe.codegen.compiler import cache_directory, compiled_library, find_compiler
from qpmhe.errors import CompilationError, EngineWarning

from .scripts import CC, RIGHT, Script, needed

ca = pytest.importorskip("casadi")
pytestmark = needed
ANSWER = {
    "a.c": '#include "a.h"\nint answer(void) { return NUMBER; }\n', "a.h": "#define NUMBER 42\n"
}
# In a process of its own: a library that is cut kills the one that maps it.
PROGRAM = (
    "import sys\nfrom qpmhe.codegen.compiler import compiled_library\n"
    "print('ready', flush=True)\nsys.stdin.readline()\n"
    f"print(compiled_library({ANSWER!r}, 'a.c').answer())\n"
)


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


@pytest.fixture(autouse=True)
def script(tmp_path, cache, monkeypatch):
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(cache))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return Script(tmp_path, monkeypatch, "my compiler")


def answer(files=ANSWER, **options):
    return compiled_library(files, "a.c", **options).answer()


def elsewhere():
    """A process that asks for the answer."""
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, input="\n", text=True)


def estimator():
    x = ca.SX.sym("x", 2)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [0.9 * x]), ca.Function("h", [x], [x[0]]), compiled=False
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1, 0.1]), cost, horizon=3, initial_state=np.zeros(2),
        engine="compiled",
    )


def no_litter(cache):
    return not any(path.is_dir() for path in cache.iterdir())


def test_the_cache_is_where_it_is_set(cache, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place in (str(cache), ".", "below/here", "with space \u00e9"):
        monkeypatch.setenv("QPMHE_CACHE_DIR", place)
        assert [answer(), answer()] == [42, 42]
        assert list(Path(place).glob("*.so"))
    assert no_litter(cache)
    monkeypatch.delenv("QPMHE_CACHE_DIR")
    assert cache_directory().name == "qpmhe"


def test_what_makes_another_library(script):
    script.does(RIGHT, "-DNUMBER_TWO=7 '-DTEXT=a b'")
    command = find_compiler()
    assert Path(command[0]).name == "my compiler"
    assert command[1:] == ["-DNUMBER_TWO=7", "-DTEXT=a b"]
    assert answer({"a.c": "int answer(void) { return NUMBER_TWO; }\n"}) == 7
    assert script.calls[0].startswith("-DNUMBER_TWO=7 -DTEXT=a b -std=c99")
    changed = {**ANSWER, "a.h": "#define NUMBER 43\n"}
    for count, (files, options, expected) in enumerate((
        (ANSWER, {}, 42), (changed, {}, 43), ({**ANSWER, "a.c": ANSWER["a.c"] + "\n"}, {}, 42),
        (ANSWER, {"key": "one"}, 42), (ANSWER, {"key": "two"}, 42),
    ), start=2):
        assert [answer(files, **options) for _ in range(2)] == [expected] * 2
        assert len(script.calls) == count
    assert answer(changed, key="one") == 42  # as the caller says
    elsewhere()
    script.does(RIGHT, "-DEXTRA")
    assert answer(key="two") == 42
    with script.path.open("a") as file:  # a compiler that was replaced
        file.write("\n")
    assert answer(key="two") == 42
    assert len(script.calls) == 8


def python_warns():
    with pytest.warns(EngineWarning) as caught:
        mhe = estimator()
    assert mhe.engine == "python"
    return str(caught[0].message)


def test_missing_compiler(monkeypatch, tmp_path):
    for named in ("/nowhere/cc", "", "no-such-compiler -O2", "cc 'open"):
        monkeypatch.setenv("CC", named)
        with pytest.raises(CompilationError, match=r"no C compiler.*CC"):
            answer()
        assert "no C compiler" in python_warns()
    monkeypatch.delenv("CC")
    assert find_compiler() is not None
    monkeypatch.setenv("PATH", str(tmp_path / "cache"))
    assert find_compiler() is None
    x = ca.SX.sym("x", 2)
    f, h = ca.Function("f", [x], [0.9 * x]), ca.Function("h", [x], [x[0]])
    system = qpmhe.from_casadi(f, h)  # CasADi's virtual machine takes its place
    assert system.f(np.ones(2), np.zeros(0)) == pytest.approx([0.9, 0.9])
    with pytest.raises(CompilationError):
        qpmhe.from_casadi(f, h, compiled=True)


@pytest.mark.parametrize(("body", "words"), [
    ("echo 'out of cheese' >&2\nexit 1", "out of cheese"),
    ("exit 0", ""),  # writes nothing
    ("printf '\\377\\376 m\\303' >&2; exit 1", ""),  # words in no encoding
    ("for last; do true; done\nwhile [ $# -gt 1 ]; do [ \"$1\" = -o ] && out=\"$2\"; shift; done\n"
     "echo nonsense > \"$out\"", ""),  # for another machine
    ("kill -9 $$", ""),
], ids=["fails", "no output", "no encoding", "no library", "killed"])
def test_compilers_of_all_sorts_raise_our_error(body, words, script, cache, monkeypatch):
    script.does(body)
    with pytest.raises(CompilationError, match=f"(?s){words and 'my compiler.*'}{words}"):
        answer()
    assert 1 <= len(script.calls) <= 3
    assert words in python_warns()
    assert no_litter(cache)
    monkeypatch.setenv("CC", CC)
    with pytest.raises(CompilationError, match="NOT_DECLARED"):
        answer({"a.c": "int answer(void) { return NOT_DECLARED; }\n"})


def test_a_compiler_without_fast_flags_is_asked_again(script):
    script.does(f'case "$*" in *march*) exit 1;; esac\n{RIGHT}')
    assert [answer(), answer()] == [42, 42]
    assert len(script.calls) == 2


@pytest.mark.parametrize("damage", [
    lambda data: b"", lambda data: data[: len(data) // 2],
    lambda data: data.replace(b"answer", b"anxwer"),
], ids=["empty", "cut", "no symbol"])
def test_damaged_libraries_are_made_anew(damage, script, cache):
    elsewhere()
    path = next(cache.glob("*.so"))
    path.write_bytes(damage(path.read_bytes()))
    elsewhere()
    elsewhere()
    assert len(script.calls) == 2


def test_remains_of_killed_compilations_are_removed(cache):
    names = ["qpmhe-making-old", "qpmhe-making-new", "tmpold"]  # the last may be anyone's
    for name in names:
        (cache / name).mkdir(parents=True)
        (cache / name / "library.so").write_text("half")
    for name in ("qpmhe-making-old", "tmpold"):
        os.utime(cache / name, 2 * (os.stat(cache).st_mtime - 2 * 86400,))
    assert answer() == 42
    left = sorted(path.name for path in cache.iterdir() if path.is_dir())
    assert left == ["qpmhe-making-new", "tmpold"]


def test_two_processes_at_once(script, cache):
    script.does(f"sleep 0.3\n{RIGHT}")
    both = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    assert [one.stdout.readline() for one in both] == ["ready\n"] * 2
    for one in both:
        one.stdin.write("\n")
        one.stdin.flush()
    assert [one.communicate(timeout=60)[0] for one in both] == ["42\n", "42\n"]
    before = len(script.calls)
    assert before in (1, 2)
    assert answer() == 42
    assert len(script.calls) == before
    assert no_litter(cache)


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX only")
def test_folders_that_cannot_be_used(cache, tmp_path, monkeypatch):
    cache.mkdir(mode=0o777)
    if os.geteuid() == 0:  # someone else's
        os.chown(cache, 12345, 12345)
    else:
        cache.chmod(0o500)
    (tmp_path / "file").write_text("")
    for folder in (cache, tmp_path / "file" / "below"):
        monkeypatch.setenv("QPMHE_CACHE_DIR", str(folder))
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


def test_a_full_disk(monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    for place in ((tempfile, "TemporaryDirectory"), (os, "replace"), (Path, "write_text")):
        with monkeypatch.context() as patch:
            patch.setattr(*place, full)
            with pytest.raises(CompilationError, match="space left"):
                answer()
    assert answer() == 42


def test_infinities_and_nans_survive_the_flags():
    source = (
        "#include <math.h>\n"
        "double nothing(double x) { return isfinite(x) ? 1 : isnan(x) ? 2 : 3; }\n"
    )
    library = compiled_library({"a.c": source}, "a.c")
    library.nothing.restype, library.nothing.argtypes = ctypes.c_double, [ctypes.c_double]
    assert [library.nothing(x) for x in (0.0, np.nan, np.inf, -np.inf)] == [1.0, 2.0, 3.0, 3.0]


def test_compiling_is_silent(capfd):
    with warnings.catch_warnings(action="error"):
        assert estimator().engine == "compiled"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("note", ["", "x", "-1\n", "99\nall of it", "1"])
def test_damaged_notes(note, cache):
    assert answer() == 42
    path = next(cache.glob("*.so"))
    (cache / f"{path.stem[:-2]}.level").write_text(note)
    if note.startswith("99"):
        with pytest.raises(compiler.WrongCodeError, match="all of it"):
            answer()
    else:
        assert answer() == 42
