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

CC = shutil.which("cc")
pytestmark = [
    pytest.mark.skipif(CC is None, reason="there is no C compiler"),
    pytest.mark.skipif(os.name != "posix", reason="the compilers here are shell scripts"),
]
ANSWER = {
    "a.c": '#include "a.h"\nint answer(void) { return NUMBER; }\n', "a.h": "#define NUMBER 42\n"
}
# In a process of its own: a library that is cut kills the one that maps it.
PROGRAM = (
    "from qpmhe.codegen.compiler import compiled_library\n"
    f"assert compiled_library({ANSWER!r}, 'a.c').answer() == 42\n"
)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)


@pytest.fixture
def wrapped(tmp_path, monkeypatch):
    """A compiler that counts its calls: a script around cc, set as CC."""
    def make(body=f'exec "{CC}" "$@"', arguments=""):
        path, log = tmp_path / "my compiler", tmp_path / "calls"
        path.write_text(f'#!/bin/sh\necho "$*" >> "{log}"\n{body}\n')
        path.chmod(0o755)
        monkeypatch.setenv("CC", f"'{path}' {arguments}".strip())

        def calls():
            return log.read_text().splitlines() if log.exists() else []

        return calls

    return make


def answer(files=ANSWER, **options):
    return compiled_library(files, "a.c", **options).answer()


def estimator(factor=0.9, weight=1.0, sets=None, **options):
    ca = pytest.importorskip("casadi")
    x = ca.SX.sym("x", 2)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [factor * x]), ca.Function("h", [x], [x[0]]), compiled=False,
        disturbances=sets,
    )
    cost = qpmhe.QuadraticCost(prior=weight * np.eye(2), disturbance=np.eye(2), noise=weight)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1 * weight, 0.1]), cost, initial_state=np.zeros(2),
        engine="compiled", **{"horizon": 3, **options},
    )


def test_the_cache_is_where_it_was_told(tmp_path, monkeypatch):
    assert answer() == 42
    made = {path.suffix for path in (tmp_path / "cache").iterdir()}
    assert ".so" in made
    assert not any(path.is_dir() for path in (tmp_path / "cache").iterdir())  # no litter
    monkeypatch.delenv("QPMHE_CACHE_DIR")
    assert cache_directory().name == "qpmhe"


@pytest.mark.parametrize("place", [".", "below/here", "with space \u00e9"])
def test_relative_and_unusual_folders(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("QPMHE_CACHE_DIR", place)
    assert answer() == 42
    assert answer() == 42
    assert list((tmp_path / place).glob("*.so"))


def test_cc_is_honoured_with_its_arguments(wrapped):
    calls = wrapped(arguments="-DNUMBER_TWO=7 '-DTEXT=a b'")
    command = find_compiler()
    assert Path(command[0]).name == "my compiler"
    assert command[1:] == ["-DNUMBER_TWO=7", "-DTEXT=a b"]
    assert answer({"a.c": "int answer(void) { return NUMBER_TWO; }\n"}) == 7
    assert len(calls()) == 1
    assert calls()[0].startswith("-DNUMBER_TWO=7 -DTEXT=a b -std=c99")


def test_second_use_does_not_compile_again(wrapped):
    calls = wrapped()
    assert [answer(), answer()] == [42, 42]
    assert len(calls()) == 1
    subprocess.run([sys.executable, "-c", PROGRAM], check=True)
    assert len(calls()) == 1


def test_what_makes_another_library(wrapped):
    calls = wrapped()
    assert answer() == 42
    assert answer({**ANSWER, "a.h": "#define NUMBER 43\n"}) == 43
    assert answer({**ANSWER, "a.c": ANSWER["a.c"] + "\n"}) == 42
    assert answer(key="one") == 42
    assert answer({**ANSWER, "a.h": "#define NUMBER 44\n"}, key="one") == 42  # as the caller says
    assert answer(key="two") == 42
    assert len(calls()) == 5
    wrapped(arguments="-DEXTRA")
    assert answer(key="two") == 42
    assert len(calls()) == 6
    wrapped(f'true\nexec "{CC}" "$@"')  # a compiler that was replaced
    assert answer(key="two") == 42
    assert len(calls()) == 7


def test_model_sizes_and_sets_compile_anew_weights_and_options_do_not(wrapped):
    calls = wrapped()
    box = qpmhe.Box([-1.0, -1.0], [1.0, 1.0])
    estimator()
    assert len(calls()) == 1
    for same in (
        {"weight": 2.0}, {"max_qps": 5, "infeasible": "keep_candidate", "backend": "banded"},
        {"warm_start": True, "delay": 1, "candidate": "reinitialized"},
    ):
        assert estimator(**same).engine == "compiled"
    assert len(calls()) == 1
    for count, other in enumerate(
        ({"factor": 0.8}, {"horizon": 4}, {"sets": box}), start=2
    ):
        assert estimator(**other).engine == "compiled"
        assert len(calls()) == count
    estimator(sets=qpmhe.Box([-2.0, -np.inf], [2.0, 9.0]))
    assert len(calls()) == 4
    one, two = estimator(weight=1.0), estimator(weight=3.0)
    assert one.update([1.0]).cost != two.update([1.0]).cost


def python_warns(**options):
    with pytest.warns(EngineWarning) as caught:
        mhe = estimator(**options)
    assert mhe.engine == "python"
    return str(caught[0].message)


@pytest.mark.parametrize("named", ["/nowhere/cc", "", "no-such-compiler -O2", "cc 'open"])
def test_missing_compiler(named, monkeypatch):
    monkeypatch.setenv("CC", named)
    with pytest.raises(CompilationError, match=r"no C compiler.*CC"):
        answer()
    assert "no C compiler" in python_warns()


def test_no_compiler_on_the_path(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_compiler() is None
    ca = pytest.importorskip("casadi")
    x = ca.SX.sym("x", 2)
    f, h = ca.Function("f", [x], [0.9 * x]), ca.Function("h", [x], [x[0]])
    system = qpmhe.from_casadi(f, h)  # CasADi's virtual machine takes its place
    assert system.f(np.ones(2), np.zeros(0)) == pytest.approx([0.9, 0.9])
    with pytest.raises(CompilationError):
        qpmhe.from_casadi(f, h, compiled=True)


def test_failing_compiler_is_quoted(wrapped, monkeypatch):
    calls = wrapped("echo 'out of cheese' >&2\nexit 1")
    with pytest.raises(CompilationError, match=r"(?s)my compiler.*out of cheese"):
        answer()
    assert 1 <= len(calls()) <= 3
    assert "out of cheese" in python_warns()
    monkeypatch.setenv("CC", CC)
    with pytest.raises(CompilationError, match="NOT_DECLARED"):
        answer({"a.c": "int answer(void) { return NOT_DECLARED; }\n"})


@pytest.mark.parametrize("body", [
    "exit 0",  # writes nothing
    "printf '\\377\\376 m\\303' >&2; exit 1",  # words in no encoding
    "for last; do true; done\nwhile [ $# -gt 1 ]; do [ \"$1\" = -o ] && out=\"$2\"; shift; done\n"
    "echo nonsense > \"$out\"",  # for another machine
    "kill -9 $$",
], ids=["no output", "no encoding", "no library", "killed"])
def test_compilers_of_all_sorts_raise_our_error(body, wrapped, tmp_path):
    wrapped(body)
    with pytest.raises(CompilationError):
        answer()
    assert python_warns()
    assert not any(path.is_dir() for path in (tmp_path / "cache").iterdir())


def test_a_compiler_without_fast_flags_is_asked_again(wrapped):
    calls = wrapped(f'case "$*" in *march*) exit 1;; esac\nexec "{CC}" "$@"')
    assert answer() == 42
    assert len(calls()) == 2
    assert answer() == 42
    assert len(calls()) == 2


DAMAGES = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "no symbol": lambda data: data.replace(b"answer", b"anxwer"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_libraries_are_made_anew(damage, wrapped, tmp_path):
    calls = wrapped()
    subprocess.run([sys.executable, "-c", PROGRAM], check=True)
    path = next((tmp_path / "cache").glob("*.so"))
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    for _ in range(2):
        subprocess.run([sys.executable, "-c", PROGRAM], check=True)
    assert len(calls()) == 2


def test_remains_of_killed_compilations_are_removed(wrapped, tmp_path):
    wrapped()
    cache = tmp_path / "cache"
    names = ["qpmhe-making-old", "qpmhe-making-new", "tmpold"]  # the last may be anyone's
    for name in names:
        (cache / name).mkdir(parents=True)
        (cache / name / "library.so").write_text("half")
    for name in ("qpmhe-making-old", "tmpold"):
        os.utime(cache / name, 2 * (os.stat(cache).st_mtime - 2 * 86400,))
    assert answer() == 42
    left = sorted(path.name for path in cache.iterdir() if path.is_dir())
    assert left == ["qpmhe-making-new", "tmpold"]


def test_two_processes_at_once(wrapped, tmp_path):
    calls = wrapped(f'sleep 0.3\nexec "{CC}" "$@"')
    program = (
        "import sys\nfrom qpmhe.codegen.compiler import compiled_library\n"
        "print('ready', flush=True)\nsys.stdin.readline()\n"
        f"print(compiled_library({ANSWER!r}, 'a.c').answer())\n"
    )
    both = [
        subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    assert [one.stdout.readline() for one in both] == ["ready\n"] * 2
    for one in both:
        one.stdin.write("\n")
        one.stdin.flush()
    assert [one.communicate(timeout=60)[0] for one in both] == ["42\n", "42\n"]
    before = len(calls())
    assert before in (1, 2)
    assert answer() == 42
    assert len(calls()) == before
    assert not any(path.is_dir() for path in (tmp_path / "cache").iterdir())


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Where the temporary folder is."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_a_folder_that_cannot_be_made(elsewhere, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert answer() == 42
    assert list(elsewhere.glob("qpmhe-*/*.so"))


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX only")
def test_a_folder_of_someone_else(elsewhere, tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o777)
    if os.geteuid() == 0:
        os.chown(folder, 12345, 12345)
    else:
        folder.chmod(0o500)
    assert answer() == 42
    assert not list(folder.iterdir())
    private = next(elsewhere.glob("qpmhe-*"))
    assert list(private.glob("*.so"))
    assert private.stat().st_mode & 0o077 == 0
    # And where that one is another's, too.
    shutil.rmtree(private)
    private.write_text("")
    monkeypatch.setattr(compiler, "cache_directory", lambda: folder)
    with pytest.raises(CompilationError, match="QPMHE_CACHE_DIR"):
        answer()


def test_a_full_disk(wrapped, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    wrapped()
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
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert estimator().engine == "compiled"
    assert capfd.readouterr() == ("", "")
