"""zest-bench: nine named scenes, a 12-camera rig, 24 times.

Frame i of the input video is from camera i mod 12; the other cameras at each time are the held-out truth.
Photographs are disjoint from the ones models are trained on (`textures.PHOTOGRAPHS`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from zestjax.base.checks import check_option
from zestjax.simulate import props, rigs
from zestjax.simulate.layout import Layout
from zestjax.simulate.textures import random_atlas
from zestjax.simulate.types import Effects, SimulatedScene

FRAMES = 24  # as many as a scene of the Dynamic Scene dataset has in ZeST-NeRF's setting: two rounds of the rig
SHADOWS = {"shadows": np.float32(0.6)}  # part of the benchmark, as all numbers below: changed, its figures are others
MIDDLE = (FRAMES - 1) / 2  # the time at which what moves passes its place


@dataclass(frozen=True)
class _Recipe:
    """fill: adds the things of a scene to (layout, chance, view). seed: of the looks. effects: of `Effects`. The rest
    sets the view, the rig and the light."""

    fill: Callable
    seed: int
    effects: dict = field(default_factory=lambda: SHADOWS)
    degrees: float = 55.0
    reach: float = 6.5
    floor: float = 0.5
    disparity: float = 0.035
    rig: str = "arc"
    jitter: float = 0.02
    light: tuple = (-1.5, -1.4, 0.8)
    ambient: float = 0.55
    gain: float = 1.15
    room: dict = field(default_factory=dict)


def bench_scene(name: str, *, height: int = 144, width: int = 256) -> SimulatedScene:
    """One scene of zest-bench.

    Args:
      name: one of `BENCH`.
      height: of the images.
      width: of the images; the field of view across is the scene's own.

    Returns:
      `SimulatedScene` of host arrays.

    Raises:
      ValueError: no such scene.
    """
    check_option("bench_scene", name=(name, BENCH))
    recipe = _RECIPES[name]
    chance = np.random.default_rng([2024, recipe.seed])
    across = np.tan(np.radians(recipe.degrees) / 2)
    view = props.View(across, across * 9 / 16, recipe.floor, recipe.reach)
    layout = Layout()
    room = {"half_width": 0.9 * view.across * view.reach + 0.8, "ceiling": 1.6, "behind": 4.0}
    props.add_room(layout, chance, view, **(room | recipe.room))
    recipe.fill(layout, chance, view)
    exposure = np.full((FRAMES, 3), recipe.gain, np.float32)
    scene = layout.scene(
        atlas=random_atlas(chance, "bench"), light=recipe.light, ambient=recipe.ambient,
        effects=Effects(**({"exposure": exposure} | recipe.effects)), mid_time=MIDDLE,
    )  # fmt: skip
    middle = np.sqrt(view.reach)
    spacing = recipe.disparity * view.width(middle)
    positions = rigs.rig_positions(spacing, kind=recipe.rig, bend=0.06)
    positions = positions + recipe.jitter * spacing * 10 * chance.uniform(-0.5, 0.5, positions.shape)
    angles = 0.7 * rigs.angles_towards(positions, (0, 0, 1.5 * middle)) + [0, 0.03, 0]
    rig = rigs.cameras_at(positions, angles, rigs.intrinsics_from_view(height, width, view.across))
    near, far = _BOUNDS[name]
    return SimulatedScene(name, scene, rig, np.arange(FRAMES) % rigs.RIG, near, far, height, width)


def _furnish(layout, chance, view, *things):
    """Things that stand: (kind, x, z) each."""
    for kind, x, z in things:
        props.add_standing(layout, chance, view, z=z, x=x, kind=kind)


def _still_life(layout, chance, view):
    _furnish(
        layout, chance, view, ("block", -0.55, 1.7), ("ball", 0.05, 1.5), ("block", 0.6, 2.1), ("panel", 0.25, 4.2)
    )
    _furnish(
        layout, chance, view, ("hanging", -0.3, 2.6), ("tower", -0.75, 5.4), ("pole", 0.85, 2.7), ("ball", -0.1, 3.3)
    )


def _walker(layout, chance, view):
    props.add_walker(layout, chance, view, z=2.3, x=0.0, size=0.54, speed=0.035, heading=np.pi / 2, rate=0.55)
    _furnish(layout, chance, view, ("block", -0.7, 1.8), ("pole", 0.25, 1.7), ("tower", 0.6, 5.2), ("panel", -0.3, 4.4))
    _furnish(layout, chance, view, ("ball", 0.8, 2.8), ("block", 0.1, 3.6))


def _blobs(layout, chance, view):
    common = dict(speed=0.008, heading=1.2)
    props.add_blob(layout, chance, view, z=2.0, x=-0.35, y=0.0, size=0.3, amount=0.35, rate=0.45, **common)
    props.add_blob(layout, chance, view, z=3.2, x=0.4, y=-0.2, size=0.45, amount=0.4, rate=0.3, **common)
    _furnish(
        layout, chance, view, ("block", 0.75, 1.9), ("tower", -0.6, 5.5), ("panel", 0.1, 4.6), ("block", -0.85, 2.8)
    )


def _marbles(layout, chance, view):
    near = ((-0.4, 1.6, 0.17, 0.02, 1.3), (0.35, 2.2, 0.26, -0.025, 1.9))
    for x, z, size, speed, heading in (*near, (0.1, 3.4, 0.4, 0.03, 1.57), (-0.7, 2.9, 0.3, 0.02, 0.6)):
        props.add_roller(layout, chance, view, z=z, x=x, size=size, speed=speed, heading=heading, gloss=0.6)
    _furnish(
        layout, chance, view, ("block", 0.75, 2.9), ("tower", -0.35, 5.6), ("block", -0.85, 3.9), ("panel", 0.5, 5.0)
    )


def _sprint(layout, chance, view):
    pace = lambda z: 0.05 * view.width(z)
    props.add_slider(layout, chance, view, z=1.9, x=-0.1, y=0.05, size=0.2, speed=pace(1.9), heading=1.5, spin=0.1)
    props.add_roller(layout, chance, view, z=2.8, x=0.2, size=0.32, speed=-pace(2.8), heading=1.7)
    props.add_slider(layout, chance, view, z=4.2, x=0.0, y=-0.35, size=0.4, speed=pace(4.2), heading=-1.5, kind="ball")
    _furnish(layout, chance, view, ("block", -0.7, 2.2), ("tower", 0.7, 5.4), ("panel", -0.3, 5.0), ("block", 0.8, 2.5))


def _lattice(layout, chance, view):
    _furnish(
        layout,
        chance,
        view,
        *(("pole", x, z) for x, z in ((-0.8, 1.9), (-0.35, 1.5), (0.15, 2.3), (0.55, 1.7), (0.9, 3))),
    )
    _furnish(layout, chance, view, ("beam", -0.3, 2.0), ("beam", 0.4, 2.6), ("tower", 0.1, 5.5), ("block", -0.6, 3.4))
    props.add_pendulum(layout, chance, view, z=2.4, x=-0.15, size=0.16, swing=0.4, rate=0.5)
    props.add_pendulum(layout, chance, view, z=3.2, x=0.55, size=0.22, swing=0.3, rate=0.37)


def _swell(layout, chance, view):
    for kind, x, z in (
        ("block", -0.5, 1.8),
        ("ball", 0.35, 2.0),
        ("tower", 0.5, 5.2),
        ("panel", -0.4, 4.2),
        ("pole", 0.8, 2.6),
    ):
        waves = dict(sway=(0.05 * z, 0, 0.03 * z), swing=(0, 0.2, 0), rate=0.4, phase=chance.uniform(0, 6.3))
        props.add_standing(layout, chance, view, z=z, x=x, kind=kind, motion=waves)
    props.add_blob(layout, chance, view, z=2.6, x=0.0, y=-0.1, size=0.35, speed=0.01, heading=1.6, amount=0.3, rate=0.4)


def _dusk(layout, chance, view):
    props.add_slider(layout, chance, view, z=2.0, x=0.3, y=None, size=0.24, speed=0.018, heading=-1.4)
    props.add_slider(layout, chance, view, z=3.0, x=-0.35, y=-0.1, size=0.36, speed=0.0, heading=0.3, spin=0.09)
    _furnish(layout, chance, view, ("block", -0.75, 1.9), ("ball", 0.75, 2.4), ("tower", 0.3, 5.6), ("pole", 0.05, 2.7))


def _crowd(layout, chance, view):
    props.add_walker(layout, chance, view, z=1.9, x=-0.3, size=0.5, speed=0.02, heading=np.pi / 2, rate=0.5)
    props.add_walker(layout, chance, view, z=3.1, x=0.4, size=0.66, speed=0.025, heading=-np.pi / 2, rate=0.42)
    props.add_roller(layout, chance, view, z=2.4, x=0.1, size=0.15, speed=0.03, heading=1.9)
    _furnish(layout, chance, view, ("block", 0.8, 2.0), ("tower", -0.55, 5.5), ("panel", 0.35, 4.7))


_DRIFT = 1 + 0.12 * np.sin(2 * np.pi * np.arange(FRAMES)[:, None] / 19 + np.array([0.0, 0.3, 0.6])).astype(np.float32)
_RECIPES = {
    "still_life": _Recipe(_still_life, 1, effects=SHADOWS | {"specular": np.float32(0.8)}),
    "walker": _Recipe(_walker, 2),
    "blobs": _Recipe(_blobs, 3, rig="zigzag"),
    "marbles": _Recipe(_marbles, 4, effects=SHADOWS | {"specular": np.float32(0.5)}, degrees=58),
    "sprint": _Recipe(_sprint, 5, effects=SHADOWS | {"motion_blur": np.float32(0.4)}),
    "lattice": _Recipe(_lattice, 6, rig="rows", disparity=0.045),
    "swell": _Recipe(
        _swell,
        7,
        room={"sway": (0.12, 0, 0.05), "swing": (0, 0.02, 0), "rate": 0.35, "strain": np.diag([0.03, 0, 0.02])},
    ),
    "dusk": _Recipe(_dusk, 8, effects=SHADOWS | {"exposure": 1.1 * _DRIFT, "noise": np.float32(0.015)}, degrees=50),
    "crowd": _Recipe(_crowd, 9, jitter=0.05, reach=8.0, disparity=0.03),
}
_BOUNDS = dict.fromkeys(_RECIPES, (1.2, 7.4)) | {"crowd": (1.2, 9.0)}
BENCH = tuple(_RECIPES)
