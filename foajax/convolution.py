"""Convolution and max-pooling in the form that suits the backend.

XLA's convolution is right for accelerators. On the CPU its gradients run at a fraction of the speed of a
matrix product, so there a convolution is written as patches times kernel (`patches.py`): both gradients are matrix
products too, of which a stride of 1 needs fewer (`winograd.py`). Where the patches of all images together are too
large for the caches, a loop takes some images at a time. All forms compute the same numbers, but for rounding; which
one is used is settled when a program is traced.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foajax.patches import PatchForm, Window
from foajax.winograd import WinogradForm, fewest_products

_MANY_IMAGES = 8  # below, when a single agent acts, XLA's own form takes half the time on the CPU too
_SLIM, _DEEP = 8, 64  # values in a patch's row: products of so few are slow, and of so many fast for a single row
_CACHED_BYTES = 12 * 2**20  # of patches; measured: 6 to 24 MB are about equal, 67 MB cost a tenth more


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
    if x.shape[3] != kernel.shape[2]:
        raise ValueError(f"image of {x.shape[3]} channels: the kernel takes {kernel.shape[2]}")
    # A batch of any size, for which jax.export traces, is no integer.
    if jax.default_backend() == "cpu" and isinstance(x.shape[0], int) and x.shape[0] >= _MANY_IMAGES:
        return _convolve_cpu(x, kernel, stride)
    return convolve_plain(x, kernel, stride)


def convolve_plain(x: Array, kernel: Array, stride: int) -> Array:
    """XLA's own convolution: the accelerators' form, and the reference of the other."""
    dimensions = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), "VALID", dimension_numbers=dimensions)


def _convolve_cpu(x: Array, kernel: Array, stride: int) -> Array:
    height, width, channels, features = kernel.shape
    h, w = Window(height, width, stride, stride).number(x)
    if stride == 1 and width * channels >= _DEEP:
        rows = fewest_products(h, height)
        if rows > 1:
            return _in_parts(WinogradForm(rows), x, kernel)
    # Neighbouring columns of the output may share a patch: as its features, with the kernel at each one's place in it.
    # Zeros make that wide kernel a whole number of steps.
    columns = _columns_together(w, width, stride) if width * channels <= _SLIM else 1
    across = columns * stride
    whole = _whole_steps(width, columns, stride)
    x = jnp.pad(x, ((0, 0), (0, 0), (0, max(0, w * stride - across + whole - x.shape[2])), (0, 0)))
    places = range(0, across, stride)
    kernel = jnp.concatenate(
        [jnp.pad(kernel, ((0, 0), (i, whole - width - i), (0, 0), (0, 0))) for i in places], axis=-1
    )
    return _in_parts(PatchForm(stride, across), x, kernel).reshape(-1, h, w, features)


def _columns_together(w: int, width: int, stride: int) -> int:
    """With how many columns of the output to a patch the patches hold the fewest values."""
    divisors = [n for n in range(1, 9) if w % n == 0]
    return min(divisors, key=lambda columns: _whole_steps(width, columns, stride) / columns)


def _whole_steps(width: int, columns: int, stride: int) -> int:
    """Width of a patch that `columns` columns of the output share, in whole steps from one such patch to the next."""
    step = columns * stride
    return -(-(width + step - stride) // step) * step


@runtime_checkable
class Form(Protocol):
    """A way to compute a convolution by matrix products, its gradients included."""

    def patch_values(self, x: Array, kernel: Array) -> int:
        """Values in the patches of one image."""

    def forward(self, x: Array, kernel: Array) -> tuple[Array, Any]:
        """The convolution, [N, h, w, D], and what the gradients need again."""

    def backward(self, x: Array, kernel: Array, saved: Any, dy: Array) -> tuple[Array, Array]:
        """Gradients of image and kernel."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _in_parts(form: Form, x: Array, kernel: Array) -> Array:
    return _forward(form, x, kernel)[0]


def _forward(form: Form, x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array, Any]]:
    part = _images_at_once(form, x, kernel)
    if part == x.shape[0]:
        y, saved = form.forward(x, kernel)
        return y, (x, kernel, saved)
    y = jax.lax.map(lambda images: form.forward(images, kernel)[0], _split(x, part))
    return y.reshape(-1, *y.shape[2:]), (x, kernel, None)


def _backward(form: Form, residuals: tuple[Array, Array, Any], dy: Array) -> tuple[Array, Array]:
    x, kernel, saved = residuals
    if saved is not None:
        return form.backward(x, kernel, saved, dy)

    def add(total: Array, part: tuple[Array, Array]) -> tuple[Array, Array]:
        images, dy = part
        # Patches are made again: that is faster than to fetch them from memory.
        _, saved = form.forward(images, kernel)
        dx, dkernel = form.backward(images, kernel, saved, dy)
        return total + dkernel, dx

    part = _images_at_once(form, x, kernel)
    dkernel, dx = jax.lax.scan(add, jnp.zeros_like(kernel), (_split(x, part), _split(dy, part)))
    return dx.reshape(x.shape), dkernel


_in_parts.defvjp(_forward, _backward)


def _images_at_once(form: Form, x: Array, kernel: Array) -> int:
    """How many images' patches are made at a time, a divisor of their number.

    All of them up to twice what stays in the caches: the loop costs something too.
    """
    size = form.patch_values(x, kernel) * x.dtype.itemsize
    if x.shape[0] * size <= 2 * _CACHED_BYTES:
        return x.shape[0]
    most = max(1, _CACHED_BYTES // size)
    return max(n for n in range(1, min(most, x.shape[0]) + 1) if x.shape[0] % n == 0)


def _split(x: Array, part: int) -> Array:
    return x.reshape(x.shape[0] // part, part, *x.shape[1:])


def max_pool(x: Float[Array, "N H W C"]) -> Float[Array, "N h w C"]:
    """Maximum over 2x2 blocks, stride 2; an odd last row or column is dropped.

    Written with `maximum`, whose gradient is elementwise: that of a windowed reduction is a scalar loop on
    the CPU. Equal maxima share the gradient.
    """
    rows, columns = x.shape[1] // 2 * 2, x.shape[2] // 2 * 2
    x = x[:, :rows, :columns]
    x = jnp.maximum(x[:, 0::2], x[:, 1::2])
    return jnp.maximum(x[:, :, 0::2], x[:, :, 1::2])
