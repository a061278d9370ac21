"""The feature pyramid, the cost regulariser and the 2-D U-Net as wholes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.nets.cost_regulariser import cost_regulariser, init_cost_regulariser
from zestjax.nets.feature_pyramid import STRIDES, feature_pyramid, init_feature_pyramid
from zestjax.nets.layers import conv2d
from zestjax.nets.unet2d import init_unet2d, unet2d


def parameters(init, *args, **options):
    """Parameters of an `init_` function's shapes; numbers from numpy, which compiles nothing."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(lambda: init(jax.random.key(0), *args, **options))
    return jax.tree.map(lambda s: jnp.asarray(0.3 * rng.normal(size=s.shape), s.dtype), shapes)


def normal(*shape):
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


@pytest.fixture(scope="module")
def pyramid():
    return parameters(init_feature_pyramid, widths=(2, 3, 4))


def test_pyramid_has_a_quarter_of_any_size(pyramid):
    for height, width in ((8, 12), (9, 6), (1, 3)):
        features = jax.eval_shape(feature_pyramid, pyramid, jnp.zeros((2, height, width, 3)))
        assert features.shape == (2, -(-height // 4), -(-width // 4), 4)


def test_feature_pixel_sits_on_image_pixel_four_times_its_own(pyramid):
    """A convolution's reach is symmetric about the pixel it sits on; norms, which see everything, are switched off."""
    reach = lambda images: sum_of_convolutions(pyramid, images)[0, 5, 6].sum()
    rows, cols = jnp.nonzero(jnp.abs(jax.jit(jax.grad(reach))(jnp.ones((1, 41, 49, 3)))).sum((0, 3)))
    assert (rows.min() + rows.max()) / 2 == 20 and (cols.min() + cols.max()) / 2 == 24


def sum_of_convolutions(params, images):
    for block, stride in zip(params.blocks, STRIDES, strict=True):
        images = conv2d(block.conv, images, stride=stride)
    return images


def test_views_may_come_in_any_order(pyramid):
    images = normal(3, 9, 10, 3)
    apply = jax.jit(feature_pyramid)
    np.testing.assert_allclose(apply(pyramid, images)[::-1], apply(pyramid, images[::-1]), rtol=1e-4, atol=1e-5)


def test_regulariser_takes_any_size_and_depth_of_levels():
    volume = normal(5, 3, 6, 4)
    for widths, n_out, channels in (((2, 3, 4), None, 2), ((3, 2), 7, 7), ((5,), None, 5)):
        params = parameters(init_cost_regulariser, 4, widths=widths, n_out=n_out)
        assert jax.eval_shape(cost_regulariser, params, volume).shape == (5, 3, 6, channels)


def test_regularisers_lowerings_agree():
    params, volume = parameters(init_cost_regulariser, 4, widths=(2, 3)), normal(5, 3, 4, 4)
    ours, plain = (
        jax.jit(lambda how=how: cost_regulariser(params, volume, lowering=how))() for how in ("auto", "plain")
    )
    np.testing.assert_allclose(ours, plain, rtol=1e-4, atol=1e-4)


def test_initial_networks_keep_the_scale_of_a_normal_input():
    params = jax.jit(lambda key: init_cost_regulariser(key, 4, widths=(8,), n_out=16))(jax.random.key(0))
    out = jax.jit(cost_regulariser)(params, normal(4, 5, 6, 4))
    assert 0.3 < jnp.std(out) < 3


def test_unet_treats_each_image_by_itself_at_any_size():
    params = parameters(init_unet2d, 3, (4, 5, 6), 2)
    x = normal(2, 7, 5, 3)
    apply = jax.jit(unet2d)
    both = apply(params, x)
    assert both.shape == (2, 7, 5, 2)
    np.testing.assert_allclose(both[0], apply(params, jnp.stack([x[0], x[1] ** 2]))[0], atol=1e-5)


def test_unet_gradients_are_finite_at_flat_images():
    params = parameters(init_unet2d, 3, (2, 3), 1)
    slopes = jax.jit(jax.grad(lambda params, x: jnp.sum(unet2d(params, x) ** 2), (0, 1)))
    for value in (0.0, 1.0, 1e4):
        grads = slopes(params, jnp.full((1, 4, 5, 3), value))
        assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(grads))


def test_faults_are_named(pyramid):
    with pytest.raises(ValueError, match="feature_pyramid: axis C of `images` is 4, expected 3"):
        feature_pyramid(pyramid, jnp.zeros((1, 8, 8, 4)))
    with pytest.raises(ValueError, match="feature_pyramid: `normalise` is 'coco'"):
        feature_pyramid(pyramid, jnp.zeros((1, 8, 8, 3)), normalise="coco")
    with pytest.raises(ValueError, match="cost_regulariser: axis C of `volume` is 3, expected 4"):
        cost_regulariser(parameters(init_cost_regulariser, 4, widths=(2,)), jnp.zeros((2, 2, 2, 3)))
    with pytest.raises(ValueError, match="unet2d: axis C of `x` is 2, expected 3"):
        unet2d(parameters(init_unet2d, 3, (2,), 1), jnp.zeros((1, 2, 2, 2)))
