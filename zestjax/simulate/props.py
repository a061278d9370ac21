"""What scenes are furnished with: rooms, things that stand, things that move. Host side, layout axes.

z        distance from the rig, layout units; what stands nearest is at about 1
reach    of a `View`: distance of the back wall
"""

from typing import Any, NamedTuple

import numpy as np

from zestjax.simulate.layout import Layout, sized
from zestjax.simulate.textures import TEXTURES


class View(NamedTuple):
    """What the rig's middle camera frames: tangents of half its view across and down, height of the floor below it
    and distance of the back wall."""

    across: float
    down: float
    floor: float
    reach: float

    def at(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Position at image fractions x, y in [-1, 1] and distance z."""
        return x * self.across * z, y * self.down * z, z

    def width(self, z: float) -> float:
        """Width of the view at a distance."""
        return 2 * self.across * z


def log_uniform(chance: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(chance.uniform(np.log(low), np.log(max(high, low * 1.001)))))


def finish(chance: np.random.Generator, view: View, z: float, size: float) -> dict[str, Any]:
    """Random textures, tile length, tint and gloss of a thing of half-length `size` at distance z."""
    tile = log_uniform(chance, 1.2 * size, max(2.4 * size, 0.8 * view.width(z)))
    tint = chance.uniform(0.65, 1.1) * chance.uniform(0.85, 1.1, 3)
    gloss = chance.uniform(0, 0.6) if chance.random() < 0.3 else 0.0
    return dict(
        textures=(int(chance.integers(TEXTURES)),), tile=tile, offset=chance.uniform(0, 2, 2), tint=tint, gloss=gloss
    )


def add_room(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    half_width: float,
    ceiling: float,
    behind: float,
    **motion: Any,
) -> None:
    """The hollow box around everything, and its floor."""
    depth = (view.reach + behind) / 2
    height = (view.floor + ceiling) / 2
    middle = np.array([0, (view.floor - ceiling) / 2, view.reach - depth])
    walls = tuple(int(i) for i in chance.choice(TEXTURES, 3, replace=False))
    look = dict(tint=chance.uniform(0.8, 1.1, 3), offset=chance.uniform(0, 2, 2))
    tile = view.width(view.reach) * chance.uniform(0.25, 0.8)
    layout.box(
        shape=sized((half_width, height + 0.02, depth)), position=middle, hollow=True, textures=walls, tile=tile,
        **look, **motion,
    )  # fmt: skip
    near_tile = view.width(view.floor / view.down) * chance.uniform(0.5, 1.6)
    layout.box(
        shape=sized((2 * half_width, 0.5, 2 * depth)), position=(middle[0], view.floor + 0.5, middle[2]),
        textures=(int(chance.integers(TEXTURES)),), tile=near_tile, offset=chance.uniform(0, 2, 2), **motion,
    )  # fmt: skip


def add_standing(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    z: float,
    x: float,
    kind: str,
    motion: dict[str, Any] | None = None,
) -> None:
    """Something still: "block", "ball", "pole", "panel", "beam", "tower" (a large block) or "hanging" (a
    ball or a block in mid-air)."""
    motion = motion or {}
    width = view.width(z)
    turn = chance.uniform(-0.8, 0.8)
    if kind == "pole":
        half = np.array([width * chance.uniform(0.002, 0.012)] * 2)
        height = view.floor * chance.uniform(0.6, 1.0) if chance.random() < 0.4 else view.floor + view.down * z
        half = np.array([half[0], height / 2, half[1]])
    elif kind == "beam":
        half = np.array([width * chance.uniform(0.15, 0.5), width * chance.uniform(0.002, 0.012), width * 0.004])
    elif kind == "panel":
        half = np.array([width * chance.uniform(0.1, 0.3), width * chance.uniform(0.08, 0.25), width * 0.006])
    elif kind == "tower":
        half = width * chance.uniform([0.05, 0.15, 0.03], [0.2, 0.45, 0.1])
    else:
        half = width * log_uniform(chance, 0.03, 0.15) * chance.uniform(0.6, 1.4, 3)
    floating = kind in ("hanging", "beam")
    y = chance.uniform(-0.7, 0.1) * view.down * z if floating else view.floor - half[1]
    look = finish(chance, view, z, float(half.max()))
    add = layout.ball if kind == "ball" or (kind == "hanging" and chance.random() < 0.5) else layout.box
    add(shape=sized(half), position=(x * view.across * z, y, z), turn=turn, **look, **motion)


def add_roller(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    z: float,
    x: float,
    size: float,
    speed: float,
    heading: float,
    gloss: float | None = None,
) -> None:
    """A ball that rolls over the floor; `speed` per frame along `heading` (0 is away, pi/2 is to the right)."""
    look = finish(chance, view, z, size)
    look |= {} if gloss is None else {"gloss": gloss}
    layout.ball(
        shape=sized((size,) * 3), position=(x * view.across * z, view.floor - size, z), turn=heading,
        velocity=(0, 0, speed), spin=(-speed / size, 0, 0), **look,
    )  # fmt: skip


def add_slider(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    z: float,
    x: float,
    y: float | None,
    size: float,
    speed: float,
    heading: float,
    spin: float = 0.0,
    kind: str = "box",
) -> None:
    """A block or ellipsoid that moves through the air or, with y None, over the floor, and may spin upright."""
    half = size * chance.uniform(0.6, 1.3, 3)
    height = view.floor - half[1] if y is None else y * view.down * z
    bob = 0.0 if y is None else chance.uniform(0, 0.4) * size
    add = layout.box if kind == "box" else layout.ball
    add(
        shape=sized(half), position=(x * view.across * z, height, z), turn=heading, velocity=(0, 0, speed),
        sway=(0, bob, 0), rate=chance.uniform(0.2, 0.8), phase=chance.uniform(0, 6.3), spin=(0, spin, 0),
        **finish(chance, view, z, size),
    )  # fmt: skip


def add_blob(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    z: float,
    x: float,
    y: float,
    size: float,
    speed: float,
    heading: float,
    amount: float,
    rate: float,
) -> None:
    """An ellipsoid that stretches and shears by `amount` while it drifts."""
    raw = chance.normal(0, 1, (3, 3))
    strain = amount * (raw + 0.6 * raw.T) / np.abs(raw + 0.6 * raw.T).max()
    layout.ball(
        shape=sized(size * chance.uniform(0.7, 1.2, 3)), position=view.at(x, y, z), turn=heading,
        velocity=(0, 0, speed), strain=strain, rate=rate, phase=chance.uniform(0, 6.3), **finish(chance, view, z, size),
    )  # fmt: skip


def add_walker(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    z: float,
    x: float,
    size: float,
    speed: float,
    heading: float,
    rate: float,
) -> None:
    """A figure of half-height `size` whose arms and two-part legs swing from its trunk: chains of three."""
    looks = [finish(chance, view, z, 0.5 * size) for _ in range(3)]
    gait = dict(rate=rate, phase=chance.uniform(0, 6.3))
    hips = view.floor - 0.96 * size
    trunk = layout.box(
        shape=sized((0.22 * size, 0.32 * size, 0.14 * size), offset=(0, -0.32 * size, 0)), turn=heading,
        position=(x * view.across * z, hips, z), velocity=(0, 0, speed), sway=(0, 0.02 * size, 0), **gait, **looks[0],
    )  # fmt: skip
    layout.ball(
        shape=sized((0.15 * size, 0.18 * size, 0.15 * size)), position=(0, -0.84 * size, 0), parent=trunk,
        swing=(0, 0.2, 0), **gait, **looks[1],
    )  # fmt: skip
    stride = min(0.7, 1.2 * abs(speed) / max(size * rate, 1e-6)) + 0.12
    for side in (-1, 1):
        arm = sized((0.07 * size, 0.3 * size, 0.07 * size), offset=(0, 0.27 * size, 0))
        layout.box(
            shape=arm, position=(side * 0.3 * size, -0.6 * size, 0), parent=trunk, swing=(-side * 0.8 * stride, 0, 0),
            **gait, **looks[1],
        )  # fmt: skip
        thigh = layout.box(
            shape=sized((0.09 * size, 0.25 * size, 0.1 * size), offset=(0, 0.23 * size, 0)), parent=trunk,
            position=(side * 0.12 * size, 0, 0), swing=(side * stride, 0, 0), **gait, **looks[2],
        )  # fmt: skip
        layout.box(
            shape=sized((0.08 * size, 0.25 * size, 0.09 * size), offset=(0, 0.23 * size, 0)), parent=thigh,
            position=(0, 0.47 * size, 0), swing=(0.5 * stride, 0, 0), **gait, **looks[2],
        )  # fmt: skip


def add_pendulum(
    layout: Layout,
    chance: np.random.Generator,
    view: View,
    *,
    z: float,
    x: float,
    size: float,
    swing: float,
    rate: float,
) -> None:
    """A weight on a thin rod that swings from above the picture."""
    top, length = -1.1 * view.down * z, chance.uniform(0.8, 1.4) * view.down * z
    gait = dict(rate=rate, phase=chance.uniform(0, 6.3))
    thin = 0.006 * view.width(z)
    rod = layout.box(
        shape=sized((thin, length / 2, thin), offset=(0, length / 2, 0)), position=(x * view.across * z, top, z),
        turn=chance.uniform(-0.5, 0.5), swing=(0.2 * swing, 0, swing), **gait, **finish(chance, view, z, length),
    )  # fmt: skip
    add = layout.box if chance.random() < 0.4 else layout.ball
    add(shape=sized((size,) * 3, offset=(0, length, 0)), parent=rod, **finish(chance, view, z, size))
