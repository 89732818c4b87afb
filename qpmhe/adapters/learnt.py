"""Networks of other libraries as functions of NumPy arrays, for models that are partly learnt."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import shown

from .._checks import flag, need, numbers
from ..errors import ModelError, ShapeError
from ..model.symbols import Symbol, SymbolArray

Array = NDArray[np.float64]
_TANH_FORM = 0.7978845608028654, 0.044715  # sqrt(2 / pi), and the factor of the cube


class LearntFunction:
    """A network as a function of NumPy arrays (..., k) to (..., r).

    Its layers are NumPy's functions and matrices in double precision, so that what calls it, such
    as the f of a `qpmhe.System`, is traced: with exact Jacobians, in C, and in certificates. It
    has a copy of the weights, and pickles.

    Attributes
    ----------
    inputs, outputs : int
        k and r.
    layers : tuple of str
        The names of the layers, in order.
    """

    def __init__(self, name: str, layers: Sequence[Layer]) -> None:
        self._name, self._layers = name, tuple(layers)
        self.layers = tuple(one.name for one in layers)
        sizes = [one for one in layers if isinstance(one, _Affine)]
        if not sizes:
            raise ModelError(f"{name} has no linear layer, so the number of inputs is not known.")
        self.outputs, self.inputs = sizes[-1].matrix.shape[0], sizes[0].matrix.shape[1]
        try:
            self(np.zeros(self.inputs))
        except (ValueError, ShapeError) as error:
            raise ModelError(f"{name} has layers that do not fit together: {error}") from error

    def __call__(self, x: Any) -> Any:
        """The network's outputs (..., r) at inputs (..., k)."""
        value = np.array(x)
        if value.shape[-1:] != (self.inputs,):
            raise ShapeError(
                f"the input of {self._name} has shape {value.shape}; expected (..., {self.inputs})."
            )
        for layer in self._layers:
            value = layer(value)
        return value

    def __repr__(self) -> str:
        return f"<{self._name}: {', '.join(self.layers)}; {self.inputs} to {self.outputs}>"


@dataclass(frozen=True, eq=False)
class _Affine:
    """W x + b."""

    name: str
    matrix: Array
    offset: Array

    def __call__(self, x: Any) -> Any:
        return x @ self.matrix.T + self.offset


@dataclass(frozen=True, eq=False)
class _Scaled:
    """Each component by itself: (x - shift) / scale, or scale x + shift."""

    name: str
    shift: Array
    scale: Array
    inverse: bool = False

    def __call__(self, x: Any) -> Any:
        _check_size(self.name, self.scale.size, x)
        return x * self.scale + self.shift if self.inverse else (x - self.shift) / self.scale


@dataclass(frozen=True, eq=False)
class _Normalized:
    """Layer normalisation: (x - mean) / sqrt(variance + eps) along the last axis, then w x + b."""

    name: str
    eps: float
    weight: Array
    offset: Array

    def __call__(self, x: Any) -> Any:
        _check_size(self.name, self.weight.size, x)
        gap = x - np.mean(x, axis=-1, keepdims=True)
        variance = np.mean(gap * gap, axis=-1, keepdims=True)
        return gap / np.sqrt(variance + self.eps) * self.weight + self.offset


def _check_size(name: str, size: int, x: Any) -> None:
    if np.shape(x)[-1] != size:  # NumPy would repeat a single one
        raise ShapeError(f"{name} of {size} has {np.shape(x)[-1]} inputs.")


@dataclass(frozen=True)
class _Activation:
    """A function of each component."""

    name: str
    kind: str

    def __call__(self, x: Any) -> Any:
        return _ACTIVATIONS[self.kind](x)


Layer = _Affine | _Scaled | _Normalized | _Activation


def _sigmoid(x: Any) -> Any:
    from scipy.special import expit  # late: `import qpmhe` does without

    return expit(x)


def _gelu(x: Any) -> Any:
    from scipy.special import erf

    return 0.5 * x * (1.0 + erf(x / np.sqrt(2.0)))


_ACTIVATIONS: dict[str, Callable[[Any], Any]] = {
    "identity": lambda x: x, "tanh": np.tanh, "sigmoid": _sigmoid, "gelu": _gelu,
    # With the derivative 0 at 0, as both libraries have it; NaN stays.
    "relu": lambda x: np.where(x <= 0.0, 0.0, x),
    "silu": lambda x: x * _sigmoid(x),
    "gelu by tanh": lambda x: 0.5 * x * (
        1.0 + np.tanh(_TANH_FORM[0] * (x + _TANH_FORM[1] * x * x * x))
    ),
}


# PyTorch

_OF_TORCH = {
    "Identity": "identity", "Dropout": "identity", "Tanh": "tanh", "Sigmoid": "sigmoid",
    "ReLU": "relu", "SiLU": "silu",
}


class TorchFunction:
    """A module that PyTorch evaluates, in double precision, as a function of (..., k).

    It is not traced: ``explain()`` of a system says so. `jacobian` gives the derivative to the
    system's ``f_jacobian`` or ``h_jacobian``.
    """

    def __init__(self, module: Any) -> None:
        self._name, self._module = type(module).__name__, deepcopy(module).double().cpu()

    def __call__(self, x: Any) -> Array:
        """The module's value at an array of numbers."""
        torch = sys.modules["torch"]
        with torch.no_grad():
            found: Array = self._module(self._tensor(x)).numpy()
        return found

    def jacobian(self, x: Any) -> Array:
        """The derivative (r, k) at one input (k,), by ``torch.func.jacrev``."""
        torch = sys.modules["torch"]
        found: Array = torch.func.jacrev(self._module)(self._tensor(x)).detach().numpy()
        return found

    def _tensor(self, x: Any) -> Any:
        value = np.array(x)
        if isinstance(value, (Symbol, SymbolArray)):
            raise value.record.refuse(
                f"the module {self._name}, which PyTorch evaluates (from_torch with traced=False)"
            )
        return sys.modules["torch"].from_numpy(np.array(value, np.float64))

    def __repr__(self) -> str:
        return f"<{self._name}, evaluated by PyTorch>"


def from_torch(module: Any, *, traced: bool = True) -> LearntFunction | TorchFunction:
    """Make a function of NumPy arrays from a trained module of PyTorch.

    It is no system, but what f or h calls beside the equations that are known, say as
    ``x + dt * physics(x, u) + net(np.append(x, u))``.

    Parameters
    ----------
    module : torch.nn.Module
        In evaluation mode (``module.eval()``), with weights in single or double precision, which
        are copied. Traced: a `torch.nn.Sequential` of ``Linear``, ``Tanh``, ``Sigmoid``, ``ReLU``,
        ``SiLU``, ``GELU``, ``LayerNorm`` of the last axis, ``Identity`` and ``Dropout``, which may
        be nested, or one of these alone.
    traced : bool
        Whether to write the layers in NumPy. Without, any module of one argument will do;
        PyTorch then evaluates it in each step, in double precision.

    Returns
    -------
    LearntFunction or TorchFunction

    Raises
    ------
    ModelError
        If it is no module, in training mode, has weights of another precision, hooks, or a layer
        that is not listed above. The message names the layer.
    """
    if not (hasattr(module, "named_modules") and hasattr(module, "training")):
        raise ModelError(f"module is a {type(module).__name__}; expected a torch.nn.Module.")
    for name, one in module.named_modules():
        where = f"{type(one).__name__}{f' ({name})' if name else ''}"
        if one.training:
            raise ModelError(
                f"the module {where} is in training mode, in which layers such as Dropout change "
                "what it returns; call module.eval() first."
            )
    for name, weights in (*module.named_parameters(), *module.named_buffers()):
        kind = str(weights.dtype).removeprefix("torch.")
        if kind not in ("float32", "float64", "int64", "bool"):
            raise ModelError(
                f"the weights {name} have the type {kind}; expected float32 or float64. Weights "
                "in half precision become single precision by module.float()."
            )
    if not flag("traced", traced):
        return TorchFunction(module)
    return LearntFunction(type(module).__name__, list(_torch_layers(module, "module")))


def _torch_layers(module: Any, where: str) -> Iterator[Layer]:
    """The layers of a module, in order."""
    name, home = type(module).__name__, type(module).__module__
    if home.startswith("torch.nn.modules."):
        if module._forward_hooks or module._forward_pre_hooks:
            raise ModelError(f"{where}, a {name}, has forward hooks, which may change its value.")
        if name == "Sequential":
            for key, one in module.named_children():
                yield from _torch_layers(one, f"{where}.{key}")
            return
        if name == "Linear":
            matrix = _values(f"{where}.weight", module.weight)
            yield _Affine(name, matrix, _values(f"{where}.bias", module.bias, matrix.shape[:1]))
            return
        if name == "LayerNorm" and len(module.normalized_shape) == 1:
            shape = tuple(module.normalized_shape)
            weight = _values(f"{where}.weight", module.weight, shape, 1.0)
            offset = _values(f"{where}.bias", module.bias, shape)
            yield _Normalized(name, float(module.eps), weight, offset)
            return
        if name == "GELU":
            yield _Activation(name, "gelu by tanh" if module.approximate == "tanh" else "gelu")
            return
        if name in _OF_TORCH:
            yield _Activation(name, _OF_TORCH[name])
            return
    raise ModelError(
        f"{where} is a {name}, which has no form in NumPy here; expected a Sequential of Linear, "
        f"LayerNorm, GELU, {', '.join(_OF_TORCH)}. With traced=False, PyTorch evaluates it."
    )


def _values(name: str, weights: Any, shape: tuple[int, ...] = (), rest: float = 0.0) -> Array:
    """Weights in double precision; of this shape where there are none."""
    if weights is None:
        return np.full(shape, rest)
    return numbers(name, weights.detach().cpu().double().numpy().copy())


# scikit-learn

_OF_SKLEARN = {"identity": "identity", "logistic": "sigmoid", "tanh": "tanh", "relu": "relu"}


def from_sklearn(model: Any) -> LearntFunction:
    """Make a function of NumPy arrays from a fitted network of scikit-learn.

    It is no system, but what f or h calls beside the equations that are known. Unlike
    ``model.predict``, it takes arrays (..., k), returns (..., r) also for r = 1, and takes
    microseconds.

    Parameters
    ----------
    model : MLPRegressor, Pipeline or TransformedTargetRegressor
        Fitted. A pipeline has steps of ``StandardScaler``, and ends with an ``MLPRegressor``; a
        ``TransformedTargetRegressor`` has either as its regressor, and a ``StandardScaler`` as its
        transformer.

    Returns
    -------
    LearntFunction

    Raises
    ------
    ModelError
        If it is none of these, or not fitted. The message names the step.

    Examples
    --------
    >>> import numpy as np
    >>> import qpmhe
    >>> from sklearn.neural_network import MLPRegressor
    >>> x = np.linspace(-2.0, 2.0, 200)[:, None]
    >>> model = MLPRegressor(hidden_layer_sizes=(16,), activation="tanh", solver="lbfgs")
    >>> net = qpmhe.from_sklearn(model.fit(x, np.sin(x[:, 0])))
    >>> net
    <MLPRegressor: layer 0, tanh, layer 1; 1 to 1>
    """
    return LearntFunction(type(model).__name__, list(_sklearn_layers(model)))


def _sklearn_layers(model: Any) -> Iterator[Layer]:
    """The layers of a model, in order."""
    name, home = type(model).__name__, type(model).__module__.partition(".")[0]
    if home == "sklearn":
        if name == "Pipeline":
            for _, step in model.steps:
                if step is not None and step != "passthrough":
                    yield from _sklearn_layers(step)
            return
        if name == "TransformedTargetRegressor":
            _check_fitted(model, "regressor_")
            if model.func is not None or type(model.transformer_).__name__ != "StandardScaler":
                raise ModelError(
                    "the TransformedTargetRegressor has no StandardScaler as its transformer."
                )
            yield from _sklearn_layers(model.regressor_)
            for one in _sklearn_layers(model.transformer_):
                assert isinstance(one, _Scaled)
                yield _Scaled("inverse StandardScaler", one.shift, one.scale, True)
            return
        if name == "StandardScaler":
            _check_fitted(model, "n_features_in_")
            size = model.n_features_in_
            shift = np.zeros(size) if model.mean_ is None else numbers("mean_", model.mean_)
            scale = np.ones(size) if model.scale_ is None else numbers("scale_", model.scale_)
            yield _Scaled(name, shift, scale)
            return
        if name == "MLPRegressor":
            _check_fitted(model, "coefs_")
            last = len(model.coefs_) - 1
            for k, (matrix, offset) in enumerate(zip(model.coefs_, model.intercepts_, strict=True)):
                kind = model.activation if k < last else model.out_activation_
                if kind not in _OF_SKLEARN:
                    raise ModelError(
                        f"the activation of layer {k} is {kind!r}; expected one of "
                        f"{', '.join(_OF_SKLEARN)}."
                    )
                yield _Affine(
                    f"layer {k}", numbers(f"coefs_[{k}]", matrix).T,
                    numbers(f"intercepts_[{k}]", offset),
                )
                if kind != "identity":
                    yield _Activation(kind, _OF_SKLEARN[kind])
            return
    raise ModelError(
        f"{shown(model)} has no form in NumPy here; expected a fitted MLPRegressor, or a Pipeline "
        "of StandardScaler and MLPRegressor."
    )


def _check_fitted(model: Any, attribute: str) -> None:
    if not hasattr(model, attribute):
        raise ModelError(f"the {type(model).__name__} is not fitted; call its fit first.")


# ONNX

_OF_ONNX = {
    "Identity": "identity", "Dropout": "identity", "Tanh": "tanh", "Sigmoid": "sigmoid",
    "Relu": "relu", "Gelu": "gelu",
}


def from_onnx(model: Any) -> LearntFunction:
    """Make a function of NumPy arrays from a network in ONNX.

    It is no system, but what f or h calls beside the equations that are known.

    Parameters
    ----------
    model : str, Path or onnx.ModelProto
        A file, or what ``onnx.load`` returns. Its operators are a chain of ``Gemm``, ``MatMul``,
        ``LayerNormalization`` of the last axis, ``Tanh``, ``Sigmoid``, ``Relu``, ``Gelu``,
        ``Identity``, ``Dropout`` outside of training, and ``Add``, ``Sub``, ``Mul`` and ``Div``
        with a constant, such as those of a scaler. Weights are in single or double precision.

    Returns
    -------
    LearntFunction

    Raises
    ------
    ModelError
        If it is none of these, or cannot be read. The message names the operator.
    InvalidInputError
        If onnx is not installed.
    """
    onnx = need("onnx", "a network in ONNX", "onnx")
    if isinstance(model, (str, PathLike)):
        try:
            model = onnx.load(model)
        except Exception as error:  # of the file, of Protocol Buffers, of weights in other files
            raise ModelError(f"{model} cannot be read as ONNX ({error}).") from error
    if not isinstance(model, onnx.ModelProto):
        raise ModelError(f"model is a {type(model).__name__}; expected a file or onnx.ModelProto.")
    graph, layers = model.graph, []
    tensors = {one.name: one for one in graph.initializer}
    inputs = [one for one in graph.input if one.name not in tensors]
    if len(inputs) != 1:
        raise ModelError(f"the network has {len(inputs)} inputs; expected one.")
    newest = [inputs[0].name]
    width = ([one.dim_value for one in inputs[0].type.tensor_type.shape.dim] or [0])[-1]
    for node in graph.node:
        given = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
        if node.op_type == "Constant" and "value" in given:
            tensors[node.output[0]] = given["value"]
            continue
        constants = [_onnx_values(onnx, tensors[one]) for one in node.input if one in tensors]
        layer, is_behind = None, any(one in tensors for one in node.input[:1])
        if [one for one in node.input if one and one not in tensors] == newest:
            layer = _onnx_layer(node.op_type, given, constants, is_behind, width)
        if layer is None or node.domain not in ("", "ai.onnx"):
            raise ModelError(
                f"{node.name or node.output[0]} is a {node.op_type}, which has no form in NumPy "
                "here with its inputs and attributes; expected a chain of Gemm, MatMul, Layer"
                f"Normalization, {', '.join(_OF_ONNX)}, and Add, Sub, Mul, Div with constants."
            )
        width = layer.matrix.shape[0] if isinstance(layer, _Affine) else width
        layers.append(layer)
        newest = list(node.output[:1])
    if newest != [one.name for one in graph.output]:
        raise ModelError("the network's output is not the value of its last operator.")
    return LearntFunction(graph.name or "network", layers)


def _onnx_layer(
    name: str, given: dict[str, Any], constants: list[Array], is_behind: bool, width: int
) -> Layer | None:
    """The layer of an operator of a value of this width and constants, which may stand first."""
    if name in _OF_ONNX and len(constants) <= (name == "Dropout"):  # its ratio
        by_tanh = given.get("approximate") == b"tanh"
        return _Activation(name, _OF_ONNX[name] + " by tanh" * by_tanh)
    if not constants or (is_behind and name not in ("Add", "Mul")):
        return None
    one, *rest = constants
    if name in ("Gemm", "MatMul") and one.ndim == 2 and not given.get("transA", 0):
        matrix = given.get("alpha", 1.0) * (one if given.get("transB", 0) else one.T)
        offset = given.get("beta", 1.0) * rest[0].reshape(-1) if rest else np.zeros(1)
        if offset.size not in (1, len(matrix)):
            return None
        return _Affine(name, matrix, np.broadcast_to(offset, len(matrix)).copy())
    if name == "LayerNormalization" and given.get("axis", -1) == -1 and one.ndim == 1:
        eps = given.get("epsilon", float(np.float32(1e-5)))  # attributes are in single precision
        return _Normalized(name, eps, one, (rest or [0.0 * one])[0])
    if name in ("Add", "Sub", "Mul", "Div") and one.size == max(one.shape, default=1) and not rest:
        # Dropping its axes of one does not change the last axis of a sum or product.
        values = np.full(width or 1, one) if one.size == 1 else one.reshape(-1)
        shift, scale = (values, np.ones_like(values))[:: 1 if name in ("Add", "Sub") else -1]
        return _Scaled(name, shift * (name in ("Add", "Sub")), scale, name in ("Add", "Mul"))
    return None


def _onnx_values(onnx: Any, tensor: Any) -> Array:
    kind = onnx.TensorProto.DataType.Name(tensor.data_type)
    if kind not in ("FLOAT", "DOUBLE"):
        raise ModelError(
            f"the weights {tensor.name} have the type {kind}; expected FLOAT or DOUBLE."
        )
    return numbers(tensor.name, onnx.numpy_helper.to_array(tensor))
