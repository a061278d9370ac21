"""The dynamic field: density, colour, scene flow and confidence of a point at a time.

P  points   V  slots (neighbours of the time)   C  channels of the motion volume   Q  encoded direction
flow  offsets in coordinates of the target's frustum, forward (t + 1) and backward (t - 1)
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.fields.conditioning import GAP_LIMIT, ViewSamples, on_surface, over_views
from zestjax.fields.conditioning import hidden as hidden_behind
from zestjax.fields.heads import HeadParams, Reading, ViewFeatures
from zestjax.fields.trunk import Trunk, init_trunk, trunk
from zestjax.nets.layers import Dense, dense, init_dense, raised

VIEW_FEATURES = 14  # three colours and the eleven scalars of `dynamic_views`
SUMMARIES = 4  # and two more of every slot
HEARSAY = 0.02  # weight of a slot that sees a point but not as what moves: a last resort where no slot does
SELF_EVIDENT = 50.0
"""By how much a view of the target's time and place counts more: what moves is then 11 dB nearer to the frame that is
its own (zest-bench's walker), and views from elsewhere keep theirs."""
SHOWN = 4.0
"""Of the blend's logit where such a view sees what moves: such a frame's own picture is then 43 dB on walker and sprint
(40.6 and 39.3 without, 12: 44.6 and 42.8), on what moves 38 and 46 (31.9, 33.4); from elsewhere within 0.06 dB."""
EARLY_WIDTH = 24  # of the net that finds the early flow
CORRECTION = 0.2  # share of the reach by which the trunk corrects the early flow: it was looked up with that one


class DynamicParams(NamedTuple):
    """The time-dependent field. early: the flow from the volume alone; with `blend` it is None where the head does not
    look at each view. head: of the field's `heads.Head`."""

    trunk: Trunk
    density: Dense
    blend: Dense | None
    flow: Dense
    confidence: Dense
    early: tuple[Dense, Dense] | None
    head: HeadParams


class DynamicSample(NamedTuple):
    """density: (P,) >= 0. colour: (P, 3) in [0, 1]. blend_logit: (P,), added to the static field's.
    flow_forward, flow_backward: (P, 3) bounded. confidence_forward, confidence_backward: (P,) in (0, 1)."""

    density: jax.Array
    colour: jax.Array
    blend_logit: jax.Array
    flow_forward: jax.Array
    flow_backward: jax.Array
    confidence_forward: jax.Array
    confidence_backward: jax.Array


def init_dynamic(
    key: jax.Array,
    *,
    n_point: int,
    n_condition: int,
    n_volume: int,
    width: int,
    depth: int,
    head: Callable[[jax.Array], HeadParams],
    looks: bool,
) -> DynamicParams:
    """Parameters, as `static.init_static`. n_volume: channels of the volume. looks: the head looks at each view: an
    early flow says where, and the field has a say in the blend."""
    keys = jax.random.split(key, 8)
    small = lambda k, n: init_dense(k, width, n, scale=0.1)
    first = lambda: init_dense(keys[5], n_volume + n_point, EARLY_WIDTH)
    return DynamicParams(
        init_trunk(keys[0], n_point, n_condition, width=width, depth=depth),
        small(keys[1], 1), small(keys[2], 1) if looks else None, small(keys[3], 6), small(keys[4], 2),
        (first(), init_dense(keys[6], EARLY_WIDTH, 6, scale=0.1)) if looks else None, head(keys[7]),
    )  # fmt: skip


def early_flow(params: DynamicParams, point: jax.Array, volume: jax.Array, *, reach: float) -> jax.Array:
    """(P, 6) flow forward then backward, from the motion volume alone, within +-reach of the frustum.

    It says where to look in the neighbours before their colours are read (flow-compensated aggregation).
    """
    assert params.early is not None  # the head looks
    first, second = params.early
    state = jax.nn.relu(dense(first, jnp.concatenate([volume, point], axis=-1)))
    return reach * jnp.tanh(raised(dense(second, state)))


def dynamic_views(samples: ViewSamples, shift: jax.Array, times: jax.Array) -> ViewFeatures:
    """Per-view features of `sample_views` for what moves: seen moving, at its own depth, in its slot.

    Args:
      samples: `ViewSamples` of the slots.
      shift: (V, P) pixels of parallax per plane, of the ray's points, also where the field is asked at points moved
        away from them.
      times: (V,) frames between the view and the target.

    Returns:
      `heads.ViewFeatures`; a view of the target's time counts for its colours the more, the nearer it stands to the
      target: from the same place the answer is at hand, whatever the depth.
    """
    agree, behind = on_surface(samples.gap), hidden_behind(samples.gap)
    support = samples.visible * samples.moving * agree
    weights = support + HEARSAY * samples.visible * (1 - behind)
    deviation = samples.colour - over_views(weights, samples.colour)[None]
    size = jnp.sum(jnp.abs(deviation), axis=1)
    through = samples.visible * jnp.square(jnp.minimum(samples.gap, 0) / GAP_LIMIT)
    wide = lambda x: jnp.broadcast_to(x[:, None], size.shape)
    scalars = [
        size, samples.visible, samples.moving, agree, behind, through, support, samples.gap / GAP_LIMIT,
        samples.moving * through, wide(jnp.exp(-jnp.abs(times))), wide(jnp.tanh(times)),
    ]  # fmt: skip
    features = jnp.concatenate([4 * deviation, jnp.stack(scalars, 1)], 1)
    spread = over_views(weights, jnp.stack([size, agree, through, samples.moving], 1))
    prior = weights * (1 + SELF_EVIDENT * _self_evidence(shift, times))
    return ViewFeatures(features, weights, prior, jnp.concatenate([spread, support, through], 0).T)


def shown_moving(samples: ViewSamples, shift: jax.Array, times: jax.Array) -> jax.Array:
    """(P,) in [0, 1] how far a view from the target's time and place shows something that moves; a constant.

    Args:
      samples: `ViewSamples` of the slots.
      shift: as `dynamic_views`.
      times: likewise.
    """
    return jax.lax.stop_gradient(jnp.max(_self_evidence(shift, times) * samples.visible * samples.moving, axis=0))


def _self_evidence(shift, times):
    """(V, P) 1 from the target's own time and place, 0 at another time or some pixels of parallax away; a constant."""
    return jax.lax.stop_gradient(jnp.where((times == 0)[:, None], jnp.exp(-jnp.square(shift)), 0))


def dynamic_field(
    params: DynamicParams,
    point: jax.Array,
    direction: jax.Array,
    reading: Reading,
    *,
    reach: float = 1.0,
    early: jax.Array | None = None,
    shown: jax.Array | None = None,
    modulation: str = "multiply",
) -> DynamicSample:
    """Density, colour, flow and confidence of P points at one time.

    Args:
      params: `DynamicParams`.
      point: (P, n) encoded position and time.
      direction: (P, Q) encoded.
      reading: what the field's head reads of the points, see `heads`.
      reach: bound of the flow, frustum units; the paper's tanh reaches the whole frustum, 1.
      early: (P, 6) flow that the last layer corrects, or None.
      shown: of `shown_moving`, or None: by how much the blend is told what moves.
      modulation: see `trunk`.

    Returns:
      `DynamicSample`.

    Source: ZeST-NeRF eq. 5.
    Differs from the reference: with a blend head colours come from the neighbours at the point's displaced position.
    """
    state = trunk(params.trunk, point, reading.condition, modulation=modulation)
    colour = reading.colour(state, direction)
    head = lambda part: raised(dense(part, state))
    raw_flow = head(params.flow)
    flow = reach * jnp.tanh(raw_flow) if early is None else early + CORRECTION * reach * jnp.tanh(raw_flow)
    confidence = jax.nn.sigmoid(head(params.confidence) + 2.0)  # certain until taught otherwise
    logit = jnp.zeros_like(raw_flow[:, 0]) if params.blend is None else head(params.blend)[:, 0]
    logit = logit if shown is None else logit + SHOWN * shown
    return DynamicSample(
        4 * jax.nn.softplus(head(params.density)[:, 0]), colour, logit,
        flow[:, :3], flow[:, 3:], confidence[:, 0], confidence[:, 1],
    )  # fmt: skip
