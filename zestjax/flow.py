"""Moving samples to neighbouring times by scene flow, and the optical flow a camera sees of it.

    S          samples on a ray
    points     (..., 3)  in the coordinates the field lives in: world, or a frustum's [0, 1]^3
    flow       (..., 3)  displacement of a point over one frame, in the units of the points
    weights    (..., S)  from `rendering`
    valid      whether a neighbouring frame exists; what is not valid counts in no loss

A neighbour k frames away is reached in k steps, each by the flow found where the step before ended.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.cameras import Camera, project

EMPTY = 1e-4  # opacity under which a ray shows too little to have an expected point


class Path(NamedTuple):
    """Points followed through time, one entry a step.

    points: (K, ..., 3) where each point is after 1, 2, .. K steps.
    flows: (K, ..., 3) the displacement of each step.
    valid: (K,) bool, or (K, ...): that this and every earlier frame on the way exists.
    """

    points: jax.Array
    flows: jax.Array
    valid: jax.Array


class InducedFlow(NamedTuple):
    """Where a camera at the neighbouring time sees each ray's expected point.

    flow: (..., 2) pixels, (u, v). pixels: (..., 2) = the ray's own pixel + flow.
    visible: (...) bool, that the ray shows something and that it is in front of the camera.
    """

    flow: jax.Array
    pixels: jax.Array
    visible: jax.Array


def follow(flow_at: Callable[[Array, int], jax.Array], points: Array, valid: Array) -> Path:
    """Follow points through neighbouring frames, each step by the flow at the place and time reached.

    Reference: ZeST-NeRF networks.py (`chain_bwd`), which follows one direction per call, by turns.

    Args:
      flow_at: `flow_at(points, step) -> (..., 3)`, the flow over the next frame of points that are `step`
        frames (a Python int, from 0) from the start, in one direction of time.
      points: (..., 3) at the start.
      valid: (K,) or (K, ...) bool, whether the frame after each step exists. K is the number of steps.

    Returns:
      `Path`. Points still have finite coordinates after a missing frame, and `valid` is False from there on.

    Raises:
      ValueError: if `points` is not (..., 3) or the flow has another shape.
    """
    check_shapes("follow", points=(points, "... 3"))
    reached, flows = [], []
    for step in range(jnp.shape(valid)[0]):
        flow = flow_at(points, step)
        if flow.shape != points.shape:
            raise ValueError(f"follow: `flow_at` gave shape {flow.shape} for points of shape {points.shape}.")
        points = points + flow
        reached.append(points)
        flows.append(flow)
    present = jnp.cumprod(jnp.asarray(valid).astype(jnp.int32), axis=0).astype(bool)
    return Path(points=jnp.stack(reached), flows=jnp.stack(flows), valid=present)


def world_flow(world_from_points: Callable[[Array], jax.Array], points: Array, flow: Array) -> jax.Array:
    """A flow in the points' own coordinates as a displacement in world units.

    Args:
      world_from_points: takes (..., 3) points to world (..., 3); the inverse of the map that made the points.
      points: (..., 3).
      flow: (..., 3) in the units of the points.

    Returns:
      (..., 3) world units.

    Raises:
      ValueError: if the shapes are not (..., 3).

    Differs from the reference: it inverts another map (OpenGL's normalised device coordinates) than the
    one that made the points.
    """
    check_shapes("world_flow", points=(points, "... 3"), flow=(flow, "... 3"))
    return world_from_points(points + flow) - world_from_points(points)


def advance(
    points: Array,
    flow: Array,
    *,
    world_from_points: Callable[[Array], jax.Array],
    points_from_world: Callable[[Array], jax.Array],
) -> jax.Array:
    """Points moved by a flow in their own coordinates, in the coordinates of another frame.

    Args:
      points: (..., 3).
      flow: (..., 3) in the units of the points.
      world_from_points: takes (..., 3) points to the world.
      points_from_world: takes the world to the coordinates wanted, a neighbour's frustum for example.

    Returns:
      (..., 3).

    Raises:
      ValueError: if the shapes are not (..., 3).
    """
    check_shapes("advance", points=(points, "... 3"), flow=(flow, "... 3"))
    return points_from_world(world_from_points(points + flow))


def expected(weights: Array, values: Array, *, normalise: bool = True) -> jax.Array:
    """Mean over a ray of a quantity of its samples.

    Source: ZeST-NeRF eq. 20.

    Args:
      weights: (..., S).
      values: (..., S, C).
      normalise: divide by the opacity. The paper does not: an expected point is then drawn to the origin
        of the world by what the ray lets through.

    Returns:
      (..., C), exact on rays of opacity 1e-4 or more; 0 on an empty one.

    Raises:
      ValueError: if the sample axes differ.
    """
    check_shapes("expected", weights=(weights, "... S"), values=(values, "... S C"))
    total = jnp.sum(weights[..., None] * values, axis=-2)
    if not normalise:
        return total
    return total / jnp.maximum(jnp.sum(weights, axis=-1), EMPTY)[..., None]


def induced_flow(
    weights: Array, points: Array, flow: Array, camera: Camera, pixels: Array, *, normalise: bool = True
) -> InducedFlow:
    """Optical flow that a scene flow causes between a ray's pixel and a camera at the neighbouring time.

    Source: ZeST-NeRF eq. 20 and the projection in the text after it.
    Reference: ZeST-NeRF losses.py `projection_from_ndc`.

    Args:
      weights: (..., S) of the dynamic field at time t.
      points: (..., S, 3) world.
      flow: (..., S, 3) scene flow from t to the neighbour, world units.
      camera: `Camera` of the neighbouring frame; its two focal lengths may differ.
      pixels: (..., 2) pixel of each ray in the frame of time t.
      normalise: see `expected`.

    Returns:
      `InducedFlow`.

    Raises:
      ValueError: if axes differ.

    Differs from the reference: it projects with the signs of OpenGL through cameras with OpenCV's axes, and
    with one focal length.
    """
    check_shapes(
        "induced_flow",
        weights=(weights, "... S"),
        points=(points, "... S 3"),
        flow=(flow, "... S 3"),
        pixels=(pixels, "... 2"),
    )
    seen = project(camera, expected(weights, points + flow, normalise=normalise))
    visible = seen.in_front & (jnp.sum(weights, axis=-1) > EMPTY)
    landed = jnp.where(visible[..., None], seen.pixels, pixels)
    return InducedFlow(flow=landed - pixels, pixels=landed, visible=visible)
