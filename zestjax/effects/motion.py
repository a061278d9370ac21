"""Does anything move beyond the cameras?

h w      rows and columns of half-resolution pixels
gap      image pixels by which optical flow leaves all that a still point may do, see `effects.standing`
excess   by how much worse the best still point explains the colours
"""

from typing import NamedTuple

import cv2
import numpy as np

from zestjax.effects.found import NO, UNKNOWN, YES, Evidence
from zestjax.effects.pairs import Looked, camera_of, image_pixels
from zestjax.effects.standing import LEAST_SURE, PATCH, Compared, excess, still_gap, track_of

# Image pixels; or, as flow of noisy frames is off by more, times the median gap; but never more pixels than the last:
# where everything moves, the median does.
GAP, GAPS, MOST_GAP = 1.0, 6.0, 2.0
# How much worse the still point must be: of white, a grey level; and of the contrast about the pixel, of which an error
# of the depth costs a part.
WORSE, CONTRASTS = 0.005, 0.15
SPECK = 3  # half-resolution pixels across: smaller spots are errors of the flow
# Frames from which on the one with most is left out: flow goes wrong in one, and what moves is in several.
FEW = 4
# Shares of the pixels, mean over the frames: least that is more than errors of the flow, and least that surely moves;
# from the table of `python experiments/effects.py`.
LEAST, MOST = 3.5e-4, 4e-3
TEXTURED, CLEAR = 0.01, 1.0  # of white, and of the noise of a pixel: contrast about it from which it has texture
# Pixels of the shorter side below which slow motion is not seen: of `walker`, whose pixels move at 144 rows (1.3 %) and
# at 108 (0.5 %), nothing is at 72.
LEAST_SIDE = 108
FEWEST_TOLD = 0.2  # share of the pixels that must have texture and a sure flow for the frames to tell


class Motion(NamedTuple):
    """Of every frame looked at. moving, told: (F, h, w) bool: pixels that move, and those that would tell. gap:
    (F, h, w) image pixels, 0 where not told. once: no frame has both its neighbours: one pair does
    not tell motion along its epipolar line from parallax."""

    moving: np.ndarray
    told: np.ndarray
    gap: np.ndarray
    once: bool


def motion_of(looked: Looked, near: float, far: float, *, noise: float) -> Motion:
    """`Motion` of a video; near, far: world units. noise: standard deviation of a pixel, of white."""
    grid = image_pixels(*looked.images.shape[1:3])
    rows = [_of_frame(looked, k, grid, near, far, noise) for k in range(len(looked.frames))]
    moving, told, gap = (np.stack(each) for each in zip(*rows, strict=True))
    return Motion(moving, told, gap, max(map(len, looked.near)) < 2)


def _of_frame(looked, k, grid, near, far, noise):
    """(moving, told, gap) of a frame looked at."""
    frame, around, again = looked.frames[k], looked.near[k], looked.again[k]
    pairs = [*around, *([] if again is None else [again])]
    camera = camera_of(looked.cameras, frame)
    tracks = [track_of(grid, camera, camera_of(looked.cameras, pair.second), near, far) for pair in pairs]
    landed = [grid[..., :2] + pair.flow for pair in pairs]
    sure = [pair.sure for pair in pairs]
    count, image = len(around), looked.images[frame]
    told = np.all([s > LEAST_SURE for s in sure[:count]], axis=0)
    gap = np.where(told, still_gap(tracks[:count], landed[:count]), 0)
    far_off, contrast = told & (gap > _limit(gap, told)), texture(image)
    if again is not None:
        sure_again = sure[-1] > LEAST_SURE
        later = np.where(sure_again, still_gap(tracks[-1:], landed[-1:]), 0)
        far_off, gap = far_off | (later > _limit(later, sure_again)), np.maximum(gap, later)
    if far_off.any():
        others = [looked.images[pair.second] for pair in pairs]
        worse = excess(Compared(image, others, tracks, landed, sure))
        far_off &= (worse > WORSE) & (worse > CONTRASTS * contrast)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (SPECK, SPECK))
    moving = cv2.morphologyEx(far_off.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    return moving, told & (contrast > max(TEXTURED, CLEAR * noise)), gap.astype(np.float32)


def _limit(gap, told):
    """Pixels of gap, (h, w), from which something may move."""
    return min(max(GAP, GAPS * float(np.median(gap[told]))), MOST_GAP) if told.any() else GAP


def texture(image: np.ndarray) -> np.ndarray:
    """(h, w) standard deviation of an image's (h, w, 3) grey values about each pixel."""
    grey = image.mean(-1).astype(np.float64)
    mean, square = (cv2.blur(x, (PATCH, PATCH)) for x in (grey, grey**2))
    return np.sqrt(np.maximum(square - mean**2, 0))


def motion_evidence(motion: Motion, looked: Looked, *, smallest: int = LEAST_SIDE) -> Evidence:
    """`Evidence` of motion; of frames with a side of fewer than `smallest` pixels nothing is said to stand still."""
    shares, told = motion.moving.mean((1, 2)), float(motion.told.mean())
    left = np.sort(shares)[: len(shares) - (len(shares) >= FEW)]
    share = float(left.mean())
    numbers = {"share_moving": share, "most_in_a_frame": float(shares.max()), "share_told": told}
    numbers["median_gap_px"] = float(np.median(motion.gap[motion.told])) if motion.told.any() else float("nan")
    limits = {
        "share_moving": LEAST,
        "share_moving_surely": MOST,
        "share_told": FEWEST_TOLD,
        "gap_px": GAP,
        "gap_of_median": GAPS,
        "colour": WORSE,
        "contrast": CONTRASTS,
    }
    verdict, reason = _verdict(share, told, motion.once)
    if verdict == NO and min(looked.size) < smallest:
        shown = "x".join(map(str, looked.size))
        verdict, reason = UNKNOWN, f"in frames of {shown} slow motion is less than {GAP:g} pixels, which is not seen"
    strongest = int(np.argmax(shares))
    picture = marked(looked.images[looked.frames[strongest]], motion.moving[strongest])
    return Evidence(verdict, numbers, limits, reason, picture)


def _verdict(share, told, once):
    """(told, reason)."""
    if share >= MOST:
        return YES, f"{share:.2%} of the pixels leave what a still point may do, and its colours"
    if told < FEWEST_TOLD:
        return UNKNOWN, f"only {told:.1%} of the pixels have texture and a sure flow"
    if share >= LEAST:
        return (
            UNKNOWN,
            f"{share:.2%} of the pixels seem to move: more than errors of the flow are, less than surely move",
        )
    if once:
        return UNKNOWN, "no frame has both its neighbours, and two alone do not tell what moves along its epipolar line"
    return NO, f"{share:.3%} of the pixels seem to move, no more than errors of the flow do"


def marked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """An image (h, w, 3) in grey with a mask (h, w) in red, or its values in [0, 1] as shares of red."""
    grey = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    share = np.asarray(mask, np.float32)[..., None]
    return (1 - share) * grey + share * np.array([1, 0.2, 0.1], np.float32)
