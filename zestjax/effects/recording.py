"""What the recording calls for: exposure, noise, places that the camera comes back to, where it looks, given priors.

N        frames
H W      rows and columns
"""

import cv2
import numpy as np

from zestjax.base.types import Array
from zestjax.cameras import Camera
from zestjax.effects.found import NO, UNKNOWN, YES, Evidence, judged, unknown
from zestjax.effects.pairs import Looked, camera_of, image_pixels
from zestjax.effects.standing import LEAST_SURE, nearest_rho, track_of
from zestjax.frames.assembly import positions
from zestjax.frames.exposure import Exposure, Gains
from zestjax.frames.known import KnownFrames

NOISY_LEAST, NOISY_MOST = 0.004, 0.008  # of white: bytes alone have 0.001, and two grey levels are seen
SEEN_AGAIN = 0.25  # of a step of the camera: so near, a place is the same
REVISITED = 0.5  # share of the frames taken where others are
FORWARD = 60.0  # degrees between any two viewing directions: planes of one camera's frustum still serve
FLOW_OFF = (2.0, 4.0)  # pixels between a given flow and ours, median: one that agrees, and one that surely is another
DEPTH_TOLD = (0.3, 0.7)  # rank correlation of given and found inverse depths: another, and one that agrees
KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float64)
KERNEL_GAIN = 6.0  # by which the kernel's answer to white noise is larger than it: the root of its summed squares


def exposure_evidence(exposure: Exposure | None, gains: Gains) -> Evidence:
    """`Evidence` of exposures that drift. exposure: as `gains` found it, None where no two frames are there."""
    limits = {"drift": gains.least}
    if exposure is None or not len(exposure.links) or not np.isfinite(exposure.links).all():
        return unknown("too few pixels of consecutive frames can be paired, or the video has one frame")
    drift = float(np.ptp(np.cumsum(np.vstack([np.zeros(3), exposure.links]), axis=0), axis=0).max())
    told = NO if exposure.gains is None else YES
    reason = f"a channel's gain changes by {np.expm1(drift):.1%} over the video; {gains.least:.0%} is a drift"
    return Evidence(told, {"drift": float(np.expm1(drift))}, limits, reason)


def noise_evidence(images: Array) -> Evidence:
    """`Evidence` of the sensor's noise, in (N, H, W, 3) uint8 or float in [0, 1]; of a few frames."""
    chosen = np.unique(np.linspace(0, len(images) - 1, 3).round()).astype(int)
    level = float(np.median([noise_of(np.asarray(images[i])) for i in chosen]))
    told, reason = judged(level, least=NOISY_LEAST, most=NOISY_MOST, name="its deviation", what="noise of the sensor")
    return Evidence(told, {"noise": level}, {"noise": NOISY_LEAST, "noise_surely": NOISY_MOST}, reason)


def noise_of(image: np.ndarray) -> float:
    """Standard deviation of an image's noise, of white: the median answer to a kernel that planes do not answer to.

    Source: Immerkaer 1996, with a median in place of the mean, so that edges do not count.
    """
    scale = 255 if image.dtype == np.uint8 else 1
    answers = np.asarray(cv2.filter2D(np.asarray(image, np.float64) / scale, -1, KERNEL))[1:-1, 1:-1]
    return float(np.median(np.abs(answers)) * 1.4826 / KERNEL_GAIN) if answers.size else float("nan")


def revisits_evidence(cameras: Camera) -> Evidence:
    """`Evidence` of places that frames are taken from again, as by a rig; cameras: (N, ...) on the host."""
    places = positions(cameras)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    step = float(np.median(steps)) if len(steps) else 0.0
    if not step > 0:
        return unknown("the camera hardly moves from one frame to the next", numbers={"step": step})
    away = np.linalg.norm(places[:, None] - places[None], axis=-1)
    np.fill_diagonal(away, np.inf)
    share = float((away.min(1) < SEEN_AGAIN * step).mean())
    told = YES if share >= REVISITED else NO
    reason = f"{share:.0%} of the frames are taken where others are; {REVISITED:.0%} is a rig"
    return Evidence(told, {"share_revisited": share, "step": step}, {"share_revisited": REVISITED}, reason)


def forward_evidence(cameras: Camera) -> Evidence:
    """`Evidence` of cameras that all look one way; cameras: (N, ...) on the host."""
    axes = np.asarray(cameras.camera_from_world, np.float64)[:, 2, :3]
    widest = float(np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1).min())))
    told = YES if widest < FORWARD else NO
    reason = f"viewing directions are {widest:.0f} degrees apart at most; {FORWARD:.0f} is one way"
    return Evidence(told, {"widest_degrees": widest}, {"widest_degrees": FORWARD}, reason)


def flow_prior_evidence(looked: Looked, given: KnownFrames | None) -> Evidence:
    """`Evidence` of a given optical flow that can be trusted: it goes where ours does, where ours is sure."""
    if given is None or given.flow is None or given.flow_valid is None:
        return Evidence(NO, {}, {}, "no optical flow is given")
    off = []
    for pairs in looked.near:
        for pair in pairs:
            side = 0 if pair.second > pair.first else 1
            flow, valid = given.flow[pair.first, side], given.flow_valid[pair.first, side]
            sure = (pair.sure > LEAST_SURE) & _halved(valid, pair.sure)
            off += [*np.linalg.norm(_halved(flow, pair.sure) - pair.flow, axis=-1)[sure]]
    if not off:
        return unknown("no pixel has a given flow and a sure one of ours")
    apart = float(np.median(off))
    told = YES if apart <= FLOW_OFF[0] else NO if apart >= FLOW_OFF[1] else UNKNOWN
    reason = (
        f"the given flow is {apart:.2f} pixels from ours, median; {FLOW_OFF[0]:g} is trusted, {FLOW_OFF[1]:g} is not"
    )
    return Evidence(told, {"median_apart_px": apart}, {"trusted": FLOW_OFF[0], "not_trusted": FLOW_OFF[1]}, reason)


def depth_prior_evidence(looked: Looked, given: KnownFrames | None) -> Evidence:
    """`Evidence` of given inverse depths that can be trusted: they rank pixels as the flow's do."""
    if given is None or given.disparity is None:
        return Evidence(NO, {}, {}, "no depth is given")
    grid, ranks = image_pixels(*looked.images.shape[1:3]), []
    for frame, pairs in zip(looked.frames, looked.near, strict=True):
        for pair in pairs[:1]:
            camera, other = (camera_of(looked.cameras, i) for i in (frame, pair.second))
            found = nearest_rho(
                track_of(grid, camera, other, float(given.near), float(given.far)), grid[..., :2] + pair.flow
            )
            ranks += _ranked(found, np.asarray(given.disparity[frame]), pair.sure)
    if not ranks:
        return unknown("too few pixels have a given depth and a sure flow")
    value = float(np.median(ranks))
    told, reason = judged(
        value,
        least=DEPTH_TOLD[0],
        most=DEPTH_TOLD[1],
        name="their rank correlation",
        what="given and found inverse depths",
    )
    return Evidence(told, {"rank_correlation": value}, {"not_trusted": DEPTH_TOLD[0], "trusted": DEPTH_TOLD[1]}, reason)


def _ranked(found, given, sure):
    """[rank correlation] of two maps where they can be compared; [] where they cannot."""
    given = _halved(given, sure)
    both = (sure > LEAST_SURE) & np.isfinite(given)
    if both.mean() < LEAST_SURE or np.ptp(found[both]) == 0 or np.ptp(given[both]) == 0:
        return []
    order = lambda x: np.argsort(np.argsort(x[both], kind="stable"), kind="stable").astype(np.float64)
    return [float(np.corrcoef(order(found), order(given))[0, 1])]


def _halved(x, like):
    """Of (H, W, ...) every second row and column, as many as half-resolution maps (h, w) have."""
    rows, columns = (np.minimum(2 * np.arange(n), size - 1) for n, size in zip(like.shape, x.shape[:2], strict=True))
    return x[np.ix_(rows, columns)]
