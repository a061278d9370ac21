"""Where every body is at a time. The caster sees these matrices only.

B        bodies
joint    the rigid frame a body hangs in; a body's own stretch is not passed on to its children
"""

import jax
import jax.numpy as jnp

from zestjax.base.numerics import matmul, matvec
from zestjax.base.types import Array, Scalar
from zestjax.simulate.types import Bodies, Scene

CHAIN = 4  # the longest chain of parents


def all_bodies(scene: Scene) -> Bodies:
    """`Bodies` of the whole scene, boxes first, then balls."""
    return jax.tree.map(lambda box, ball: jnp.concatenate([box, ball]), scene.boxes, scene.balls)


def rotation_from_vector(vector: Array) -> jax.Array:
    """(..., 3, 3) rotations by (..., 3) axis-angle vectors (Rodrigues); exact and differentiable at 0."""
    squared = jnp.sum(vector * vector, axis=-1)
    small = squared < 1e-12  # below, the series is exact in float32
    angle = jnp.sqrt(jnp.where(small, 1, squared))
    first = jnp.where(small, 1 - squared / 6, jnp.sin(angle) / angle)[..., None, None]
    second = jnp.where(small, 0.5 - squared / 24, (1 - jnp.cos(angle)) / (angle * angle))[..., None, None]
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])]
    skew = jnp.stack(rows, -2)
    return jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype), skew.shape) + first * skew + second * matmul(skew, skew)


def _affine(linear, offset):
    """(..., 4, 4) from a (..., 3, 3) linear part and a (..., 3) offset."""
    top = jnp.concatenate([linear, offset[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], linear.dtype), (*offset.shape[:-1], 1, 4))
    return jnp.concatenate([top, last], axis=-2)


def world_from_bodies(bodies: Bodies, time: Scalar) -> jax.Array:
    """Where the unit bodies are.

    Args:
      bodies: `Bodies` of the whole scene (`all_bodies`).
      time: () frames, need not be whole.

    Returns:
      (B, 4, 4) affine world_from_unit.
    """
    motion, shape = bodies.motion, bodies.shape
    wave = jnp.sin(motion.rate * time + motion.phase)[:, None]
    offset = motion.velocity * time + motion.sway * wave
    rotation = rotation_from_vector(motion.spin * time + motion.swing * wave)
    local = matmul(motion.joint, _affine(rotation, offset))
    joints = local
    for _ in range(CHAIN):
        above = jnp.take(joints, jnp.maximum(motion.parent, 0), axis=0)
        joints = jnp.where((motion.parent < 0)[:, None, None], local, matmul(above, local))
    stretch = jnp.eye(3, dtype=shape.dtype)[None] + motion.strain * wave[..., None]
    return matmul(matmul(joints, _affine(stretch, jnp.zeros_like(offset))), shape)


def affine_inverse(transform: Array) -> jax.Array:
    """Inverse of (..., 4, 4) affine transforms by cofactors; the linear part must not be singular."""
    a, b, c = (transform[..., :3, i] for i in range(3))
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-2)
    linear = rows / jnp.sum(a * jnp.cross(b, c), axis=-1)[..., None, None]
    return _affine(linear, -matvec(linear, transform[..., :3, 3]))


def carried(points: Array, body: Array, there_from_here: Array) -> jax.Array:
    """Material points (..., 3) on bodies (...) int32, moved by (B, 4, 4) world_from_world; -1 stays put."""
    moved = jnp.take(there_from_here, jnp.maximum(body, 0), axis=0)
    return jnp.where((body < 0)[..., None], points, matvec(moved[..., :3, :3], points) + moved[..., :3, 3])


def movement(bodies: Bodies, time_from: Scalar, time_to: Scalar) -> jax.Array:
    """(B, 4, 4) taking each body's material points from one time to another, world to world."""
    here, there = world_from_bodies(bodies, time_from), world_from_bodies(bodies, time_to)
    return matmul(there, affine_inverse(here))
