"""Scores of one picture, their means, and how far from the floors to the ceiling they are; as dicts for JSON.

region   `full`, `dynamic` or `static` pixels; a region of fewer than `LEAST_PIXELS` has no score (None)
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

from zestjax import metrics
from zestjax.judge.lpips import lpips as lpips_distance

REGIONS = ("full", "dynamic", "static")
LEAST_PIXELS = 64
CONFIDENCE = 0.95


@jax.jit
def _measure(image, truth, mask):
    return metrics.psnr(image, truth, mask=mask), metrics.ssim(image, truth, mask=mask)


@jax.jit
def _lpips(params, image, truth):
    return lpips_distance(params, image, truth)


@jax.jit
def _lpips_masked(params, image, truth, mask):
    return lpips_distance(params, image, truth, mask=mask)


_depth_error = jax.jit(metrics.depth_abs_rel)
_flow_error = jax.jit(metrics.endpoint_error)


def score_image(image, truth, dynamic=None, *, lpips=None):
    """PSNR, SSIM and LPIPS of a picture by region.

    Args:
      image: (H, W, 3) in [0, 1].
      truth: (H, W, 3) in [0, 1].
      dynamic: (H, W) bool of the moving pixels, or None when they are not known.
      lpips: `LpipsParams`, or None: LPIPS is null.

    Returns:
      {region: {"psnr", "ssim", "lpips"} or None}.
    """
    image, truth = jnp.clip(jnp.asarray(image, jnp.float32), 0, 1), jnp.asarray(truth, jnp.float32)
    everywhere = np.ones(truth.shape[:2], bool)
    masks = {"full": everywhere}
    if dynamic is not None:
        masks |= {"dynamic": np.asarray(dynamic), "static": ~np.asarray(dynamic)}
    scores: dict = dict.fromkeys(REGIONS)
    for region, mask in masks.items():
        if mask.sum() >= LEAST_PIXELS:
            psnr, ssim = _measure(image, truth, jnp.asarray(mask, jnp.float32))
            looks = None
            if lpips is not None:
                whole = region == "full"
                looks = _lpips(lpips, image, truth) if whole else _lpips_masked(lpips, image, truth, jnp.asarray(mask))
            distance = None if looks is None else number(looks)
            scores[region] = {"psnr": number(psnr), "ssim": number(ssim), "lpips": distance}
    return scores


def score_depth(depth, truth):
    """Mean relative depth error over the pixels whose truth is known, or None."""
    if truth is None or depth is None:
        return None
    truth = jnp.asarray(truth, jnp.float32)
    return number(_depth_error(jnp.asarray(depth, jnp.float32), truth, jnp.ones_like(truth)))


def score_flow(flow, truth):
    """Mean end-point error in pixels where the truth is known, or None."""
    if truth is None or flow is None:
        return None
    truth = jnp.asarray(truth, jnp.float32)
    return number(_flow_error(jnp.asarray(flow, jnp.float32), truth, jnp.ones_like(truth[..., 0])))


def number(value):
    """A float for JSON, rounded to 5 decimals; None where it is not finite."""
    value = float(value)
    return round(value, 5) if math.isfinite(value) else None


def mean_scores(rows):
    """The mean of equal dicts of numbers, dicts and Nones, key by key, over those that have the key's value."""
    present = [row for row in rows if row is not None]
    if not present:
        return None
    if isinstance(present[0], dict):
        keys = dict.fromkeys(key for row in present for key in row)
        return {key: mean_scores([row.get(key) for row in present]) for key in keys}
    return number(np.mean(present))


def half_width(values):
    """Half of the interval that holds the mean of all such numbers with probability `CONFIDENCE` (Student's t); None of
    fewer than two."""
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return None
    return float(stdtrit(len(values) - 1, (1 + CONFIDENCE) / 2) * values.std(ddof=1) / np.sqrt(len(values)))


def better_floor(floors, region="full"):
    """The highest PSNR of the floors in a region, or None."""
    known = [floor[region]["psnr"] for floor in floors.values() if floor and floor.get(region)]
    return max(known) if known else None


def share_of_the_way(mean, floors, ceiling, region="full"):
    """Where the model stands between the best floor (0) and the ceiling (1) in a region's PSNR, or None."""
    low = better_floor(floors, region)
    if low is None or not ceiling or not ceiling.get(region) or not mean.get(region):
        return None
    return number((mean[region]["psnr"] - low) / (ceiling[region]["psnr"] - low))
