"""Reading between samples: loops, borders, single rows, forward and reverse gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match

from zestjax import resample

bilinear = jax.jit(resample.bilinear, static_argnames="border")
trilinear = jax.jit(resample.trilinear, static_argnames="border")


def read_by_loop(array, place, border):
    """Multilinear interpolation in float64: every corner with its weight, for an array of any rank."""
    array, place, sizes = np.float64(array), np.float64(place), np.array(array.shape[:-1])
    if border == "zero" and ((place < 0) | (place > sizes - 1)).any():
        return np.zeros(array.shape[-1])
    place = np.clip(place, 0, sizes - 1)
    first = np.minimum(np.floor(place).astype(int), np.maximum(sizes - 2, 0))
    total = 0.0
    for corner in itertools.product((0, 1), repeat=len(sizes)):
        weight = np.prod(np.where(corner, place - first, 1 - (place - first)))
        total = total + weight * array[tuple(np.minimum(first + corner, sizes - 1))]
    return total


def places(shape, count=24):
    """Random places in and around an array, its corners, and its last sample."""
    sizes = np.array(shape)
    inside = np.random.default_rng(0).uniform(-1.5, sizes + 0.5, (count, len(shape)))
    corners = np.array(list(itertools.product(*((0, s - 1) for s in sizes))))
    return np.concatenate([inside, corners]).astype("f")


@pytest.mark.parametrize("border", ["zero", "clamp"])
@pytest.mark.parametrize("shape", [(5, 7), (1, 7), (5, 1), (1, 1)])
def test_bilinear_is_the_weighted_sum_of_four_pixels(shape, border):
    image = np.random.default_rng(1).normal(size=(*shape, 3)).astype("f")
    where = places(shape)
    values, visible = bilinear(image, where[:, ::-1], border=border)
    expected = [read_by_loop(image, place, border) for place in where]
    np.testing.assert_allclose(values, expected, atol=1e-5)
    np.testing.assert_array_equal(visible, ((where >= 0) & (where <= np.array(shape) - 1)).all(-1))


@pytest.mark.parametrize("border", ["zero", "clamp"])
@pytest.mark.parametrize("shape", [(3, 4, 5), (1, 4, 5), (3, 1, 1)])
def test_trilinear_is_the_weighted_sum_of_eight_cells(shape, border):
    volume = np.random.default_rng(1).normal(size=(*shape, 2)).astype("f")
    where = places(shape)
    expected = [read_by_loop(volume, place, border) for place in where]
    np.testing.assert_allclose(trilinear(volume, where, border=border), expected, atol=1e-5)


def test_whole_coordinates_return_the_pixels_themselves():
    image = jax.random.normal(jax.random.key(0), (4, 6, 2))
    v, u = jnp.meshgrid(jnp.arange(4.0), jnp.arange(6.0), indexing="ij")
    values, visible = bilinear(image, jnp.stack([u, v], -1))
    np.testing.assert_array_equal(values, image)
    assert visible.all()


def test_rounding_at_the_border_does_not_blind_a_pixel():
    _, visible = bilinear(jnp.ones((4, 6, 1)), jnp.asarray([[5.0005, 3.0], [-0.0005, 0.0], [5.01, 3.0]]))
    np.testing.assert_array_equal(visible, [True, True, False])


def test_an_affine_image_is_read_exactly_between_pixels():
    v, u = jnp.meshgrid(jnp.arange(5.0), jnp.arange(7.0), indexing="ij")
    where = jax.random.uniform(jax.random.key(0), (50, 2)) * 4
    values = bilinear((2 * u - 3 * v + 1)[..., None], where).values[:, 0]
    np.testing.assert_allclose(values, 2 * where[:, 0] - 3 * where[:, 1] + 1, atol=1e-5)


@pytest.mark.parametrize("far", [np.nan, np.inf, -np.inf, 1e30, -1e30])
def test_pixels_that_are_not_numbers_are_outside(far):
    pixels = jnp.asarray([[far, 1.0], [1.0, far], [1.0, 1.0]])
    values, visible = bilinear(jnp.ones((3, 4, 2)), pixels)
    np.testing.assert_array_equal(visible, [False, False, True])
    np.testing.assert_array_equal(values[:, 0], [0, 0, 1])
    assert_finite(lambda image: resample.bilinear(image, pixels).values, jnp.ones((3, 4, 2)))
    gradient = jax.grad(lambda p: resample.bilinear(jnp.ones((3, 4, 2)), p).values.sum())(pixels)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("border", ["zero", "clamp"])
def test_gradients_match_finite_differences(x64, border):
    rng = np.random.default_rng(2)
    where = jnp.asarray(rng.uniform(-1, 5, (12, 3)))
    read = lambda image, p: resample.bilinear(image, p, border=border).values
    assert_grads_match(read, jnp.asarray(rng.normal(size=(5, 4, 2))), where[:, :2])
    look = lambda volume, p: resample.trilinear(volume, p, border=border)
    assert_grads_match(look, jnp.asarray(rng.normal(size=(3, 5, 4, 2))), where)


def test_forward_mode_agrees_with_reverse_mode(x64):
    image, pixels = jax.random.normal(jax.random.key(0), (4, 5, 1)), jnp.asarray([[1.3, 2.2], [0.1, 0.9]])
    read = lambda p: resample.bilinear(image, p).values
    forward, reverse = jax.jit(lambda p: (jax.jacfwd(read)(p), jax.jacrev(read)(p)))(pixels)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="`border` is 'wrap'"):
        resample.bilinear(jnp.ones((2, 2, 1)), jnp.ones(2), border="wrap")
    with pytest.raises(ValueError, match="`image`"):
        resample.bilinear(jnp.ones((2, 2)), jnp.ones(2))
    with pytest.raises(ValueError, match="`cells`"):
        resample.trilinear(jnp.ones((2, 2, 2, 1)), jnp.ones(2))


def test_no_address_leaves_the_axis_whatever_the_coordinate():
    lower, fraction = resample.split(jnp.array([-0.5, -jnp.inf, jnp.nan, 3.25, 9.0, jnp.inf]), 5)
    np.testing.assert_array_equal(lower, [0, 0, 0, 3, 3, 3])
    np.testing.assert_array_equal(fraction[jnp.array([0, 3, 4])], [-0.5, 0.25, 6])
    assert jnp.isnan(fraction[2])


@pytest.mark.parametrize("far", [np.nan, np.inf, -np.inf, 1e30])
def test_cells_that_are_not_numbers_are_outside_a_volume(far):
    cells, volume = jnp.asarray([[far, 1.0, 1.0], [1.0, 1.0, far], [1.0, 1.0, 1.0]]), jnp.ones((2, 3, 4, 1))
    read = lambda cells: resample.trilinear(volume, cells, border="zero")
    np.testing.assert_array_equal(read(cells)[:, 0], [0, 0, 1])
    assert np.isfinite(jax.grad(lambda c: read(c).sum())(cells)).all()
