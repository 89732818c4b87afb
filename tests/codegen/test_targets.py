"""The written C on other processors, emulated: what the page on microcontrollers says."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from qpmhe import codegen
from qpmhe.codegen.library import planned

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "microcontroller.md"
SAMPLES = 500
# Compiler and options, emulator, precision; the page says the first two.
TARGETS = {
    "cortex-m7": (
        "arm-none-eabi-gcc", "-mcpu=cortex-m7 -mfpu=fpv5-d16 -mfloat-abi=hard",
        "qemu-system-arm -machine mps2-an500", "double",
    ),
    "cortex-m4": (
        "arm-none-eabi-gcc", "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard",
        "qemu-system-arm -machine mps2-an386", "float",
    ),
    "aarch64": ("aarch64-linux-gnu-gcc", "-static", "qemu-aarch64", "double"),
    "aarch64 single": ("aarch64-linux-gnu-gcc", "-static", "qemu-aarch64", "float"),
}
BOARD = "--specs=rdimon.specs -nostartfiles -T board.ld"
HOST = "-nographic -monitor none -serial none -semihosting-config enable=on,target=native -kernel"
# What a speed, a current and a load of this motor are of the order of.
UNITS = np.array([100.0, 10.0, 0.1])


def block(start):
    """The block of the page whose info string starts so, or the Python that makes the estimator."""
    text = re.search(rf"^```{re.escape(start)}\n(.*?)^```", PAGE.read_text(), re.M | re.S)[1]
    return text.partition("written =")[0]


def motor(bounded=True, **options):
    """The page's estimator, with other options."""
    names = {}
    exec(block("python"), names)
    mhe = names["mhe"]
    system = mhe.system if bounded else mhe.system.with_sets({"states": None})
    return type(mhe)(
        system, mhe.observer, mhe.cost, horizon=20, initial_state=[0.0, 0.0, 0.05],
        **{"max_qps": 2, "engine": "python"} | options,
    )


def record(system):
    generator, x, ys = np.random.default_rng(0), np.zeros(3), []
    us = np.where(np.arange(SAMPLES) // 125 % 2, 6.0, 12.0)[:, None]
    for t, u in enumerate(us):
        x[2] = 0.2 * (t >= SAMPLES // 2)
        ys.append(system.h(x, u) + 0.1 * generator.standard_normal(1))
        x = system.f(x, u)
    return np.array(ys), us


def needed(compiler, emulator):
    for tool in (compiler, emulator.split()[0]):
        if shutil.which(tool) is None:
            pytest.skip(f"there is no {tool}")


def write_program(mhe, ys, us, folder):
    """The page's files, and a record."""
    texts = [f"#define SAMPLES {len(ys)}"] + [
        f"static const drive_real {one}[][{rows.shape[1]}] = {{" + ",".join(
            "{" + ",".join(float(value).hex() for value in row) + "}" for row in rows
        ) + "};" for one, rows in (("y", ys), ("u", us))
    ]
    start = ",".join(float(value).hex() for value in mhe.initial_state)
    (folder / "samples.h").write_text("\n".join(
        [*texts, f"static const drive_real start[] = {{{start}}};\n"]
    ))
    for file, info in (("main.c", "c"), ("start.c", "c"), ("board.ld", "text")):
        (folder / file).write_text(block(f'{info} title="{file}"'))


def run(folder, compiler, flags, emulator):
    is_board = emulator.startswith("qemu-system")
    sources = ["main.c", "drive.c", *(["start.c"] if is_board else [])]
    command = [compiler, "-std=gnu99", "-Os", *flags.split(), *(BOARD.split() if is_board else [])]
    subprocess.run([*command, *sources, "-lm", "-o", "drive.elf"], cwd=folder, check=True)
    emulated = [*emulator.split(), *(HOST.split() if is_board else []), "./drive.elf"]
    subprocess.run(emulated, cwd=folder, check=True, timeout=200, stdin=subprocess.DEVNULL)


def on_target(name, mhe, ys, us, folder):
    """The estimates of the written code, as an emulator runs it, and what it says that it needs."""
    compiler, flags, emulator, real = TARGETS[name]
    needed(compiler, emulator)
    needs = codegen.write(
        mhe, folder, name="drive", real=real, compiler=f"{compiler} {flags} -Os"
    ).needs
    write_program(mhe, ys, us, folder)
    run(folder, compiler, flags, emulator)
    layout, _ = planned(mhe.system, mhe.observer, mhe.cost, mhe.settings, real)
    found = np.frombuffer((folder / "estimates.bin").read_bytes(), layout.estimate_type())
    assert len(found) == len(ys)
    return found, needs


@pytest.mark.slow
@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("name", TARGETS)
def test_a_target_is_the_python_step(name, bounded, tmp_path):
    mhe = motor()
    ys, us = record(mhe.system)
    if not bounded:
        mhe = motor(bounded=False)
    elif TARGETS[name][3] == "double":  # whose solutions of QPs are exact, as those in C are
        pytest.importorskip("daqp")
        mhe = motor(backend="daqp")
    found, needs = on_target(
        name, motor() if bounded else mhe, ys, us, tmp_path
    )
    run = mhe.run(ys, us)
    assert (found["cost"] <= found["candidate_cost"]).all()
    states = np.stack([one["trajectory"][one["length"]] for one in found])
    errors = np.abs(states - run.states[1:]) / UNITS
    if TARGETS[name][3] == "double":
        assert errors.mean() < 1e-12
        np.testing.assert_array_equal(found["status"], [one.value for one in run.statuses])
        np.testing.assert_allclose(found["cost"], run.costs, 1e-8, 1e-9)
    else:
        assert errors.mean() < 5e-4
    for count in ("qps", "corrections", "nearest_points", "iterations"):
        assert found[count].max() <= getattr(needs, count)
    assert bounded == (found["iterations"].max() > 0)


@pytest.mark.slow
def test_the_stack_is_as_deep_as_is_said(tmp_path):
    """Of a stack full of marks, the record overwrites no more, and most of it."""
    mhe = motor()
    ys, us = record(mhe.system)
    _, needs = on_target("cortex-m7", mhe, ys[:60], us[:60], tmp_path)
    main = (tmp_path / "main.c").read_text()
    main = main.replace("int main(void)", """
static unsigned deepest;
static void watched(const drive_real *y, const drive_real *u)
{
    unsigned *bottom, *at;
    __asm volatile("mov %0, sp" : "=r"(bottom));
    for (at = bottom - 4000; at < bottom - 8; at++) *at = 0xA5A5A5A5;
    drive_update(&estimator, &workspace, y, u, &estimate);
    for (at = bottom - 4000; *at == 0xA5A5A5A5; at++) ;
    if ((unsigned)(bottom - at) > deepest) deepest = bottom - at;
}

int main(void)""").replace(
        "drive_update(&estimator, &workspace, y[t], u[t], &estimate);\n", "watched(y[t], u[t]);\n"
    ).replace("fwrite(&estimate, sizeof estimate, 1, out)", "(void)0").replace(
        "return fclose", "fwrite(&deepest, sizeof deepest, 1, out);\n    return fclose"
    )
    (tmp_path / "main.c").write_text(main)
    run(tmp_path, *TARGETS["cortex-m7"][:3])
    deepest = 4 * int(np.frombuffer((tmp_path / "estimates.bin").read_bytes(), np.uint32)[0])
    assert 0.5 * needs.stack < deepest <= needs.stack + 64  # and the saved registers of the caller


# What a Cortex-M3 calls for each operation in double precision.
CALLS = [f"__aeabi_{one}" for one in ("dadd", "dsub", "drsub", "dmul", "ddiv")]


@pytest.mark.slow
@pytest.mark.parametrize(("options", "least", "most"), [
    ({"bounded": False, "max_qps": 0}, 700, 760), ({"bounded": False, "max_qps": 1}, 8_200, 8_900),
    ({"bounded": False, "max_qps": 2}, 24_500, 26_500), ({}, 26_000, 115_000),
])
def test_operations_of_a_step(options, least, most, tmp_path):
    """As many as the page says, once the window is full."""
    tools = "arm-none-eabi-gcc", "qemu-system-arm -machine mps2-an385"
    needed(*tools)
    mhe = motor(**options)
    ys, us = record(mhe.system)
    codegen.write(mhe, tmp_path, name="drive")
    write_program(mhe, ys[:200], us[:200], tmp_path)
    counting = "static unsigned count;\n" + "".join(
        f"double __real_{one}(double, double);\ndouble __wrap_{one}(double a, double b)\n"
        f"{{\n    count++;\n    return __real_{one}(a, b);\n}}\n" for one in CALLS
    )
    main = (tmp_path / "main.c").read_text()
    main = main.replace("int main(void)", f"{counting}int main(void)").replace(
        "fwrite(&estimate, sizeof estimate, 1, out);", "fwrite(&count, 4, 1, out), count = 0;"
    )
    (tmp_path / "main.c").write_text(main)
    start = (tmp_path / "start.c").read_text()
    (tmp_path / "start.c").write_text(re.sub(r".*CPACR.*\n", "", start))  # it has no FPU
    run(tmp_path, tools[0], "-mcpu=cortex-m3 -Wl," + ",".join(
        f"--wrap={one}" for one in CALLS), tools[1])
    found = np.frombuffer((tmp_path / "estimates.bin").read_bytes(), np.uint32)[25:]
    assert least < np.median(found) < most
    assert found.max() < most
    assert found.min() > least
