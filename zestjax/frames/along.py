"""What the optical flow says of depth and motion along the path of a point through the video, found once a video.

A frame's two neighbours tell little of what moves: half a pixel of flow is as much as its parallax. Carried along the
flow, a point has an answer of its own from each frame that it is seen in.

N        frames
E        planes, see `frames.evidence`
h w      rows and columns of a cell
gap, sure, neighbours  see `frames.evidence`
weight   in [0, 1], how far a cell's own gap is to be believed: 0 where a flow is not to be trusted
"""

import functools

import jax
import jax.numpy as jnp

from zestjax.base.types import Scalar
from zestjax.cameras import Camera, resized
from zestjax.frames.cells import SIDE
from zestjax.frames.evidence import Along, Neighbours, cell_flow, flow_gaps
from zestjax.planesweep import homographies, plane_depths
from zestjax.rays import pixel_grid
from zestjax.resample import bilinear

# Of a weight from one frame to the next: with 0.7, 0.9 and 1 the depths of what moves in zest-bench are off by 0.087,
# 0.086 and 0.088 of the way from near to far.
KEPT = 0.9
LEAST = 0.05  # weight below which a path says rather nothing: a guess that was never varied


@functools.partial(jax.jit, static_argnames=("planes",))
def gaps_along(cameras: Camera, beside: Neighbours, near: Scalar, far: Scalar, *, planes: int) -> Along:
    """Gaps of every frame of a video, averaged along the flow.

    Args:
      cameras: `Camera` (N, ...) of full-size images.
      beside: `Neighbours` of each frame, (N, 2, ...).
      near: () world units.
      far: () world units.
      planes: E.

    Returns:
      `Along` (N, h, w, E). Depths are taken to stay what they are while the point is seen.

    Source: zestjax.
    """
    depths = plane_depths(near, far, planes, spacing="inverse")
    flow, sure = jax.vmap(cell_flow)(beside.flow, beside.sure)
    own = jax.lax.map(lambda frame: _own(depths, frame), (cameras, beside.cameras, flow, sure))
    grid = pixel_grid(*flow.shape[2:4], dtype=flow.dtype)

    def carry(side):
        def step(state, frame):
            here, moved, trusted = frame
            came = bilinear(state, grid + moved[side] / SIDE).values * (KEPT * trusted[side])[..., None]
            return here + came, came

        return step

    start = jnp.zeros_like(own[0])
    _, after = jax.lax.scan(carry(0), start, (own, flow, sure), reverse=True)
    _, before = jax.lax.scan(carry(1), start, (own, flow, sure))
    return _averaged(own + before + after, planes)


def _own(depths, frame):
    """(h, w, 2 E + 2) what one frame adds to its points' paths: by how much a gap is below 1, times its weight, for
    either kind and every plane; and the two weights."""
    camera, beside, flow, sure = frame
    share = 1 / SIDE
    hom = homographies(resized(camera, share, share), resized(beside, share, share), depths)
    still, moving = jax.lax.map(lambda plane: flow_gaps(flow, sure, plane), hom)
    weight = (sure[0] + sure[1]) / 2
    both = [jnp.moveaxis(weight[None] * (1 - still), 0, -1), jnp.moveaxis(1 - moving, 0, -1)]
    return jnp.concatenate([*both, weight[..., None], (sure[0] * sure[1])[..., None]], -1)


def _averaged(paths, planes):
    """`Along` of what the paths' frames add up to."""
    still, moving, weights = jnp.split(paths, (planes, 2 * planes), axis=-1)
    mean = lambda sums, weight: 1 - sums / (weight + LEAST)
    return Along(mean(still, weights[..., :1]), mean(moving, weights[..., 1:]))
