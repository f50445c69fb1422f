"""A convolution as patches times kernel: with it both gradients are matrix products too."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Window(NamedTuple):
    """The size of a patch and its steps."""

    height: int
    width: int
    down: int = 1
    across: int = 1

    def number(self, x: Float[Array, "N H W C"]) -> tuple[int, int]:
        """Patches of an image, down and across: h and w."""
        return (x.shape[1] - self.height) // self.down + 1, (x.shape[2] - self.width) // self.across + 1


def patches(x: Float[Array, "N H W C"], window: Window) -> Float[Array, "R P"]:
    """All patches as rows, [N*h*w, height*width*C]: first the columns of each are put together, then its rows.

    The window's width is a multiple of its step across.
    """
    h, w = window.number(x)
    blocks = _blocks(x, window)
    x = jnp.stack([blocks[:, :, j : j + w] for j in range(window.width // window.across)], axis=3)
    x = x.reshape(*x.shape[:3], -1)
    slices = [x[:, i : i + window.down * (h - 1) + 1 : window.down] for i in range(window.height)]
    return jnp.stack(slices, axis=3).reshape(x.shape[0] * h * w, -1)


def add_patches(rows: Float[Array, "R P"], x: Float[Array, "N H W C"], window: Window) -> Float[Array, "N H W C"]:
    """The transpose of `patches`: every value added to where it comes from, in an image like `x`."""
    (image,) = jax.linear_transpose(lambda x: _patches_at_once(x, window), x)(rows)
    return image


def kernel_gradient(dy: Float[Array, "*B R D"], rows: Float[Array, "*B R P"]) -> Float[Array, "*B P D"]:
    """rows^T dy as (dy^T rows)^T, two thirds of the time: the long axis is contracted with the few features first.

    XLA would make the one form of the other again.
    """
    return jax.lax.optimization_barrier(dy.mT @ rows).mT


def _patches_at_once(x: Array, window: Window) -> Array:
    """`patches` in one step: slower, but for most layers its transpose takes a half to a third of the time."""
    h, w = window.number(x)
    blocks = _blocks(x, window)
    rows = [blocks[:, i : i + window.down * (h - 1) + 1 : window.down] for i in range(window.height)]
    slices = [row[:, :, j : j + w] for row in rows for j in range(window.width // window.across)]
    return jnp.stack(slices, axis=3).reshape(x.shape[0] * h * w, -1)


def _blocks(x: Array, window: Window) -> Array:
    """Rows in blocks of `across` pixels, [N, H, blocks, across*C]: fewer and longer slices to copy."""
    n, rows, _, channels = x.shape
    blocks = window.number(x)[1] - 1 + window.width // window.across
    return x[:, :, : blocks * window.across].reshape(n, rows, blocks, window.across * channels)


@dataclasses.dataclass(frozen=True)
class PatchForm:
    """Any convolution whose kernel's width is a multiple of its step."""

    down: int
    across: int

    def _window(self, kernel: Array) -> Window:
        return Window(kernel.shape[0], kernel.shape[1], self.down, self.across)

    def patch_values(self, x: Array, kernel: Array) -> int:
        """Values in the patches of one image."""
        return math.prod(self._window(kernel).number(x)) * math.prod(kernel.shape[:3])

    def forward(self, x: Array, kernel: Array) -> tuple[Array, Array]:
        """The convolution, [N, h, w, D], and what the gradient needs again."""
        window, features = self._window(kernel), kernel.shape[3]
        rows = patches(x, window)
        return (rows @ kernel.reshape(-1, features)).reshape(-1, *window.number(x), features), rows

    def backward(self, x: Array, kernel: Array, rows: Array, dy: Array) -> tuple[Array, Array]:
        """Gradients of image and kernel."""
        features = kernel.shape[3]
        dy = dy.reshape(-1, features)
        dkernel = kernel_gradient(dy, rows).reshape(kernel.shape)
        return add_patches(dy @ kernel.reshape(-1, features).T, x, self._window(kernel)), dkernel
