"""What a decision costs: counts against hand counts, and a record for every experiment."""

from __future__ import annotations

import functools
import json

import jax
import jax.numpy as jnp
import pytest

from foajax import cli
from foajax import cost as command
from foajax.config.compose import compose
from foajax.learning.agent import Agent
from foajax.networks import torsos
from foajax.reporting import cost

KEYS = {
    *("experiment", "torso", "pixels_nominal", "pixels_actual", "torso_flops", "decision_flops", "params"),
    *(f"{part}_us_batch{batch}" for part in ("sense", "network", "decision") for batch in (1, 32)),
}


def convolution(side, kernel, stride, channels, features):
    """Hand count of a layer with bias and ReLU, and the side of its output."""
    out = (side - kernel) // stride + 1
    return out, out * out * features * (2 * kernel * kernel * channels + 2)


def nature(side):
    """Hand count of the Nature torso on a square image, none of which is left out."""
    total, channels = 0, 1
    size, step = (8, 4) if side >= 44 else (4, 2)
    for features, (kernel, stride) in ((32, (size + (side - size) % step, step)), (64, (4, 2)), (64, (3, 1))):
        side += -(side - kernel) % stride
        side, count = convolution(side, kernel, stride, channels, features)
        total, channels = total + count, features
    return total


def count(experiment, network="nature"):
    agent = Agent(compose([f"experiment={experiment}", f"network={network}"]), num_actions=4, crop_top=None)
    return cost._count(agent, jax.eval_shape(agent.initial_params, jax.random.key(0)))


def test_a_multiply_add_counts_as_two():
    x, layer = jnp.zeros((1, 80, 80, 1)), torsos.convolution(32, (8, 8), 4, use_bias=False)
    params = jax.eval_shape(layer.init, jax.random.key(0), x)
    assert cost.flops(layer.apply, params, x) == 2 * 19 * 19 * 32 * 8 * 8 == 1_478_656
    assert cost.flops(layer.apply, params, jnp.zeros((5, 80, 80, 1))) == 5 * 1_478_656


@pytest.mark.parametrize(
    "experiment, sides",
    [
        ("nonfoa", [80]),
        ("constant70", [80]),
        ("constant70_packed", [35]),
        ("decreasing_p_packed", [30, 25, 18]),
    ],
)
def test_the_torso_against_a_hand_count(experiment, sides):
    paddings = 2 * len(sides)  # XLA counts one operation for each, whatever its size
    assert 0 <= count(experiment)["torso_flops"] - sum(map(nature, sides)) <= paddings


def test_a_decision_adds_dense_layers_lstm_and_little_else():
    record = count("nonfoa")
    # 7x7x64 features to 256, with last action and reward to gates of 256, the recurrence, four actions and a value.
    products = 2 * (3136 * 256 + (256 + 5) * 1024 + 256 * 1024 + 256 * 5)
    rest = record["decision_flops"] - record["torso_flops"] - products
    assert 0 < rest < 0.01 * record["decision_flops"]
    norm = 2 * 1024  # scale and bias
    biases, torso = 256 + 1024 + 5, 64 * 32 + 32 + 16 * 32 * 64 + 64 + 9 * 64 * 64 + 64
    assert record["params"] == products // 2 + biases + norm + torso


def test_the_paper_s_pixel_counts_and_its_claim():
    full, canvas, packed = count("nonfoa"), count("constant70"), count("constant70_packed")
    assert (full["pixels_nominal"], full["pixels_actual"], full["pixels_ratio"]) == (6400, 6400, 1.0)
    assert canvas["pixels_actual"] == packed["pixels_actual"] == 1225
    assert packed["pixels_ratio"] == 1225 / 6400
    assert canvas["torso_flops"] == full["torso_flops"] > packed["torso_flops"]


def test_the_other_torso():
    record = count("nonfoa", "a3c")
    assert record["torso"] == "a3c"
    # Four convolutions of 80, 38, 18 and 8 positions a side; what pooling and ReLU add is below 2%.
    products = 2 * (80**2 * 32 * 25 + 38**2 * 32 * 25 * 32 + 18**2 * 64 * 16 * 32 + 8**2 * 64 * 9 * 64)
    assert products < record["torso_flops"] < 1.02 * products


def test_the_saving_is_what_the_readme_says():
    full, packed = count("nonfoa", "a3c"), count("constant70_packed", "a3c")
    assert [round(packed[f"{part}_flops"] / full[f"{part}_flops"], 2) for part in ("torso", "decision")] == [0.15, 0.18]


@pytest.mark.slow
def test_the_command(tmp_path, capsys):
    out = tmp_path / "cost.json"
    assert cli.run(command.cost, ["experiments=constant70_packed", "repeats=3", f"json={out}"]) == 0
    found = json.loads(out.read_text())
    records = found["results"]
    assert found["command"] == f"python -m foajax.cost experiments=constant70_packed repeats=3 json={out}"
    assert [record["experiment"] for record in records] == ["constant70_packed", "nonfoa"]
    for record in records:
        assert set(record) >= KEYS
        assert all(record[key] > 0 for key in KEYS - {"experiment", "torso"})
    packed, full = records
    assert full["torso_flops_ratio"] == full["decision_us_batch1_ratio"] == 1
    assert packed["torso_flops_ratio"] == packed["torso_flops"] / full["torso_flops"]
    assert packed["decision_us_batch32_ratio"] == packed["decision_us_batch32"] / full["decision_us_batch32"]
    printed = capsys.readouterr().out
    assert "constant70_packed" in printed
    assert f"jax {jax.__version__}" in printed


@pytest.mark.parametrize(
    "word, message",
    [
        ("experiments=nonfoa,constant71", "experiments=constant71: did you mean constant70? accepted is one of"),
        ("repeats=0", "repeats=0: accepted is an integer >= 1"),
        ("torso=resnet", "torso=resnet: accepted is one of nature, a3c or null"),
        (
            "json=/nowhere/at/all.json",
            "json=/nowhere/at/all.json: accepted is a file that can be written, in a directory",
        ),
    ],
)
def test_a_mistake_is_one_line(word, message, capsys):
    assert cli.run(command.cost, [word]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foajax: error: {message}")
    assert error.count("\n") == 1


def test_without_names_all_experiments_on_frames_of_80x80_are_timed_as_exported():
    timed = command.Options(target="onnx").names
    assert "nonfoa" in timed and "search_full" not in timed
    assert set(timed) < set(command.Options().names)


def test_an_experiment_keeps_its_own_network_unless_one_is_asked_for():
    def torsos_of(torso):
        found = cost.compose_each(["search_rings_p"], torso=torso, color=False)
        return {name: config.network.torso for name, config in found.items()}

    assert torsos_of(None) == {"search_rings_p": "small", "nonfoa": "nature"}
    assert torsos_of("a3c") == {"search_rings_p": "a3c", "nonfoa": "a3c"}


def test_a_run_of_its_own_is_measured():
    config = compose(["sensor=rings", "sensor.rings=[[24,24,2]]", "name=mine", "network.dense=8", "network.lstm=8"])
    (record,) = cost.measure_decisions([config], repeats=2)
    assert record["experiment"] == "mine" and record["pixels_actual"] == 144 and record["decision_us_batch1"] > 1


def test_calls_take_turns_and_the_median_counts(monkeypatch):
    order, clock = [], iter([0, 1, 0, 9, 0, 2, 0, 9, 0, 30, 0, 9])
    monkeypatch.setattr(cost.time, "perf_counter", lambda: next(clock))
    groups = [{"a": functools.partial(order.append, "a")}, {"b": functools.partial(order.append, "b")}]
    assert cost.medians(groups, 3) == [{"a": 2e6}, {"b": 9e6}]
    assert "".join(order) == "aabb" * 3  # each after one untimed, which compiles
