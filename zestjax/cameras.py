"""Pinhole cameras.

Axes are OpenCV's: x right, y down, z forward; a depth is a z, so it is > 0 in front. A pixel's centre is at
its integer coordinate. `a_from_b` names a transform that takes coordinates in b to coordinates in a, so that
products read `a_from_c = a_from_b @ b_from_c`. A pixel is (u, v): column, then row.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import matmul, matvec, safe_norm
from zestjax.base.types import Array, Scalar

NEAREST_DEPTH = 1e-6  # world units in front of the camera: a depth that a pixel may be divided by, also in float32


class Camera(NamedTuple):
    """One camera, or a batch of them on shared leading axes.

    intrinsics: (..., 3, 3) pixels.
    camera_from_world: (..., 4, 4) rigid, world units.
    """

    intrinsics: Array
    camera_from_world: Array


class Projected(NamedTuple):
    """Where points land in an image.

    pixels: (..., 2) column and row; of a point that is not in front, a finite value without meaning.
    depth: (...,) z in the camera, world units; <= 0 behind it.
    in_front: (...,) bool, depth > 1e-6.
    """

    pixels: jax.Array
    depth: jax.Array
    in_front: jax.Array


def transformed(transform: Array, points: Array) -> jax.Array:
    """Points (..., 3) in one frame to another by (..., 4, 4) a_from_b, whose leading axes broadcast with theirs."""
    turned = matvec(transform[..., :3, :3], points)
    return turned + jnp.broadcast_to(transform[..., :3, 3], turned.shape)


def rigid_inverse(transform: Array) -> jax.Array:
    """Inverse of (..., 4, 4) rigid transforms, by the transpose: exact to rounding."""
    rotation = jnp.swapaxes(transform[..., :3, :3], -1, -2)
    translation = -matvec(rotation, transform[..., :3, 3])
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    return jnp.concatenate([top, transform[..., 3:, :]], axis=-2)


def intrinsics_inverse(intrinsics: Array) -> jax.Array:
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


def project(camera: Camera, points: Array) -> Projected:
    """World points to pixels.

    Args:
      camera: `Camera`, leading axes broadcasting with those of `points`.
      points: (..., 3) world.

    Returns:
      `Projected`; the gradient is finite everywhere, behind the camera too.
    """
    check_shapes("project", points=(points, "... 3"))
    return project_in_camera(camera.intrinsics, transformed(camera.camera_from_world, points))


def project_in_camera(intrinsics: Array, points: Array) -> Projected:
    """Points in the camera's own axes to pixels; see `project`."""
    points = jnp.asarray(points)
    image = matvec(intrinsics, points)
    depth = points[..., 2]
    in_front = depth > NEAREST_DEPTH
    pixels = image[..., :2] / jnp.where(in_front, depth, 1)[..., None]
    return Projected(pixels, depth, in_front)


def unproject(camera: Camera, pixels: Array, depth: Array) -> jax.Array:
    """Pixels (..., 2) at depths (...) to world points (..., 3): the inverse of `project`."""
    check_shapes("unproject", pixels=(pixels, "... 2"), depth=(depth, "..."))
    homogeneous = jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)
    in_camera = matvec(intrinsics_inverse(camera.intrinsics), homogeneous) * depth[..., None]
    return transformed(rigid_inverse(camera.camera_from_world), in_camera)


def centre(camera: Camera) -> jax.Array:
    """World position of the optical centre, (..., 3)."""
    return rigid_inverse(camera.camera_from_world)[..., :3, 3]


def scaled(camera: Camera, factor_u: Scalar, factor_v: Scalar) -> Camera:
    """The camera of an image whose pixel (u, v) shows what (u / factor_u, v / factor_v) did: strided sampling.

    A feature map of stride 4 has factors 1/4: feature pixel j sits on image pixel 4 j.
    """
    return camera._replace(intrinsics=matmul(_pixel_map(camera, factor_u, factor_v, 0, 0), camera.intrinsics))


def resized(camera: Camera, factor_u: Scalar, factor_v: Scalar) -> Camera:
    """The camera of an area-resized image: pixel corners, not centres, keep their place.

    u_new = (u + 1/2) * factor_u - 1/2.
    """
    pixel_map = _pixel_map(camera, factor_u, factor_v, (factor_u - 1) / 2, (factor_v - 1) / 2)
    return camera._replace(intrinsics=matmul(pixel_map, camera.intrinsics))


def _pixel_map(camera, factor_u, factor_v, shift_u, shift_v):
    """(3, 3) map of homogeneous pixels that scales, then shifts."""
    rows = [[factor_u, 0, shift_u], [0, factor_v, shift_v], [0, 0, 1]]
    dtype = camera.intrinsics.dtype
    return jnp.stack([jnp.stack([jnp.asarray(entry, dtype) for entry in row]) for row in rows])


def relative(a: Camera, b: Camera) -> jax.Array:
    """(..., 4, 4) transform a_from_b between two cameras' axes."""
    return matmul(a.camera_from_world, rigid_inverse(b.camera_from_world))


def look_at(position: Array, target: Array, *, up: Array | Sequence[float]) -> jax.Array:
    """Pose of a camera at `position` that sees `target` in its centre, upright.

    Args:
      position: (..., 3) world.
      target: (..., 3) world, another point than `position`.
      up: (..., 3) world direction that points up in the image; any length but 0. Where it is parallel to the viewing
        direction another is chosen in its place.

    Returns:
      (..., 4, 4) camera_from_world.

    Raises:
      ValueError: if an argument does not end in 3.
    """
    check_shapes("look_at", position=(position, "... 3"), target=(target, "... 3"), up=(up, "... 3"))
    position, target, up = jnp.broadcast_arrays(position, target, jnp.asarray(up).astype(position.dtype))
    forward = _unit(target - position)
    sideways = jnp.cross(forward, _unit(up))
    # A direction that is never `forward`; taken within 1e-4 of parallel, where float32 has three digits left.
    spare = jnp.cross(forward, jnp.roll(jnp.abs(forward) + 1e-3, 1, axis=-1))
    parallel = safe_norm(sideways, keepdims=True) < 1e-4
    right = _unit(jnp.where(parallel, spare, sideways))
    down = jnp.cross(forward, right)
    rotation = jnp.stack([right, down, forward], axis=-2)
    return _rigid(rotation, -matvec(rotation, position))


def camera_from_opengl_pose(pose: Array, height: Scalar, width: Scalar, focal: Scalar | Sequence[float]) -> Camera:
    """The camera of a pose in OpenGL's axes (x right, y up, z backward), principal point in the image's middle.

    Args:
      pose: (..., 3, 4) or (..., 4, 4) world_from_camera.
      height: rows of the image.
      width: columns of the image.
      focal: pixels, a number or (focal_u, focal_v).

    Returns:
      `Camera`; the middle of an image of W pixels whose centres are integers is (W - 1) / 2.

    Raises:
      ValueError: if `pose` does not end in 3 or 4 rows of 4.

    Differs from the reference: ZeST-NeRF puts the principal point at W / 2 with pixel centres at integers.
    """
    rows = 4 if jnp.ndim(pose) > 1 and jnp.shape(pose)[-2] == 4 else 3
    check_shapes("camera_from_opengl_pose", pose=(pose, f"... {rows} 4"))
    pose = jnp.asarray(pose)
    flip = jnp.asarray([1, -1, -1], pose.dtype)
    rotation = pose[..., :3, :3] * jnp.broadcast_to(flip, (*pose.shape[:-2], 3, 3))
    camera_from_world = jnp.swapaxes(rotation, -1, -2)
    focal_u, focal_v = focal if isinstance(focal, tuple | list) else (focal, focal)
    rows = [[focal_u, 0, (width - 1) / 2], [0, focal_v, (height - 1) / 2], [0, 0, 1]]
    batch = pose.shape[:-2]
    entry = lambda value: jnp.broadcast_to(jnp.asarray(value, pose.dtype), batch)
    intrinsics = jnp.stack([jnp.stack([entry(value) for value in row], -1) for row in rows], -2)
    return Camera(intrinsics, _rigid(camera_from_world, -matvec(camera_from_world, pose[..., :3, 3])))


def camera_from_llff_pose(pose: Array) -> Camera:
    """The camera of a LLFF pose: (..., 3, 5) columns down, right, backward, position, and (height, width, focal).

    Returns:
      `Camera`, principal point in the image's middle; see `camera_from_opengl_pose`.

    Raises:
      ValueError: if `pose` is not (..., 3, 5).
    """
    check_shapes("camera_from_llff_pose", pose=(pose, "... 3 5"))
    pose = jnp.asarray(pose)
    down, right, backward, position, size = (pose[..., k] for k in range(5))
    opengl = jnp.stack([right, -down, backward, position], axis=-1)
    return camera_from_opengl_pose(opengl, size[..., 0], size[..., 1], size[..., 2])


def check_camera(where: str, camera: Camera) -> None:
    """Refuse cameras that no later stage could use. For arrays with values: call it before `jax.jit`, not inside.

    Args:
      where: name of the calling function, used in the message.
      camera: `Camera`, any leading axes.

    Raises:
      ValueError: if a shape is wrong, an entry is not finite, a focal length is not above 0, intrinsics are not upper
        triangular or do not end in (0, 0, 1), or a pose is not rigid (determinant 1, last row (0, 0, 0, 1)).
    """
    check_shapes(
        where, intrinsics=(camera.intrinsics, "... 3 3"), camera_from_world=(camera.camera_from_world, "... 4 4")
    )
    k, pose = np.asarray(camera.intrinsics, np.float64), np.asarray(camera.camera_from_world, np.float64)
    rotation = pose[..., :3, :3]
    gram = rotation @ np.swapaxes(rotation, -1, -2)
    lower = np.stack([k[..., 1, 0], k[..., 2, 0], k[..., 2, 1], k[..., 2, 2] - 1], -1)
    # Rows that are written as 0 and 1 may be off by rounding (1e-6); a rotation read from a text file by three digits.
    faults = {
        "`intrinsics` has an entry that is not finite": ~np.isfinite(k).all((-2, -1)),
        "`camera_from_world` has an entry that is not finite": ~np.isfinite(pose).all((-2, -1)),
        "`intrinsics` is singular: a focal length is 0": (k[..., 0, 0] == 0) | (k[..., 1, 1] == 0),
        "`intrinsics` has a focal length below 0, which mirrors the image": (k[..., 0, 0] < 0) | (k[..., 1, 1] < 0),
        "`intrinsics` is not upper triangular with (0, 0, 1) in its last row": (np.abs(lower) > 1e-6).any(-1),
        "`camera_from_world` is not rigid: its rotation is not orthonormal": (np.abs(gram - np.eye(3)) > 1e-3).any(
            (-2, -1)
        ),
        "`camera_from_world` is a reflection: its determinant is -1": np.linalg.det(rotation) < 0,
        "`camera_from_world` does not end in (0, 0, 0, 1)": (np.abs(pose[..., 3, :] - [0, 0, 0, 1]) > 1e-6).any(-1),
    }
    for fault, found in faults.items():
        if np.any(found):
            at = tuple(int(i) for i in np.argwhere(found)[0])
            raise ValueError(f"{where}: {fault}{f' (camera {at})' if at else ''}.")


def check_bounds(where: str, near: Scalar, far: Scalar) -> None:
    """Refuse depth bounds other than 0 < near < far < inf. For arrays with values, not under jit.

    Raises:
      ValueError: naming the function and both bounds.
    """
    near, far = np.asarray(near), np.asarray(far)
    if not (np.all(near > 0) and np.all(near < far) and np.all(np.isfinite(far))):
        raise ValueError(f"{where}: depth bounds should be 0 < near < far, got near {near} and far {far}.")


def _unit(vector):
    length = safe_norm(vector, keepdims=True)
    return vector / jnp.where(length > 0, length, 1)


def _rigid(rotation, translation):
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, last], axis=-2)
