"""What each loss measures on a block of rays: functions by the loss's name, not traced where its weight is absent.

R S        rays of a block, samples on a ray
direction  +1 forward (to t + 1), -1 backward; order (forward, backward) on a leading axis of 2
warped     the dynamic field at x + flow, one frame away (two with `chain`), composited on the ray of t
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.cameras import project, unproject
from zestjax.flow import induced_flow, world_flow
from zestjax.losses.means import mean_over_valid
from zestjax.losses.photometric import photometric_loss, reconstruction_loss
from zestjax.losses.priors import depth_loss, geometric_loss
from zestjax.losses.regularisers import blend_entropy_loss, disocclusion_loss, distortion_loss
from zestjax.losses.scene_flow import cycle_loss, minimum_flow_loss, spatial_smoothness_loss, temporal_loss
from zestjax.losses.supervision import motion_mask_loss
from zestjax.rendering import composite, confidence_map, weights_from_density
from zestjax.systems.system import Params, Prediction, Scene, System
from zestjax.video import Frames, Inputs

DIRECTIONS = (1, -1)
Known = jax.Array | np.ndarray | None
NEAR_SURFACE = 0.05  # share of the depth within which a sample counts as on the true surface
LEAST_WEIGHT = 1e-3  # less is none: a mean by weights that nearly underflow would be all noise


class Truth(NamedTuple):
    """What rays should show; what is not known is None, and no term can be asked of it (`terms.ANSWERS`).

    pixels: (R, 2). colour: (R, 3). static: (R, 3) without what moves, and static_valid: (R,) 1 or 0. moving: (R,) 1 or
    0. depth: (R,) world units. flow: (R, 2, 3) world, to the next and previous time. flow_valid: (R,) 1 or 0, the flow
    is known and not nothing. known: (R,) 1 or 0, depth and flow are known there. disparity: (R,) of a prior, up to a
    scale and a shift, not finite where unknown. pixel_flow: (R, 2, 2) of a prior, pixels to the next and previous
    frame, and pixel_flow_valid: (R, 2) 1 or 0. jitter: (R, S) in [0, 1), places of the ray's samples in their strata,
    or None: in the middles.
    """

    pixels: jax.Array | np.ndarray
    colour: jax.Array | np.ndarray
    static: Known = None
    static_valid: Known = None
    moving: Known = None
    depth: Known = None
    flow: Known = None
    flow_valid: Known = None
    known: Known = None
    disparity: Known = None
    pixel_flow: Known = None
    pixel_flow_valid: Known = None
    jitter: Known = None


class Warped(NamedTuple):
    """Of each path: colour (M, R, 3), confidence (M, R), valid (M,), and of the one-frame paths the flow there and
    back, world units, (2, R, S, 3) each."""

    colour: jax.Array
    confidence: jax.Array
    valid: jax.Array
    there: jax.Array
    back: jax.Array


def slot_valid(slots: Frames, offset: int) -> jax.Array:
    """() 1 if the slot at this offset from the target time is among the slots and filled, else 0."""
    return jnp.max(jnp.where(slots.times == offset, slots.valid, 0))


def slots_about(inputs: Inputs) -> Frames:
    """The slots of `Inputs` with times relative to the target's."""
    assert inputs.slots is not None
    return inputs.slots._replace(times=inputs.slots.times - inputs.time)


def warped(
    system: System, params: Params, scene: Scene, inputs: Inputs, prediction: Prediction, *, chain: bool = False
) -> Warped:
    """The dynamic field followed to the neighbouring times.

    Args:
      system: with a dynamic field.
      params: of the system.
      scene: of `System.encode`.
      inputs: `Inputs`.
      prediction: `Prediction` at t.
      chain: also t +- 2, by the flow found at t +- 1.

    Returns:
      `Warped`. A neighbour that does not exist is not valid and counts in nothing.

    Source: ZeST-NeRF eq. 11, eq. 12, eq. 13.
    """
    marched, here, field = prediction.marched, prediction.dynamic, system.dynamic
    assert here is not None and field is not None
    world = system.place(scene, inputs).world
    colours, certain, valid, there, back = [], [], [], [], []
    for sign in DIRECTIONS:
        coords, sample, exists, confidence = marched.coords, here, 1.0, 1.0
        for step in range(1, 2 + chain):
            flow = sample.flow_forward if sign > 0 else sample.flow_backward
            confidence = confidence * (sample.confidence_forward if sign > 0 else sample.confidence_backward)
            moved, offset = coords + flow, sign * step
            seen, place = _seen_from(scene.dynamic, offset), system.place(scene, inputs, offset=offset)
            after = field(params.dynamic, seen, marched._replace(coords=moved), place)
            exists = exists * slot_valid(slots_about(inputs), offset)
            weights = weights_from_density(after.density, marched.lengths)
            colours.append(composite(weights, after.colour).values)
            certain.append(confidence_map(weights, confidence))
            valid.append(exists)
            if step == 1:
                reverse = after.flow_backward if sign > 0 else after.flow_forward
                there.append(world_flow(world, coords, flow))
                back.append(world_flow(world, moved, reverse))
            coords, sample = moved, after
    return Warped(*(jnp.stack(x) for x in (colours, certain, valid, there, back)))


def _seen_from(seen, offset):
    """What the dynamic field reads, its slots' times relative to a time `offset` frames after the target's."""
    if seen.views is None:
        return seen
    return seen._replace(views=seen.views._replace(times=seen.views.times - offset))


class About:
    """What several measures of one prediction share, each found when it is first asked for."""

    def __init__(self, system, params, scene, inputs, prediction, chain):
        self.given = (system, params, scene, inputs, prediction)
        self.system, self.scene, self.inputs, self.prediction, self.chain = system, scene, inputs, prediction, chain

    @functools.cached_property
    def warped(self):
        """`Warped`."""
        return warped(*self.given, chain=self.chain)

    @functools.cached_property
    def slots(self):
        """`Frames`, their times relative to the target's."""
        return slots_about(self.inputs)

    @functools.cached_property
    def exists(self):
        """(2,) 1 if there is a frame in that direction, else 0."""
        return jnp.stack([slot_valid(self.slots, sign) for sign in DIRECTIONS])

    @functools.cached_property
    def flows(self):
        """(2, R, S, 3) scene flow of every sample, world units."""
        world = self.system.place(self.scene, self.inputs).world
        coords, dynamic = self.prediction.marched.coords, self.prediction.dynamic
        return jnp.stack([world_flow(world, coords, flow) for flow in (dynamic.flow_forward, dynamic.flow_backward)])

    @functools.cached_property
    def confidences(self):
        """(2, R, S)."""
        dynamic = self.prediction.dynamic
        return jnp.stack([dynamic.confidence_forward, dynamic.confidence_backward])


def _pho(a, p, t):
    return photometric_loss(a.warped.colour, t.colour, a.warped.confidence, valid=a.warped.valid)


def _sp(a, p, t):
    points = p.marched.points
    return spatial_smoothness_loss(a.flows, jnp.broadcast_to(points, (2, *points.shape)), valid=a.exists)


STATIC = {
    "rec": lambda a, p, t: reconstruction_loss(p.colour, t.colour),
    "static_rec": lambda a, p, t: reconstruction_loss(p.static_colour, t.static, valid=t.static_valid),
    "distortion": lambda a, p, t: distortion_loss(p.weights, _edges(a, p)),
}
DYNAMIC = {
    "dynamic_rec": lambda a, p, t: reconstruction_loss(p.colour, t.colour, valid=t.moving),
    "mask": lambda a, p, t: motion_mask_loss(p.dynamicness, t.moving),
    "b": lambda a, p, t: blend_entropy_loss(p.blend),
    "flow3d": lambda a, p, t: _surface_flow(a.flows, p, t),
    "depth": lambda a, p, t: _depth(p, t),
}
NEIGHBOUR = {
    "pho": _pho,
    "w": lambda a, p, t: disocclusion_loss(a.confidences, valid=a.exists),
    "cyc": lambda a, p, t: cycle_loss(a.warped.there, a.warped.back, a.confidences, valid=a.exists),
    "min": lambda a, p, t: minimum_flow_loss(a.flows, valid=a.exists),
    "sp": _sp,
    "geo": lambda a, p, t: _geometric(p, t, a.inputs, a.slots, a.flows),
}
BOTH_NEIGHBOURS = {
    "temp": lambda a, p, t: temporal_loss(*a.flows, valid=jnp.broadcast_to(a.exists[0] * a.exists[1], p.depth.shape)),
}
RAYS = STATIC | DYNAMIC | NEIGHBOUR | BOTH_NEIGHBOURS
"""The measures of rays, functions of (`About`, `Prediction`, `Truth`). Source: ZeST-NeRF section 3.5."""


def make_measures(
    system: System, params: Params, scene: Scene, inputs: Inputs, *, chain: bool = False
) -> dict[str, Callable]:
    """Functions `measure(prediction, truth) -> ()` for one block of rays, by the name of the loss.

    Args:
      system: what a loss needs that the system lacks must not be asked for, see `terms.unmeasured`.
      params: gradients reach the warped renders through them.
      scene: of `System.encode`.
      inputs: `Inputs`.
      chain: see `warped`.
    """
    kept: dict[int, About] = {}

    def bound(measure):
        def call(prediction, truth):
            about = kept.setdefault(id(prediction), About(system, params, scene, inputs, prediction, chain))
            return measure(about, prediction, truth)

        return call

    return {name: bound(measure) for name, measure in RAYS.items()}


def _edges(a, p):
    """(R, S + 1) ends of the samples' intervals: half-way between them, and near and far, as shares of what lies
    between those."""
    near, far = a.inputs.near, a.inputs.far
    inside = jax.lax.stop_gradient((p.marched.depths[:, 1:] + p.marched.depths[:, :-1]) / 2)
    ends = jnp.zeros_like(inside[:, :1])
    return jnp.concatenate([ends, (inside - near) / (far - near), ends + 1], axis=-1)


def _surface_flow(flows, prediction, truth):
    """Scene flow of the samples at the true surface, against the truth, as a share of the depth; ten times that."""
    depth = jnp.where(truth.flow_valid > 0, truth.depth, 1)
    weight = jnp.exp(-jnp.square((prediction.marched.depths / depth[:, None] - 1) / NEAR_SURFACE))
    weight = jax.lax.stop_gradient(jnp.where(weight > LEAST_WEIGHT, weight, 0)) * truth.flow_valid[:, None]
    error = jnp.abs(flows - jnp.moveaxis(truth.flow, 1, 0)[:, :, None]) / depth[None, :, None, None]
    each = [mean_over_valid("flow3d", jnp.minimum(e, 1.0), valid=weight) for e in error]
    return 5 * (each[0] + each[1])


def _depth(prediction, truth):
    """Rendered disparity of what moves against a prior's, or the true one."""
    ours = -1 / prediction.depth_of_dynamic  # minus a disparity grows with the depth, as the prior's sign has it
    if truth.disparity is None:
        return depth_loss(ours, -1 / truth.depth, valid=truth.known)
    return depth_loss(ours, -truth.disparity, valid=jnp.isfinite(truth.disparity))


def _geometric(prediction, truth, inputs, slots, flows):
    """Where the neighbours' cameras see each ray's expected point, against where the optical flow prior does."""
    total = jnp.zeros((), truth.colour.dtype)
    for i, (flow, sign) in enumerate(zip(flows, DIRECTIONS, strict=True)):
        index = jnp.argmax((slots.times == sign).astype(jnp.int32))
        camera = jax.tree.map(lambda x, index=index: x[index], slots.cameras)
        seen = induced_flow(prediction.dynamic_alone, prediction.marched.points, flow, camera, truth.pixels)
        there, known = _flow_target(truth, inputs, camera, i)
        valid = seen.visible.astype(flow.dtype) * known * slot_valid(slots, sign)
        total = total + geometric_loss(seen.pixels, there, valid=valid) / 2
    return total


def _flow_target(truth, inputs, camera, i):
    """(R, 2) pixels of the neighbour that the rays' pixels go to in a direction, and (R,) where that is known: by an
    optical flow prior, or the true scene flow."""
    if truth.pixel_flow is not None:
        return truth.pixels + truth.pixel_flow[:, i], truth.pixel_flow_valid[:, i]
    moved = project(camera, unproject(inputs.camera, truth.pixels, truth.depth) + truth.flow[:, i])
    return moved.pixels, moved.in_front.astype(truth.known.dtype) * truth.known
