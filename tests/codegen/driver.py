"""A C program that drives the written code with the samples of a case, or with wild ones."""

import ctypes
import shutil
import subprocess
from functools import cache

import numpy as np

from qpmhe.codegen import compiler, write

from .cases import case

CC = shutil.which("cc")
FLAGS = tuple(flag for flag in compiler._FLAGS if flag not in ("-shared", "-fPIC"))
WILD = 40

# Reads x0 and samples, each with what is its own in memory of exactly its size; writes J, J of
# the candidate and the newest state of each. Every third sample is undone and taken again.
DRIVER = r"""
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "mhe.h"

static int part(void **where)
{
    int32_t size;
    *where = 0;
    if (fread(&size, sizeof size, 1, stdin) != 1) return 0;
    if (size == 0) return 1;
    *where = malloc((size_t)size);
    return *where && fread(*where, (size_t)size, 1, stdin) == 1;
}

int main(void)
{
    mhe_estimator *e = malloc(sizeof *e), *before = malloc(sizeof *before);
    mhe_workspace *k = calloc(1, sizeof *k);
    mhe_estimate *out = malloc(sizeof *out);
    double x0[MHE_NX];
    double *reached = malloc(sizeof(double) * MHE_HORIZON * MHE_NX);
    double *covariances = malloc(sizeof(double) * MHE_HORIZON * MHE_NX * MHE_NX);
    double *ys = 0, *us = 0;
    int64_t count = 0;
    void *parts[8];
    if (fread(x0, sizeof x0, 1, stdin) != 1) return 2;
    mhe_reset(e, &mhe_default_settings, x0);
    for (;; count++) {
        mhe_sample s;
        int read = 1;
        memset(&s, 0, sizeof s);
        for (int i = 0; i < 8 && read; i++) read = part(parts + i);
        if (!read || fread(&s.step, sizeof s.step, 1, stdin) != 1) break;
        s.y = parts[0], s.u = parts[1], s.noise_weight = parts[2];
        s.disturbance_weight = parts[3], s.disturbances = parts[4], s.noises = parts[5];
        s.states = parts[6], s.sampled = parts[7];
        ys = realloc(ys, sizeof(double) * (size_t)(count + 1) * MHE_NY);
        memcpy(ys + count * MHE_NY, s.y, sizeof(double) * MHE_NY);
#if MHE_NU
        us = realloc(us, sizeof(double) * (size_t)(count + 1) * MHE_NU);
        memcpy(us + count * MHE_NU, s.u, sizeof(double) * MHE_NU);
#endif
        if (count % 3 == 2) {
            mhe_update_undoable(e, before, k, &s, out);
            mhe_undo(e, before);
        }
        mhe_update_special(e, k, &s, out);
        for (int i = 0; i < 8; i++) free(parts[i]);
        fwrite(&out->cost, sizeof(double), 1, stdout);
        fwrite(&out->candidate_cost, sizeof(double), 1, stdout);
        fwrite(out->trajectory + out->length * MHE_NX, sizeof(double), MHE_NX, stdout);
    }
    mhe_recompute(e, reached, covariances);
    mhe_amend(e, k, e->time - 2, ys, out);
    mhe_reset(e, &mhe_default_settings, x0);
    mhe_log log;
    memset(&log, 0, sizeof log);
    log.costs = malloc(sizeof(double) * (size_t)count);
    log.delayed = malloc(sizeof(double) * (size_t)count * MHE_NX);
    mhe_run(e, 1, k, count, ys, us, &log);
    free(log.costs), free(log.delayed), free(ys), free(us), free(reached), free(covariances);
    free(e), free(before), free(k), free(out);
    return 0;
}
"""
# In the driver's order.
PARTS = (
    "y", "u", "noise_weight", "disturbance_weight", "disturbances", "noises", "states", "sampled"
)


def packed(parts, step):
    """One sample as the driver reads it."""
    found = (np.int32(len(one)).tobytes() + one for one in parts)
    return b"".join((*found, np.float64(step).tobytes()))


@cache
def recorded(name):
    """The start, the samples as C gets them, and what the engine makes of them."""
    one = case(name)
    mhe = one.estimator("compiled")
    engine, samples, results = mhe._engine, [], []
    start, call = mhe.state, engine._call

    def watched(memory, before, workspace, sample, out):
        record = engine._own if sample.value == engine._own.record.ctypes.data else engine._plain
        fields = record.record[0]
        sizes = {name: array.nbytes for name, array in record._arrays.items()} | {
            "y": 8 * one.system.p, "u": 8 * one.system.m
        }
        parts = [
            ctypes.string_at(int(fields[part]), sizes[part]) if fields[part] else b""
            for part in PARTS
        ]
        samples.append((parts, float(fields["step"])))
        call(memory, before, workspace, sample, out)

    engine._call = watched
    for sample in one.samples:
        found = mhe.update(**sample)
        results.append((found.cost, found.candidate_cost, *found.state))
    return start, samples, np.array(results)


def wild(name):
    """Samples with anything in them: missing, infinite, huge, far off, irregular."""
    one, (_, samples, _) = case(name), recorded(name)
    generator, found = np.random.default_rng(len(name)), []
    for t in range(WILD):
        parts, step = samples[generator.integers(len(samples))]
        y = np.frombuffer(parts[0]).copy()
        scale = generator.choice([1.0, 10.0, 1e6, 1e30, 1e200, 1e308], p=[0.6, *[0.08] * 5])
        with np.errstate(over="ignore"):
            y *= scale * generator.uniform(-1.0, 1.0, y.size)
        y[generator.random(y.size) < 0.1] = generator.choice([np.nan, np.inf, -np.inf, 0.0])
        u = np.frombuffer(parts[1]) * generator.choice([1.0, -3.0, 1e9], p=[0.8, 0.15, 0.05])
        if one.system.dt and t % 4 == 1:
            step = generator.choice([0.1, 1.0, 3.0]) * one.system.dt
        found.append(([y.tobytes(), u.tobytes(), *parts[2:]], step))
    return found


def built(name, folder, flags, command=CC):
    """The program of a case, made with these flags."""
    write(case(name).estimator("compiled"), folder)
    (folder / "main.c").write_text(DRIVER)
    program = folder / "main"
    subprocess.run(
        [command, "-std=c99", *flags, "-o", program, "main.c", "mhe.c", "-lm"], cwd=folder,
        check=True,
    )
    return program


def driven(program, start, samples):
    """J, J of the candidate and the newest state after each sample."""
    done = subprocess.run(
        [program], input=start.tobytes() + b"".join(packed(*sample) for sample in samples),
        capture_output=True, check=False, timeout=120,
    )
    assert done.returncode == 0, done.stderr.decode()
    return np.frombuffer(done.stdout).reshape(len(samples), -1)
