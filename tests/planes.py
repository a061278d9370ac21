"""A camera that moves past textured planes: pictures whose cameras are known, at no cost. A helper of tests."""

import cv2
import numpy as np

from zestjax.sfm.rotations import rotation_from_turn

PLANES = ((6.0, (-9.0, 9.0, -6.0, 6.0)), (4.0, (-2.6, -0.6, -1.2, 0.9)), (3.0, (0.4, 1.5, -0.4, 1.0)))
"""Depth, and (left, right, top, bottom), world units."""
TEXELS = 40  # of a texture a world unit


def texture(height, width, seed=0):
    """(H, W, 3) float32 smooth noise of two sizes in [0, 255]."""
    noise = np.random.default_rng(seed).uniform(size=(height, width, 3)).astype(np.float32)
    mixed = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 4)
    return 255 * (mixed - mixed.min()) / np.ptp(mixed)


def path(count, *, reach=1.2, turns=0.06, seed=0):
    """(N, 4, 4) world_from_camera: sideways by `reach`, wavering, turning by up to `turns` radians."""
    chance = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    share = np.linspace(-0.5, 0.5, count)
    poses[:, 0, 3], poses[:, 1, 3] = reach * share, 0.1 * reach * np.sin(5 * share)
    poses[:, 2, 3] = 0.2 * reach * share**2
    turn = np.stack([0.3 * turns * np.sin(4 * share), -turns * share, 0.1 * turns * chance.normal(size=count)], -1)
    poses[:, :3, :3] = rotation_from_turn(turn)
    return poses


def pictures(poses, *, height=96, width=128, focal=120.0, planes=PLANES):
    """(N, H, W, 3) uint8 of what cameras see, principal point in the middle."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    rays = np.stack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones_like(u)], -1)
    frames = []
    for pose in poses:
        world, place = rays @ pose[:3, :3].T, pose[:3, 3]
        frame = np.zeros((height, width, 3), np.float32)
        for seed, (depth, (left, right, top, bottom)) in enumerate(planes):
            point = place + world * ((depth - place[2]) / world[..., 2])[..., None]
            x, y = (point[..., 0] - left) * TEXELS, (point[..., 1] - top) * TEXELS
            size = int((bottom - top) * TEXELS), int((right - left) * TEXELS)
            shown = cv2.remap(texture(*size, seed), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
            inside = (x >= 0) & (x <= size[1] - 1) & (y >= 0) & (y <= size[0] - 1)
            frame = np.where(inside[..., None], shown, frame)
        frames.append(np.round(frame).clip(0, 255).astype(np.uint8))
    return np.stack(frames)
