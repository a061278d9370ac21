"""The published formulas as slow float64 loops, recorded arrays, and the checks every numerical function gets."""

import importlib
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.testing import assert_finite, assert_grads_match, value_and_gradients  # noqa: F401

GOLDEN = Path(__file__).parents[2] / "shared" / "golden"


def of_experiments(name):
    """A script of `experiments/` as a module."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


def golden(name, *, batch=False):
    """Arrays recorded from the authors' functions, without their batch axis unless `batch`; skips where absent."""
    path = GOLDEN / name
    if not path.exists():
        pytest.skip(f"needs {Path('shared') / 'golden' / name} beside the repository")
    with np.load(path) as file:
        return {
            key: file[key][0] if not batch and file[key].ndim > 1 and file[key].shape[0] == 1 else file[key]
            for key in file
        }


def uniform(seed, *shape, low=0.0, high=1.0, dtype=jnp.float32):
    """Drawn by numpy, which compiles nothing."""
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, shape), dtype)


def normal(seed, *shape, dtype=jnp.float32):
    """Drawn by numpy, which compiles nothing."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), dtype)


def weights_by_loop(density, lengths):
    """NeRF eq. 3, one sample at a time."""
    reaching, weights = 1.0, []
    for sigma, delta in zip(np.asarray(density, np.float64), np.asarray(lengths, np.float64), strict=True):
        alpha = 1.0 - np.exp(-sigma * delta)
        weights.append(reaching * alpha)
        reaching *= 1.0 - alpha
    return np.array(weights)


def blend_by_loop(static_alpha, dynamic_alpha, blend):
    """NSFF section 3.3: a sample's opacity is shared between the fields by its blend."""
    reaching, static, dynamic = 1.0, [], []
    for a, d, b in zip(*(np.asarray(x, np.float64) for x in (static_alpha, dynamic_alpha, blend)), strict=True):
        static.append(reaching * a * (1 - b))
        dynamic.append(reaching * d * b)
        reaching *= (1 - a * (1 - b)) * (1 - d * b)
    return np.array(static), np.array(dynamic)


def density_blend_by_loop(static_density, dynamic_density, blend, lengths):
    """ZeST-NeRF eq. 7-9, with b inside the sum."""
    thickness, static, dynamic = 0.0, [], []
    columns = (np.asarray(x, np.float64) for x in (static_density, dynamic_density, blend, lengths))
    for s, d, b, length in zip(*columns, strict=True):
        reaching = np.exp(-thickness)
        static.append(reaching * (1 - b) * (1 - np.exp(-s * length)))
        dynamic.append(reaching * b * (1 - np.exp(-d * length)))
        thickness += (s * (1 - b) + d * b) * length
    return np.array(static), np.array(dynamic)


def distortion_by_loop(weights, edges):
    """mip-NeRF 360 eq. 15, over all pairs of one ray."""
    weights, edges = np.asarray(weights, np.float64), np.asarray(edges, np.float64)
    middles = (edges[1:] + edges[:-1]) / 2
    total = 0.0
    for i, wi in enumerate(weights):
        total += wi**2 * (edges[i + 1] - edges[i]) / 3
        for j, wj in enumerate(weights):
            total += wi * wj * abs(middles[i] - middles[j])
    return total


def adam_by_loop(gradients, start, *, rate, b1=0.9, b2=0.999, eps=1e-8, path=False):
    """Kingma and Ba, algorithm 1, on one number; `rate` is one, or one for each step. `path`: where each step led."""
    x, mean, square, led = float(start), 0.0, 0.0, []
    for t, (g, r) in enumerate(zip(gradients, np.broadcast_to(rate, len(gradients)), strict=True), start=1):
        mean, square = b1 * mean + (1 - b1) * g, b2 * square + (1 - b2) * g * g
        x -= r * (mean / (1 - b1**t)) / (np.sqrt(square / (1 - b2**t)) + eps)
        led.append(x)
    return led if path else x
