"""Exposure and white balance that drift: found from a video's own frames, and evened out before frames are compared.

N        frames
gains    (N, 3) logarithm of each channel's gain; only their differences mean anything
link     difference of two frames' gains, from the pixels that the optical flow pairs, there and back
exclude  frames that are not read; their gains are those between their neighbours'
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from zestjax.base.parts import part
from zestjax.base.types import Array
from zestjax.frames.assembly import Footage
from zestjax.frames.optical_flow import agreement, as_bytes, dense_flow
from zestjax.video import Inputs

SURE = 0.5  # of a flow, there and back, whose pixels are compared
INSIDE = (0.05, 0.95)  # colours whose ratio says something: darker ones are noise, brighter ones cut off
LEAST_PAIRS = 0.2  # share of a picture that must be paired for a link: noise of 144 x 256 pairs with noise over a tenth


class Exposure(NamedTuple):
    """links: (N - 1, 3) of consecutive frames, NaN where they do not tell. gains: (N, 3) whose mean is 0, or None: they
    do not drift, or the frames do not tell."""

    links: np.ndarray
    gains: np.ndarray | None


@part
class Gains:
    """Gains of a video's frames, where they drift by more than `least` (a share, over the whole video).

    Found over zest-bench without drift: up to 0.045 (a highlight that wanders), 0.018 (all moves), else below 0.01;
    with a drift of 0.27, 0.29.
    """

    least: float = 0.08

    def __call__(self, seen: Footage, *, exclude: Collection[int] = (), known: Exposure | None = None) -> Exposure:
        """`Exposure` of a video.

        Args:
          seen: `Footage`.
          exclude: see the header.
          known: of the same video with other frames excluded, whose links are not found again.
        """
        half = np.asarray(seen.half)
        count, used = len(half), [i for i in range(len(half)) if i not in exclude]
        fresh = lambda: np.array([_link(half, seen, i, i + 1) for i in range(count - 1)]).reshape(-1, 3)
        links = fresh() if known is None else known.links
        pairs = list(zip(used, used[1:], strict=False))
        steps = [links[i] if j == i + 1 else _link(half, seen, i, j) for i, j in pairs]
        found = np.cumsum([np.zeros(3), *steps], axis=0)
        if not steps or not np.ptp(found, axis=0).max() >= np.log1p(self.least):  # also of NaN
            return Exposure(links, None)
        gains = np.stack([np.interp(np.arange(count), used, channel) for channel in found.T], axis=-1)
        return Exposure(links, (gains - gains.mean(0)).astype(np.float32))


def _link(half, seen, first, second):
    """(3,) by how much the second frame's gains are above the first's; NaN where too few pixels tell."""
    there, back = _flows(half, seen, first, second)
    return (_ratio(half[first], half[second], *there) - _ratio(half[second], half[first], *back)) / 2


def _flows(half, seen, first, second):
    """((flow, sure), (flow, sure)) there and back, pixels of the half-resolution frames."""
    if second == first + 1:
        flow, sure = seen.flow
        return (flow[first, 0] / 2, sure[first, 0]), (flow[second, 1] / 2, sure[second, 1])
    ends = as_bytes(half[[first, second]])
    there, back = dense_flow(ends[0], ends[1]), dense_flow(ends[1], ends[0])
    return (there, agreement(there, back)), (back, agreement(back, there))


def _ratio(image, other, flow, sure):
    """(3,) median logarithm of what the pixels are in the other frame over what they are in this one, or NaN."""
    rows, columns = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    at = columns + flow[..., 0], rows + flow[..., 1]
    carried: Any = cv2.remap(other, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    within = lambda x: (x > INSIDE[0]) & (x < INSIDE[1])
    told = (sure > SURE)[..., None] & within(image) & within(carried)
    if told.mean(axis=(0, 1)).min() < LEAST_PAIRS:
        return np.full(3, np.nan, np.float32)
    each = zip(*(np.moveaxis(x, -1, 0) for x in (image, carried, told)), strict=True)
    return np.array([np.median(np.log(there[pairs] / here[pairs])) for here, there, pairs in each])


def evened(seen: Footage, exposure: Exposure | None) -> Footage:
    """`Footage` as if all frames had the exposure of the darkest, so that no colour leaves [0, 1]; as it is where
    exposures do not drift, or nobody asked."""
    gains = None if exposure is None else exposure.gains
    if gains is None:
        return seen
    return seen._replace(half=seen.half * jnp.exp(jnp.asarray(gains.min(0) - gains))[:, None, None])


def exposed_as_target(inputs: Inputs, frames: Array, exposure: Exposure | None) -> Inputs:
    """`Inputs` whose frames have the exposure of the target's time, colours above 1 cut off; as they are where
    exposures do not drift, or nobody asked.

    Args:
      inputs: `Inputs`.
      frames: (V,) int, which frames they hold: those of the static field, then those of the dynamic one.
      exposure: `Exposure` of the video, or None.
    """
    gains = None if exposure is None else exposure.gains
    if gains is None:
        return inputs
    gains, count = jnp.asarray(gains), len(inputs.key.valid)
    time = jnp.asarray(inputs.time).astype(jnp.int32)
    factors = jnp.exp(gains[time][None] - gains[jnp.asarray(frames)])[:, None, None].astype(inputs.key.images.dtype)
    shown = lambda part, factor: part._replace(images=jnp.minimum(part.images * factor, 1))
    slots = None if inputs.slots is None else shown(inputs.slots, factors[count:])
    return inputs._replace(key=shown(inputs.key, factors[:count]), slots=slots)
