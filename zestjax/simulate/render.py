"""Images, depths and material points of a simulated scene.

H W      rows and columns
S        samples along each side of a pixel
"""

import jax
import jax.numpy as jnp

from zestjax.base.numerics import matmul
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera, intrinsics_inverse, rigid_inverse
from zestjax.simulate.cast import Placed, along, nearest_hit
from zestjax.simulate.motion import affine_inverse, all_bodies, world_from_bodies
from zestjax.simulate.shade import shaded
from zestjax.simulate.types import Bodies, Effects, Frame, Scene


def placed_bodies(bodies: Bodies, time: Scalar) -> Placed:
    """`Placed` at a time."""
    return Placed(affine_inverse(world_from_bodies(bodies, time)), bodies.present, bodies.hollow)


def camera_rays(
    camera: Camera, pixels_u: Array, pixels_v: Array
) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """Origin, a vector of (), and directions, a vector of (R), of pixels; z = 1 in the camera: the ray parameter
    is the depth."""
    world_from_camera = rigid_inverse(camera.camera_from_world)
    matrix = matmul(world_from_camera[:3, :3], intrinsics_inverse(camera.intrinsics))
    direction = tuple(matrix[i, 0] * pixels_u + matrix[i, 1] * pixels_v + matrix[i, 2] for i in range(3))
    return tuple(world_from_camera[i, 3] for i in range(3)), direction


def _pixel_grid(height, width, dtype):
    v, u = jnp.meshgrid(jnp.arange(height, dtype=dtype), jnp.arange(width, dtype=dtype), indexing="ij")
    return u, v


def seen_surface(scene: Scene, camera: Camera, time: Scalar, *, height: int, width: int) -> Frame:
    """What a camera sees at the pixels' centres: a `Frame` whose image is black."""
    bodies = all_bodies(scene)
    u, v = _pixel_grid(height, width, camera.intrinsics.dtype)
    origin, direction = camera_rays(camera, u, v)
    hit = nearest_hit(placed_bodies(bodies, time), origin, direction, boxes=scene.boxes.present.shape[0])
    point = along(origin, jnp.where(hit.body < 0, 1, hit.distance), direction)
    point = jnp.stack(point, axis=-1)
    return Frame(jnp.zeros_like(point), hit.distance, hit.body, point)


def render(scene: Scene, camera: Camera, time: Scalar, *, height: int, width: int, samples: int = 2) -> Frame:
    """What a camera sees at a time.

    Args:
      scene: `Scene`.
      camera: one `Camera`.
      time: () frames; exposure is read at the nearest whole one.
      height: of the image.
      width: of the image.
      samples: rays along each side of a pixel for the image.

    Returns:
      `Frame`, without the sensor's noise (`with_noise`).
    """
    bodies, effects = all_bodies(scene), scene.effects
    u, v = _pixel_grid(height, width, camera.intrinsics.dtype)
    count = samples * samples

    def sample(index):
        step = jnp.stack([index % samples, index // samples]).astype(u.dtype)
        shift = (step + 0.5) / samples - 0.5
        moment = time
        if effects.motion_blur is not None:
            moment = time + effects.motion_blur * ((index.astype(u.dtype) + 0.5) / count - 0.5)
        placed = placed_bodies(bodies, moment)
        origin, direction = camera_rays(camera, u + shift[0], v + shift[1])
        hit = nearest_hit(placed, origin, direction, boxes=scene.boxes.present.shape[0])
        angle = 1 / (camera.intrinsics[0, 0] * samples)
        return shaded(scene, bodies, placed, hit, origin, direction, angle)

    add = lambda total, index: (jax.tree.map(jnp.add, total, sample(index)), None)
    total, _ = jax.lax.scan(add, (jnp.zeros_like(u),) * 3, jnp.arange(count))
    image = jnp.stack(total, axis=-1) / count
    if effects.exposure is not None:
        image = image * jnp.take(effects.exposure, jnp.round(time).astype(jnp.int32), axis=0)[None, None]
    frame = seen_surface(scene, camera, time, height=height, width=width)
    return frame._replace(image=jnp.clip(image, 0, 1))


def with_noise(key: jax.Array, image: Array, effects: Effects) -> Array:
    """The image with the sensor's noise, in [0, 1]; unchanged where the effects have none."""
    if effects.noise is None:
        return image
    return jnp.clip(image + effects.noise * jax.random.normal(key, image.shape, image.dtype), 0, 1)
