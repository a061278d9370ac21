"""How close a picture, a depth or a flow is to the truth.

Pure functions of one image each, differentiable and ready for `jax.jit` and `jax.vmap`. A mask (H, W) chooses the
pixels that count, as booleans or as weights in [0, 1]; where it is empty there is nothing to score and the result is
NaN, which a report writes as null.

    H W      rows and columns
    C        channels, 3 for RGB
"""

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import safe_norm
from zestjax.base.types import Array

PSNR_CAP = 100.0
"""dB given to identical images, whose PSNR is infinite: no 8-bit image that differs at all reaches it."""

SSIM_RADIUS, SSIM_SIGMA = 5, 1.5  # pixels: the window of 11 x 11 of Wang et al. 2004


def psnr(image: Array, truth: Array, *, mask: Array | None = None) -> jax.Array:
    """Peak signal-to-noise ratio in dB for values in [0, 1], at most `PSNR_CAP`.

    Source: ZeST-NeRF eq. 23, eq. 24.

    Args:
      image: (H, W, C) scored picture.
      truth: (H, W, C) what it should be.
      mask: (H, W) or None for every pixel.

    Returns:
      () dB; NaN when the mask is empty.

    Raises:
      ValueError: shapes do not match.
    """
    check_shapes("psnr", image=(image, "H W C"), truth=(truth, "H W C"))
    error = mean_where(jnp.mean((image - truth) ** 2, axis=-1), mask, where="psnr")
    return -10 * jnp.log10(jnp.maximum(error, 10 ** (-PSNR_CAP / 10)))


def ssim(image: Array, truth: Array, *, mask: Array | None = None) -> jax.Array:
    """Mean structural similarity: see `ssim_map`. The 5 outer pixels, whose windows leave the image, do not count.

    Args:
      image: (H, W, C), H and W at least 11.
      truth: (H, W, C).
      mask: (H, W) or None for every pixel.

    Returns:
      () in [-1, 1]; NaN when the mask has no pixel 5 or more away from the border.

    Raises:
      ValueError: shapes do not match, or the image is smaller than the window.
    """
    similarity = jnp.mean(ssim_map(image, truth), axis=-1)
    inside = slice(SSIM_RADIUS, -SSIM_RADIUS)
    if mask is not None:
        check_shapes("ssim", image=(similarity, "H W"), mask=(mask, "H W"))
        mask = mask[inside, inside]
    return mean_where(similarity[inside, inside], mask, where="ssim")


def ssim_map(image: Array, truth: Array) -> jax.Array:
    """Structural similarity of every pixel and channel for values in [0, 1].

    Gaussian window 11 x 11 of sigma 1.5, images mirrored at the border, biased variances. Variances are centred in each
    window, first along the rows and then across them, so that a flat patch has variance 0 and not rounding.

    Source: ZeST-NeRF eq. 25; SSIM (Wang et al. 2004) with its own settings (Gaussian weights, K1 = 0.01, K2 = 0.03).
    Differs from the reference: the released ZeST-NeRF code averages a window of 5.

    Args:
      image: (H, W, C), H and W at least 11.
      truth: (H, W, C).

    Returns:
      (H, W, C) in [-1, 1].

    Raises:
      ValueError: shapes do not match, or the image is smaller than the window.
    """
    sizes = check_shapes("ssim", image=(image, "H W C"), truth=(truth, "H W C"))
    if min(sizes["H"], sizes["W"]) < 2 * SSIM_RADIUS + 1:
        raise ValueError(
            f"ssim: `image` is {sizes['H']}x{sizes['W']} (HxW), expected at least 11x11, the size of the window."
        )
    zero = jnp.zeros_like(image)
    moments = (image, truth, zero, zero, zero)
    for _ in ("rows", "columns"):
        moments = [jnp.swapaxes(moment, 0, 1) for moment in _window_moments(*moments)]
    mean_a, mean_b, variance_a, variance_b, covariance = moments
    c1, c2 = 0.01**2, 0.03**2  # of Wang et al. 2004, for values in [0, 1]
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return luminance * (2 * covariance + c2) / (variance_a + variance_b + c2)


def depth_abs_rel(depth: Array, truth: Array, mask: Array | None) -> jax.Array:
    """Mean of |depth - truth| / truth over the mask, of pixels whose true depth is finite and > 0.

    Args:
      depth: (H, W) world units.
      truth: (H, W) on the same scale.
      mask: (H, W) or None for every pixel.

    Returns:
      (); NaN when no pixel counts.

    Raises:
      ValueError: shapes do not match.
    """
    check_shapes("depth_abs_rel", depth=(depth, "H W"), truth=(truth, "H W"))
    known = jnp.isfinite(truth) & (truth > 0)
    relative = jnp.abs(depth - jnp.where(known, truth, 1)) / jnp.where(known, truth, 1)
    mask = known if mask is None else jnp.where(known, jnp.asarray(mask, depth.dtype), 0)
    return mean_where(relative, mask, where="depth_abs_rel")


def endpoint_error(flow: Array, truth: Array, mask: Array | None) -> jax.Array:
    """Mean length of the difference of two optical flows over the mask, of pixels whose true flow is finite.

    Args:
      flow: (H, W, 2) pixels.
      truth: (H, W, 2) pixels.
      mask: (H, W) or None for every pixel.

    Returns:
      () pixels; NaN when no pixel counts.

    Raises:
      ValueError: shapes do not match.
    """
    check_shapes("endpoint_error", flow=(flow, "H W 2"), truth=(truth, "H W 2"))
    known = jnp.all(jnp.isfinite(truth), axis=-1)
    error = safe_norm(flow - jnp.where(known[..., None], truth, 0))
    mask = known if mask is None else jnp.where(known, jnp.asarray(mask, flow.dtype), 0)
    return mean_where(error, mask, where="endpoint_error")


def _window_moments(*moments):
    """Moments of a window along the rows from those of its parts, each (H, W, C): the law of total variance."""
    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    taps = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    height, dtype = moments[0].shape[0], moments[0].dtype
    mirrored = [jnp.pad(moment, ((SSIM_RADIUS,) * 2, (0, 0), (0, 0)), mode="symmetric") for moment in moments]

    def average(parts_of):
        """Mean over the window of what `parts_of` makes of the moments that many rows on."""

        def add(total, entry):
            rows, tap = entry
            shifted = [jax.lax.dynamic_slice_in_dim(moment, rows, height) for moment in mirrored]
            return tuple(t + tap * part for t, part in zip(total, parts_of(*shifted), strict=True)), None

        zeros = tuple(jnp.zeros_like(part) for part in parts_of(*moments))
        return jax.lax.scan(add, zeros, (jnp.arange(len(taps)), jnp.asarray(taps / taps.sum(), dtype)))[0]

    mean_a, mean_b = average(lambda a, b, *_: (a, b))
    spread = lambda a, b, va, vb, c: (va + (a - mean_a) ** 2, vb + (b - mean_b) ** 2, c + (a - mean_a) * (b - mean_b))
    return mean_a, mean_b, *average(spread)


def mean_where(x: Array, mask: Array | None, *, where: str) -> jax.Array:
    """Mean of x (H, W) under the mask, None for all; NaN when it is empty. x may be non-finite outside the mask."""
    if mask is None:
        return _mean(x)
    check_shapes(where, image=(x, "H W"), mask=(mask, "H W"))
    mask = jnp.asarray(mask, x.dtype)
    share = _mean(mask)
    return jnp.where(share > 0, _mean(jnp.where(mask > 0, x, 0) * mask) / jnp.where(share > 0, share, 1), jnp.nan)


def _mean(x):
    """Mean of (H, W), row by row: one float32 sum over an image is off in the fifth digit."""
    return jnp.mean(jnp.mean(x, axis=-1))
