"""Cores, the network's memory from step to step. A new one is a Flax module with the two methods of `Core`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from foajax.config.parse import refuse
from foajax.config.parts import is_code, make_part
from foajax.config.schema import NetworkConfig
from foajax.networks.lstm import lstm
from foajax.types import CoreState

Carry = Any  # a pytree of arrays [B, ...]


@runtime_checkable
class Core(Protocol):
    """The memory of the network: a Flax module that reads T steps of B environments in order.

    The state is any pytree of arrays [B, ...]. Where an episode begins, forget it: no step may depend on the episode
    before.
    """

    def initial_state(self, batch: int) -> Carry:
        """Returns the state before the very first step. It may not use parameters."""

    def __call__(
        self, inputs: Float[Array, "T B F"], is_first: Bool[Array, "T B"], state: Carry
    ) -> tuple[Float[Array, "T B L"], Carry]:
        """Reads T steps.

        Args:
          inputs: features of each step, and what the network is told beside them.
          is_first: true where an episode begins with the step: forget the state before it.
          state: the state before the first of these steps.

        Returns:
          The outputs for the heads, and the state after the last step.
        """


class LSTM(nn.Module):
    """Hochreiter & Schmidhuber (1997); its gradient is written out (`foajax.networks.lstm`)."""

    width: int
    norm: bool = True
    forget_bias: float = 1.0

    def initial_state(self, batch: int) -> CoreState:
        zeros = jnp.zeros((batch, self.width))
        return CoreState(cell=zeros, hidden=zeros)

    @nn.compact
    def __call__(
        self, inputs: Float[Array, "T B F"], is_first: Bool[Array, "T B"], state: CoreState
    ) -> tuple[Float[Array, "T B L"], CoreState]:
        projected = _project(inputs, (0.0, self.forget_bias, 0.0, 0.0), self, "lstm_")
        return lstm(projected, self.param("lstm_recurrent", _orthogonal, self.width, 4), is_first, state)


class GRU(nn.Module):
    """Cho et al. (2014), with the reset gate after the recurrent product, as cuDNN has it."""

    width: int
    norm: bool = True
    forget_bias: float = 1.0

    def initial_state(self, batch: int) -> Float[Array, "B L"]:
        return jnp.zeros((batch, self.width))

    @nn.compact
    def __call__(
        self, inputs: Float[Array, "T B F"], is_first: Bool[Array, "T B"], state: Float[Array, "B L"]
    ) -> tuple[Float[Array, "T B L"], Float[Array, "B L"]]:
        projected = _project(inputs, (0.0, self.forget_bias, 0.0), self)
        recurrent = self.param("recurrent", _orthogonal, self.width, 3)
        bias = self.param("bias", nn.initializers.zeros, (self.width,))[None]

        def step(hidden: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            projected, is_first = inputs
            hidden = jnp.where(is_first[:, None], 0.0, hidden)
            (reset, keep, new), (r, k, n) = (jnp.split(x, 3, -1) for x in (projected, hidden @ recurrent))
            keep = jax.nn.sigmoid(keep + k)
            hidden = keep * hidden + (1.0 - keep) * jnp.tanh(new + jax.nn.sigmoid(reset + r) * (n + bias))
            return hidden, hidden

        last, hiddens = jax.lax.scan(step, state, (projected, is_first))
        return hiddens, last


class MinGRU(nn.Module):
    """A recurrence that is linear in its state (Feng et al. 2024): all steps at once, in log T rounds.

    h_t = a_t h_{t-1} + (1 - a_t) c_t, where a_t and c_t depend on step t's input alone. At an episode's start h_{t-1}
    counts as 0.
    """

    width: int
    norm: bool = True
    forget_bias: float = 1.0

    def initial_state(self, batch: int) -> Float[Array, "B L"]:
        return jnp.zeros((batch, self.width))

    @nn.compact
    def __call__(
        self, inputs: Float[Array, "T B F"], is_first: Bool[Array, "T B"], state: Float[Array, "B L"]
    ) -> tuple[Float[Array, "T B L"], Float[Array, "B L"]]:
        keep, candidate = jnp.split(_project(inputs, (self.forget_bias, 0.0), self), 2, -1)
        keep = jax.nn.sigmoid(keep)
        added = (1.0 - keep) * candidate
        state = jnp.where(is_first[0][:, None], 0.0, state)  # whatever it held
        added = added.at[0].add(keep[0] * state)
        keep = jnp.where(is_first[..., None], 0.0, keep)

        def join(before: tuple[Array, Array], after: tuple[Array, Array]) -> tuple[Array, Array]:
            return before[0] * after[0], after[0] * before[1] + after[1]

        _, hiddens = jax.lax.associative_scan(join, (keep, added))
        return hiddens, hiddens[-1]


class Memoryless(nn.Module):
    """No memory, for a control: a dense layer in its place, which reads the same inputs."""

    width: int
    norm: bool = True
    forget_bias: float = 0.0  # nothing is kept

    def initial_state(self, batch: int) -> tuple[()]:
        return ()

    @nn.compact
    def __call__(
        self, inputs: Float[Array, "T B F"], is_first: Bool[Array, "T B"], state: tuple[()]
    ) -> tuple[Float[Array, "T B L"], tuple[()]]:
        return nn.relu(_project(inputs, (0.0,), self)), ()


CORES = {"lstm": LSTM, "gru": GRU, "mingru": MinGRU, "none": Memoryless}  # by `network.core`


def make_core(config: NetworkConfig) -> Any:
    """Makes the core that `network.core` names, a Flax module.

    Raises:
      ConfigError: `network.core` names code that cannot be found, takes other arguments or is no core.
    """
    own = {"width": config.lstm, "norm": config.lstm_norm, "forget_bias": config.forget_bias}
    arguments = dict(config.core_kwargs) if is_code(config.core) else own | dict(config.core_kwargs)
    made = make_part("network.core", config.core, CORES, **arguments)
    if not (isinstance(made, nn.Module) and isinstance(made, Core)):
        raise refuse("network.core", config.core, "a Flax module with the methods of foajax.networks.cores.Core")
    return made


def _project(inputs: Float[Array, "T B F"], biases: Sequence[float], core: Any, prefix: str = "") -> Array:
    """Computes the inputs' part of each gate, [T, B, gates * width], for all steps at once and outside of any loop.

    `biases` are the gates' initial biases. A positive one opens a gate that keeps, so that memory lasts some steps
    (Jozefowicz et al. 2015).
    """

    def init(key: Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Array:
        return jnp.repeat(jnp.array(biases, dtype), shape[0] // len(biases))

    dense = nn.Dense(
        len(biases) * core.width,
        kernel_init=nn.initializers.orthogonal(1.0),
        bias_init=nn.initializers.zeros if core.norm else init,
        name=f"{prefix}input",
    )
    if not core.norm:
        return dense(inputs)
    # Ba et al. (2016). Without it a long training drives the gates to 0 and 1, and the score stands still.
    return nn.LayerNorm(bias_init=init, name=f"{prefix}norm")(dense(inputs))


def _orthogonal(key: Array, width: int, gates: int) -> Array:
    """Draws an orthogonal recurrent matrix for each gate."""
    make = nn.initializers.orthogonal(1.0)
    return jnp.concatenate([make(k, (width, width)) for k in jax.random.split(key, gates)], axis=-1)
