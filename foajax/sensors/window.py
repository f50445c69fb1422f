"""An area of a frame: cut out around the focal point, and put back in its place."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num

Shape = tuple[int, int]  # rows, columns


def gather_window(image: Num[Array, "H W"], corner: Int[Array, "2"], size: Shape) -> Num[Array, "h w"]:
    """Cuts an area of `size` with its top-left pixel at `corner` out of an image, 0 where it overhangs."""
    height, width = image.shape
    rows, columns = (first + jnp.arange(length) for first, length in zip(corner, size, strict=True))
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))[None]
    index = jnp.clip(rows, 0, height - 1)[:, None] * width + jnp.clip(columns, 0, width - 1)[None]
    return jnp.where(inside, image.reshape(-1).at[index].get(mode="promise_in_bounds"), 0)


def apart(window: Num[Array, "h w"], corner: Int[Array, "2"]) -> Num[Array, "h w"]:
    """The same window, worked out before it is used.

    Fused into what uses it, a gather is three times slower, and XLA drops optimisation barriers
    before it fuses. A loop that never turns keeps them apart.
    """
    never = corner[0] == np.iinfo(corner.dtype).min
    return lax.while_loop(lambda state: state[0], lambda state: jax.tree.map(jnp.zeros_like, state), (never, window))[1]


def place(image: Float[Array, "h w"], corner: Int[Array, "2"], frame_shape: Shape) -> Float[Array, "H W"]:
    """Puts an image into an empty frame: the inverse of `gather_window`."""
    # XLA reads through the padding and never lays it out.
    padded = jnp.pad(image, [(size, size) for size in frame_shape])
    # A start below 0 would count from the end.
    return lax.dynamic_slice(padded, jnp.maximum(np.array(frame_shape) - corner, 0), frame_shape)
