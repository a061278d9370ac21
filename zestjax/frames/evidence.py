"""What a frame's own pixels say about its depth and its motion, without learning: computed once a frame, cached.

J        source frames compared with the reference frame
E        planes of the sweep, uniform in inverse depth, the nearest first
h w      rows and columns of a cell, a quarter of the image: cell j is centred on image pixel 4 j + 3/2
cost     truncated absolute colour difference / TRUNCATION, in [0, 1]; 1 where nothing can be compared
gap      image pixels between where the optical flow says a pixel goes and where it would go if it stood still on a
         plane, / GAP and truncated, in [0, 1]; 1 where the flow is not to be trusted
neighbours  the frames t + 1 and t - 1, in this order
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import matvec, safe_norm
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera, resized
from zestjax.frames.cells import cell_values, pooled
from zestjax.planesweep import homographies, plane_depths
from zestjax.rays import pixel_grid
from zestjax.resample import bilinear

TRUNCATION = 0.15  # colour difference from which a source says only that it differs: a guess that was never varied
GAP = 4.0  # pixels between two flows from which they only differ, about a cell: a guess that was never varied
FLOW_RANGE = 64.0  # pixels of flow, beyond what the far plane has, that the flow channels span either way
FLOW_CHANNELS = 16  # at the four half-resolution pixels of a cell, to both neighbours


class Along(NamedTuple):
    """Of one frame, or of many on a leading axis. still, moving: (h, w, E) gaps averaged over the path of the cell's
    point through the video, see `frames.along`; 1 where no flow is to be trusted."""

    still: Array
    moving: Array


class Evidence(NamedTuple):
    """Of one frame, or of many on a leading axis; every value in [0, 1].

    static: (h, w, E) mean cost over the sources if the point stands still at that plane.
    best: (h, w, E) mean over the better half of them: what covers the point in some does not count.
    still: (h, w, E) gap to the neighbours if the point stands still there.
    moving: (h, w, E) gap if it moves with constant velocity through t - 1, t, t + 1 at that plane.
    still_along, moving_along: (h, w, E) of `Along`.
    flow: (h, w, 16) optical flow minus that of the far plane; 1/2 is none, see `FLOW_RANGE`.
    sure: (h, w, 2) trust in the flow to each neighbour.
    colours: (h, w, 12) the frame's colours at the four half-resolution pixels of the cell.
    """

    static: Array
    best: Array
    still: Array
    moving: Array
    still_along: Array
    moving_along: Array
    flow: Array
    sure: Array
    colours: Array


class MatchingViews(NamedTuple):
    """Frames to compare with: half-resolution images (J, 2h, 2w, 3), `Camera` of full size (J, ...), valid (J,)."""

    images: Array
    cameras: Camera
    valid: Array


class Neighbours(NamedTuple):
    """How the frame's pixels move to its neighbours. flow: (2, 2h, 2w, 2) image pixels. sure: (2, 2h, 2w) in [0, 1],
    0 where there is no such frame. cameras: `Camera` of full size (2, ...)."""

    flow: Array
    sure: Array
    cameras: Camera


def _grid(height, width, dtype):
    return jnp.concatenate([pixel_grid(height, width, dtype=dtype), jnp.ones((height, width, 1), dtype)], -1)


def _carried(homography, grid):
    """Where a homography takes the grid's pixels (..., 2), and whether they stay in front."""
    points = matvec(homography, grid)
    front = points[..., 2] > 1e-6  # share of the plane's depth: what is divided by
    return points[..., :2] / jnp.where(front, points[..., 2], 1)[..., None], front


def static_costs(reference: Array, sources: MatchingViews, hom: Array) -> tuple[jax.Array, jax.Array]:
    """(h, w) mean cost over the valid sources at one plane, and over their better half; hom (J, 3, 3) between
    half-resolution pixels of the reference (2h, 2w, 3) and the sources."""
    grid = _grid(reference.shape[0], reference.shape[1], reference.dtype)

    def compare(_, inputs):
        image, homography, valid = inputs
        pixels, front = _carried(homography, grid)
        warped, visible = bilinear(image, pixels)
        weight = (visible & front).astype(valid.dtype) * valid
        difference = jnp.mean(jnp.abs(reference - warped), axis=-1)
        cost = weight * jnp.minimum(difference / TRUNCATION, 1)
        return None, pooled(jnp.stack([cost, weight], -1), 2)

    _, found = jax.lax.scan(compare, None, (sources.images, hom, sources.valid))
    cost, weight = found[..., 0], found[..., 1]
    mean = lambda cost, weight: jnp.where(weight > 0, cost / jnp.where(weight > 0, weight, 1), 1)
    each = _ascending([jnp.where(w > 0, mean(c, w), 2) for c, w in zip(cost, weight, strict=True)])
    count = jnp.sum(jnp.stack(each) <= 1, axis=0, dtype=cost.dtype)
    kept = [(count > 2 * k).astype(cost.dtype) for k in range(len(each))]
    better = mean(sum(k * e for k, e in zip(kept, each, strict=True)), sum(kept))
    return mean(jnp.sum(cost, 0), jnp.sum(weight, 0)), better


def _ascending(arrays):
    """Arrays sorted element by element; a network of exchanges, many times faster than a sort over a leading axis."""
    arrays = list(arrays)
    for last in range(len(arrays) - 1, 0, -1):
        for i in range(last):
            arrays[i], arrays[i + 1] = jnp.minimum(arrays[i], arrays[i + 1]), jnp.maximum(arrays[i], arrays[i + 1])
    return arrays


def cell_flow(flow: Array, sure: Array) -> tuple[jax.Array, jax.Array]:
    """Flow (2, 2h, 2w, 2) and its trust (2, 2h, 2w) of cells: (2, h, w, 2), the mean by trust, and (2, h, w)."""
    weighted, sure = pooled(flow * sure[..., None], 2), pooled(sure[..., None], 2)
    return weighted / jnp.where(sure > 0, sure, 1), sure[..., 0]


def flow_gaps(flow: Array, sure: Array, hom: Array) -> tuple[jax.Array, jax.Array]:
    """(h, w) gaps at one plane if a cell stands still there, and if it moves with constant velocity.

    Args:
      flow: (2, h, w, 2) image pixels.
      sure: (2, h, w).
      hom: (2, 3, 3) between quarter-resolution pixels.
    """
    grid = _grid(flow.shape[1], flow.shape[2], flow.dtype)
    velocities, known = [], []
    for k in range(2):
        pixels, front = _carried(hom[k], grid)
        velocities.append(flow[k] - 4 * (pixels - grid[..., :2]))
        known.append(sure[k] * front.astype(sure.dtype))
    length = lambda v: jnp.minimum(safe_norm(v) / GAP, 1)
    total = known[0] + known[1]
    gap = known[0] * length(velocities[0]) + known[1] * length(velocities[1])
    still = jnp.where(total > 0, gap / jnp.where(total > 0, total, 1), 1)
    return still, 1 - known[0] * known[1] * (1 - length(velocities[0] + velocities[1]))


def _flow_channels(neighbours, hom):
    """(h, w, 16) of the flow beyond that of the far plane; hom (2, 3, 3) between half-resolution pixels."""
    _, height, width, _ = neighbours.flow.shape
    grid = _grid(height, width, neighbours.flow.dtype)
    parts = []
    for flow, sure, homography in zip(neighbours.flow, neighbours.sure, hom, strict=True):
        pixels, front = _carried(homography, grid)
        known = front & (sure > 0)
        own = jnp.where(known[..., None], flow - 2 * (pixels - grid[..., :2]), 0)
        parts.append(jnp.clip(0.5 + own / (2 * FLOW_RANGE), 0, 1))
    return cell_values(jnp.concatenate(parts, -1))


def frame_evidence(
    image: Array,
    camera: Camera,
    sources: MatchingViews,
    neighbours: Neighbours,
    along: Along,
    near: Scalar,
    far: Scalar,
    *,
    planes: int,
) -> Evidence:
    """Evidence of one frame.

    Args:
      image: (2h, 2w, 3) the frame at half resolution (`half_images`).
      camera: its `Camera`, of the full-size image.
      sources: `MatchingViews` for the static cost.
      neighbours: `Neighbours`.
      along: `Along` of it.
      near: () world units.
      far: () world units.
      planes: E.

    Returns:
      `Evidence`.

    Source: zestjax; each input frame gets evidence of its own depth and motion.
    """
    check_shapes("frame_evidence", image=(image, "P Q 3"), sources=(sources.images, "J P Q 3"),
                 flow=(neighbours.flow, "2 P Q 2"), sure=(neighbours.sure, "2 P Q"))  # fmt: skip
    depths = plane_depths(near, far, planes, spacing="inverse")
    scaled = lambda share, of: homographies(resized(camera, share, share), resized(of, share, share), depths)
    flow, sure = cell_flow(neighbours.flow, neighbours.sure)

    def plane(hom):
        return *static_costs(image, sources, hom[0]), *flow_gaps(flow, sure, hom[1])

    found = jax.lax.map(plane, (scaled(0.5, sources.cameras), scaled(0.25, neighbours.cameras)))
    static, best, still, moving = (jnp.moveaxis(x, 0, -1) for x in found)
    beyond = _flow_channels(neighbours, scaled(0.5, neighbours.cameras)[-1])
    trusted = jnp.moveaxis(sure, 0, -1)
    return Evidence(static, best, still, moving, along.still, along.moving, beyond, trusted, cell_values(image))
