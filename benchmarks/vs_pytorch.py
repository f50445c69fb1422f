"""How fast is the network against the same one in PyTorch, at the learner's shapes?

    python benchmarks/vs_pytorch.py [experiments=nonfoa,constant70_packed] [torso=nature] [num_envs=4] [out=<file>]

The network is torso, dense layer, LSTM over T+1 = 21 steps (reset where episodes start), and heads. Both sides get the
same random images and parameters, and their outputs are compared first. `forward_backward` is the gradient of a loss
that costs as much as A2C's. `update` adds clipping and Adam with AMSGrad; `update_fused` takes PyTorch's fused Adam.
Both sides run in this process, in turns, with all its cores. Speeds are medians, in steps/s. It needs PyTorch, which
foajax itself does not use: `pip install torch`. Run it on an idle machine.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from foajax import cli
from foajax.config.compose import compose
from foajax.config.schema import Config, NetworkConfig
from foajax.learning.agent import Agent
from foajax.learning.optimizer import make_optimizer
from foajax.reporting import bench
from foajax.runtime import keep_memory
from foajax.types import CoreState, NetworkOutput

STEPS = 21  # T + 1
ACTIONS = 4
PARTS = ("forward", "forward_backward", "update", "update_fused")


class Options(bench.Options):
    experiments: str = Field("nonfoa,constant70_packed", description="Names with commas between them.")
    torso: str = Field("nature", description="Choice of the group network/.")
    num_envs: int = Field(4, ge=1, description="Environments of a minibatch.")
    repeats: int = Field(40, ge=5, description="Repeats of each timing.")


def torch_network(params: dict, network: NetworkConfig) -> tuple[Callable, list]:
    """Builds the network of `foajax.networks.network` from PyTorch's operations; returns it and its parameters."""
    import torch
    import torch.nn.functional as F

    leaves: list = []

    def leaf(array: Any, *order: int) -> Any:
        tensor = torch.tensor(np.asarray(array).transpose(order or range(np.ndim(array))))
        leaves.append(tensor.contiguous().requires_grad_())
        return leaves[-1]

    def linear(own: dict) -> Any:
        weight, bias = leaf(own["kernel"], 1, 0), leaf(own["bias"])
        return lambda x: F.linear(x, weight, bias)

    def convolutions(own: dict) -> Any:
        layers = [(leaf(c["kernel"], 3, 2, 0, 1), leaf(c["bias"])) for _, c in sorted(own.items())]

        def nature(x: Any) -> Any:
            strides = (4 if layers[0][0].shape[-1] >= 8 else 2, 2, 1)
            for (weight, bias), stride in zip(layers, strides, strict=False):
                if network.padding == "cover":
                    bottom, right = (
                        -(size - k) % stride for size, k in zip(x.shape[2:], weight.shape[2:], strict=True)
                    )
                    x = F.pad(x, (0, right, 0, bottom))
                x = F.relu(F.conv2d(x, weight, bias, stride=stride))
            return x

        def a3c(x: Any) -> Any:
            for (weight, bias), border in zip(layers, (2, 1, 1, 1), strict=False):
                x = F.conv2d(x, weight, bias, padding=border)
                x = F.relu(F.max_pool2d(x, 2) if min(x.shape[2:]) > 4 else x)
            return x

        run = nature if network.torso == "nature" else a3c
        return lambda x: run(x).permute(0, 2, 3, 1).flatten(1)  # features in the order of foajax's

    torsos = {int(name[6:]): convolutions(own) for name, own in params.items() if name.startswith("torso_")}
    dense = linear(params["dense"]) if "dense" in params else None
    project = linear(params["lstm_input"])
    norm = [leaf(params["lstm_norm"][name]) for name in ("scale", "bias")] if "lstm_norm" in params else None
    recurrent = leaf(params["lstm_recurrent"], 1, 0)
    heads = [
        linear(params[n]) for n in ("natural_policy", "natural_value", "vision_policy", "vision_value") if n in params
    ]

    def forward(images: Sequence[Any], side: Any, keep: Any, state: tuple) -> list:
        parts = [torsos[i](x) if i in torsos else x.permute(0, 2, 3, 1).flatten(1) for i, x in enumerate(images)]
        features = torch.cat(parts, 1)
        if dense:
            normed = F.layer_norm(features, features.shape[-1:], eps=1e-6) if network.dense_norm else features
            features = F.relu(dense(normed))
        gates = project(torch.cat([features, side], 1))
        if norm:
            gates = F.layer_norm(gates, gates.shape[-1:], *norm, eps=1e-6)
        gates = gates.reshape(*keep.shape[:2], -1)
        cell, hidden = state
        outputs = []
        for t in range(keep.shape[0]):
            cell, hidden = cell * keep[t], hidden * keep[t]
            i, f, g, o = (gates[t] + F.linear(hidden, recurrent)).chunk(4, -1)
            cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
            hidden = torch.sigmoid(o) * torch.tanh(cell)
            outputs.append(hidden)
        stacked = torch.stack(outputs)
        return [head(stacked) for head in heads]

    return forward, leaves


def flat_loss(outputs: Sequence[Any], log_softmax: Callable, actions: Callable) -> Any:
    """Computes a loss that costs as much as A2C's: log-probability, value error and entropy of each head."""
    total = 0.0
    for logits, value in zip(outputs[0::2], outputs[1::2], strict=True):
        log_p = log_softmax(logits)
        total = total + (0.5 * value**2 - log_p[..., :1]).mean() + 0.01 * (actions(log_p) * log_p).sum(-1).mean()
    return total


class Inputs(NamedTuple):
    """What both sides get."""

    roi: list[np.ndarray]  # [T+1, B, h, w, 1] each
    side: np.ndarray  # [T+1, B, S]: what the core is told beside the images
    is_first: np.ndarray  # [T+1, B]

    @classmethod
    def make(cls, agent: Agent, batch: int) -> Inputs:
        """Makes random inputs."""
        random = np.random.default_rng(0)
        integers, numbers = jnp.zeros((1, 2), jnp.int32), jnp.zeros(1)
        width = agent.side(integers, integers, numbers, jnp.zeros(1, bool)).shape[-1]
        return cls(
            roi=[random.normal(size=(STEPS, batch, *shape)).astype(np.float32) for shape in agent.image_shapes],
            side=random.uniform(-1, 1, (STEPS, batch, width)).astype(np.float32),
            is_first=random.random((STEPS, batch)) < 0.02,
        )


def our_calls(agent: Agent, params: Any, inputs: Inputs) -> dict[str, Callable]:
    """Makes foajax's calls; `forward` returns the outputs, `forward_backward` the gradient."""
    images, *others = jax.tree.map(jnp.asarray, inputs)
    zeros = jnp.zeros((inputs.is_first.shape[1], agent.config.network.lstm))
    optimizer = make_optimizer(agent.config.learner, 1)

    def forward(params: Any) -> list:
        output = agent.forward(params, images, *others, CoreState(cell=zeros, hidden=zeros))[0]
        return [x if x.ndim == 3 else x[..., None] for x in NetworkOutput(*output) if x is not None]

    def loss(params: Any) -> Any:
        return flat_loss(forward(params), jax.nn.log_softmax, jnp.exp)

    def step(params: Any, state: Any) -> Any:
        change, state = optimizer.update(jax.grad(loss)(params), state, params)
        return jax.tree.map(jnp.add, params, change), state

    programs = {"forward": jax.jit(forward), "forward_backward": jax.jit(jax.grad(loss))}
    compiled = jax.jit(step, donate_argnums=(0, 1))
    training = [jax.tree.map(jnp.copy, params), optimizer.init(params)]

    def update() -> None:
        training[:] = compiled(*training)
        jax.block_until_ready(training)

    calls: dict[str, Callable] = {
        part: lambda program=program: jax.block_until_ready(program(params)) for part, program in programs.items()
    }
    return calls | {"update": update, "update_fused": update}


def their_calls(agent: Agent, params: Any, inputs: Inputs) -> dict[str, Callable]:
    """Makes the same calls in PyTorch."""
    import torch

    config = agent.config
    run, leaves = torch_network(params["params"], config.network)
    images = [torch.tensor(x.reshape(-1, *x.shape[2:]).transpose(0, 3, 1, 2)).contiguous() for x in inputs.roi]
    side = torch.tensor(inputs.side.reshape(-1, inputs.side.shape[-1]))
    keep = torch.tensor(1.0 - inputs.is_first[..., None].astype(np.float32))
    zeros = torch.zeros(inputs.is_first.shape[1], config.network.lstm)
    most = config.learner.max_grad_norm or 1e9

    def forward() -> list:
        with torch.no_grad():
            return run(images, side, keep, (zeros, zeros))

    def gradient() -> list:
        for leaf in leaves:
            leaf.grad = None
        outputs = run(images, side, keep, (zeros, zeros))
        flat_loss(outputs, lambda x: torch.log_softmax(x, -1), torch.exp).backward()
        return [leaf.grad for leaf in leaves]

    def updating(*, fused: bool) -> Callable:
        rate, eps = config.learner.learning_rate, config.learner.adam_eps
        adam = torch.optim.Adam(leaves, lr=rate, eps=eps, amsgrad=True, fused=fused)

        def update() -> None:
            gradient()
            torch.nn.utils.clip_grad_norm_(leaves, most)
            adam.step()

        return update

    updates = {"update": updating(fused=False), "update_fused": updating(fused=True)}
    return {"forward": forward, "forward_backward": gradient} | updates


def measure(name: str, config: Config, options: Options) -> dict[str, Any]:
    """Measures one experiment on both sides."""
    agent = Agent(config, ACTIONS, None)
    params = agent.initial_params(jax.random.key(0))
    inputs = Inputs.make(agent, options.num_envs)
    sides = our_calls(agent, params, inputs), their_calls(agent, params, inputs)
    for mine, other in zip(*(calls["forward"]() for calls in sides), strict=True):
        np.testing.assert_allclose(mine, other.numpy(), atol=2e-4)
    gradients = (jax.tree.leaves(calls["forward_backward"]()) for calls in sides)
    norms = [float(np.sqrt(sum((np.asarray(g) ** 2).sum() for g in gradient))) for gradient in gradients]
    np.testing.assert_allclose(*norms, rtol=1e-3)
    record: dict[str, Any] = {"experiment": name, "torso": options.torso, "num_envs": options.num_envs}
    record["steps"] = STEPS - 1
    for part in PARTS:
        mine, other = _medians([calls[part] for calls in sides], options.repeats)
        steps = (STEPS - 1) * options.num_envs
        record[part] = {"foajax": steps / mine, "pytorch": steps / other, "ratio": other / mine}
    return record


def _medians(calls: Sequence[Callable], repeats: int) -> list[float]:
    """Times calls in turns of five, in seconds; in between, the other side's threads have time to fall asleep."""
    times: list[list[float]] = [[] for _ in calls]
    for turn in range(repeats // 5 + 1):
        for call, taken in zip(calls, times, strict=True):
            call()
            for _ in range(5):
                begin = time.perf_counter()
                call()
                if turn:
                    taken.append(time.perf_counter() - begin)
    return [statistics.median(taken) for taken in times]


def main(arguments: Sequence[str]) -> None:
    options = cli.parse(Options, arguments)
    configs = {
        name: compose([f"experiment={name}", f"network={options.torso}", "learner=a2c"])
        for name in options.experiments.split(",")
    }
    try:
        import torch
    except ImportError:
        print("left out: PyTorch is not installed")
        return
    keep_memory()
    device = {
        "device": jax.devices()[0].device_kind,
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
    }
    print("  ".join(f"{key} {value}" for key, value in device.items()))
    records = []
    for name, config in configs.items():
        record = measure(name, config, options)
        records.append(record | device)
        for part in PARTS:
            speeds = record[part]
            print(
                f"  {name:20} {part:17} foajax {speeds['foajax']:8,.0f}  PyTorch {speeds['pytorch']:8,.0f} steps/s"
                f"  ratio {speeds['ratio']:.2f}",
                flush=True,
            )
    if options.out:
        bench.write("out", options.out, records, ["python", "benchmarks/vs_pytorch.py", *arguments])


if __name__ == "__main__":
    sys.exit(cli.run(main))
