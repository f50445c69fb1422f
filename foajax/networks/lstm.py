"""An LSTM whose state is zeroed where an episode starts, with the gradient written out.

Differentiating the loop would add one outer product to the recurrent weights' gradient at each step, all of
it memory traffic. Here the backward loop only carries the state's gradient, and the weights' gradient is one
matrix product over all steps, outside the loop.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from foajax.types import CoreState


def lstm(
    projected: Float[Array, "T B G"],
    kernel: Float[Array, "L G"],
    is_first: Bool[Array, "T B"],
    state: CoreState,
) -> tuple[Float[Array, "T B L"], CoreState]:
    """Runs over T steps; returns the hidden vectors and the carry that leaves the last step (G = 4L).

    `projected` is the input's part of the gates, bias included, in the order input, forget, candidate, output
    (Hochreiter & Schmidhuber 1997, with the forget gate of Gers et al. 2000). The carry that enters step t is
    zeroed where `is_first[t]`. The gradient reaches `projected` and `kernel`, and the state that enters.
    """
    hidden, cell, last = _lstm(projected, kernel, 1.0 - is_first.astype(projected.dtype), state.cell, state.hidden)
    return hidden, CoreState(cell=cell, hidden=last)


@jax.custom_vjp
def _lstm(projected: Array, kernel: Array, keep: Array, cell: Array, hidden: Array) -> tuple[Array, Array, Array]:
    return _forward(projected, kernel, keep, cell, hidden)[0]


def _forward(projected: Array, kernel: Array, keep: Array, cell: Array, hidden: Array):
    def step(carry, inputs):
        cell, hidden = carry
        projected, keep = inputs
        cell, hidden = (jnp.where(keep[:, None] > 0, x, 0.0) for x in (cell, hidden))
        i, f, g, o = jnp.split(projected + hidden @ kernel, 4, axis=-1)
        i, f, g, o = jax.nn.sigmoid(i), jax.nn.sigmoid(f), jnp.tanh(g), jax.nn.sigmoid(o)
        new_cell = f * cell + i * g
        squashed = jnp.tanh(new_cell)
        new_hidden = o * squashed
        return (new_cell, new_hidden), (new_hidden, (i, f, g, o, cell, hidden, squashed))

    (cell, hidden), (hiddens, saved) = jax.lax.scan(step, (cell, hidden), (projected, keep))
    return (hiddens, cell, hidden), (kernel, keep, saved)


def _backward(residuals, gradients):
    kernel, keep, saved = residuals
    dhiddens, dcell, dhidden = gradients
    # Transposed once: XLA would move it into the loop, and read the kernel the wrong way round at each step.
    transposed = jax.lax.optimization_barrier(kernel.T)

    def step(carry, inputs):
        dcell, dhidden = carry
        dout, keep, (i, f, g, o, cell, _, squashed) = inputs
        dhidden = dhidden + dout
        dcell = dcell + dhidden * o * (1.0 - squashed**2)
        dgates = jnp.concatenate(
            [
                dcell * g * i * (1.0 - i),
                dcell * cell * f * (1.0 - f),
                dcell * i * (1.0 - g**2),
                dhidden * squashed * o * (1.0 - o),
            ],
            axis=-1,
        )
        return (dcell * f * keep[:, None], (dgates @ transposed) * keep[:, None]), dgates

    (dcell, dhidden), dgates = jax.lax.scan(step, (dcell, dhidden), (dhiddens, keep, saved), reverse=True)
    hiddens = saved[5]
    width = hiddens.shape[-1]
    dkernel = hiddens.reshape(-1, width).T @ dgates.reshape(-1, 4 * width)
    return dgates, dkernel, jnp.zeros_like(keep), dcell, dhidden


_lstm.defvjp(_forward, _backward)
