#!/bin/sh
# What happens: numpy.array([thing], float) passes on the exception that thing.__float__ raises, until the class gets a
# __getitem__: then NumPy raises its own "setting an array element with a sequence" in place of it.
# Why most guess wrong: neither a length nor an iterator was added; that one can index a scalar makes it a sequence.
# Who meets it: authors of symbols, units and tracers, whose message on why a value has no number disappears.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6
"$folder/venv/bin/python" - <<'PROGRAM'
import numpy


class Plain:
    def __float__(self):
        raise RuntimeError("no number: it is a symbol")


class Indexed(Plain):
    def __getitem__(self, key):
        return self


print("numpy", numpy.__version__)
seen = {}
for kind in (Plain, Indexed):
    try:
        numpy.array([kind()], float)
    except Exception as error:
        seen[kind] = error
        print(f"{kind.__name__:8}", type(error).__name__, "-", error)
assert type(seen[Plain]) is RuntimeError
assert type(seen[Indexed]) is not RuntimeError, "the behaviour has changed: the error is passed on"
PROGRAM
