"""Convolution with fewer products: minimal filtering along the rows (Winograd 1980; Lavin & Gray 2016).

m rows of the output take m*r products of an image's row with one of the kernel's r. Read as polynomials, whose
product is known from m + r - 1 of its values, they take as many: combinations of the image's rows are convolved, along
the columns alone, with combinations of the kernel's, and the output's rows are combinations of the results,

    y = A^T [(G k) * (B^T x)].
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from foajax.networks.patches import Window, add_patches, kernel_gradient, patches

# Where the polynomials are evaluated, beside infinity. With more than these, float32 loses digits.
_POINTS = (0.0, 1.0, -1.0, 2.0, -2.0, 0.5)
_WORTHWHILE = 0.8  # of the products: the combinations cost something too
_barrier = jax.lax.optimization_barrier  # or XLA computes a combination again for each patch that it is copied to


@dataclasses.dataclass(frozen=True)
class WinogradForm:
    """A convolution of stride 1, `rows` rows of the output at a time: a tile."""

    rows: int

    def patch_values(self, x: Array, kernel: Array) -> int:
        """Values in the patches of one image."""
        height, width, channels, _ = kernel.shape
        h, w = Window(height, width).number(x)
        return _products(h, self.rows, height) * w * width * channels

    def forward(self, x: Array, kernel: Array) -> tuple[Array, Array]:
        """The convolution, [N, h, w, D], and what the gradients need again."""
        height, width, _, features = kernel.shape
        h, w = Window(height, width).number(x)
        kernels = self._kernels(kernel)
        inputs = _barrier(self._inputs(x, height))
        patched = patches(inputs.reshape(-1, 1, *inputs.shape[3:]), Window(1, width))
        patched = patched.reshape(len(kernels), -1, kernels.shape[1])
        products = _barrier(patched @ kernels)
        _, _, of_output = _transforms(self.rows, height)
        y = _combine(of_output, products.reshape(len(kernels), x.shape[0], -1, w, features), axis=2)
        return y.reshape(x.shape[0], -1, w, features)[:, :h], patched

    def backward(self, x: Array, kernel: Array, patched: Array, dy: Array) -> tuple[Array, Array]:
        """Gradients of image and kernel."""
        height, width, channels, features = kernel.shape
        _, of_kernel, of_output = _transforms(self.rows, height)
        dy = jnp.pad(dy, ((0, 0), (0, -dy.shape[1] % self.rows), (0, 0), (0, 0)))
        dy = dy.reshape(x.shape[0], -1, self.rows, *dy.shape[2:])
        products = _barrier(_combine(of_output.T, jnp.moveaxis(dy, 2, 0)))
        products = products.reshape(len(patched), -1, features)
        dkernels = kernel_gradient(products, patched)
        dkernel = jnp.tensordot(jnp.asarray(of_kernel.T, x.dtype), dkernels, 1).reshape(kernel.shape)
        dpatched = (products @ self._kernels(kernel).mT).reshape(-1, width * channels)
        like = jnp.zeros((len(dpatched) // dy.shape[3], 1, *x.shape[2:]), x.dtype)
        dinputs = _barrier(add_patches(dpatched, like, Window(1, width)))
        return self._add_inputs(dinputs.reshape(len(patched), x.shape[0], -1, *x.shape[2:]), x, height), dkernel

    def _kernels(self, kernel: Array) -> Array:
        """G k: a kernel of one row for each product, [products, width*C, D]."""
        height, width, channels, features = kernel.shape
        of_kernel = jnp.asarray(_transforms(self.rows, height)[1], kernel.dtype)
        return (of_kernel @ kernel.reshape(height, -1)).reshape(-1, width * channels, features)

    def _inputs(self, x: Array, taps: int) -> Array:
        """B^T x: for each product a row of each tile, [products, N, tiles, W, C]."""
        tiles = -(-(x.shape[1] - taps + 1) // self.rows)
        of_image = _transforms(self.rows, taps)[0]
        x = jnp.pad(x, ((0, 0), (0, tiles * self.rows + taps - 1 - x.shape[1]), (0, 0), (0, 0)))
        last = self.rows * (tiles - 1) + 1
        return _combine(of_image, [x[:, i : i + last : self.rows] for i in range(len(of_image))])

    def _add_inputs(self, dinputs: Array, x: Array, taps: int) -> Array:
        """The transpose of `_inputs`. Written out: XLA's own pads each row by itself, and adds whole images."""
        rows = _combine(_transforms(self.rows, taps)[0].T, dinputs)
        beyond = -(-(taps - 1) // self.rows)  # how many tiles on a tile's last rows reach

        def row(i: int) -> Array:
            """Row i of each tile: its own, and what the tiles before have of it."""
            shares = enumerate(rows[i :: self.rows])
            return functools.reduce(
                jnp.add, [jnp.pad(share, ((0, 0), (k, beyond - k), (0, 0), (0, 0))) for k, share in shares]
            )

        image = jnp.stack([row(i) for i in range(self.rows)], axis=2)
        return image.reshape(x.shape[0], -1, *x.shape[2:])[:, : x.shape[1]]


def fewest_products(h: int, taps: int) -> int:
    """The rows of a tile with which `h` rows of an output take the fewest products; 1 where that saves too little."""
    rows = min(range(2, len(_POINTS) + 3 - taps), key=lambda rows: _products(h, rows, taps), default=1)
    return rows if _products(h, rows, taps) <= _WORTHWHILE * h * taps else 1


def _products(h: int, rows: int, taps: int) -> int:
    """Rows of products for `h` rows of an output, in tiles of `rows`."""
    return -(-h // rows) * (rows + taps - 1)


@functools.cache
def _transforms(rows: int, taps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """B^T, G and A^T for `rows` outputs of a kernel of `taps`.

    A and G evaluate polynomials of these lengths; B^T is the transpose of what finds the coefficients of a product
    from its values (Lagrange's), whose denominators are in G: its own entries, and A's, are sums of powers of two.
    """
    points = np.array(_POINTS[: rows + taps - 2])
    others = [np.delete(points, i) for i in range(len(points))]
    basis = [np.append(np.poly(other)[::-1], 0.0) for other in others] + [np.poly(points)[::-1]]
    denominators = [np.prod(point - other) for point, other in zip(points, others, strict=True)] + [1.0]

    def evaluate(length: int) -> np.ndarray:
        return np.vstack([np.vander(points, length, increasing=True), np.eye(length)[-1]])

    return np.array(basis), evaluate(taps) / np.array(denominators)[:, None], evaluate(rows).T


def _combine(matrix: np.ndarray, rows: Sequence[Array] | Array, *, axis: int = 0) -> Array:
    """matrix @ rows, elementwise: most of its entries are 0, 1 or -1. The results are stacked along `axis`."""
    terms = [[float(c) * row for c, row in zip(weights, rows, strict=True) if c] for weights in matrix]
    return jnp.stack([functools.reduce(jnp.add, row) for row in terms], axis=axis)
