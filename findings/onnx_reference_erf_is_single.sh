#!/bin/sh
# What happens: the reference evaluator of ONNX, onnx.reference, computes Erf in single precision where all tensors are
# double: the values have 8 correct digits.
# Why most guess wrong: it is the reference, its result has the type of doubles, and its other functions have 16 digits.
# Who meets it: who tests a converter, or a runtime in double precision, against the reference with a tolerance below 1e-8,
# and looks for the fault in his own code.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 onnx==1.23.2
"$folder/venv/bin/python" - <<'PROGRAM'
import math

import numpy
import onnx
from onnx import TensorProto, helper
from onnx.reference import ReferenceEvaluator

print("onnx", onnx.__version__)
x = numpy.linspace(-2.0, 2.0, 9)
off = {}
for name, exact in (("Erf", math.erf), ("Tanh", math.tanh)):
    graph = helper.make_graph(
        [helper.make_node(name, ["x"], ["y"])], "one",
        [helper.make_tensor_value_info("x", TensorProto.DOUBLE, [None])],
        [helper.make_tensor_value_info("y", TensorProto.DOUBLE, [None])])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)])
    onnx.checker.check_model(model, full_check=True)
    (y,) = ReferenceEvaluator(model).run(None, {"x": x})
    off[name] = float(abs(y - [exact(value) for value in x]).max())
    print(name, "is of", y.dtype, "and off by", off[name])
assert off["Tanh"] < 1e-15
assert 1e-9 < off["Erf"] < 1e-7, "the behaviour has changed"
PROGRAM
