"""Convolution and max-pooling in the form that suits the backend.

XLA's convolution is right for accelerators. On the CPU its gradients run at a fraction of the speed of a
matrix product, so there a convolution is written as patches times kernel: both gradients are matrix
products too. Where the patches of all images together are too large for the caches, a loop takes some
images at a time. Both forms compute the same numbers; which one is used is settled when a program is traced.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_MANY_IMAGES = 8  # below, when a single agent acts, XLA's own form takes half the time on the CPU too
_CACHED_BYTES = 12 * 2**20  # of patches; measured: 6 to 20 MB are about equal, 40 MB costs twice the time


def convolve(
    x: Float[Array, "N H W C"], kernel: Float[Array, "k l C D"], *, stride: int = 1
) -> Float[Array, "N h w D"]:
    """Valid convolution (cross-correlation, as in every deep-learning library).

    Output side: h = (H - k) // stride + 1, likewise w. Pad the input beforehand for other borders.
    """
    if x.shape[1] < kernel.shape[0] or x.shape[2] < kernel.shape[1]:
        raise ValueError(
            f"image {x.shape[1]}x{x.shape[2]} is smaller than the kernel {kernel.shape[0]}x{kernel.shape[1]}"
        )
    if jax.default_backend() == "cpu" and x.shape[0] >= _MANY_IMAGES:
        return _convolve_cpu(x, kernel, stride)
    return convolve_plain(x, kernel, stride)


def convolve_plain(x: Array, kernel: Array, stride: int) -> Array:
    """XLA's own convolution: the accelerators' form, and the reference of the other."""
    dimensions = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), "VALID", dimension_numbers=dimensions)


def _convolve_cpu(x: Array, kernel: Array, stride: int) -> Array:
    if extra := -kernel.shape[1] % stride:
        # Zeros make the kernel's width a whole number of strides.
        x = jnp.pad(x, ((0, 0), (0, 0), (0, extra), (0, 0)))
        kernel = jnp.pad(kernel, ((0, 0), (0, extra), (0, 0), (0, 0)))
    return _patch_convolution(stride, x, kernel)


def _patches(x: Array, height: int, width: int, stride: int) -> Array:
    """All patches as rows, [N*h*w, height*width*C]: first the columns of each are put together, then its rows."""
    h, w = _number(x, height, width, stride)
    blocks = _blocks(x, w, width, stride)
    x = jnp.stack([blocks[:, :, j : j + w] for j in range(width // stride)], axis=3)
    x = x.reshape(*x.shape[:3], -1)
    slices = [x[:, i : i + stride * (h - 1) + 1 : stride] for i in range(height)]
    return jnp.stack(slices, axis=3).reshape(x.shape[0] * h * w, -1)


def _patches_at_once(x: Array, height: int, width: int, stride: int) -> Array:
    """The same in one step: slower, but for most layers its transpose takes a half to a third of the time."""
    h, w = _number(x, height, width, stride)
    blocks = _blocks(x, w, width, stride)
    down, across = range(height), range(width // stride)
    slices = [blocks[:, i : i + stride * (h - 1) + 1 : stride, j : j + w] for i in down for j in across]
    return jnp.stack(slices, axis=3).reshape(x.shape[0] * h * w, -1)


def _number(x: Array, height: int, width: int, stride: int) -> tuple[int, int]:
    """Patches of an image, down and across."""
    return (x.shape[1] - height) // stride + 1, (x.shape[2] - width) // stride + 1


def _blocks(x: Array, across: int, width: int, stride: int) -> Array:
    """Rows in blocks of `stride` pixels, [N, H, blocks, stride*C]: fewer and longer slices to copy."""
    n, rows, _, channels = x.shape
    blocks = across - 1 + width // stride
    return x[:, :, : blocks * stride].reshape(n, rows, blocks, stride * channels)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _patch_convolution(stride: int, x: Array, kernel: Array) -> Array:
    return _patch_forward(stride, x, kernel)[0]


def _patch_forward(stride: int, x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array, Array | None]]:
    height, width, _, features = kernel.shape
    h, w = _number(x, height, width, stride)
    flat = kernel.reshape(-1, features)
    part = _images_at_once(x, h * w * flat.shape[0])
    patches = None
    if part == x.shape[0]:
        patches = _patches(x, height, width, stride)
        y = patches @ flat
    else:
        y = jax.lax.map(lambda images: _patches(images, height, width, stride) @ flat, _split(x, part))
    return y.reshape(x.shape[0], h, w, features), (x, kernel, patches)


def _patch_backward(stride: int, residuals: tuple[Array, Array, Array | None], dy: Array) -> tuple[Array, Array]:
    x, kernel, patches = residuals
    height, width, _, features = kernel.shape
    flat = kernel.reshape(-1, features)

    def gradients(images: Array, dy: Array, patches: Array) -> tuple[Array, Array]:
        dy = dy.reshape(-1, features)
        # The transposed product is the faster one of the two: the long axis is contracted with the few features first.
        dkernel = dy.T @ patches
        (dx,) = jax.linear_transpose(lambda x: _patches_at_once(x, height, width, stride), images)(dy @ flat.T)
        return dkernel, dx

    if patches is not None:
        dkernel, dx = gradients(x, dy, patches)
        return dx, dkernel.T.reshape(kernel.shape)

    def add(total: Array, part: tuple[Array, Array]) -> tuple[Array, Array]:
        images, dy = part
        # Made again: that is faster than to fetch them from memory.
        dkernel, dx = gradients(images, dy, _patches(images, height, width, stride))
        return total + dkernel, dx

    part = _images_at_once(x, dy.shape[1] * dy.shape[2] * flat.shape[0])
    dkernel, dx = jax.lax.scan(add, jnp.zeros_like(flat.T), (_split(x, part), _split(dy, part)))
    return dx.reshape(x.shape), dkernel.T.reshape(kernel.shape)


def _images_at_once(x: Array, patch_values: int) -> int:
    """How many images' patches are made at a time, a divisor of their number: so many as stay in the caches."""
    most = max(1, _CACHED_BYTES // (patch_values * x.dtype.itemsize))
    return max(n for n in range(1, min(most, x.shape[0]) + 1) if x.shape[0] % n == 0)


def _split(x: Array, part: int) -> Array:
    return x.reshape(x.shape[0] // part, part, *x.shape[1:])


_patch_convolution.defvjp(_patch_forward, _patch_backward)


def max_pool(x: Float[Array, "N H W C"]) -> Float[Array, "N h w C"]:
    """Maximum over 2x2 blocks, stride 2; an odd last row or column is dropped.

    Written with `maximum`, whose gradient is elementwise: that of a windowed reduction is a scalar loop on
    the CPU. Equal maxima share the gradient.
    """
    rows, columns = x.shape[1] // 2 * 2, x.shape[2] // 2 * 2
    x = x[:, :rows, :columns]
    x = jnp.maximum(x[:, 0::2], x[:, 1::2])
    return jnp.maximum(x[:, :, 0::2], x[:, :, 1::2])
