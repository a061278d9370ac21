"""Metrics against other implementations, closed forms and the points where a naive form breaks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from zestjax import metrics


@pytest.fixture(scope="module")
def pictures():
    """A photograph, and the same with noise and a blurred corner."""
    truth = (data.astronaut()[100:140, 180:230] / 255).astype(np.float32)
    noisy = truth + 0.1 * np.random.default_rng(0).standard_normal(truth.shape)
    noisy[:20, :20] = truth[:20, :20].mean()
    return np.clip(noisy, 0, 1).astype(np.float32), truth


ssim, ssim_map = jax.jit(metrics.ssim), jax.jit(metrics.ssim_map)
slopes = {metric: jax.jit(jax.value_and_grad(metric)) for metric in (metrics.psnr, metrics.ssim)}


def skimage_ssim(a, b):
    return structural_similarity(  # pyright: ignore[reportReturnType]
        a.astype(np.float64), b.astype(np.float64), channel_axis=2, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, full=True,
    )  # fmt: skip


def test_ssim_and_its_map_equal_scikit_images(pictures):
    mean, similarity = tuple(skimage_ssim(*pictures))[:2]
    assert float(ssim(*pictures)) == pytest.approx(mean, abs=1e-5)
    np.testing.assert_allclose(ssim_map(*pictures), similarity, atol=1e-5)


def test_psnr_equals_scikit_images(pictures):
    assert float(metrics.psnr(*pictures)) == pytest.approx(peak_signal_noise_ratio(*pictures, data_range=1), abs=1e-4)


def test_masks_of_two_halves_make_up_the_whole(pictures):
    left = np.zeros(pictures[0].shape[:2], bool)
    left[:, :21] = True
    error = lambda mask: 10 ** (-float(metrics.psnr(*pictures, mask=mask)) / 10)
    assert left.mean() * error(left) + (~left).mean() * error(~left) == pytest.approx(error(None), rel=1e-5)
    inside = left[5:-5, 5:-5].mean()
    halves = inside * ssim(*pictures, mask=left) + (1 - inside) * ssim(*pictures, mask=~left)
    assert float(halves) == pytest.approx(float(ssim(*pictures)), abs=1e-6)


def test_identical_pictures_reach_the_cap_and_one(pictures):
    assert float(metrics.psnr(pictures[1], pictures[1])) == pytest.approx(metrics.PSNR_CAP)
    assert float(ssim(pictures[1], pictures[1])) == pytest.approx(1)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_patches_have_no_variance_from_rounding(pictures, level):
    flat = jnp.full_like(pictures[0], level)
    c1 = 0.01**2
    other = 0.25
    closed = (2 * level * other + c1) / (level**2 + other**2 + c1)
    assert float(ssim(flat, jnp.full_like(flat, other))) == pytest.approx(closed, abs=1e-6)


@pytest.mark.parametrize("extreme", ["identical", "black and white", "flat"])
def test_values_and_gradients_are_finite_at_the_extremes(pictures, extreme):
    picture, truth = pictures
    a, b = {
        "identical": (truth, truth),
        "black and white": (np.zeros_like(truth), np.ones_like(truth)),
        "flat": (np.full_like(truth, 0.3), np.full_like(truth, 0.3)),
    }[extreme]
    for slope in slopes.values():
        value, gradient = slope(a, b)
        assert jnp.isfinite(value) and jnp.all(jnp.isfinite(gradient))


def test_an_empty_mask_scores_nothing(pictures):
    empty = np.zeros(pictures[0].shape[:2], bool)
    assert jnp.isnan(metrics.psnr(*pictures, mask=empty)) and jnp.isnan(ssim(*pictures, mask=empty))
    assert jnp.isnan(metrics.depth_abs_rel(jnp.ones((4, 5)), jnp.ones((4, 5)), empty[:4, :5]))


def test_depth_error_skips_what_has_no_true_depth():
    depth = jnp.array([[2.0, 3.0, 5.0, 7.0]])
    truth = jnp.array([[1.0, jnp.inf, jnp.nan, 0.0]])
    assert float(metrics.depth_abs_rel(depth, truth, None)) == 1
    assert float(metrics.depth_abs_rel(depth, 2 * depth, jnp.array([[1, 0, 0, 1]], bool))) == 0.5


def test_flow_error_is_the_mean_length_where_the_truth_is_known():
    flow = jnp.zeros((1, 3, 2))
    truth = jnp.array([[[3.0, 4.0], [jnp.nan, 0.0], [0.0, 1.0]]])
    assert float(metrics.endpoint_error(flow, truth, None)) == 3
    assert float(metrics.endpoint_error(flow, truth, jnp.array([[True, True, False]]))) == 5


def test_wrong_shapes_are_refused_by_name():
    with pytest.raises(ValueError, match="psnr: axis W of `truth`"):
        metrics.psnr(jnp.zeros((4, 5, 3)), jnp.zeros((4, 6, 3)))
    with pytest.raises(ValueError, match="psnr: axis H of `mask`"):
        metrics.psnr(jnp.zeros((4, 5, 3)), jnp.zeros((4, 5, 3)), mask=jnp.ones((5, 5)))
    with pytest.raises(ValueError, match="at least 11x11"):
        metrics.ssim(jnp.zeros((10, 20, 3)), jnp.zeros((10, 20, 3)))
