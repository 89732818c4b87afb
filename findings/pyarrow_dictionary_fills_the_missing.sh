#!/bin/sh
# What happens: ChunkedArray.to_numpy() of a dictionary-encoded column puts the last entry of the dictionary where a value
# is missing; Array.to_numpy() of the same values has None there, ChunkedArray.to_pandas() NaN.
# Why most guess wrong: three conversions of one column differ, and the values that come are valid ones of the column.
# Who meets it: whoever reads categories from Parquet (a Table's column is a ChunkedArray) and turns
# them into NumPy arrays: an operating mode appears where nothing was recorded.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 pandas==3.1.1 pyarrow==26.0.1
cd "$folder"
"$folder/venv/bin/python" - <<'PROGRAM'
import numpy
import pyarrow
import pyarrow.parquet

print("pyarrow", pyarrow.__version__, "numpy", numpy.__version__)
written = ["low", None, "high"]
table = pyarrow.table({"mode": pyarrow.array(written).dictionary_encode()})
pyarrow.parquet.write_table(table, "record.parquet")
column = pyarrow.parquet.read_table("record.parquet")["mode"]
print("written", written)
print("Array.to_numpy()", column.chunk(0).to_numpy(zero_copy_only=False).tolist())
print("ChunkedArray.to_pandas()", column.to_pandas().tolist())
print("ChunkedArray.to_numpy()", column.to_numpy().tolist())
assert column.to_pylist() == written
assert column.to_numpy().tolist() == ["low", "high", "high"], "the behaviour has changed"
PROGRAM
