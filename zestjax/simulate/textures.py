"""Textures from scikit-image's bundled photographs and from procedural patterns, drawn on the host.

A scene carries its textures as an atlas: `TEXTURES` square tiles with their halved copies (mip levels), packed
into one uint32 a texel so that a lookup is one gather of one word. Training and zest-bench draw from
disjoint photographs, and from procedural patterns of different seeds.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import skimage

TILE = 256  # texels along a tile's side at level 0
LEVELS = 6  # of halved copies: the last has 8 texels a side, for what is far
TEXTURES = 12  # of an atlas: room, props and movers rarely share one; 12 tiles with their copies take 4 MB
PHOTOGRAPHS = {
    "training": (
        ("astronaut.png", "coffee.png", "ihc.png", "gravel.png", "camera.png", "moon.png")
        + ("hubble_deep_field.jpg", "cell.png", "logo.png", "microaneurysms.png")
    ),
    "bench": ("chelsea.png", "retina.jpg", "brick.png", "grass.png", "coins.png", "rocket.jpg", "text.png"),
}


@cache
def photograph(name: str) -> np.ndarray:
    """(h, w, 3) uint8 RGB, read from the installed scikit-image.

    Raises:
      ValueError: where the file is missing or unreadable.
    """
    path = Path(str(skimage.__file__)).parent / "data" / name
    image = cv2.imread(str(path)) if path.exists() else None
    if image is None:
        raise ValueError(f"photograph: {path} is missing or unreadable; reinstall scikit-image.")
    scale = 2 * TILE / min(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image[..., ::-1])


def _crop(chance, image):
    """A tile from a random similar-shaped part of an image, mirrored beyond its borders."""
    height, width = image.shape[:2]
    side = min(height, width) * chance.uniform(0.35, 1.0)
    angle = chance.normal(0, 0.15) + (np.pi / 2) * (chance.integers(4) if chance.random() < 0.3 else 0)
    turn = side / TILE * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = np.array([chance.uniform(side / 2, width - side / 2), chance.uniform(side / 2, height - side / 2)])
    matrix = np.concatenate([turn, (middle - turn @ [TILE / 2, TILE / 2])[:, None]], axis=1)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, (TILE, TILE), flags=flags, borderMode=cv2.BORDER_REFLECT_101)


def noise_tile(chance: np.random.Generator, *, coarsest: int = 4, decay: float = 0.55) -> np.ndarray:
    """(TILE, TILE) smooth value noise in [0, 1]: octaves of interpolated random grids."""
    total, weight, cells = np.zeros((TILE, TILE), np.float32), 1.0, coarsest
    while cells <= TILE // 2:
        grid = chance.random((cells, cells), dtype=np.float32)
        total += weight * cv2.resize(grid, (TILE, TILE), interpolation=cv2.INTER_CUBIC)
        weight, cells = weight * decay, cells * 2
    low, high = np.percentile(total, [2, 98])
    return np.clip((total - low) / (high - low), 0, 1)


def _pattern_tile(chance):
    """(TILE, TILE) stripes, checks, dots or rings in [0, 1]."""
    v, u = np.mgrid[:TILE, :TILE].astype(np.float32) / TILE
    count = 2.0 ** chance.uniform(1.5, 4)
    angle = chance.uniform(0, np.pi)
    a, b = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    wave_a, wave_b = np.sin(2 * np.pi * count * a), np.sin(2 * np.pi * count * b)
    kind = chance.integers(4)
    waves = (
        wave_a,
        wave_a * wave_b,
        np.minimum(wave_a, wave_b),
        np.sin(2 * np.pi * count * np.hypot(u - 0.5, v - 0.5)),
    )
    return np.clip(0.5 + waves[kind] * chance.uniform(1, 6), 0, 1).astype(np.float32)


def _coloured(chance, grey):
    """(TILE, TILE, 3) float from a grey tile in [0, 1], running between two random colours."""
    low, high = chance.uniform(0, 0.55, 3), chance.uniform(0.4, 1, 3)
    mean = 0.5 * (low.mean() + high.mean())
    low, high = 0.45 * mean + 0.55 * low, 0.3 * mean + 0.7 * high
    return (low + (high - low) * grey[..., None]).astype(np.float32)


def _graded(chance, tile):
    """Random exposure, contrast and saturation, as of another camera on another day."""
    grey = tile.mean(axis=-1, keepdims=True)
    tile = grey + (tile - grey) * chance.uniform(0.3, 1.3)
    centre = tile.mean()
    return (tile - centre) * chance.uniform(0.5, 1.4) + np.clip(centre * chance.uniform(0.7, 1.3), 0.15, 0.8)


def random_tile(chance: np.random.Generator, split: str) -> np.ndarray:
    """One texture of a split ("training" or "bench"): (TILE, TILE, 3) uint8."""
    # How often it is a photograph, noise or a pattern, toned or shaded: guesses.
    kind = chance.random()
    if kind < 0.68:
        names = PHOTOGRAPHS[split]
        tile = _crop(chance, photograph(names[chance.integers(len(names))])).astype(np.float32) / 255
        spread = np.abs(tile[..., 0] - tile[..., 2]).mean()
        if spread < 0.01 or chance.random() < 0.15:
            tile = _coloured(chance, tile.mean(axis=-1))
        if chance.random() < 0.2:
            tile = tile[..., chance.permutation(3)]
    else:
        grey = noise_tile(chance, coarsest=int(2 ** chance.integers(1, 5)), decay=chance.uniform(0.45, 0.9))
        grey = _pattern_tile(chance) * 0.7 + 0.3 * grey if kind > 0.9 else grey
        tile = _coloured(chance, grey)
    if chance.random() < 0.4:
        tile = tile * (1 - chance.uniform(0.1, 0.5) * noise_tile(chance, decay=chance.uniform(0.5, 0.95))[..., None])
    return (np.clip(_graded(chance, tile), 0, 1) * 255).astype(np.uint8)


def packed_atlas(tiles: np.ndarray) -> np.ndarray:
    """(T,) uint32 from (n, TILE, TILE, 3) uint8 tiles: level by level, tile by tile, row by row, as 0xBBGGRR."""
    tiles, levels = np.asarray(tiles), []
    for level in range(LEVELS):
        side = TILE >> level
        small = tiles if level == 0 else tiles.reshape(len(tiles), side, 1 << level, side, 1 << level, 3).mean((2, 4))
        words = (small + (0.5 if level else 0)).astype(np.uint32)
        levels.append((words[..., 0] | words[..., 1] << 8 | words[..., 2] << 16).reshape(-1))
    return np.concatenate(levels)


def random_atlas(chance: np.random.Generator, split: str, *, textures: int = TEXTURES) -> np.ndarray:
    """(T,) uint32 packed atlas of `textures` random textures of one split."""
    return packed_atlas(np.stack([random_tile(chance, split) for _ in range(textures)]))
