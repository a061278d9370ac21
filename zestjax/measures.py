"""What each loss term measures on a block of rays: `Terms` of functions, not traced where the weight is absent.

R S        rays of a block, samples on a ray
direction  +1 forward (to t + 1), -1 backward; order (forward, backward) on a leading axis of 2
warped     the dynamic field at x + flow, one frame away (two with `chain`), composited on the ray of t
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.cameras import project, unproject
from zestjax.flow import optical_flow, world_flow
from zestjax.frustum import world_from_frustum
from zestjax.losses.means import mean_over_valid
from zestjax.losses.objective import Terms, absent
from zestjax.losses.photometric import photometric_loss, reconstruction_loss
from zestjax.losses.priors import depth_loss, geometric_loss
from zestjax.losses.regularisers import blend_entropy_loss, disocclusion_loss
from zestjax.losses.scene_flow import cycle_loss, minimum_flow_loss, spatial_smoothness_loss, temporal_loss
from zestjax.losses.supervision import motion_mask_loss
from zestjax.prediction import encoded_directions, query_dynamic
from zestjax.rendering import composite, confidence_map, weights_from_density

DIRECTIONS = (1, -1)
NEAR_SURFACE = 0.05  # share of the depth within which a sample counts as on the true surface
RAY_TERMS = (
    "rec", "static_rec", "dynamic_rec", "mask", "b", "flow3d", "pho", "w", "cyc", "min", "sp", "temp", "geo", "depth",
)  # fmt: skip
FRAME_TERMS = ("frame_ce", "frame_mask")
SCENE_TERMS = ("depth_ce", *FRAME_TERMS)
NEIGHBOUR_TERMS = ("pho", "w", "cyc", "min", "sp", "temp", "geo")
LEAST_WEIGHT = 1e-3  # less is none: a mean by weights that nearly underflow would be all noise


def unmeasured(config):
    """What a training step of a configuration cannot measure.

    Args:
      config: `presets.Config`.

    Returns:
      {name of a term: what it needs}.
    """
    others = [name for name in Terms._fields if name not in RAY_TERMS + SCENE_TERMS]
    found = dict.fromkeys(others, "a measure of your own, bound by `losses.objective.make_objective`")
    if not config.dynamic:
        found |= dict.fromkeys(set(RAY_TERMS) - {"rec", "static_rec"}, "a dynamic field, `dynamic=True`")
    else:
        there = [sign for sign in DIRECTIONS if sign in config.slots]
        if not there:
            found |= dict.fromkeys(NEIGHBOUR_TERMS, "slots next to the target time, -1 or 1")
        elif len(there) == 1:
            found["temp"] = "slots on both sides of the target time, -1 and 1"
    if not config.any_volume or config.sampling != "guided":
        found["depth_ce"] = "volumes that guide the sampling: `geometry` or `motion`, with `sampling='guided'`"
    if not config.analysed:
        found |= dict.fromkeys(FRAME_TERMS, "the frames' own analysis: `encoder='frames'`, with `geometry` or `motion`")
    return found


def check_weights(where, config, weights):
    """Refuse a weight of what a training step cannot measure: it would train without a word and without the term.

    Args:
      where: name of the calling function, used in the message.
      config: `presets.Config`.
      weights: `Terms`.

    Raises:
      ValueError: naming the terms, their weights and what they need; or there is no term at all.
    """
    if all(absent(weight) for weight in weights):
        raise ValueError(f"{where}: no term has a weight, so nothing would be learned; give at least one.")
    needs = unmeasured(config)
    lost = {name: weight for name, weight in weights._asdict().items() if name in needs and not absent(weight)}
    if lost:
        listed = "; ".join(f"`{name}` (weight {weight}) needs {needs[name]}" for name, weight in lost.items())
        raise ValueError(f"{where}: terms that cannot be measured here: {listed}. Give None or 0, or `measurable`.")


def measurable(config, weights):
    """The `Terms` of those weights whose terms a training step of this configuration can measure; the rest are None."""
    needs = unmeasured(config)
    return Terms(**{name: None if name in needs else weight for name, weight in weights._asdict().items()})


class Truth(NamedTuple):
    """What a crop should show. pixels: (R, 2). colour, static: (R, 3). static_valid, moving: (R,) 1 or 0.
    depth: (R,) world units. flow: (R, 2, 3) world, to the next and previous time. flow_valid: (R,) 1 or 0, the flow is
    known and not nothing. known: (R,) 1 or 0, depth and flow are known at all."""

    pixels: jax.Array | np.ndarray
    colour: jax.Array | np.ndarray
    static: jax.Array | np.ndarray
    static_valid: jax.Array | np.ndarray
    moving: jax.Array | np.ndarray
    depth: jax.Array | np.ndarray
    flow: jax.Array | np.ndarray
    flow_valid: jax.Array | np.ndarray
    known: jax.Array | np.ndarray


class Warped(NamedTuple):
    """Of each path: colour (M, R, 3), confidence (M, R), valid (M,), and of the one-frame paths the flow there and
    back, world units, (2, R, S, 3) each."""

    colour: jax.Array
    confidence: jax.Array
    valid: jax.Array
    there: jax.Array
    back: jax.Array


def slot_valid(slots, offset):
    """() 1 if the slot at this offset from the target time is among the slots and filled, else 0."""
    return jnp.max(jnp.where(slots.times == offset, slots.valid, 0))


def warped(params, encoding, inputs, prediction, *, config, chain=False):
    """The dynamic field followed to the neighbouring times.

    Args:
      params: `model.ZestParams`.
      encoding: `model.Encoding`.
      inputs: `model.Inputs`.
      prediction: `Prediction` at t.
      config: `presets.Config`.
      chain: also t +- 2, by the flow found at t +- 1.

    Returns:
      `Warped`. A neighbour that does not exist is not valid and counts in nothing.

    Source: ZeST-NeRF eq. 11, eq. 12, eq. 13.
    """
    marched, here = prediction.marched, prediction.dynamic
    world = functools.partial(world_from_frustum, encoding.frustum, spacing=config.spacing)
    directions = encoded_directions(marched, config)
    shape = marched.depths.shape
    colours, certain, valid, there, back = [], [], [], [], []
    for sign in DIRECTIONS:
        coords, sample, exists, confidence = marched.coords, here, 1.0, 1.0
        for step in range(1, 2 + chain):
            flow = sample.flow_forward if sign > 0 else sample.flow_backward
            confidence = confidence * (sample.confidence_forward if sign > 0 else sample.confidence_backward)
            moved = coords + flow
            time = inputs.time + sign * step
            there_then = _seen_from(encoding, sign * step)
            after = query_dynamic(
                params, there_then, moved.reshape(-1, 3), directions, time, inputs.duration, config=config
            )
            after = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), after)
            exists = exists * slot_valid(encoding_slots(inputs), sign * step)
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


def _seen_from(encoding, offset):
    """The encoding with its slots' times relative to a time `offset` frames after the target's."""
    if encoding.slots is None:
        return encoding
    return encoding._replace(slots=encoding.slots._replace(times=encoding.slots.times - offset))


def encoding_slots(inputs):
    """The slots of `Inputs` with times relative to the target's."""
    return inputs.slots._replace(times=inputs.slots.times - inputs.time)


def make_measures(params, encoding, inputs, *, config, chain=False):
    """`Terms` of `measure(prediction, truth) -> ()` for one block of rays.

    Args:
      params: `model.ZestParams`; gradients reach the warped renders through it.
      encoding: `model.Encoding`.
      inputs: `model.Inputs`.
      config: `presets.Config`.
      chain: see `warped`.

    Returns:
      `Terms` of callables.

    Source: ZeST-NeRF section 3.5.
    """
    memo = {}

    def followed(prediction):
        if "warped" not in memo:
            memo["warped"] = warped(params, encoding, inputs, prediction, config=config, chain=chain)
        return memo["warped"]

    slots = encoding_slots(inputs)
    exists = jnp.stack([slot_valid(slots, sign) for sign in DIRECTIONS])
    flows = functools.partial(world_flows, frustum=encoding.frustum, spacing=config.spacing)
    both_exist = exists[0] * exists[1]

    def pho(prediction, truth):
        found = followed(prediction)
        return photometric_loss(found.colour, truth.colour, found.confidence, valid=found.valid)

    def cyc(prediction, truth):
        found = followed(prediction)
        return cycle_loss(found.there, found.back, confidences(prediction), valid=exists)

    def sp(prediction, truth):
        points = prediction.marched.points
        return spatial_smoothness_loss(flows(prediction), jnp.broadcast_to(points, (2, *points.shape)), valid=exists)

    return Terms(
        rec=lambda p, t: reconstruction_loss(p.colour, t.colour),
        static_rec=lambda p, t: reconstruction_loss(p.static_colour, t.static, valid=t.static_valid),
        dynamic_rec=lambda p, t: reconstruction_loss(p.colour, t.colour, valid=t.moving),
        mask=lambda p, t: motion_mask_loss(p.dynamicness, t.moving),
        b=lambda p, t: blend_entropy_loss(p.blend),
        w=lambda p, t: disocclusion_loss(confidences(p), valid=exists),
        min=lambda p, t: minimum_flow_loss(flows(p), valid=exists),
        temp=lambda p, t: temporal_loss(*flows(p), valid=jnp.broadcast_to(both_exist, p.depth.shape)),
        depth=lambda p, t: depth_loss(-1 / p.depth_of_dynamic, -1 / t.depth, valid=t.known),
        flow3d=lambda p, t: _surface_flow(flows(p), p, t),
        geo=lambda p, t: _geometric(p, t, inputs, slots, flows(p)),
        pho=pho, cyc=cyc, sp=sp,
    )  # fmt: skip


def world_flows(prediction, *, frustum, spacing):
    """(2, R, S, 3) scene flow of every sample in `DIRECTIONS`, world units."""
    world = functools.partial(world_from_frustum, frustum, spacing=spacing)
    coords, dynamic = prediction.marched.coords, prediction.dynamic
    return jnp.stack([world_flow(world, coords, flow) for flow in (dynamic.flow_forward, dynamic.flow_backward)])


def confidences(prediction):
    """(2, R, S) confidence in `DIRECTIONS`."""
    return jnp.stack([prediction.dynamic.confidence_forward, prediction.dynamic.confidence_backward])


def _surface_flow(flows, prediction, truth):
    """Scene flow of the samples at the true surface, against the truth, as a share of the depth; ten times that."""
    depth = jnp.where(truth.flow_valid > 0, truth.depth, 1)
    weight = jnp.exp(-jnp.square((prediction.marched.depths / depth[:, None] - 1) / NEAR_SURFACE))
    weight = jax.lax.stop_gradient(jnp.where(weight > LEAST_WEIGHT, weight, 0)) * truth.flow_valid[:, None]
    error = jnp.abs(flows - jnp.moveaxis(truth.flow, 1, 0)[:, :, None]) / depth[None, :, None, None]
    each = [mean_over_valid("flow3d", jnp.minimum(e, 1.0), valid=weight) for e in error]
    return 5 * (each[0] + each[1])


def _geometric(prediction, truth, inputs, slots, flows):
    """Where the neighbours' cameras see each ray's expected point, against where the optical flow prior does."""
    point = unproject(inputs.camera, truth.pixels, truth.depth)
    total = jnp.zeros((), truth.depth.dtype)
    for flow, sign, known in zip(flows, DIRECTIONS, jnp.moveaxis(truth.flow, 1, 0), strict=True):
        index = jnp.argmax((slots.times == sign).astype(jnp.int32))
        camera = jax.tree.map(lambda x, index=index: x[index], slots.cameras)
        seen = optical_flow(prediction.dynamic_alone, prediction.marched.points, flow, camera, truth.pixels)
        prior = project(camera, point + known)
        valid = (seen.visible & prior.in_front).astype(flow.dtype) * truth.known * slot_valid(slots, sign)
        total = total + geometric_loss(seen.pixels, prior.pixels, valid=valid) / 2
    return total
