"""Torsos: from one image of the sensor to features. A new one is a Flax module that takes [N, H, W, C]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from foajax.config.parse import refuse
from foajax.config.parts import make_part
from foajax.config.schema import NetworkConfig

RELU_GAIN = math.sqrt(2.0)  # keeps the variance through a ReLU (He et al. 2015)


def convolution(features: int, kernel: tuple[int, int], stride: int = 1, **more: Any) -> nn.Conv:
    """Makes a convolution with a bias and, unless `more` says otherwise, no padding."""
    init = nn.initializers.orthogonal(RELU_GAIN)
    return nn.Conv(features, kernel, (stride, stride), **{"padding": "VALID", "kernel_init": init, **more})


class NatureTorso(nn.Module):
    """Convolutions of Mnih et al. (2015): 32 8x8/4, 64 4x4/2, 64 3x3/1.

    A packed image is already subsampled, so below 44 pixels the first layer halves its kernel and stride: a
    unit then sees about the same patch of the frame as on the canvas. Layers that no longer fit are left out.
    The strides fit the 84 pixels of that paper and leave out the last 4 rows and columns of 80, where Breakout has
    its paddle. With `covers` nothing is left out: the first kernel grows by what its stride leaves, which costs little
    there, and the maps of the others are padded with zeros.
    """

    widths: Sequence[int] = (32, 64, 64)
    covers: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "N H W C"]) -> Float[Array, "N F"]:
        first = (8, 4) if min(x.shape[1:3]) >= 44 else (4, 2)
        layers = zip(self.widths, (first, (4, 2), (3, 1)), strict=True)
        for layer, (features, (kernel, stride)) in enumerate(layers):
            if min(x.shape[1:3]) < kernel:
                continue
            height = width = kernel
            if self.covers and layer == 0:
                height, width = (kernel + (size - kernel) % stride for size in x.shape[1:3])
            elif self.covers:
                bottom, right = (-(size - kernel) % stride for size in x.shape[1:3])
                x = jnp.pad(x, ((0, 0), (0, bottom), (0, right), (0, 0)))
            x = nn.relu(convolution(features, (height, width), stride, name=f"Convolution_{layer}")(x))
        return x.reshape(x.shape[0], -1)


class A3CTorso(nn.Module):
    """Four times 'convolution, 2x2 max-pool, ReLU': 32 5x5, 32 5x5, 64 4x4, 64 3x3, as public A3C code does.

    Maps of 4x4 and less are not pooled further, which on an 80x80 canvas changes nothing.
    """

    widths: Sequence[int] = (32, 32, 64, 64)

    @nn.compact
    def __call__(self, x: Float[Array, "N H W C"]) -> Float[Array, "N F"]:
        layers = zip(self.widths, (5, 5, 4, 3), (2, 1, 1, 1), strict=True)
        for layer, (features, kernel, border) in enumerate(layers):
            x = jnp.pad(x, ((0, 0), (border, border), (border, border), (0, 0)))
            x = convolution(features, (kernel, kernel), name=f"Convolution_{layer}")(x)
            x = nn.relu(max_pool(x) if min(x.shape[1:3]) > 4 else x)
        return x.reshape(x.shape[0], -1)


def max_pool(x: Float[Array, "N H W C"]) -> Float[Array, "N h w C"]:
    """Maximum over 2x2 blocks, stride 2; an odd last row or column is dropped.

    Written with `maximum`, whose gradient is elementwise: that of a windowed reduction is a scalar loop on
    the CPU, 4 to 40 times slower. Equal maxima share the gradient.
    """
    rows, columns = x.shape[1] // 2 * 2, x.shape[2] // 2 * 2
    x = x[:, :rows, :columns]
    x = jnp.maximum(x[:, 0::2], x[:, 1::2])
    return jnp.maximum(x[:, :, 0::2], x[:, :, 1::2])


class ImpalaTorso(nn.Module):
    """The residual torso of Espeholt et al. (2018): per width a 3x3 convolution, a 3x3/2 max-pool and two blocks.

    For accelerators: on a CPU it takes many times as long as the others.
    """

    widths: Sequence[int] = (16, 32, 32)

    @nn.compact
    def __call__(self, x: Float[Array, "N H W C"]) -> Float[Array, "N F"]:
        for width in self.widths:
            x = nn.max_pool(convolution(width, (3, 3), padding="SAME")(x), (3, 3), (2, 2), "SAME")
            for _ in range(2):
                inner = convolution(width, (3, 3), padding="SAME")(nn.relu(x))
                x = x + convolution(width, (3, 3), padding="SAME")(nn.relu(inner))
        return nn.relu(x).reshape(x.shape[0], -1)


class SmallTorso(nn.Module):
    """Two convolutions for images of some hundred values: 16 4x4/2, 32 3x3/2, padded with zeros where strides do not
    fit. A seventh of the nature torso's work on 16x16."""

    widths: Sequence[int] = (16, 32)

    @nn.compact
    def __call__(self, x: Float[Array, "N H W C"]) -> Float[Array, "N F"]:
        for features, kernel in zip(self.widths, (4, 3), strict=True):
            bottom, right = (-(size - kernel) % 2 for size in x.shape[1:3])
            x = jnp.pad(x, ((0, 0), (0, bottom), (0, right), (0, 0)))
            x = nn.relu(convolution(features, (kernel, kernel), 2)(x))
        return x.reshape(x.shape[0], -1)


TORSOS = {"nature": NatureTorso, "a3c": A3CTorso, "small": SmallTorso, "impala": ImpalaTorso}  # by `network.torso`


def make_torso(config: NetworkConfig, name: str | None = None) -> nn.Module:
    """Makes the torso that `network.torso` names, for one image.

    Raises:
      ConfigError: `network.torso` names code that cannot be found, takes other arguments or is no Flax module; or
        `network.widths` are not as many as it has layers.
    """
    arguments: dict[str, Any] = {**config.torso_kwargs, "name": name}
    if config.torso == "nature":
        arguments["covers"] = config.padding == "cover"
    if config.widths is not None:
        arguments["widths"] = config.widths
    made = make_part("network.torso", config.torso, TORSOS, **arguments)
    if not isinstance(made, nn.Module):
        raise refuse("network.torso", config.torso, "a Flax module")
    if isinstance(made, NatureTorso | A3CTorso | SmallTorso) and len(made.widths) != len(type(made).widths):
        accepted = f"{len(type(made).widths)} numbers for network.torso={config.torso}"
        raise refuse("network.widths", list(made.widths), accepted)
    return made
