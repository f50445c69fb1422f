"""The ONNX graph gives what the JAX network gives, whatever it is made of."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.parse import ConfigError, replace

onnx = pytest.importorskip("onnx", reason="needs the extra robot")
onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra robot")
onnx_graph = pytest.importorskip("foajax.robot.onnx_graph", reason="needs the extra robot")

NETWORKS = {
    "one image": ["experiment=constant70_packed"],
    "periphery": ["experiment=constant70_p_packed"],
    "rings": ["experiment=decreasing_p_packed"],
    "canvas": ["experiment=nonfoa"],
    "left out borders": ["experiment=nonfoa", "network.padding=valid"],
    "small images": ["sensor.rings=[[20,20,1],[60,60,3]]", "sensor.layout=packed"],
    "log-polar": ["experiment=logpolar"],
    "a3c": ["experiment=constant70", "network=a3c", *("network.dense=8", "network.lstm=8")],
    "a3c of a small image": ["experiment=constant50_sub2_packed", "network.torso=a3c"],
    "no dense layer": ["experiment=constant70_p_packed", "network.dense=0"],
    "norms": ["experiment=constant70_p_packed", "network.dense_norm=true"],
    "no norm": ["experiment=constant70_packed", "network.lstm_norm=false"],
    "impala": ["experiment=constant50_sub2_packed", "network.torso=impala", "network.widths=[4,8]"],
    "impala of odd images": ["sensor.rings=[[33,21,1]]", "sensor.layout=packed", "network.torso=impala"],
    "widths": ["experiment=constant70_packed", "network.widths=[8,8,16]"],
    "gru": ["experiment=constant70_packed", "network.core=gru"],
    "mingru": ["experiment=constant70_packed", "network.core=mingru", "network.lstm_norm=false"],
    "no memory": ["experiment=constant70_packed", "network.core=none"],
    "a priority map": ["experiment=search_rings_p"],
    "told nothing": [
        *("experiment=nonfoa", "network.last_actions=false", "network.last_reward=false"),
    ],
}


@pytest.mark.parametrize("words", NETWORKS.values(), ids=NETWORKS)
def test_the_graph_is_the_network(words, make_stored):
    stored = make_stored(*words)
    model = onnx_graph.policy(stored.agent, stored.params, {})
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    random = np.random.default_rng(0)
    feed = {i.name: random.normal(size=(3, *i.shape[1:])).astype(np.float32) for i in session.get_inputs()}
    images = [jnp.asarray(x.transpose(0, 2, 3, 1))[None] for name, x in feed.items() if name.startswith("image")]
    side = feed.get("side", np.zeros((3, 0), np.float32))[None]
    leaves, structure = jax.tree.flatten(stored.agent.initial_state(3).core_state)
    states = [name for name in ("cell", "hidden") if name in feed]
    assert len(states) == len(leaves)
    state = jax.tree.unflatten(structure, [jnp.asarray(feed[name]) for name in states])
    inputs = images, jnp.asarray(side), jnp.zeros((1, 3), bool), state
    output, state = jax.jit(stored.agent.forward)(stored.params, *inputs)
    wanted = {"natural_logits": output.natural_logits[0], "natural_value": output.natural_value[0][:, None]}
    if output.vision_logits is not None:
        wanted |= {"vision_logits": output.vision_logits[0], "vision_value": output.vision_value[0][:, None]}
    wanted |= dict(zip([f"next_{name}" for name in states], jax.tree.leaves(state), strict=True))
    for batch in (1, 3):
        results = session.run(None, {name: x[:batch] for name, x in feed.items()})
        found = dict(zip([o.name for o in session.get_outputs()], results, strict=True))
        assert set(found) == set(wanted)
        for name, value in wanted.items():
            np.testing.assert_allclose(found[name], value[:batch], atol=1e-5, err_msg=name)


def test_the_file_says_what_it_is(make_stored):
    stored = make_stored("experiment=constant70_p_packed")
    model = onnx_graph.policy(stored.agent, stored.params, {"game": "breakout"})
    onnx.checker.check_model(model, full_check=True)
    assert [(o.domain, o.version) for o in model.opset_import] == [("", onnx_graph.OPSET)]
    assert {p.key: p.value for p in model.metadata_props} == {"game": "breakout"}
    for value in (*model.graph.input, *model.graph.output):
        assert value.type.tensor_type.shape.dim[0].dim_param == "batch"
    known = {value.name for value in model.graph.value_info}
    named = {name for node in model.graph.node for name in node.output}
    assert named <= known | {value.name for value in model.graph.output}  # every shape is inferred


def test_a_part_that_nobody_knows_is_refused(make_stored):
    stored = make_stored("experiment=constant70_packed")
    params = {"params": stored.params["params"] | {"attention": {"kernel": np.zeros((2, 2), np.float32)}}}
    with pytest.raises(ConfigError, match="parameters: the network has no attention/kernel; accepted is those of"):
        onnx_graph.policy(stored.agent, params, {})


def test_a_part_that_is_missing_is_refused(make_stored):
    stored = make_stored("experiment=constant70_packed")
    params = {"params": {name: part for name, part in stored.params["params"].items() if name != "dense"}}
    with pytest.raises(ConfigError, match="parameters: dense/kernel is missing; accepted is those of"):
        onnx_graph.policy(stored.agent, params, {})


@pytest.mark.parametrize("key", ["core", "torso"])
def test_parts_from_elsewhere_are_refused(key, make_stored):
    stored = make_stored("experiment=constant70_packed")
    config = replace(stored.agent.config, network=replace(stored.agent.config.network, **{key: "mine.parts:Part"}))
    accepted = "lstm, gru, mingru, none" if key == "core" else "nature, a3c, impala"
    message = f"network.{key}=mine.parts:Part: cannot be exported; accepted is one of {accepted}"
    with pytest.raises(ConfigError, match=message):
        onnx_graph.policy(dataclasses.replace(stored.agent, config=config), stored.params, {})


def test_a_core_with_arguments_is_refused(make_stored):
    stored = make_stored("experiment=constant70_packed", "network.core_kwargs.width=64")
    with pytest.raises(ConfigError, match=r"network.core_kwargs=\{'width': 64\}: cannot be exported; accepted is \{\}"):
        onnx_graph.policy(stored.agent, stored.params, {})


def test_16_bits_halve_the_file_and_change_little(make_stored):
    stored = make_stored("experiment=constant70_p_packed", "network.dense=128", "network.lstm=128")
    model = onnx_graph.policy(stored.agent, stored.params, {})
    small = pytest.importorskip("foajax.robot.smaller").float16(model)
    assert small.ByteSize() < 0.6 * model.ByteSize()
    outputs = compare(model, small)
    assert 0 < max(outputs.values()) < 0.01


def test_8_bits_quantise_every_matrix_product(make_stored):
    stored = make_stored("experiment=constant70_p_packed", "network.dense=128", "network.lstm=128")
    model = onnx_graph.policy(stored.agent, stored.params, {"game": "breakout"})
    small = pytest.importorskip("foajax.robot.smaller").int8(model)
    assert small.ByteSize() < 0.5 * model.ByteSize()
    kinds = [node.op_type for node in small.graph.node]
    assert "MatMulInteger" in kinds
    assert not {"MatMul", "Gemm"} & set(kinds)
    assert {"game": "breakout"}.items() <= {p.key: p.value for p in small.metadata_props}.items()
    outputs = compare(model, small)
    assert 0 < max(outputs.values()) < 0.3


def compare(*models):
    """The largest difference of each output of two networks."""
    found = []
    for model in models:
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        random = np.random.default_rng(0)
        feed = {i.name: random.normal(size=(2, *i.shape[1:])).astype(np.float32) for i in session.get_inputs()}
        found.append(dict(zip([o.name for o in session.get_outputs()], session.run(None, feed), strict=True)))
    return {name: float(np.abs(value - found[1][name]).max()) for name, value in found[0].items()}
