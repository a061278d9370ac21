"""Where the cameras stand: rigs that are revisited, and handheld paths. Host arrays, layout axes.

N        cameras or frames
width    of the view at a distance: 2 * tan(half the horizontal field of view) * distance
"""

from collections.abc import Sequence

import numpy as np

from zestjax.cameras import Camera

RIG = 12  # cameras, as the rig of the Dynamic Scene dataset has


def intrinsics_from_view(height: int, width: int, tangent: float) -> np.ndarray:
    """(3, 3) of square pixels; `tangent` of half the horizontal field of view, pixel edge to pixel edge."""
    focal = width / (2 * tangent)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], np.float32)


def cameras_at(positions: np.ndarray, angles: np.ndarray, intrinsics: np.ndarray, *, unit: float = 1.0) -> Camera:
    """Cameras from places and small turns.

    Args:
      positions: (N, 3) layout units.
      angles: (N, 3) yaw to the right, pitch down, roll, radians.
      intrinsics: (3, 3).
      unit: world units per layout unit.

    Returns:
      `Camera` with (N, ...) float32 leaves on the host.
    """
    yaw, pitch, roll = np.asarray(angles, np.float64).T
    one, zero = np.ones_like(yaw), np.zeros_like(yaw)
    c, s = np.cos, np.sin
    matrix = lambda rows: np.stack([np.stack(row, -1) for row in rows], -2)
    turn = matrix([[c(yaw), zero, s(yaw)], [zero, one, zero], [-s(yaw), zero, c(yaw)]])
    nod = matrix([[one, zero, zero], [zero, c(pitch), s(pitch)], [zero, -s(pitch), c(pitch)]])
    tilt = matrix([[c(roll), -s(roll), zero], [s(roll), c(roll), zero], [zero, zero, one]])
    rotation = np.swapaxes(turn @ nod @ tilt, -1, -2)
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, np.asarray(positions, np.float64) * unit)
    return Camera(np.tile(np.asarray(intrinsics, np.float32), (len(yaw), 1, 1)), poses.astype(np.float32))


def angles_towards(positions: np.ndarray, target: Sequence[float] | np.ndarray) -> np.ndarray:
    """(N, 3) yaw and pitch, no roll, that look from (N, 3) positions at one (3,) point."""
    away = np.asarray(target) - np.asarray(positions)
    yaw = np.arctan2(away[:, 0], away[:, 2])
    return np.stack([yaw, np.arctan2(away[:, 1], np.hypot(away[:, 0], away[:, 2])), np.zeros_like(yaw)], -1)


def rig_positions(spacing: float, *, kind: str = "arc", bend: float = 0.0, count: int = RIG) -> np.ndarray:
    """(N, 3) places of a rig.

    Args:
      spacing: between neighbours.
      kind: "arc", "rows" (two rows, one above the other) or "zigzag".
      bend: how far the ends come forward, as a share of the rig's length.
      count: N.
    """
    rows = 2 if kind == "rows" else 1
    column = np.arange(count) % (count // rows)
    x = (column - (count // rows - 1) / 2) * spacing
    y = np.zeros(count)
    if kind == "rows":
        y = (np.arange(count) // (count // 2) - 0.5) * spacing
    elif kind == "zigzag":
        y = (np.arange(count) % 2 - 0.5) * 0.6 * spacing
    half = np.abs(x).max()
    return np.stack([x, y, bend * 2 * half * (x / half) ** 2], -1)


def smooth_walk(chance: np.random.Generator, count: int, columns: int, *, waves: int = 3) -> np.ndarray:
    """(count, columns) smooth random curves of about unit amplitude and mean 0."""
    t = np.arange(count)[:, None, None] / max(count, 2)
    rates = chance.uniform(0.3, 2.5, (1, columns, waves))
    curves = (np.sin(2 * np.pi * (rates * t + chance.random(rates.shape))) / rates).sum(-1)
    curves = curves - curves.mean(0)
    return curves / np.maximum(np.abs(curves).max(0), 1e-6)


def handheld_path(chance: np.random.Generator, count: int, step: float, focus: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and turns of a hand that drifts sideways while it shakes.

    Args:
      chance: `numpy.random.Generator`.
      count: N.
      step: drift per frame, layout units.
      focus: distance of what the hand keeps in view.

    Returns:
      positions (N, 3), angles (N, 3).
    """
    # The sizes of drift and shake are guesses.
    heading = chance.uniform(-np.pi, np.pi)
    lateral = np.array([np.cos(heading), 0.25 * np.sin(heading), 0.0])
    forward = np.array([0, 0, chance.normal(0, 0.25)])
    t = (np.arange(count) - (count - 1) / 2)[:, None]
    positions = step * (
        t * (lateral + forward) + smooth_walk(chance, count, 3) * [0.15 * count, 0.08 * count, 0.06 * count]
    )
    positions += chance.normal(0, 0.1 * step, positions.shape)
    positions[:, 2] = np.clip(positions[:, 2], -0.5, 0.35)
    angles = angles_towards(positions, (0, 0, focus)) * chance.uniform(-0.2, 1.0)
    shake = smooth_walk(chance, count, 3) * chance.uniform(0, 0.03) + chance.normal(
        0, chance.uniform(0, 0.003), (count, 3)
    )
    return positions, angles + shake * [1, 1, 0.7]
