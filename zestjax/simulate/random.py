"""Scenes without end, from a random key: what models are trained on.

Drawn on the host; all scenes of one layout size and frame count have the same shapes, so that one compiled
program renders them all. Ranges: field of view 35-90 degrees, far/near 2-30, motion from none to fast,
rigs, arcs and hands, static scenes, scenes in which everything moves, dark ones, exposure differences.

    N        frames of the input video
    T        targets
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.cameras import Camera, scaled
from zestjax.simulate import props, rigs
from zestjax.simulate.layout import Layout
from zestjax.simulate.render import render
from zestjax.simulate.textures import random_atlas
from zestjax.simulate.types import Effects, Scene


class RandomScene(NamedTuple):
    """scene: `Scene`. cameras: (N,) `Camera` that took the frames. targets: (T,) `Camera` and target_times: (T,)
    int32 of views to predict, never the camera that took the frame of that time."""

    scene: Scene
    cameras: Camera
    targets: Camera
    target_times: np.ndarray


def generator(key: jax.Array) -> np.random.Generator:
    """`numpy.random.Generator` that is a function of a JAX key."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())


def random_scene(key: jax.Array, *, height: int, width: int, frames: int = 16, targets: int = 8) -> RandomScene:
    """A scene with its cameras.

    Args:
      key: JAX random key.
      height: of the images.
      width: of the images.
      frames: N.
      targets: T.

    Returns:
      `RandomScene` of host arrays; deterministic in the key.
    """
    chance = generator(key)
    unit = props.log_uniform(chance, 0.2, 10)
    aim = chance.normal(0, 1, 3) * [0.12, 0.07, 0.01] + [0, 0.03, 0]
    view = _random_view(chance, height / width, aim[1])
    intrinsics = rigs.intrinsics_from_view(height, width, view.across)
    at = lambda positions, angles: rigs.cameras_at(positions, angles, intrinsics, unit=unit)
    places = _random_places(chance, view, frames, targets)
    layout = Layout()
    _fill(layout, chance, view, frames, np.abs(places.positions[:, 0]).max())
    ceiling = 0.7 * view.down * view.reach
    light = (chance.uniform(-0.6, 0.6) * view.reach * view.across, -ceiling, chance.uniform(-0.3, 0.7) * view.reach)
    scene = layout.scene(
        atlas=random_atlas(chance, "training"), light=light, ambient=chance.uniform(0.35, 0.85),
        effects=_random_effects(chance, frames), mid_time=(frames - 1) / 2, unit=unit,
    )  # fmt: skip
    cameras, wanted = at(places.positions, places.angles + aim), at(places.target_positions, places.target_angles + aim)
    brightness = chance.uniform(0.06, 0.2) if chance.random() < 0.12 else chance.uniform(0.28, 0.55)
    scene = _exposed(scene, Camera(*(leaf[frames // 2] for leaf in cameras)), brightness, height, width)
    return RandomScene(scene, cameras, wanted, places.target_times.astype(np.int32))


_probe = jax.jit(render, static_argnames=("height", "width", "samples"))


def _exposed(scene, camera, brightness, height, width, *, share=4):
    """The scene with its exposure such that the camera's image has a mean brightness, as a camera's automatic has."""
    small = scaled(camera, np.float32(1 / share), np.float32(1 / share))
    dim = scene._replace(effects=scene.effects._replace(exposure=np.full_like(scene.effects.exposure, 0.25)))
    mean = 4 * float(jnp.mean(_probe(dim, small, 0.0, height=height // share, width=width // share, samples=1).image))
    gain = np.float32(np.clip(brightness / max(mean, 1e-3), 0.2, 4.0))
    return scene._replace(effects=scene.effects._replace(exposure=scene.effects.exposure * gain))


def _random_view(chance, aspect, pitch):
    wide = chance.random() < 0.5
    across = np.tan(np.radians(chance.uniform(60, 90) if wide else chance.uniform(35, 60)) / 2)
    down = across * aspect
    reach = props.log_uniform(chance, 2.0, 24.0)
    return props.View(across, down, (down + max(pitch, 0)) * chance.uniform(1.05, 2.4), reach)


class _Places(NamedTuple):
    positions: np.ndarray
    angles: np.ndarray
    target_positions: np.ndarray
    target_angles: np.ndarray
    target_times: np.ndarray


def _random_places(chance, view, frames, targets):
    """Cameras of the frames and of the targets: a revisited rig in half of the scenes, else a hand."""
    middle = np.sqrt(view.reach)
    times = chance.permutation(np.arange(max(frames, targets)) % frames)[:targets]
    if chance.random() < 0.5:
        spacing = min(props.log_uniform(chance, 0.01, 0.07) * view.width(middle), 0.11 * view.width(1.0))
        kind = ("arc", "arc", "rows", "zigzag")[chance.integers(4)]
        positions = rigs.rig_positions(spacing, kind=kind, bend=chance.uniform(0, 0.12))
        positions = positions[:: -1 if chance.random() < 0.5 else 1] + chance.normal(0, 0.04 * spacing, (rigs.RIG, 3))
        angles = rigs.angles_towards(positions, (0, 0, middle * chance.uniform(1, 4))) * chance.uniform(0, 1)
        angles = angles + chance.normal(0, 0.01, angles.shape)
        taken = np.arange(frames) % rigs.RIG
        other = (times + chance.integers(1, rigs.RIG, targets)) % rigs.RIG
        return _Places(positions[taken], angles[taken], positions[other], angles[other], times)
    step = min(props.log_uniform(chance, 0.001, 0.03) * view.width(middle), 0.05 * view.width(1.0))
    positions, angles = rigs.handheld_path(chance, frames, step, middle * chance.uniform(0.7, 3))
    near = np.clip(times + chance.integers(1, 5, targets) * chance.choice([-1, 1], targets), 0, frames - 1)
    near = np.where(near == times, (times + 1) % frames, near)
    mix = np.where(chance.random(targets) < 0.5, 1.0, chance.uniform(0.3, 1.2, targets))[:, None]
    aside = chance.normal(0, 1, (targets, 3)) * [1, 0.4, 0.3] * view.width(middle) * chance.uniform(0.005, 0.03)
    aside = np.where(chance.random((targets, 1)) < 0.4, aside, 0)
    blend = lambda rows: rows[times] + mix * (rows[near] - rows[times])
    return _Places(positions, angles, blend(positions) + aside, blend(angles), times)


def _random_effects(chance, frames):
    """Every effect is in the program; its strength may be 0."""
    exposure = np.ones((frames, 3))
    if chance.random() < 0.3:
        exposure *= 1 + chance.uniform(0.02, 0.12) * rigs.smooth_walk(chance, frames, 1)
        exposure *= (
            1 + chance.uniform(0.0, 0.03) * chance.normal(0, 1, (frames, 1)) + chance.normal(0, 0.005, (frames, 3))
        )
    sometimes = lambda share, low, high: np.float32(chance.uniform(low, high) if chance.random() < share else 0)
    return Effects(
        shadows=sometimes(0.6, 0.3, 0.9),
        specular=sometimes(0.5, 0.3, 1),
        motion_blur=sometimes(0.3, 0.2, 0.8),
        exposure=exposure.astype(np.float32),
        noise=sometimes(0.5, 0, 0.025),
    )


def _fill(layout, chance, view, frames, farthest):
    """Room, things that stand and things that move."""
    everything = chance.random() < 0.05
    speed = props.log_uniform(chance, 0.001, 0.05)

    def drift(z, turn=0.0):
        if not everything:
            return {}
        sway = chance.normal(0, 1.5, 3) * [1, 0, 0.5] * view.width(z) * speed
        return dict(sway=sway, swing=(0, turn, 0), rate=chance.uniform(0.2, 0.5), phase=chance.uniform(0, 6.3))

    half_width = max(view.across * view.reach * chance.uniform(0.55, 1.3), farthest + 1.2)
    ceiling = max(view.down * view.reach * chance.uniform(0.75, 1.6), 0.8)
    props.add_room(
        layout, chance, view, half_width=half_width, ceiling=ceiling, behind=3 + 0.2 * view.reach,
        **drift(min(view.reach, 3), chance.normal(0, 0.03)),
    )  # fmt: skip
    for _ in range(chance.integers(0, 4)):
        z = view.reach * chance.uniform(0.6, 0.9)
        props.add_standing(
            layout, chance, view, z=z, x=chance.uniform(-1, 1), kind="tower", motion=drift(z, chance.normal(0, 0.15))
        )
    kinds = ("block", "block", "ball", "pole", "panel", "beam", "hanging", "block")
    for _ in range(chance.integers(3, 9)):
        z = props.log_uniform(chance, 1.15, 0.93 * view.reach)
        kind = kinds[chance.integers(len(kinds))]
        props.add_standing(
            layout, chance, view, z=z, x=chance.uniform(-1, 1), kind=kind, motion=drift(z, chance.normal(0, 0.15))
        )
    if chance.random() < 0.16 and not everything:
        return
    for _ in range(1 + chance.poisson(1.5)):
        _add_mover(layout, chance, view, frames, speed * props.log_uniform(chance, 0.5, 2))


def _add_mover(layout, chance, view, frames, speed):
    """One thing that moves `speed` view widths per frame or so."""
    z = props.log_uniform(chance, 1.25, min(0.75 * view.reach, 9))
    size = view.width(z) * log_size(chance)
    heading = chance.choice([-1, 1]) * np.pi / 2 + chance.normal(0, 0.5)
    pace = speed * view.width(z)
    pace = min(pace, max(0.7 * (z - 1), 0.05) / (frames / 2 * max(abs(np.cos(heading)), 0.05)))
    x, rate = chance.uniform(-0.6, 0.6), chance.uniform(0.2, 1.0)
    common = dict(z=z, x=x, size=size, speed=pace, heading=heading)
    height = None if chance.random() < 0.5 else chance.uniform(-0.6, 0.4)
    kind = chance.choice(
        ["roller", "slider", "spinner", "blob", "walker", "pendulum"], p=[0.15, 0.25, 0.1, 0.2, 0.2, 0.1]
    )
    if kind == "walker" and layout.room_for(boxes=7, balls=1):
        props.add_walker(layout, chance, view, **(common | {"size": 1.6 * size}), rate=rate)
    elif kind == "pendulum" and layout.room_for(boxes=2, balls=1):
        props.add_pendulum(layout, chance, view, z=z, x=x, size=0.7 * size, swing=chance.uniform(0.05, 0.6), rate=rate)
    elif not layout.room_for(balls=1):
        return
    elif kind == "blob":
        props.add_blob(
            layout, chance, view, **common, y=chance.uniform(-0.4, 0.5), amount=chance.uniform(0.1, 0.45), rate=rate
        )
    elif kind == "roller":
        props.add_roller(layout, chance, view, **common)
    else:
        spin = chance.normal(0, 0.12) if kind == "spinner" else 0.0
        shape = "box" if layout.room_for(boxes=1) and chance.random() < 0.6 else "ball"
        props.add_slider(layout, chance, view, **common, y=height, spin=spin, kind=shape)


def log_size(chance: np.random.Generator) -> float:
    """Half-length of a mover as a share of the view's width."""
    return props.log_uniform(chance, 0.04, 0.19)
