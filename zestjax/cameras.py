"""Pinhole cameras.

Axes are OpenCV's: x right, y down, z forward; a depth is a z, so it is > 0 in front. A pixel's centre is at
its integer coordinate. `a_from_b` names a transform that takes coordinates in b to coordinates in a, so that
products read `a_from_c = a_from_b @ b_from_c`. A pixel is (u, v): column, then row.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.checks import check_shapes
from zestjax.numerics import matmul, matvec

NEAREST_DEPTH = 1e-6


class Camera(NamedTuple):
    """One camera, or a batch of them on shared leading axes.

    intrinsics: (..., 3, 3) pixels.
    camera_from_world: (..., 4, 4) rigid, world units.
    """

    intrinsics: jax.Array
    camera_from_world: jax.Array


class Projected(NamedTuple):
    """Where points land in an image.

    pixels: (..., 2) column and row; of a point that is not in front, a finite value without meaning.
    depth: (...,) z in the camera, world units; <= 0 behind it.
    in_front: (...,) bool, depth > 1e-6.
    """

    pixels: jax.Array
    depth: jax.Array
    in_front: jax.Array


def rigid_inverse(transform):
    """Inverse of (..., 4, 4) rigid transforms, by the transpose: exact to rounding."""
    rotation = jnp.swapaxes(transform[..., :3, :3], -1, -2)
    translation = -matvec(rotation, transform[..., :3, 3])
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    return jnp.concatenate([top, transform[..., 3:, :]], axis=-2)


def intrinsics_inverse(intrinsics):
    """Inverse of (..., 3, 3) upper-triangular intrinsics in closed form; focal lengths must not be 0."""
    fx, skew, cx = intrinsics[..., 0, 0], intrinsics[..., 0, 1], intrinsics[..., 0, 2]
    fy, cy = intrinsics[..., 1, 1], intrinsics[..., 1, 2]
    zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    rows = [
        jnp.stack([1 / fx, -skew / (fx * fy), (skew * cy - cx * fy) / (fx * fy)], -1),
        jnp.stack([zero, 1 / fy, -cy / fy], -1),
        jnp.stack([zero, zero, one], -1),
    ]
    return jnp.stack(rows, -2)


def project(camera, points):
    """World points to pixels.

    Args:
      camera: `Camera`, leading axes broadcasting with those of `points`.
      points: (..., 3) world.

    Returns:
      `Projected`; the gradient is finite everywhere, behind the camera too.
    """
    check_shapes("project", points=(points, "... 3"))
    pose = camera.camera_from_world
    in_camera = matvec(pose[..., :3, :3], points) + pose[..., :3, 3]
    return project_in_camera(camera.intrinsics, in_camera)


def project_in_camera(intrinsics, points):
    """Points in the camera's own axes to pixels; see `project`."""
    image = matvec(intrinsics, points)
    depth = points[..., 2]
    in_front = depth > NEAREST_DEPTH
    pixels = image[..., :2] / jnp.where(in_front, depth, 1)[..., None]
    return Projected(pixels, depth, in_front)


def unproject(camera, pixels, depth):
    """Pixels (..., 2) at depths (...) to world points (..., 3): the inverse of `project`."""
    check_shapes("unproject", pixels=(pixels, "... 2"))
    homogeneous = jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)
    in_camera = matvec(intrinsics_inverse(camera.intrinsics), homogeneous) * depth[..., None]
    world_from_camera = rigid_inverse(camera.camera_from_world)
    return matvec(world_from_camera[..., :3, :3], in_camera) + world_from_camera[..., :3, 3]


def centre(camera):
    """World position of the optical centre, (..., 3)."""
    return rigid_inverse(camera.camera_from_world)[..., :3, 3]


def scaled(camera, factor_u, factor_v):
    """The camera of an image whose pixel (u, v) shows what (u / factor_u, v / factor_v) did: strided sampling.

    A feature map of stride 4 has factors 1/4: feature pixel j sits on image pixel 4 j.
    """
    factors = jnp.stack([jnp.asarray(factor_u), jnp.asarray(factor_v), jnp.asarray(1.0)])
    return camera._replace(intrinsics=camera.intrinsics * factors.astype(camera.intrinsics.dtype)[:, None])


def resized(camera, factor_u, factor_v):
    """The camera of an area-resized image: pixel corners, not centres, keep their place.

    u_new = (u + 1/2) * factor_u - 1/2.
    """
    camera = scaled(camera, factor_u, factor_v)
    shift = jnp.zeros((3, 3), camera.intrinsics.dtype)
    shift = shift.at[0, 2].set((factor_u - 1) / 2).at[1, 2].set((factor_v - 1) / 2)
    return camera._replace(intrinsics=camera.intrinsics + shift)


def relative(a, b):
    """(..., 4, 4) transform a_from_b between two cameras' axes."""
    return matmul(a.camera_from_world, rigid_inverse(b.camera_from_world))
