"""Rotations on the host, in float64.

turn     (..., 3) axis times angle, radians
rotation (..., 3, 3)
"""

import numpy as np


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrix whose product with w is vector x w; `vector`: (..., 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape, 3)


def rotation_from_turn(turn: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation by (..., 3) axis times angle: Rodrigues' formula, without a singular point at 0."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    generator = cross_matrix(turn)
    sine = np.sinc(angle / np.pi)  # sin(a) / a
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos(a)) / a^2
    return np.eye(3) + sine * generator + versine * generator @ generator


def rotation_angle(rotation: np.ndarray) -> np.ndarray:
    """(...) radians in [0, pi] by which (..., 3, 3) rotations turn; exact near 0, where the trace alone is not."""
    skew = rotation - np.swapaxes(rotation, -1, -2)
    sine = np.linalg.norm(np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1), axis=-1) / 2
    return np.arctan2(sine, (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation nearest to (..., 3, 3) matrices, by their singular values."""
    left, _, right = np.linalg.svd(matrix)
    sign = np.linalg.det(left @ right)
    left = left * np.stack([np.ones_like(sign), np.ones_like(sign), sign], -1)[..., None, :]
    return left @ right
