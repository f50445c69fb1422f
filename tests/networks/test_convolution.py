"""Both forms of the convolution against each other and a NumPy loop; max-pool against a loop."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.networks import convolution, winograd
from foajax.networks.convolution import convolve, convolve_plain, max_pool

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
    # Deep enough for fewer products: tiles of 5, 4, 4, 3 and 2 rows, with and without rows left over.
    ((2, 7, 7, 24), (3, 3, 24, 5), 1),
    ((2, 9, 8, 22), (3, 3, 22, 4), 1),
    ((2, 12, 9, 16), (4, 4, 16, 3), 1),
    ((3, 14, 9, 13), (5, 5, 13, 4), 1),
    ((3, 3, 6, 32), (2, 2, 32, 3), 1),
    # Slim: four, five and two columns share a patch; 13 columns do not.
    ((2, 10, 12, 1), (5, 5, 1, 3), 1),
    ((2, 9, 9, 1), (5, 5, 1, 3), 1),
    ((2, 16, 12, 1), (6, 6, 1, 3), 2),
    ((2, 9, 17, 1), (5, 5, 1, 3), 1),
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


@pytest.mark.parametrize("image, kernel, stride", CASES)
def test_plain_form_follows_the_definition(image, kernel, stride):
    x, w = arrays(image, kernel)
    np.testing.assert_allclose(convolve_plain(x, w, stride), loop(x, w, stride), atol=2e-5)


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("image, kernel, stride", CASES)
def test_fast_form_follows_the_definition(image, kernel, stride):
    x, w = arrays(image, kernel)
    fast = jax.jit(lambda x, w: convolution._convolve_cpu(x, w, stride))
    np.testing.assert_allclose(fast(x, w), loop(x, w, stride), atol=2e-5)


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("image, kernel, stride", CASES)
def test_both_gradients_of_the_fast_form_are_the_plain_ones(image, kernel, stride):
    x, w = arrays(image, kernel)
    weights = jnp.asarray(np.random.default_rng(7).normal(size=loop(x, w, stride).shape), jnp.float32)

    def gradients(form):
        return jax.jit(jax.grad(lambda x, w: jnp.sum(form(x, w, stride) * weights), argnums=(0, 1)))(x, w)

    for fast, plain in zip(gradients(convolution._convolve_cpu), gradients(convolve_plain), strict=True):
        np.testing.assert_allclose(fast, plain, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("taps", [2, 3, 4, 5])
@pytest.mark.parametrize("rows", [2, 3, 4, 5])
def test_transforms_filter_exactly(rows, taps):
    if rows + taps > 8:
        pytest.skip("more points than are used")
    of_image, of_kernel, of_output = winograd._transforms(rows, taps)
    rng = np.random.default_rng(rows + taps)
    x, kernel = rng.normal(size=rows + taps - 1), rng.normal(size=taps)
    np.testing.assert_allclose(
        of_output @ ((of_kernel @ kernel) * (of_image @ x)), np.correlate(x, kernel, mode="valid"), atol=1e-12
    )


@pytest.mark.parametrize(
    "h, taps, rows", [(5, 3, 5), (7, 3, 4), (18, 4, 4), (38, 5, 3), (2, 2, 2), (1, 3, 1), (20, 6, 2), (20, 7, 1)]
)
def test_tiles_take_the_fewest_products_or_are_not_used(h, taps, rows):
    assert winograd.fewest_products(h, taps) == rows


@pytest.mark.parametrize(
    "image, kernel, share",
    [
        ((8, 7, 7, 64), (3, 3, 64, 64), 7 / 15),
        ((8, 42, 42, 32), (5, 5, 32, 32), 13 * 7 / (38 * 5)),
        ((8, 84, 84, 1), (5, 5, 1, 32), 8 / 5),  # four columns share a patch that is 8 wide
        ((8, 20, 20, 32), (4, 4, 32, 64), 1),
    ],
)
def test_layers_of_the_torsos_take_their_share_of_the_multiplications(image, kernel, share):
    x, w = arrays(image, kernel)
    stride = 2 if share == 1 else 1
    operations = jax.jit(lambda x, w: convolve(x, w, stride=stride)).lower(x, w).compile().cost_analysis()["flops"]
    plain = 2 * loop(x, w, stride).size * np.prod(kernel[:3])
    assert share <= operations / plain < 1.15 * share  # the combinations of rows take a few more


def test_backend_and_batch_choose_the_form(monkeypatch):
    x, w = arrays((8, 8, 8, 6), (3, 3, 6, 7))
    assert "conv_general_dilated" not in str(jax.make_jaxpr(lambda x, w: convolve(x, w))(x, w))
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x, w: convolve(x, w))(x[:1], w))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x, w: convolve(x, w))(x, w))


@pytest.mark.parametrize("images", [1, 8])
def test_an_image_of_other_channels_than_the_kernels_is_refused(images):
    x, w = arrays((images, 7, 7, 64), (3, 3, 32, 5))
    with pytest.raises(ValueError, match="image of 64 channels: the kernel takes 32"):
        inspect.unwrap(convolve)(x, w)


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
