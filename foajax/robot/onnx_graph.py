"""Writes the network as an ONNX graph from its parameters: one decision, with the recurrent state in and out.

Inputs: a normalised image [batch, C, h, w] per part of the sensor; `side` [batch, S], if the core is told something
beside the images; the core's states. Outputs: logits [batch, actions] and value [batch, 1] of each head, and the next
states. Any batch size works. The caller begins an episode with states of zeros.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from foajax.config.parse import refuse
from foajax.config.schema import NetworkConfig
from foajax.learning.agent import Agent
from foajax.networks.network import smallest_image
from foajax.runs.agents import named
from foajax.types import Params

OPSET = 17  # the first with LayerNormalization; runtimes since 2022 have it
_IR_VERSION = 8  # of the same year
_EPSILON = 1e-6  # of Flax's layer norm
_FLOAT = TensorProto.FLOAT
_ACCEPTED = "those of the network in its config.yaml"


class Graph:
    """Collects nodes and constants. Each method that adds a value returns its name."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self._params = named(params)
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.inputs: list[onnx.ValueInfoProto] = []
        self.outputs: list[onnx.ValueInfoProto] = []

    def take(self, path: str) -> np.ndarray:
        """Takes a parameter by its path, such as `dense/kernel`. Each can be taken once."""
        if path not in self._params:
            raise refuse("parameters", accepted=_ACCEPTED, why=f"{path} is missing")
        return self._params.pop(path)

    def left_over(self) -> list[str]:
        """Lists the parameters that nothing has taken."""
        return list(self._params)

    def has(self, path: str) -> bool:
        """Whether a parameter can be taken."""
        return path in self._params

    def input(self, name: str, *shape: int) -> str:
        """Adds an input [batch, *shape]."""
        self.inputs.append(helper.make_tensor_value_info(name, _FLOAT, ["batch", *shape]))
        return name

    def output(self, name: str, *shape: int) -> str:
        """Declares an output [batch, *shape], which the node of that name gives."""
        self.outputs.append(helper.make_tensor_value_info(name, _FLOAT, ["batch", *shape]))
        return name

    def constant(self, name: str, array: np.ndarray) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(self, kind: str, name: str, *inputs: str, **attributes: Any) -> str:
        """Adds a node with one output of the same name."""
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def dense(self, name: str, x: str, order: np.ndarray | None = None) -> str:
        """Adds a dense layer; feature i of `x` meets row `order[i]` of its kernel."""
        rows = self.take(f"{name}/kernel")
        kernel = self.constant(f"{name}.kernel", rows if order is None else rows[order])
        return self.node("Gemm", name, x, kernel, self.constant(f"{name}.bias", self.take(f"{name}/bias")))

    def product(self, name: str, x: str) -> str:
        """Adds a matrix product with a parameter."""
        return self.node("MatMul", name, x, self.constant(f"{name}.kernel", self.take(name)))

    def split(self, name: str, x: str, names: Sequence[str], width: int) -> list[str]:
        """Splits the last axis into `names`, each of `width`."""
        sizes = self.constant(f"{name}.widths", np.full(len(names), width, np.int64))
        self.nodes.append(helper.make_node("Split", [x, sizes], list(names), name=f"{name}.split", axis=-1))
        return list(names)

    def layer_norm(self, name: str, x: str, width: int) -> str:
        """Adds a layer norm over the last axis, with a scale and a shift where the network has them."""
        scale = self.take(f"{name}/scale") if self.has(f"{name}/scale") else np.ones(width, np.float32)
        shift = [self.constant(f"{name}.bias", self.take(f"{name}/bias"))] if self.has(f"{name}/bias") else []
        parts = [x, self.constant(f"{name}.scale", scale), *shift]
        return self.node("LayerNormalization", name, *parts, axis=-1, epsilon=_EPSILON)

    def channels(self, name: str) -> int:
        """Returns the number of channels that a convolution will give; call it before adding that."""
        return len(self._params.get(f"{name}/bias", ()))

    def convolution(self, name: str, x: str, *, stride: int = 1, pads: Sequence[int] = (0, 0, 0, 0)) -> str:
        """Adds a convolution; `pads` are rows and columns of zeros above, left, below and right."""
        kernel = self.take(f"{name}/kernel").transpose(3, 2, 0, 1)
        weights = self.constant(f"{name}.kernel", kernel), self.constant(f"{name}.bias", self.take(f"{name}/bias"))
        shape = {"kernel_shape": list(kernel.shape[2:]), "strides": [stride, stride], "pads": list(pads)}
        return self.node("Conv", name, x, *weights, **shape)


Image = tuple[int, int, int]  # rows, columns, channels
Core = Callable[[Graph, NetworkConfig, str, np.ndarray], str]
Torso = Callable[[Graph, NetworkConfig, str, str, Image], tuple[str, Image]]


def policy(agent: Agent, params: Params, facts: Mapping[str, str]) -> onnx.ModelProto:
    """Makes an ONNX model of an agent's network and its parameters, with `facts` as metadata.

    Raises:
      ConfigError: the network has a part that this module does not know, or other parameters.
    """
    config = agent.config.network
    graph = Graph(params["params"])
    write_core = _known("network.core", config.core, CORES)
    if config.core_kwargs:
        raise refuse("network.core_kwargs", dict(config.core_kwargs), "{}", why="cannot be exported")
    x, order = _features(graph, config, agent.image_shapes)
    side = side_width(agent)
    if side:
        x = graph.node("Concat", "told", x, graph.input("side", side), axis=-1)
        order = np.concatenate([order, len(order) + np.arange(side)])
    hidden = write_core(graph, config, x, order)
    _head(graph, "natural", hidden)
    if agent.network.num_vision_actions:
        last = f"image_{len(agent.image_shapes) - 1}"
        _head(graph, "vision", hidden, _priority(graph, last, hidden) if config.priority_map else None)
    if graph.left_over():
        raise refuse("parameters", accepted=_ACCEPTED, why=f"the network has no {graph.left_over()[0]}")
    return _model(graph, facts)


def side_width(agent: Agent) -> int:
    """Counts the numbers that the core is told beside the images."""
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


def _features(graph: Graph, config: NetworkConfig, shapes: Sequence[Image]) -> tuple[str, np.ndarray]:
    """Adds a torso per image, joins the features and adds the dense layer, if there is one.

    Returns the value [batch, F] and the place of each of its numbers in the network's order.
    """
    write_torso = _known("network.torso", config.torso, TORSOS)
    names, orders, start = [], [], 0
    for i, shape in enumerate(shapes):
        name = graph.input(f"image_{i}", shape[2], *shape[:2])
        if min(shape[:2]) >= smallest_image(config.torso):
            name, shape = write_torso(graph, config, f"torso_{i}", name, shape)
        names.append(graph.node("Flatten", f"features_{i}", name, axis=1))
        # ONNX puts channels first, the network has them last: the rows of the next kernel are sorted anew.
        orders.append(start + np.arange(np.prod(shape)).reshape(shape).transpose(2, 0, 1).ravel())
        start += int(np.prod(shape))
    x = graph.node("Concat", "features", *names, axis=-1) if len(names) > 1 else names[0]
    order = np.concatenate(orders)
    if not config.dense:
        return x, order
    if config.dense_norm:
        x = graph.layer_norm("dense_norm", x, len(order))
    return graph.node("Relu", "dense_relu", graph.dense("dense", x, order)), np.arange(config.dense)


def _nature(graph: Graph, config: NetworkConfig, name: str, x: str, shape: Image) -> tuple[str, Image]:
    """Adds a `torsos.NatureTorso`."""
    height, width, channels = shape
    first = (8, 4) if min(height, width) >= 44 else (4, 2)
    covers = config.padding == "cover"
    for layer, (kernel, stride) in enumerate((first, (4, 2), (3, 1))):
        if min(height, width) < kernel:
            continue
        below, right = (-(size - kernel) % stride if covers and layer else 0 for size in (height, width))
        grown = [kernel + (size - kernel) % stride if covers and not layer else kernel for size in (height, width)]
        channels = graph.channels(f"{name}/Convolution_{layer}")
        x = graph.convolution(f"{name}/Convolution_{layer}", x, stride=stride, pads=(0, 0, below, right))
        x = graph.node("Relu", f"{name}/relu_{layer}", x)
        height = (height + below - grown[0]) // stride + 1
        width = (width + right - grown[1]) // stride + 1
    return x, (height, width, channels)


def _a3c(graph: Graph, config: NetworkConfig, name: str, x: str, shape: Image) -> tuple[str, Image]:
    """Adds a `torsos.A3CTorso`."""
    height, width, channels = shape
    for layer, (kernel, border) in enumerate(((5, 2), (5, 1), (4, 1), (3, 1))):
        channels = graph.channels(f"{name}/Convolution_{layer}")
        x = graph.convolution(f"{name}/Convolution_{layer}", x, pads=(border,) * 4)
        height, width = height + 2 * border - kernel + 1, width + 2 * border - kernel + 1
        if min(height, width) > 4:
            x = graph.node("MaxPool", f"{name}/pool_{layer}", x, kernel_shape=[2, 2], strides=[2, 2])
            height, width = height // 2, width // 2
        x = graph.node("Relu", f"{name}/relu_{layer}", x)
    return x, (height, width, channels)


def _impala(graph: Graph, config: NetworkConfig, name: str, x: str, shape: Image) -> tuple[str, Image]:
    """Adds a `torsos.ImpalaTorso`, whose convolutions keep the image's size."""
    height, width, channels = shape
    layers = itertools.count()

    def convolve(x: str) -> str:
        return graph.convolution(f"{name}/Conv_{next(layers)}", x, pads=(1,) * 4)

    part = 0
    while graph.has(f"{name}/Conv_{5 * part}/kernel"):
        channels = graph.channels(f"{name}/Conv_{5 * part}")
        # 'SAME' as in Flax: an odd row or column of zeros goes below or to the right.
        missing = [max(2 * (-(-size // 2) - 1) + 3 - size, 0) for size in (height, width)]
        pads = [m // 2 for m in missing] + [m - m // 2 for m in missing]
        pool = {"kernel_shape": [3, 3], "strides": [2, 2], "pads": pads}
        x = graph.node("MaxPool", f"{name}/pool_{part}", convolve(x), **pool)
        height, width = -(-height // 2), -(-width // 2)
        for block in (f"{name}/block_{part}_{i}" for i in range(2)):
            inner = convolve(graph.node("Relu", f"{block}/relu_0", x))
            x = graph.node("Add", f"{block}/sum", x, convolve(graph.node("Relu", f"{block}/relu_1", inner)))
        part += 1
    return graph.node("Relu", f"{name}/relu", x), (height, width, channels)


def _small(graph: Graph, config: NetworkConfig, name: str, x: str, shape: Image) -> tuple[str, Image]:
    """Adds a `torsos.SmallTorso`."""
    height, width, channels = shape
    for layer, kernel in enumerate((4, 3)):
        below, right = -(height - kernel) % 2, -(width - kernel) % 2
        channels = graph.channels(f"{name}/Conv_{layer}")
        x = graph.convolution(f"{name}/Conv_{layer}", x, stride=2, pads=(0, 0, below, right))
        x = graph.node("Relu", f"{name}/relu_{layer}", x)
        height, width = (height + below - kernel) // 2 + 1, (width + right - kernel) // 2 + 1
    return x, (height, width, channels)


def _lstm(graph: Graph, config: NetworkConfig, x: str, order: np.ndarray) -> str:
    """Adds one step of `cores.LSTM`, with its gates in the order input, forget, candidate, output.

    ONNX's own LSTM has no place for the norm between the input's product and the gates.
    """
    cell, hidden = (graph.input(state, config.lstm) for state in ("cell", "hidden"))
    projected = _projected(graph, config, x, order, gates=4, prefix="lstm_")
    gates = graph.node("Add", "gates", projected, graph.product("lstm_recurrent", hidden))
    sums = graph.split("gates", gates, ["input", "forget", "candidate", "output"], config.lstm)
    i, f, o = (graph.node("Sigmoid", f"{sums[gate]}_gate", sums[gate]) for gate in (0, 1, 3))
    candidate = graph.node("Tanh", f"{sums[2]}_gate", sums[2])
    kept, new = graph.node("Mul", "kept", f, cell), graph.node("Mul", "new", i, candidate)
    next_cell = graph.node("Add", graph.output("next_cell", config.lstm), kept, new)
    squashed = graph.node("Tanh", "squashed", next_cell)
    return graph.node("Mul", graph.output("next_hidden", config.lstm), o, squashed)


def _gru(graph: Graph, config: NetworkConfig, x: str, order: np.ndarray) -> str:
    """Adds one step of `cores.GRU`, with the reset gate after the recurrent product."""
    hidden = graph.input("hidden", config.lstm)
    projected = _projected(graph, config, x, order, gates=3, prefix="core/")
    reset, keep, new = graph.split("from_input", projected, ["reset", "keep", "candidate"], config.lstm)
    recurrent = graph.product("core/recurrent", hidden)
    r, k, n = graph.split("from_memory", recurrent, ["reset_memory", "keep_memory", "candidate_memory"], config.lstm)
    r = graph.node("Sigmoid", "reset_gate", graph.node("Add", "reset_sum", reset, r))
    bias = graph.constant("core/bias", graph.take("core/bias"))
    remembered = graph.node("Mul", "remembered", r, graph.node("Add", "candidate_biased", n, bias))
    candidate = graph.node("Tanh", "squashed", graph.node("Add", "candidate_sum", new, remembered))
    return _mixed(graph, config, graph.node("Add", "keep_sum", keep, k), hidden, candidate)


def _mingru(graph: Graph, config: NetworkConfig, x: str, order: np.ndarray) -> str:
    """Adds one step of `cores.MinGRU`."""
    hidden = graph.input("hidden", config.lstm)
    projected = _projected(graph, config, x, order, gates=2, prefix="core/")
    keep, candidate = graph.split("from_input", projected, ["keep", "candidate"], config.lstm)
    return _mixed(graph, config, keep, hidden, candidate)


def _memoryless(graph: Graph, config: NetworkConfig, x: str, order: np.ndarray) -> str:
    """Adds a `cores.Memoryless`, which has no state."""
    return graph.node("Relu", "core", _projected(graph, config, x, order, gates=1, prefix="core/"))


def _mixed(graph: Graph, config: NetworkConfig, keep: str, hidden: str, candidate: str) -> str:
    """Adds the next state: sigmoid(keep) of `hidden`, the rest of `candidate`."""
    keep = graph.node("Sigmoid", "keep_gate", keep)
    rest = graph.node("Sub", "rest", graph.constant("one", np.ones((), np.float32)), keep)
    kept, new = graph.node("Mul", "kept", keep, hidden), graph.node("Mul", "new", rest, candidate)
    return graph.node("Add", graph.output("next_hidden", config.lstm), kept, new)


def _projected(graph: Graph, config: NetworkConfig, x: str, order: np.ndarray, *, gates: int, prefix: str) -> str:
    """Adds the input's part of a core's gates."""
    projected = graph.dense(f"{prefix}input", x, order)
    return graph.layer_norm(f"{prefix}norm", projected, gates * config.lstm) if config.lstm_norm else projected


def _priority(graph: Graph, cells: str, hidden: str) -> str:
    """Adds what `Network.priority` gives to the logits of the vision head, [batch, cells]."""
    near = graph.node("Relu", "map_relu", graph.convolution("map_near", cells, pads=(1,) * 4))
    flat = graph.node("Reshape", "map_flat", near, graph.constant("map_flat.shape", np.array([0, 0, -1])))
    kernel, bias = graph.take("map_keys/kernel").T, graph.take("map_keys/bias")[:, None]
    products = graph.node("MatMul", "map_products", graph.constant("map_keys.kernel", kernel), flat)
    keys = graph.node("Add", "map_keys", products, graph.constant("map_keys.bias", bias))
    scaled = graph.constant("map_scale", np.array(len(kernel) ** -0.5, np.float32))
    query = graph.node("Mul", "map_query_scaled", graph.dense("map_query", hidden), scaled)
    row = graph.node("Unsqueeze", "map_row", query, graph.constant("map_row.axis", np.array([1])))
    matches = graph.node("MatMul", "map_matches", row, keys)
    return graph.node("Squeeze", "map", matches, graph.constant("map.axis", np.array([1])))


def _head(graph: Graph, name: str, hidden: str, more: str | None = None) -> None:
    """Adds a head: its logits, plus `more`, and its value."""
    for part, output in (("policy", "logits"), ("value", "value")):
        kernel, bias = graph.take(f"{name}_{part}/kernel"), graph.take(f"{name}_{part}/bias")
        weights = graph.constant(f"{name}_{part}.kernel", kernel), graph.constant(f"{name}_{part}.bias", bias)
        given = graph.output(f"{name}_{output}", len(bias))
        if more and part == "policy":
            graph.node("Add", given, graph.node("Gemm", f"{name}_{part}", hidden, *weights), more)
        else:
            graph.node("Gemm", given, hidden, *weights)


TORSOS: dict[str, Torso] = {"nature": _nature, "a3c": _a3c, "impala": _impala, "small": _small}
# A core adds one step: it reads the features, adds an input and an output `next_<state>` for each of its states, and
# returns the value that the heads read.
CORES: dict[str, Core] = {"lstm": _lstm, "gru": _gru, "mingru": _mingru, "none": _memoryless}


def _known(key: str, name: str, parts: Mapping[str, Any]) -> Any:
    if name not in parts:
        raise refuse(key, name, parts, why="cannot be exported")
    return parts[name]
