"""The network with two heads: torso, core, four outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from foajax.config.schema import NetworkConfig
from foajax.networks.cores import LSTM, Carry, make_core
from foajax.networks.torsos import RELU_GAIN, convolution, make_torso
from foajax.types import NetworkOutput, Params

_MAP = 16  # numbers that describe a cell of the priority map


class Network(nn.Module):
    """Torso on every image of the sensor, dense layer, core, natural head and, where gaze is learned, vision head.

    The torso sees all T*B images at once, outside of any loop: convolution gradients inside a loop are slow.
    """

    config: NetworkConfig
    num_natural_actions: int
    num_vision_actions: int  # 0: no vision head (non-FoA, and gaze that is not learned)

    def setup(self) -> None:
        self.core = make_core(self.config)
        if isinstance(self.core, LSTM):
            nn.share_scope(self, self.core)  # agents on disk have its parameters beside the network's own

    @nn.compact
    def __call__(
        self,
        roi: Sequence[Float[Array, "T B _ _ _"]],
        side: Float[Array, "T B S"],
        is_first: Bool[Array, "T B"],
        core_state: Carry,
    ) -> tuple[NetworkOutput, Carry]:
        """Returns outputs [T, B, ...] and the last state. `side` holds what the core is told beside the images."""
        steps, batch = is_first.shape
        features = self.features([image.reshape(steps * batch, *image.shape[2:]) for image in roi])
        features = jnp.concatenate([features, side.reshape(steps * batch, side.shape[-1])], axis=-1)
        hidden, core_state = self.core(features.reshape(steps, batch, -1), is_first, core_state)
        natural_logits, natural_value = self.head("natural", hidden, self.num_natural_actions)
        vision_logits, vision_value = None, None
        if self.num_vision_actions:
            vision_logits, vision_value = self.head("vision", hidden, self.num_vision_actions)
            if self.config.priority_map:
                vision_logits = vision_logits + self.priority(roi[-1], hidden)
        output = NetworkOutput(
            natural_logits=natural_logits,
            natural_value=natural_value,
            vision_logits=vision_logits,
            vision_value=vision_value,
        )
        return output, core_state

    def features(self, images: Sequence[Float[Array, "N _ _ _"]]) -> Float[Array, "N F"]:
        """Concatenates the torso's features of all images, then applies the dense layer if there is one."""
        parts = [
            make_torso(self.config, name=f"torso_{i}")(x)
            if min(x.shape[1:3]) >= smallest_image(self.config.torso)
            else x.reshape(x.shape[0], -1)
            for i, x in enumerate(images)
        ]
        features = jnp.concatenate(parts, axis=-1)
        if self.config.dense:
            if self.config.dense_norm:  # so that one learning rate suits every sensor, however many features it has
                features = nn.LayerNorm(use_bias=False, use_scale=False, name="dense_norm")(features)
            dense = nn.Dense(self.config.dense, kernel_init=nn.initializers.orthogonal(RELU_GAIN), name="dense")
            features = nn.relu(dense(features))
        return features

    def priority(self, cells: Float[Array, "T B h w C"], hidden: Float[Array, "T B L"]) -> Float[Array, "T B V"]:
        """Returns what each cell of the peripheral grid adds to the logit of looking there: its match with a query.

        The query comes from the core's output and is the same for all cells, as are the weights that read a cell and
        its neighbours. So what makes a place worth a look is learned once, not once for each place.
        """
        steps, batch = hidden.shape[:2]
        near = nn.relu(convolution(_MAP, (3, 3), padding="SAME", name="map_near")(cells.reshape(-1, *cells.shape[2:])))
        keys = nn.Dense(_MAP, name="map_keys")(near).reshape(steps, batch, -1, _MAP)
        query = nn.Dense(_MAP, kernel_init=nn.initializers.orthogonal(0.1), name="map_query")(hidden)
        return jnp.einsum("tbvk,tbk->tbv", keys, query) / math.sqrt(_MAP)

    def head(self, name: str, hidden: Float[Array, "T B L"], actions: int) -> tuple[Array, Array]:
        """Returns logits and value of a head. First logits are small: all actions are about equally likely."""
        logits = nn.Dense(actions, kernel_init=nn.initializers.orthogonal(0.01), name=f"{name}_policy")(hidden)
        value = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0), name=f"{name}_value")(hidden)
        return logits, value[..., 0]


def smallest_image(torso: str) -> int:
    """Returns the smallest side of an image that `torso` reads. A smaller image goes straight to the next layer."""
    return 12 if torso == "small" else 8


def initial_params(network: Network, key: Array, image_shapes: Sequence[tuple[int, int, int]], side: int) -> Params:
    """Draws parameters for images of these shapes (h, w, channels), and `side` numbers beside them."""
    roi = [jnp.zeros((1, 1, *shape)) for shape in image_shapes]
    core_state = initial_core_state(network, 1)
    return network.init(key, roi, jnp.zeros((1, 1, side)), jnp.zeros((1, 1), bool), core_state)


def initial_core_state(network: Network, batch: int) -> Carry:
    """Returns the core's state before the first step of `batch` environments."""
    return make_core(network.config).initial_state(batch)
