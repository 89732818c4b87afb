"""Networks of other libraries as functions: the libraries' own values and derivatives."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.adapters.learnt import LearntFunction, _Activation, _Affine, _Normalized, _Scaled
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import ModelError, ShapeError

DRAW = np.random.default_rng(0)
X = DRAW.uniform(-2.0, 2.0, (60, 3)) * [1.0, 30.0, 0.01]
Y = np.stack([np.sin(X[:, 0]) + X[:, 1], X[:, 0] * X[:, 2]], axis=1)
IN_TRAINING, IN_HALF, UNKNOWN = "in training mode", "type float16", r"module\.1 is a Softmax"


@pytest.fixture(scope="module")
def sklearn():
    pytest.importorskip("sklearn")
    from sklearn import compose, exceptions, neural_network, pipeline, preprocessing

    def network(y=Y, **options):
        made = neural_network.MLPRegressor(
            hidden_layer_sizes=(9, 7), max_iter=3, random_state=0, **options
        )
        with pytest.warns(exceptions.ConvergenceWarning):
            return made.fit(X, y)

    def scaled(y=Y, **options):
        made = pipeline.make_pipeline(
            preprocessing.StandardScaler(**options), "passthrough",
            preprocessing.StandardScaler(with_mean=False),
            neural_network.MLPRegressor(
                hidden_layer_sizes=(9,), max_iter=3, random_state=0, activation="tanh"
            ),
        )
        both = compose.TransformedTargetRegressor(made, transformer=preprocessing.StandardScaler())
        with pytest.warns(exceptions.ConvergenceWarning):
            return both.fit(X, y)

    network.scaled, network.compose, network.preprocessing = scaled, compose, preprocessing
    network.kind = neural_network.MLPRegressor
    return network


@pytest.mark.parametrize("activation", ["identity", "logistic", "tanh", "relu"])
def test_a_network_of_sklearn_has_its_values(sklearn, activation):
    for y in (Y, Y[:, 0]):
        model = sklearn(y, activation=activation)
        net = pickle.loads(pickle.dumps(qpmhe.from_sklearn(model)))
        expected = model.predict(X).reshape(len(X), -1)
        np.testing.assert_allclose(net(X), expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(net(X[0].tolist()), expected[0], rtol=1e-12, atol=1e-12)
        assert net(X.reshape(5, 12, 3)).shape == (5, 12, net.outputs)
        assert np.isnan(net([np.nan, 0.0, 0.0])).all()


def test_scalers_before_and_behind_it(sklearn):
    for model in (sklearn.scaled(), sklearn.scaled(Y[:, 0], with_std=False)):
        net = qpmhe.from_sklearn(model)
        expected = model.predict(X).reshape(len(X), -1)
        np.testing.assert_allclose(net(X), expected, rtol=1e-12, atol=1e-12)
        assert net.layers[-1] == "inverse StandardScaler"


def test_what_sklearn_has_besides_is_refused_by_name(sklearn):
    model = sklearn()
    transformed = sklearn.compose.TransformedTargetRegressor(func=np.log, inverse_func=np.exp)
    transformed.regressor_ = model
    for wrong, message in (
        (sklearn.kind(), "MLPRegressor is not fitted"),
        (sklearn.compose.TransformedTargetRegressor(), "TransformedTargetRegressor is not fitted"),
        (transformed, "no StandardScaler as its transformer"),
        (sklearn.preprocessing.MinMaxScaler().fit(X), r"MinMaxScaler\(\) has no form"),
        (sklearn.preprocessing.StandardScaler().fit(X), "has no linear layer"),
        (type("Own", (sklearn.kind,), {})(), "Own.* has no form"),
        (sklearn.kind, "MLPRegressor'> has no form in NumPy here; expected a fitted"),
        (3, "3 has no form"),
    ):
        with pytest.raises(ModelError, match=message):
            qpmhe.from_sklearn(wrong)
    with pytest.raises(ShapeError, match=r"shape \(2,\); expected \(\.\.\., 3\)"):
        qpmhe.from_sklearn(model)([1.0, 2.0])
    scaler = _Scaled("scaler", np.zeros(1), np.ones(1))  # NumPy would repeat it
    with pytest.raises(ModelError, match="do not fit together: scaler of 1 has 3 inputs"):
        LearntFunction("both", [scaler, _Affine("layer", np.ones((1, 3)), np.zeros(1))])
    model.coefs_[0][0, 0] = np.nan
    with pytest.raises(qpmhe.errors.InvalidInputError, match=r"coefs_\[0\]"):
        qpmhe.from_sklearn(model)


def layered(width=24):
    """A network with all kinds of layers, by numbers."""
    layers, size = [], 3
    for k, kind in enumerate(("tanh", "relu", "silu", "gelu", "gelu by tanh", "sigmoid")):
        matrix = DRAW.standard_normal((width, size)) / np.sqrt(size)
        layers += [_Affine("a", matrix, DRAW.standard_normal(width) / 3.0), _Activation(kind, kind)]
        size = width
        if k == 2:
            layers.append(_Normalized("n", 1e-5, DRAW.uniform(0.5, 1.5, width), np.ones(width)))
    layers.append(_Affine("a", DRAW.standard_normal((2, width)), np.ones(2)))
    return LearntFunction("net", layers)


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_physics_and_a_network_are_traced_with_exact_jacobians(engine):
    if engine == "compiled" and not find_compiler():
        pytest.skip("there is no C compiler")
    net = layered()
    system = qpmhe.System(
        lambda x, u: 0.9 * x + 0.1 * net(np.append(x, u)), lambda x: x[:1], n=2, p=1, m=1
    )
    assert system.explain().startswith("f: traced.")
    x, u = DRAW.standard_normal(2), DRAW.standard_normal(1)
    moves = 1e-5 * np.eye(3)[:2]
    rise = net(np.append(x, u) + moves) - net(np.append(x, u) - moves)
    slope = 0.9 * np.eye(2) + 0.1 * rise.T / 2e-5
    np.testing.assert_allclose(system.f_jacobian(x, u), slope, rtol=1e-8, atol=1e-8)
    observer = qpmhe.Luenberger([[0.3], [0.1]])
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=[[10.0]])
    made, reference = (
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=[0.0, 0.0], engine=one
        ) for one in (engine, "python")
    )
    for y in DRAW.standard_normal((8, 1)):
        one, other = made.update(y, u), reference.update(y, u)
        np.testing.assert_allclose(one.state, other.state, rtol=1e-9, atol=1e-9)
    assert made.engine == engine


def test_relu_has_no_slope_at_zero():
    net = LearntFunction("net", [_Affine("a", np.eye(1), np.zeros(1)), _Activation("relu", "relu")])
    system = qpmhe.System(net, lambda x: x, n=1, p=1)
    slopes = [system.f_jacobian(np.array([x])).item() for x in (-1.0, 0.0, 1.0)]
    assert slopes == [0.0, 0.0, 1.0]


def onnx_model(nodes, constants=None, inputs=("x",), width=3, output=None):
    """A graph: (operator, operands, value, attributes), and its constants by name."""
    onnx = pytest.importorskip("onnx")
    from onnx import helper, numpy_helper

    made = [helper.make_node(kind, list(operands), [value], **given)
            for kind, operands, value, given in nodes]
    tensor = onnx.TensorProto.DOUBLE
    graph = helper.make_graph(
        made, "net", [helper.make_tensor_value_info(one, tensor, [None, width]) for one in inputs],
        [helper.make_tensor_value_info(output or nodes[-1][2], tensor, None)],
        [numpy_helper.from_array(np.asarray(one), name)
         for name, one in (constants or {}).items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)])


def all_of_onnx(gelu):
    """Every operator that is taken; weights transposed or not, constants on either side."""
    draw = DRAW.standard_normal
    constants = {
        "mean": draw(3), "deviation": DRAW.uniform(0.5, 2.0, (1, 3)), "w1": draw((3, 12)),
        "b1": draw((1, 12)), "w2": draw((12, 12)), "b2": draw(12), "gain": draw(12), "b3": draw(12),
        "w3": draw((2, 12)), "half": np.array(0.5), "ratio": np.array(0.3), "top": draw(2),
    }
    by_tanh = {"approximate": "tanh"} if gelu == "Gelu" else {}
    nodes = [
        ("Sub", ("x", "mean"), "a", {}), ("Div", ("a", "deviation"), "b", {}),
        ("Gemm", ("b", "w1", "b1"), "c", {"alpha": 0.7, "beta": 1.3}), ("Tanh", ("c",), "d", {}),
        ("LayerNormalization", ("d", "gain", "b3"), "e", {"epsilon": 1e-3}),
        ("MatMul", ("e", "w2"), "f", {}), ("Add", ("b2", "f"), "g", {}), (gelu, ("g",), "h", {}),
        ("Mul", ("half", "h"), "i", {}), (gelu, ("i",), "j", by_tanh),
        ("Identity", ("j",), "k", {}), ("Sub", ("k", "half"), "l", {}), ("Relu", ("l",), "m", {}),
        ("Constant", (), "value", {"value": numpy_tensor(draw((12, 12)))}),
        ("MatMul", ("m", "value"), "n", {}), ("Sigmoid", ("n",), "o", {}),
        ("LayerNormalization", ("o", "gain"), "p", {}), ("Dropout", ("p", "ratio"), "q", {}),
        ("Gemm", ("q", "w3", "half"), "r", {"transB": 1}), ("Mul", ("r", "top"), "y", {}),
    ]
    return onnx_model(nodes, constants)


def numpy_tensor(values):
    return pytest.importorskip("onnx").numpy_helper.from_array(values, "constant")


@pytest.mark.parametrize(("gelu", "tolerance"), [
    ("Identity", 1e-12), ("Gelu", 1e-6),  # the reference has its constants in single precision
])
def test_a_network_in_onnx_has_the_values_of_its_reference(gelu, tolerance, tmp_path):
    onnx = pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    model = all_of_onnx(gelu)
    onnx.save(model, tmp_path / "net.onnx")
    (expected,) = ReferenceEvaluator(model).run(None, {"x": X})
    for given in (model, tmp_path / "net.onnx", str(tmp_path / "net.onnx")):
        net = pickle.loads(pickle.dumps(qpmhe.from_onnx(given)))
        assert (net.inputs, net.outputs, len(net.layers)) == (3, 2, 19)
        np.testing.assert_allclose(net(X), expected, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(net(X[0]), expected[0], rtol=tolerance, atol=tolerance)
    system = qpmhe.System(lambda x, u: net(np.append(x, u)), lambda x: x[:1], n=2, p=1, m=1)
    assert system.explain().startswith("f: traced. Jacobian: exact")


def test_what_has_no_form_in_onnx_is_refused_by_name(tmp_path):
    pytest.importorskip("onnx")
    (tmp_path / "none.onnx").write_bytes(b"no such thing")
    w, relu = {"w": np.eye(3)}, ("Relu", ("x",), "a", {})
    weighted = ("MatMul", ("x", "w"), "b", {})
    for given, message in (
        (tmp_path / "none.onnx", "none.onnx cannot be read as ONNX"),
        (tmp_path / "missing.onnx", "missing.onnx cannot be read as ONNX"),
        (3, "model is a int; expected a file"),
        (onnx_model([("Softmax", ("x",), "y", {})]), "y is a Softmax, which has no form"),
        (onnx_model([("Relu", ("x",), "y", {"domain": "mine"})]), "y is a Relu"),
        (onnx_model([("MatMul", ("w", "x"), "y", {})], w), "y is a MatMul"),
        (onnx_model([("Sub", ("w", "x"), "y", {})], {"w": np.ones(3)}), "y is a Sub"),
        (onnx_model([("Add", ("x", "w"), "y", {})], w), "y is a Add"),
        (onnx_model([("Gemm", ("x", "w"), "y", {"transA": 1})], w), "y is a Gemm"),
        (onnx_model([weighted, ("Gemm", ("x", "w"), "c", {})], w), "c is a Gemm"),  # a branch
        (onnx_model([relu, ("Mul", ("x", "a"), "y", {})]), "y is a Mul"),
        (onnx_model([("Add", ("x", "z"), "y", {})], inputs=("x", "z")), "has 2 inputs; expected"),
        (onnx_model([weighted, ("Relu", ("b",), "c", {})], w, output="b"), "output is not"),
        (onnx_model([relu]), "net has no linear layer"),
        (onnx_model([weighted, ("Add", ("b", "d"), "c", {})], w | {"d": np.ones(4)}), "not fit"),
        (onnx_model([weighted], {"w": np.eye(3, dtype=np.float16)}), "weights w have the type FLO"),
        (onnx_model([("LayerNormalization", ("x", "d"), "y", {"axis": 0})], {"d": np.ones(3)}),
         "y is a LayerNormalization"),
    ):
        with pytest.raises(ModelError, match=message):
            qpmhe.from_onnx(given)


# With PyTorch, where it is installed


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


def modules(torch):
    nn = torch.nn
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(3, 24), nn.Tanh(), nn.LayerNorm(24), nn.Linear(24, 24), nn.SiLU(),
        nn.Sequential(nn.Linear(24, 20, bias=False), nn.GELU(), nn.Identity(), nn.Dropout(0.3)),
        nn.Linear(20, 20), nn.ReLU(), nn.LayerNorm(20, elementwise_affine=False), nn.Linear(20, 20),
        nn.GELU(approximate="tanh"), nn.Linear(20, 9), nn.Sigmoid(), nn.Linear(9, 2),
    ).double().eval()


@pytest.mark.parametrize("traced", [True, False])
def test_a_module_of_torch_has_its_values_and_jacobians(torch, traced):
    module = modules(torch)
    net = qpmhe.from_torch(module, traced=traced)
    options = {} if traced else {"f_jacobian": lambda x, u: net.jacobian(np.append(x, u))[:, :2]}
    system = qpmhe.System(
        lambda x, u: net(np.append(x, u)), lambda x: x[:1], n=2, p=1, m=1, **options
    )
    text = "f: traced. Jacobian: exact" if traced else "the module Sequential, which PyTorch eval"
    assert text in system.explain()
    for size in (1e-3, 1.0, 30.0):
        z = size * DRAW.standard_normal(3)
        value = module(torch.tensor(z)).detach().numpy()
        slope = torch.func.jacrev(module)(torch.tensor(z)).detach().numpy()[:, :2]
        np.testing.assert_allclose(system.f(z[:2], z[2:]), value, rtol=1e-12, atol=1e-13)
        found = system.f_jacobian(z[:2], z[2:])
        np.testing.assert_allclose(found, slope, rtol=1e-12, atol=1e-13)
    batch = DRAW.standard_normal((4, 3))
    expected = module(torch.tensor(batch)).detach().numpy()
    np.testing.assert_allclose(net(batch), expected, rtol=1e-12, atol=1e-13)
    # It has a copy of the weights.
    with torch.no_grad():
        module[0].weight.zero_()
    np.testing.assert_allclose(net(batch), expected, rtol=1e-12, atol=1e-13)


def test_modules_that_have_no_form_are_refused_by_name(torch):
    nn = torch.nn
    own = type("Own", (nn.Module,), {"forward": lambda self, x: x})
    hooked = nn.Linear(3, 3).eval()
    hooked.register_forward_hook(lambda *_: None)
    for wrong, message in (
        (nn.Sequential(nn.Linear(3, 3)), IN_TRAINING),
        (nn.Sequential(nn.Linear(3, 3), nn.Dropout().train()).eval().train(), IN_TRAINING),
        (modules(torch).half(), IN_HALF),
        (nn.Sequential(nn.Linear(3, 3), nn.Softmax(-1)).eval(), UNKNOWN),
        (own().eval(), "module is a Own.*traced=False"),
        (hooked, "forward hooks"),
        (nn.Sequential(nn.Linear(3, 4), nn.Linear(3, 3)).eval(), "do not fit"),
        (nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(5)).eval(), "do not fit"),
        (nn.Sequential(nn.Tanh()).eval(), "no linear layer"),
        (nn.utils.parametrizations.weight_norm(nn.Linear(3, 3)).eval(), "ParametrizedLinear"),
        (nn.Sequential, "expected a torch.nn.Module"),
        (3, "expected a torch.nn.Module"),
    ):
        with pytest.raises(ModelError, match=message):
            qpmhe.from_torch(wrong)


def test_weights_in_single_precision_are_taken_as_they_are(torch):
    module = modules(torch).float()
    z = DRAW.standard_normal(3)
    expected = module.double()(torch.tensor(z)).detach().numpy()
    np.testing.assert_allclose(qpmhe.from_torch(module)(z), expected, rtol=1e-12, atol=1e-13)
