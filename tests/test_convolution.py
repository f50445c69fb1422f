"""Both forms of the convolution against each other and a NumPy loop; max-pool against a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax import convolution
from foajax.convolution import convolve, convolve_plain, max_pool

# (image, kernel, stride): the layers of both torsos at small sizes, then odd and rectangular ones.
CASES = [
    ((3, 80, 80, 1), (8, 8, 1, 4), 4),
    ((2, 19, 19, 3), (4, 4, 3, 5), 2),
    ((2, 8, 8, 6), (3, 3, 6, 7), 1),
    ((2, 35, 35, 1), (4, 4, 1, 3), 2),
    ((2, 50, 50, 1), (10, 10, 1, 4), 4),
    ((2, 11, 9, 5), (5, 5, 5, 3), 1),
    ((1, 9, 13, 2), (3, 2, 2, 4), 1),
    ((2, 11, 7, 2), (3, 3, 2, 4), 2),
    ((2, 10, 11, 2), (4, 2, 2, 3), 2),
    ((1, 4, 4, 3), (4, 4, 3, 2), 1),
    ((12, 6, 6, 2), (3, 3, 2, 4), 1),
]


def arrays(image, kernel):
    rng = np.random.default_rng(sum(image) + sum(kernel))
    return (
        jnp.asarray(rng.normal(size=image), jnp.float32),
        jnp.asarray(rng.normal(size=kernel) / np.sqrt(np.prod(kernel[:3])), jnp.float32),
    )


def loop(x, kernel, stride):
    """The definition, in float64."""
    x, kernel = np.asarray(x, np.float64), np.asarray(kernel, np.float64)
    rows, columns = kernel.shape[:2]
    h, w = (x.shape[1] - rows) // stride + 1, (x.shape[2] - columns) // stride + 1
    y = np.zeros((x.shape[0], h, w, kernel.shape[-1]))
    for i in range(h):
        for j in range(w):
            patch = x[:, i * stride : i * stride + rows, j * stride : j * stride + columns]
            y[:, i, j] = np.einsum("nklc,klcd->nd", patch, kernel)
    return y


@pytest.fixture(params=[12 * 2**20, 6000, 1], ids=["at once", "some at a time", "one by one"])
def cache(request, monkeypatch):
    """Caches that hold all patches, some and none."""
    monkeypatch.setattr(convolution, "_CACHED_BYTES", request.param)


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("image, kernel, stride", CASES)
@pytest.mark.parametrize("form", [convolution._convolve_cpu, convolve_plain])
def test_form_follows_the_definition(form, image, kernel, stride):
    x, w = arrays(image, kernel)
    expected = loop(x, w, stride)
    np.testing.assert_allclose(form(x, w, stride), expected, atol=2e-5)
    np.testing.assert_allclose(jax.jit(lambda x, w: form(x, w, stride))(x, w), expected, atol=2e-5)


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("image, kernel, stride", CASES)
def test_both_gradients_of_the_fast_form_are_the_plain_ones(image, kernel, stride):
    x, w = arrays(image, kernel)
    weights = jnp.asarray(np.random.default_rng(7).normal(size=loop(x, w, stride).shape), jnp.float32)

    def gradients(form):
        return jax.grad(lambda x, w: jnp.sum(form(x, w, stride) * weights), argnums=(0, 1))(x, w)

    for fast, plain in zip(gradients(convolution._convolve_cpu), gradients(convolve_plain), strict=True):
        np.testing.assert_allclose(fast, plain, rtol=1e-4, atol=1e-4)


def test_backend_and_batch_choose_the_form(monkeypatch):
    x, w = arrays((8, 8, 8, 6), (3, 3, 6, 7))
    assert "conv_general_dilated" not in str(jax.make_jaxpr(lambda x, w: convolve(x, w))(x, w))
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x, w: convolve(x, w))(x[:1], w))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x, w: convolve(x, w))(x, w))


def test_an_image_smaller_than_the_kernel_is_refused():
    x, w = arrays((1, 4, 4, 3), (5, 5, 3, 2))
    with pytest.raises(ValueError, match="4x4 is smaller than the kernel 5x5"):
        convolve(x, w)


@pytest.mark.parametrize("shape", [(2, 6, 8, 3), (2, 7, 5, 3)])
def test_max_pool_follows_the_definition(shape):
    x = jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)
    h, w = shape[1] // 2, shape[2] // 2
    expected = np.array(
        [[np.asarray(x)[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max((1, 2)) for j in range(w)] for i in range(h)]
    )
    np.testing.assert_array_equal(max_pool(x), expected.transpose(2, 0, 1, 3))


def test_max_pool_gradient_goes_to_the_maximum_and_is_shared_by_equals():
    x = jnp.array([[1.0, 2.0], [3.0, 0.0]]).reshape(1, 2, 2, 1)
    gradient = jax.grad(lambda x: 5.0 * jnp.sum(max_pool(x)))
    np.testing.assert_array_equal(gradient(x)[0, :, :, 0], [[0, 0], [5, 0]])
    np.testing.assert_array_equal(gradient(jnp.ones_like(x))[0, :, :, 0], [[1.25, 1.25], [1.25, 1.25]])
