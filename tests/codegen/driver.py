"""A C program that takes the written code through the record of a case, or through a wild one."""

import ctypes
import shutil
import subprocess
from functools import cache

import numpy as np

from qpmhe.codegen import compiler, write
from qpmhe.codegen.library import RunLog, planned

from .cases import case

CC = shutil.which("cc")
FLAGS = tuple(flag for flag in compiler._FLAGS if flag not in ("-shared", "-fPIC"))
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
# With sanitizers GCC 12 warns of indices that loops of one output do not reach; they watch these.
WATCHED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-Wno-array-bounds")
WILD = 40
SAMPLE, AMEND, SET = range(3)

# Reads x0 and events: a kind, a number and parts, each in memory of exactly its size. Writes the
# estimate of each. Every third sample is undone and taken again, and the scratch is spoilt between
# events. Then the record is run by two members, twice, and the log of the second one is written.
DRIVER = r"""
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "mhe.h"

static void *memory(size_t size)
{
    void *made = calloc(1, size + 1);
    if (!made) exit(3);
    return made;
}

static void *part(void)
{
    int32_t size;
    void *where;
    if (fread(&size, sizeof size, 1, stdin) != 1) exit(2);
    if (size == 0) return 0;
    where = malloc((size_t)size);
    if (!where || fread(where, (size_t)size, 1, stdin) != 1) exit(2);
    return where;
}

static void run(mhe_workspace *k, const mhe_real *x0, const mhe_real *ys, const mhe_real *us,
                int64_t count)
{
    const size_t n = 2 * (size_t)count, state = n * MHE_NX * sizeof(mhe_real);
    mhe_estimator *es = memory(2 * sizeof *es);
    mhe_estimate *out = memory(2 * sizeof *out);
    mhe_log log, nothing;
    memset(&log, 0, sizeof log), memset(&nothing, 0, sizeof nothing);
    log.states = memory(state), log.filtered = memory(state), log.delayed = memory(state);
    log.observer_states = memory(state);
    log.costs = memory(n * sizeof(mhe_real)), log.candidate_costs = memory(n * sizeof(mhe_real));
    log.status = memory(n * sizeof(int32_t)), log.qps = memory(n * sizeof(int32_t));
    log.iterations = memory(n * sizeof(int32_t));
    for (int silent = 1; silent >= 0; silent--) {
        for (int i = 0; i < 2; i++) mhe_reset(es + i, &mhe_default_settings, x0);
        mhe_run(es, 2, k, count, ys, us, silent ? &nothing : &log);
    }
    for (int i = 0; i < 2; i++) mhe_reset(es + i, &mhe_default_settings, x0);
    mhe_update_members(es, 2, k, ys, us, out);
    const mhe_real *reals[] = {log.states, log.filtered, log.delayed, log.observer_states};
    for (int i = 0; i < 4; i++)
        fwrite(reals[i] + count * MHE_NX, sizeof(mhe_real), (size_t)count * MHE_NX, stdout);
    fwrite(log.costs + count, sizeof(mhe_real), (size_t)count, stdout);
    fwrite(log.candidate_costs + count, sizeof(mhe_real), (size_t)count, stdout);
    fwrite(log.status + count, sizeof(int32_t), (size_t)count, stdout);
    fwrite(log.qps + count, sizeof(int32_t), (size_t)count, stdout);
    for (int i = 0; i < 4; i++) free((void *)(size_t)reals[i]);
    free(log.costs), free(log.candidate_costs), free(log.status), free(log.qps);
    free(log.iterations), free(es), free(out);
}

int main(void)
{
    mhe_estimator *e = memory(sizeof *e), *before = memory(sizeof *before);
    mhe_workspace *k = memory(sizeof *k);
    mhe_estimate *out = memory(sizeof *out);
    mhe_settings *kept[16] = {0};
    mhe_real x0[MHE_NX], *ys = memory(1), *us = memory(1);
    const size_t real = sizeof(mhe_real), covariance = MHE_HORIZON * MHE_NX * MHE_NX;
    mhe_real *reached = memory(MHE_HORIZON * MHE_NX * real), *spread = memory(covariance * real);
    int64_t count = 0;
    int32_t kind, sets = 0;
    double number;
    if (fread(x0, sizeof x0, 1, stdin) != 1) return 2;
    mhe_reset(e, &mhe_default_settings, x0);
    while (fread(&kind, sizeof kind, 1, stdin) && fread(&number, sizeof number, 1, stdin)) {
        memset(k, 0xbe, sizeof *k);
        if (kind == 0) {
            mhe_sample s;
            void *parts[8];
            size_t latest = (size_t)count++;
            int own = number != 0;
            memset(&s, 0, sizeof s);
            for (int i = 0; i < 8; i++) parts[i] = part(), own |= i > 1 && parts[i];
            s.y = parts[0], s.u = parts[1], s.noise_weight = parts[2];
            s.disturbance_weight = parts[3], s.disturbances = parts[4], s.noises = parts[5];
            s.states = parts[6], s.sampled = parts[7], s.step = (mhe_real)number;
            ys = realloc(ys, real * 2 * (latest + 1) * MHE_NY);
            us = realloc(us, real * 2 * (latest + 1) * MHE_NU + 1);
            if (!ys || !us) return 3;
            memcpy(ys + latest * MHE_NY, s.y, real * MHE_NY);
            if (MHE_NU) memcpy(us + latest * MHE_NU, s.u, real * MHE_NU);
            if (latest % 3 == 2) {
                mhe_update_undoable(e, before, k, &s, out);
                mhe_undo(e, before);
            }
            if (own) mhe_update_special(e, k, &s, out);
            else mhe_update(e, k, s.y, s.u, out);
            for (int i = 0; i < 8; i++) free(parts[i]);
        } else if (kind == 1) {
            mhe_real *y = part();
            const int64_t beyond[] = {-1, e->time, e->time - MHE_HORIZON - 1, INT64_MAX};
            for (int i = 0; i < 4; i++)
                if (mhe_amend(e, k, beyond[i], y, out) != -1) return 4;
            if (mhe_amend(e, k, (int64_t)number, y, out) != 0) return 4;
            free(y);
        } else {
            mhe_settings *settings = kept[sets++] = part();
            int32_t *size = part();
            mhe_real *parameters = part();
            mhe_set(e, k, settings, (int32_t)number, parameters, *size, out);
            free(size), free(parameters);
        }
        fwrite(out, sizeof *out, 1, stdout);
    }
    mhe_recompute(e, reached, spread);
    memcpy(ys + count * MHE_NY, ys, real * (size_t)count * MHE_NY);
    memcpy(us + count * MHE_NU, us, real * (size_t)count * MHE_NU);
    run(k, x0, ys, MHE_NU ? us : 0, count);
    for (int i = 0; i < 16; i++) free(kept[i]);
    free(ys), free(us), free(reached), free(spread), free(e), free(before), free(k), free(out);
    return 0;
}
"""
# In the driver's order.
PARTS = (
    "y", "u", "noise_weight", "disturbance_weight", "disturbances", "noises", "states", "sampled"
)
LOG = ("states", "filtered", "delayed", "observer_states", "costs", "candidate_costs",
       "flags", "qps")


def packed(kind, number, parts):
    """One event as the driver reads it."""
    found = (np.int32(len(one)).tobytes() + one for one in parts)
    return b"".join((np.int32(kind).tobytes(), np.float64(number).tobytes(), *found))


@cache
def recorded(name):
    """The start, the events as C gets them, and the estimates that C makes of them."""
    one = case(name)
    mhe = one.estimator("compiled")
    engine, events, results = mhe._engine, [], []
    library, start = engine._library, mhe.state
    update, amend, change = engine._call, library.amend, library.set

    def updated(memory, before, workspace, sample, out):
        record = engine._own if sample.value == engine._own.record.ctypes.data else engine._plain
        fields = record.record[0]
        sizes = {name: array.nbytes for name, array in record._arrays.items()} | {
            "y": 8 * one.system.p, "u": 8 * one.system.m
        }
        events.append((SAMPLE, float(fields["step"]), [
            ctypes.string_at(int(fields[part]), sizes[part]) if fields[part] else b""
            for part in PARTS
        ]))
        update(memory, before, workspace, sample, out)
        results.append(engine._out[0].copy())

    def amended(memory, workspace, time, y, out):
        events.append((AMEND, time, [engine._y.tobytes()]))
        amend(memory, workspace, time, y, out)
        results.append(engine._out[0].copy())

    def changed(memory, workspace, settings, changes, parameters, count, out):
        kept = np.frombuffer(
            ctypes.string_at(settings.value, library.settings.nbytes), library.settings.dtype
        ).copy()
        if library.layout.clock:
            kept["clock"] = 0
        given = b"" if parameters is None else ctypes.string_at(parameters.value, 8 * count)
        events.append((SET, changes, [kept.tobytes(), np.int32(count).tobytes(), given]))
        change(memory, workspace, settings, changes, parameters, count, out)
        results.append(engine._out[0].copy())

    engine._call, library.amend, library.set = updated, amended, changed
    for t, sample in enumerate(one.samples):
        mhe.update(**sample)
        if t in one.changes:
            mhe.set(**one.changes[t])
        if t % 9 == 8:
            late = np.resize(sample["y"], one.system.p) + 0.1
            mhe.amend(t - min(3, one.options["horizon"] - 1), late)
    return start, events, np.array(results)


def wild(name):
    """Samples with anything in them: missing, infinite, huge, far off, irregular."""
    one, (_, events, _) = case(name), recorded(name)
    samples = [event[1:] for event in events if event[0] == SAMPLE]
    generator, found = np.random.default_rng(len(name)), []
    for t in range(WILD):
        step, parts = samples[generator.integers(len(samples))]
        y = np.frombuffer(parts[0]).copy()
        scale = generator.choice([1.0, 10.0, 1e6, 1e30, 1e200, 1e308], p=[0.6, *[0.08] * 5])
        with np.errstate(over="ignore"):
            y *= scale * generator.uniform(-1.0, 1.0, y.size)
        y[generator.random(y.size) < 0.1] = generator.choice([np.nan, np.inf, -np.inf, 0.0])
        u = np.frombuffer(parts[1]) * generator.choice([1.0, -3.0, 1e9], p=[0.8, 0.15, 0.05])
        if one.system.dt and t % 4 == 1:
            step = generator.choice([0.1, 1.0, 3.0]) * one.system.dt
        found.append((SAMPLE, step, [y.tobytes(), u.tobytes(), *parts[2:]]))
    return found


def built(name, folder, flags, command=CC, real="double"):
    """The program of a case, made with these flags."""
    write(case(name).estimator("python"), folder, real=real)
    (folder / "main.c").write_text(DRIVER)
    program = folder / "main"
    subprocess.run(
        [command, "-std=c99", *flags, "-o", program, "main.c", "mhe.c", "-lm"], cwd=folder,
        check=True,
    )
    return program


def driven(program, name, start, events, real="double"):
    """The estimates of all events, and the log of a run, by name."""
    done = subprocess.run(
        [program], input=start.tobytes() + b"".join(packed(*event) for event in events),
        capture_output=True, check=False, timeout=120,
    )
    assert done.returncode == 0, done.stderr.decode()
    one = case(name).estimator("python")
    layout, _ = planned(one.system, one.observer, one.cost, one.settings, real)
    kind = layout.estimate_type()
    size, count = len(events) * kind.itemsize, sum(event[0] == SAMPLE for event in events)
    estimates = np.frombuffer(done.stdout[:size], kind)
    offset, log = size, RunLog((count,), one.system.n, 0)
    for part in LOG:
        shape = getattr(log, part).shape
        number = np.dtype(np.int32 if part in ("flags", "qps") else layout.number)
        length = int(np.prod(shape))
        values = np.frombuffer(done.stdout, number, length, offset)
        setattr(log, part, values.reshape(shape))
        offset += length * number.itemsize
    assert offset == len(done.stdout)
    return estimates, log


def same_estimates(found, expected, tolerance, statuses=True):
    """Whether the estimates of two records agree, as far as their windows reach."""
    for one, other in zip(found, expected, strict=True):
        assert one["cost"] <= one["candidate_cost"]
        for name in ("time", "length", "status", "qps", "nearest_points")[: 5 if statuses else 2]:
            assert one[name] == other[name], name
        length = int(other["length"])
        for name, states in (
            ("trajectory", 1), ("candidate", 1), ("disturbances", 0), ("noises", 0),
        ):
            same(one[name][: length + states], other[name][: length + states], tolerance, name)
        for name in ("filtered", "observer_state", "cost", "candidate_cost"):
            same(one[name], other[name], tolerance, name)


def same(found, expected, tolerance, name=""):
    """Equality up to rounding, relative to the largest of the finite numbers."""
    size = 1.0 + np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance * size, err_msg=name)
