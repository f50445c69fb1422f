"""The network as an ONNX graph, written from its parameters: one decision, with the recurrent state in and out.

Inputs: one image a sensor part, [batch, 1, h, w], normalised; `side` [batch, S] where the core is told something
beside the images; one state of the core each. Outputs: logits [batch, actions] and value [batch, 1] of each head, and
the next state. The batch is free. Episodes are the caller's: a state of zeros begins one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from foajax.agent import Agent
from foajax.config import ConfigError, NetworkConfig
from foajax.foveation import image_shapes
from foajax.types import Params

OPSET = 17  # the first with LayerNormalization; runtimes since 2022 have it
_IR_VERSION = 8  # of the same year
_EPSILON = 1e-6  # of Flax's layer norm
_SMALLEST_IMAGE = 8  # as in `networks`: smaller images go straight to the next layer
_FLOAT = TensorProto.FLOAT


class Graph:
    """Collects nodes and constants. Each method gives the name of the value that it adds."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self._params = dict(_flat(params))
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.inputs: list[onnx.ValueInfoProto] = []
        self.outputs: list[onnx.ValueInfoProto] = []

    def take(self, path: str) -> np.ndarray:
        """A parameter by its path, e.g. `dense/kernel`; each is taken once."""
        if path not in self._params:
            raise ConfigError(f"network: has no {path}; accepted is a network of this version's config.yaml")
        return self._params.pop(path)

    def left_over(self) -> list[str]:
        """The parameters that nothing took."""
        return list(self._params)

    def has(self, path: str) -> bool:
        """Whether a parameter is there to be taken."""
        return path in self._params

    def input(self, name: str, *shape: int) -> str:
        """Adds an input [batch, *shape]."""
        self.inputs.append(helper.make_tensor_value_info(name, _FLOAT, ["batch", *shape]))
        return name

    def output(self, name: str, *shape: int) -> str:
        """Names an output [batch, *shape]; a node of that name gives it."""
        self.outputs.append(helper.make_tensor_value_info(name, _FLOAT, ["batch", *shape]))
        return name

    def constant(self, name: str, array: np.ndarray) -> str:
        """Adds a constant."""
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(self, kind: str, name: str, *inputs: str, **attributes: Any) -> str:
        """Adds a node with one output, which bears its name."""
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def dense(self, name: str, x: str, order: np.ndarray | None = None) -> str:
        """A dense layer; `order` says which of its rows takes each feature of `x`."""
        rows = self.take(f"{name}/kernel")
        kernel = self.constant(f"{name}.kernel", rows if order is None else rows[order])
        return self.node("Gemm", name, x, kernel, self.constant(f"{name}.bias", self.take(f"{name}/bias")))

    def layer_norm(self, name: str, x: str, width: int) -> str:
        """A layer norm over the last axis, scaled and shifted where the network has learned to."""
        scale = self.take(f"{name}/scale") if self.has(f"{name}/scale") else np.ones(width, np.float32)
        shift = [self.constant(f"{name}.bias", self.take(f"{name}/bias"))] if self.has(f"{name}/bias") else []
        parts = [x, self.constant(f"{name}.scale", scale), *shift]
        return self.node("LayerNormalization", name, *parts, axis=-1, epsilon=_EPSILON)

    def convolution(self, name: str, x: str, *, stride: int = 1, pads: Sequence[int] = (0, 0, 0, 0)) -> str:
        """A convolution; `pads` are rows and columns of zeros above, left, below and right."""
        kernel = self.take(f"{name}/kernel").transpose(3, 2, 0, 1)
        weights = self.constant(f"{name}.kernel", kernel), self.constant(f"{name}.bias", self.take(f"{name}/bias"))
        shape = {"kernel_shape": list(kernel.shape[2:]), "strides": [stride, stride], "pads": list(pads)}
        return self.node("Conv", name, x, *weights, **shape)


Image = tuple[int, int, int]  # rows, columns, channels
Core = Callable[[Graph, NetworkConfig, str, np.ndarray], str]


@dataclasses.dataclass(frozen=True)
class Features:
    """What the images have become: a value [batch, F] and the place of each of its numbers in the network's order."""

    name: str
    order: np.ndarray


def policy(agent: Agent, params: Params, facts: Mapping[str, str]) -> onnx.ModelProto:
    """The network of an agent with its parameters; `facts` are written into the file for whoever opens it.

    Raises:
      ConfigError: the network has a part that this module does not know.
    """
    config = agent.config.network
    graph = Graph(params["params"])
    features = _features(graph, config, image_shapes(agent.config.sensor, agent.config.env.frame_shape))
    side = side_width(agent)
    x, order = features.name, features.order
    if side:
        x = graph.node("Concat", "told", x, graph.input("side", side), axis=-1)
        order = np.concatenate([order, len(order) + np.arange(side)])
    hidden = core(config)(graph, config, x, order)
    _head(graph, "natural", hidden)
    if agent.network.num_vision_actions:
        _head(graph, "vision", hidden)
    if graph.left_over():
        raise ConfigError(f"network: {graph.left_over()[0]} cannot be exported; accepted are {', '.join(CORES)} cores")
    return _model(graph, facts)


def side_width(agent: Agent) -> int:
    """How many numbers the core is told beside the images."""
    integers, numbers = jnp.zeros((1, 2), jnp.int32), jnp.zeros(1)
    return jax.eval_shape(agent.side, integers, integers, numbers, jnp.zeros(1, bool)).shape[-1]


def _model(graph: Graph, facts: Mapping[str, str]) -> onnx.ModelProto:
    body = helper.make_graph(graph.nodes, "policy", graph.inputs, graph.outputs, graph.constants)
    body.doc_string = __doc__ or ""
    imports = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(body, opset_imports=imports, ir_version=_IR_VERSION, producer_name="foajax")
    helper.set_model_props(model, dict(facts))
    onnx.checker.check_model(model, full_check=True)
    return onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True, data_prop=True)


def _features(graph: Graph, config: NetworkConfig, shapes: Sequence[Image]) -> Features:
    """Torso on every image, concatenated; then the dense layer if there is one."""
    names, orders, start = [], [], 0
    for i, shape in enumerate(shapes):
        name = graph.input(f"image_{i}", shape[2], *shape[:2])
        if min(shape[:2]) >= _SMALLEST_IMAGE:
            name, shape = TORSOS[config.torso](graph, config, f"torso_{i}", name, shape)
        names.append(graph.node("Flatten", f"features_{i}", name, axis=1))
        # ONNX lays channels first, the network had them last: the rows of the next kernel are sorted anew.
        orders.append(start + np.arange(np.prod(shape)).reshape(shape).transpose(2, 0, 1).ravel())
        start += int(np.prod(shape))
    x = graph.node("Concat", "features", *names, axis=-1) if len(names) > 1 else names[0]
    order = np.concatenate(orders)
    if config.dense_norm:
        x = graph.layer_norm("dense_norm", x, len(order))
    if not config.dense:
        return Features(x, order)
    return Features(graph.node("Relu", "dense_relu", graph.dense("dense", x, order)), np.arange(config.dense))


def _nature(graph: Graph, config: NetworkConfig, name: str, x: str, shape: Image) -> tuple[str, Image]:
    """`networks.NatureTorso`."""
    height, width, channels = shape
    first = (8, 4) if min(height, width) >= 44 else (4, 2)
    layer = 0
    for place, (kernel, stride) in enumerate((first, (4, 2), (3, 1))):
        if min(height, width) < kernel:
            continue
        covers = config.padding == "cover"
        below, right = (-(size - kernel) % stride if covers and place else 0 for size in (height, width))
        grown = [kernel + (size - kernel) % stride if covers and not place else kernel for size in (height, width)]
        x = graph.convolution(f"{name}/Convolution_{layer}", x, stride=stride, pads=(0, 0, below, right))
        x = graph.node("Relu", f"{name}/relu_{layer}", x)
        height = (height + below - grown[0]) // stride + 1
        width = (width + right - grown[1]) // stride + 1
        channels, layer = (32, 64, 64)[place], layer + 1
    return x, (height, width, channels)


def _a3c(graph: Graph, config: NetworkConfig, name: str, x: str, shape: Image) -> tuple[str, Image]:
    """`networks.A3CTorso`."""
    height, width, channels = shape
    for layer, (features, kernel, border) in enumerate(((32, 5, 2), (32, 5, 1), (64, 4, 1), (64, 3, 1))):
        x = graph.convolution(f"{name}/Convolution_{layer}", x, pads=(border,) * 4)
        height, width, channels = height + 2 * border - kernel + 1, width + 2 * border - kernel + 1, features
        if min(height, width) > 4:
            x = graph.node("MaxPool", f"{name}/pool_{layer}", x, kernel_shape=[2, 2], strides=[2, 2])
            height, width = height // 2, width // 2
        x = graph.node("Relu", f"{name}/relu_{layer}", x)
    return x, (height, width, channels)


def _lstm(graph: Graph, config: NetworkConfig, x: str, order: np.ndarray) -> str:
    """One step of `recurrence.lstm`; gates in the order input, forget, candidate, output.

    Not ONNX's LSTM: it has no place for the norm between the input's product and the gates.
    """
    cell, hidden = (graph.input(state, config.lstm) for state in ("cell", "hidden"))
    projected = graph.dense("lstm_input", x, order)
    if config.lstm_norm:
        projected = graph.layer_norm("lstm_norm", projected, 4 * config.lstm)
    kernel = graph.constant("lstm_recurrent.kernel", graph.take("lstm_recurrent"))
    gates = graph.node("Add", "gates", projected, graph.node("MatMul", "lstm_recurrent", hidden, kernel))
    sizes = graph.constant("gate_widths", np.full(4, config.lstm, np.int64))
    names = ["input", "forget", "candidate", "output"]
    graph.nodes.append(helper.make_node("Split", [gates, sizes], [f"{n}_sum" for n in names], name="split", axis=-1))
    i, f, g, o = (
        graph.node("Tanh" if name == "candidate" else "Sigmoid", f"{name}_gate", f"{name}_sum") for name in names
    )
    kept, new = graph.node("Mul", "kept", f, cell), graph.node("Mul", "new", i, g)
    next_cell = graph.node("Add", graph.output("next_cell", config.lstm), kept, new)
    squashed = graph.node("Tanh", "squashed", next_cell)
    return graph.node("Mul", graph.output("next_hidden", config.lstm), o, squashed)


def _head(graph: Graph, name: str, hidden: str) -> None:
    for part, output in (("policy", "logits"), ("value", "value")):
        kernel, bias = graph.take(f"{name}_{part}/kernel"), graph.take(f"{name}_{part}/bias")
        weights = graph.constant(f"{name}_{part}.kernel", kernel), graph.constant(f"{name}_{part}.bias", bias)
        graph.node("Gemm", graph.output(f"{name}_{output}", len(bias)), hidden, *weights)


TORSOS = {"nature": _nature, "a3c": _a3c}
# A core makes one step: it takes the value that the images have become, adds an input for each of its states and an
# output `next_<state>` for each, and gives the value that the heads read.
CORES: dict[str, Core] = {"lstm": _lstm}


def core(config: NetworkConfig) -> Core:
    """How the core of a network is written; `ConfigError` where it is not known."""
    name = getattr(config, "core", "lstm")
    if name not in CORES:
        raise ConfigError(f"network.core={name}: accepted by export are {', '.join(CORES)}")
    return CORES[name]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, np.ndarray]]:
    leaves: list[tuple[str, np.ndarray]] = []
    for name, value in tree.items():
        path = f"{prefix}{name}"
        leaves += _flat(value, path + "/") if isinstance(value, Mapping) else [(path, np.asarray(value, np.float32))]
    return leaves
