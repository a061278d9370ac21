"""Exact answers: where every visible material point goes, and whether another view sees it.

H W      rows and columns
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.numerics import matvec
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera, project
from zestjax.simulate.cast import nearest_hit
from zestjax.simulate.motion import all_bodies, carried, movement
from zestjax.simulate.render import placed_bodies
from zestjax.simulate.types import Bodies, Frame, Scene

STILL = 1e-4  # a point that moves less than this share of its depth stands still


class Correspondence(NamedTuple):
    """flow: (H, W, 2) pixels, column and row, from a pixel of view a to where its material point is in view b.
    scene_flow: (H, W, 3) world displacement of that point. visible: (H, W) bool, view b sees the point. depth:
    (H, W) its depth in view b."""

    flow: Array
    scene_flow: Array
    visible: Array
    depth: Array


def scene_flow(scene: Scene, frame: Frame, time: Scalar, time_there: Scalar) -> jax.Array:
    """(H, W, 3) world displacement of a frame's material points from its time to another."""
    return carried(frame.point, frame.body, movement(all_bodies(scene), time, time_there)) - frame.point


def motion_mask(scene: Scene, frame: Frame, time: Scalar) -> jax.Array:
    """(H, W) bool: does the pixel's material point move in the world between time - 1, time and time + 1?"""
    moves = [scene_flow(scene, frame, time, time + step) for step in (-1, 1)]
    distance = jnp.maximum(*(jnp.sqrt(jnp.sum(move * move, axis=-1)) for move in moves))
    return (distance > STILL * frame.depth) & (frame.body >= 0)


def moving_bodies(bodies: Bodies) -> jax.Array:
    """(B,) bool: bodies that ever move, by themselves or in a chain of joints."""
    motion = bodies.motion
    parts = (motion.velocity, motion.sway, motion.spin, motion.swing, motion.strain)
    own = jnp.any(jnp.stack([jnp.any(p.reshape(p.shape[0], -1) != 0, axis=-1) for p in parts]), axis=0)
    moves = own
    for _ in range(4):
        moves = own | ((motion.parent >= 0) & moves[jnp.maximum(motion.parent, 0)])
    return moves


def without_movers(scene: Scene) -> Scene:
    """The scene with everything that moves taken away, except what is around it (hollow bodies)."""
    moves, boxes = moving_bodies(all_bodies(scene)), scene.boxes.present.shape[0]
    keep = lambda bodies, moves: bodies._replace(present=bodies.present & (bodies.hollow | ~moves))
    return scene._replace(boxes=keep(scene.boxes, moves[:boxes]), balls=keep(scene.balls, moves[boxes:]))


def seen_from(scene: Scene, camera: Camera, time: Scalar, points: Array, *, tolerance: float = 2e-3) -> jax.Array:
    """Does a camera see world points at a time?

    Args:
      scene: `Scene`.
      camera: one `Camera`.
      time: () frames.
      points: (..., 3) world.
      tolerance: a surface nearer by less than this share of the distance does not hide the point.

    Returns:
      (...) bool; not a test of the image's borders.
    """
    inverse = camera.camera_from_world
    centre = -matvec(jnp.swapaxes(inverse[:3, :3], 0, 1), inverse[:3, 3])
    direction = tuple(points[..., i] - centre[i] for i in range(3))
    origin = tuple(centre[i] for i in range(3))
    placed = placed_bodies(all_bodies(scene), time)
    hit = nearest_hit(placed, origin, direction, boxes=scene.boxes.present.shape[0])
    return hit.distance > 1 - tolerance


def correspond(
    scene: Scene, frame: Frame, camera: Camera, time: Scalar, camera_there: Camera, time_there: Scalar
) -> Correspondence:
    """From the pixels of one view to another view at another time.

    Args:
      scene: `Scene`.
      frame: what `camera` sees at `time`.
      camera: one `Camera`.
      time: () frames.
      camera_there: the other view's, for an image of the same size.
      time_there: the other view's.

    Returns:
      `Correspondence`; of a ray that meets nothing, not visible.
    """
    height, width = frame.depth.shape
    moved = scene_flow(scene, frame, time, time_there)
    there = project(camera_there, frame.point + moved)
    here = project(camera, frame.point)
    limit = jnp.asarray([width - 1, height - 1], there.pixels.dtype)
    inside = jnp.all((there.pixels >= 0) & (there.pixels <= limit[None, None]), axis=-1) & there.in_front
    visible = inside & (frame.body >= 0) & seen_from(scene, camera_there, time_there, frame.point + moved)
    return Correspondence(there.pixels - here.pixels, moved, visible, there.depth)
