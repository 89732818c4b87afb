"""What the written C says that it needs: bounds that no step exceeds, and measured sizes."""

import pickle
import shutil
import subprocess

import numpy as np
import pytest

from qpmhe import codegen
from qpmhe.codegen.needs import stack_of
from qpmhe.errors import CompilationError, OptionError

from .cases import case
from .clean import wild
from .test_write import linear
from .test_written import DRIVER, estimates

pytestmark = [
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
COUNTS = ("qps", "corrections", "nearest_points", "iterations")


@pytest.mark.parametrize(("name", "cap"), [
    ("inputs", None), ("restored", 3), ("states in a polytope", 2), ("soft states", 1),
    ("restored", None), ("mixed losses", 2), ("fewer disturbances in sets", 2),
    ("soft states", None), ("held in sets", 1), ("graduated reinitialized", 2),
])
def test_no_step_takes_more_than_is_said(name, cap, tmp_path):
    """Nor do the active set and the interior point together take more iterations than the cap."""
    one = case(name).with_options(max_solver_iterations=cap)
    samples = [
        sample | {"y": np.resize(sample["y"], one.system.p)}
        for sample in (*one.samples, *wild(one))
    ]
    needs = codegen.write(one.estimator("python"), tmp_path).needs
    found = estimates(one, samples, tmp_path, ("-O1",))
    header = (tmp_path / "mhe.h").read_text()
    for count in COUNTS:
        most = getattr(needs, count)
        assert found[count].max() <= most, count
        assert f"#define MHE_MOST_{count.upper()} {most}\n" in header
    solved = found["qps"] + found["corrections"] + found["nearest_points"]
    # Few are solved again with a ridge; none where roots need no ridge.
    within = found["iterations"] <= (cap or 50) * solved
    assert within.all() if "fewer" in name else within.mean() > 0.9
    assert (found["iterations"] <= 2 * (cap or 50) * solved).all()
    if needs.iterations:
        assert found["iterations"].max() > 0


@pytest.mark.slow
def test_sizes_are_those_of_the_compiler(tmp_path):
    mhe = linear(horizon=4, max_qps=2)
    written = codegen.write(mhe, tmp_path, compiler="cc -O1")
    needs, (header, _) = written.needs, written
    assert (needs.qps, needs.corrections, needs.nearest_points, needs.iterations) == (2, 0, 0, 0)
    text = " ".join(header.read_text().replace("\n *", "").split())
    assert f"As `cc -O1` compiles it: {needs.memory} bytes of memory; {needs.code} of code" in text
    driver = DRIVER.partition("int main")[0] + (
        'int main(void) { printf("%d", (int)MHE_MEMORY); return sizeof e + sizeof k + sizeof out '
        "== MHE_MEMORY ? 0 : 1; }\n"
    )
    (tmp_path / "main.c").write_text(driver)
    subprocess.run(["cc", "-o", "main", "main.c"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True)
    assert int(done.stdout) == needs.memory
    single = codegen.write(mhe, tmp_path, compiler="cc -O1", real="float").needs
    assert needs.memory / 2 < single.memory < 0.7 * needs.memory
    assert needs.code > 1000
    assert codegen.write(mhe, tmp_path).needs.memory is None
    copied = pickle.loads(pickle.dumps(written))
    assert (copied, copied.needs) == (written, needs)
    accents = codegen.write(mhe, tmp_path, compiler="cc -DNAME=é").needs
    assert accents.memory == needs.memory
    if needs.stack is not None:  # by GCC
        assert 100 < needs.frame < needs.stack < 100_000


@pytest.mark.parametrize("compiler", ["no-such-compiler -O2", "", "cc 'open", 3])
def test_compilers_that_are_none(compiler, tmp_path):
    with pytest.raises(OptionError, match=r"compiler is .*expected the command of a C compiler"):
        codegen.write(linear(), tmp_path / "out", compiler=compiler)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_compilers_that_fail(tmp_path):
    for compiler in (
        "cc -no-such-option-at-all", "cc -O1 -ffast-math", "false", "true", "cc -S", "cc -o one.o",
    ):
        with pytest.raises(CompilationError, match="does not compile"):
            codegen.write(linear(), tmp_path, compiler=compiler)


def test_calls_by_pointers_are_any_of_those_that_nobody_names():
    sizes = {"f": 8, "a.c:g": 100, "a.c:h": 20, "a.c:by_pointer": 300, "other": 5000}
    calls = [("f", "a.c:g"), ("f", "a.c:h"), ("a.c:h", "__indirect_call"), ("other", "f")]
    graph = "".join(
        f'node: {{ title: "{one}" label: "{one}\\na.c:1:2\\n{size} bytes (static)" }}\n'
        for one, size in sizes.items()
    ) + "".join(
        f'edge: {{ sourcename: "{one}" targetname: "{two}" label: "a.c:3:4" }}\n'
        for one, two in calls
    )
    assert stack_of(graph, "f") == {"stack": 328, "frame": 300}
    assert stack_of(graph, "a.c:g") == {"stack": 100, "frame": 100}
