"""What surfaces call for: do some hide others, do colours change with the direction, are some things thin?

h w      rows and columns of half-resolution pixels
rho      inverse depth, 1 / world units
"""

import cv2
import numpy as np

from zestjax.effects.found import Evidence, judged, unknown
from zestjax.effects.motion import FEWEST_TOLD, Motion, marked
from zestjax.effects.pairs import Looked, Pair, camera_of, image_pixels
from zestjax.effects.standing import carried, nearest_rho, pixel_on, still_gap, track_of

LOST = 0.1  # of a flow: there and back are off by more than 2.3 pixels, as where one end is hidden
BELIEVED = 0.5  # of a flow whose colours are compared
SMOOTH = 9  # half-resolution pixels across: highlights are wider, noise and errors of the flow at edges are not
HELD = 1.0  # image pixels by which the flows may leave the same still point: DIS is off by half of one
SHADOW = 15  # half-resolution pixels across: so near to what moves, its shadow changes colours too
LEAST_CHANGE = 0.02  # of white, of a smoothed colour: five grey levels
SPREADS = 3.0  # standard deviations of the noise, smoothed, that a change must be above
THIN = 9  # half-resolution pixels across: what is narrower is thin
NEARER = 0.25  # by which share of its inverse depth a thin thing is in front of what is around it
SHIFT = 2.0  # image pixels by which its flow leaves that of what is around it: DIS is off by half of one
# Shares of the pixels below which an effect is not there, and from which it surely is, from the table of
# `python experiments/effects.py`.
HIDDEN_LEAST, HIDDEN_MOST = 5e-4, 5e-3
CHANGED_LEAST, CHANGED_MOST = 2e-3, 1e-2
THIN_LEAST, THIN_MOST = 1e-3, 1e-2


def disocclusion_evidence(looked: Looked) -> Evidence:
    """`Evidence` of what is hidden in one frame and seen in another: pixels whose flow is lost within the picture, of
    the neighbours or of a frame farther away, whichever are more."""
    lost = [np.mean([_lost(pair, looked.size) for pair in pairs], axis=0) for pairs in looked.near if pairs]
    if not lost:
        return unknown("there are no two frames to be compared")
    shares = [float(share.mean()) for share in lost]
    farther = [float(_lost(pair, looked.size).mean()) for pair in looked.wide if pair is not None]
    share, most = max(float(np.mean(shares)), float(np.mean(farther or [0.0]))), int(np.argmax(shares))
    what = "pixels that another frame hides"
    told, reason = judged(share, least=HIDDEN_LEAST, most=HIDDEN_MOST, name="their share", what=what)
    limits = {"share_hidden": HIDDEN_LEAST, "share_hidden_surely": HIDDEN_MOST}
    picture = marked(looked.images[looked.frames[most]], lost[most])
    return Evidence(told, {"share_hidden": share}, limits, reason, picture)


def _lost(pair: Pair, size):
    """(h, w) bool of pixels that stay inside the picture (of size (H, W)) and whose flow does not come back."""
    landed = image_pixels(*pair.sure.shape)[..., :2] + pair.flow
    return np.all((landed >= 0) & (landed <= np.array(size[::-1]) - 1), axis=-1) & (pair.sure < LOST)


def view_evidence(looked: Looked, motion: Motion, near: float, far: float) -> Evidence:
    """`Evidence` of colours that change with the direction: smooth changes of what stands still, above the noise; near,
    far: world units."""
    about = np.ones((SHADOW, SHADOW), np.uint8)
    apart = [cv2.dilate(moving.astype(np.uint8), about) == 0 for moving in motion.moving]
    held = [_held(looked, k, near, far) & apart[k] for k in range(len(looked.frames))]
    found = [_changed(looked, pair, still) for pair, still in zip(looked.wide, held, strict=True) if pair is not None]
    shown = [each for each in found if each is not None]
    if not shown:
        return unknown("no two frames show enough of the same still surfaces")
    shares, noise = [float(changed.mean()) for changed, _, _ in shown], float(np.median([x for _, x, _ in shown]))
    share, most = float(np.mean(shares)), int(np.argmax(shares))
    numbers = {"share_changed": share, "noise": noise}
    what = "still surfaces whose colour changes from view to view"
    told, reason = judged(share, least=CHANGED_LEAST, most=CHANGED_MOST, name="their share", what=what)
    limits = {"share_changed": CHANGED_LEAST, "share_changed_surely": CHANGED_MOST, "change": LEAST_CHANGE}
    changed, _, frame = shown[most]
    return Evidence(told, numbers, limits, reason, marked(looked.images[frame], changed))


def _held(looked, k, near, far):
    """(h, w) bool of pixels that one still point explains in the neighbours and in the frame farther away."""
    wide = looked.wide[k]
    pairs, grid = [*looked.near[k], *([] if wide is None else [wide])], image_pixels(*looked.images.shape[1:3])
    camera = camera_of(looked.cameras, looked.frames[k])
    tracks = [track_of(grid, camera, camera_of(looked.cameras, pair.second), near, far) for pair in pairs]
    gap = still_gap(tracks, [grid[..., :2] + pair.flow for pair in pairs])
    return np.all([pair.sure > BELIEVED for pair in pairs], axis=0) & (gap < HELD)


def _changed(looked, pair, still):
    """((h, w) bool of changed colours, the noise, the frame), or None where too little can be compared."""
    landed = image_pixels(*pair.sure.shape)[..., :2] + pair.flow
    image, other = looked.images[pair.first], carried(looked.images[pair.second], landed)
    within = lambda x: np.all((x > 0.02) & (x < 0.98), axis=-1)  # what is cut off has no change to show
    weight = ((pair.sure > BELIEVED) & still & within(image) & within(other)).astype(np.float32)
    if weight.mean() < FEWEST_TOLD:
        return None
    seen = weight > 0
    image, other = image.mean(-1), other.mean(-1)
    change = other / np.median(other[seen] / image[seen]) - image  # without an exposure that is left over
    noise = 1.4826 * np.median(np.abs(change[seen]))  # a normal law's standard deviation, outliers left out
    near = cv2.blur(weight, (SMOOTH, SMOOTH))
    smooth = cv2.blur(weight * change, (SMOOTH, SMOOTH)) / np.maximum(near, 1e-6)  # a patch of nothing is left out
    limit = max(LEAST_CHANGE, SPREADS * noise / SMOOTH)
    return (np.abs(smooth) > limit) & (near > BELIEVED), float(noise), pair.first


def thin_evidence(looked: Looked, near: float, far: float) -> Evidence:
    """`Evidence` of thin things in front of others, by inverse depths of the flow; near, far: world units."""
    grid, masks = image_pixels(*looked.images.shape[1:3]), []
    for frame, pairs in zip(looked.frames, looked.near, strict=True):
        for pair in pairs[:1]:
            track = track_of(grid, camera_of(looked.cameras, frame), camera_of(looked.cameras, pair.second), near, far)
            rho = np.where(pair.sure > BELIEVED, nearest_rho(track, grid[..., :2] + pair.flow), 0)
            rho = cv2.medianBlur(rho.astype(np.float32), 3)
            shift = np.linalg.norm(pixel_on(track, rho) - pixel_on(track, _wide(rho)), axis=-1)
            masks.append(thin(rho) & (shift > SHIFT))
    if not masks:
        return unknown("there are no two frames to be compared")
    shares = [float(mask.mean()) for mask in masks]
    share, most = float(np.mean(shares)), int(np.argmax(shares))
    told, reason = judged(share, least=THIN_LEAST, most=THIN_MOST, name="their share", what="pixels of thin things")
    limits = {"share_thin": THIN_LEAST, "share_thin_surely": THIN_MOST}
    picture = marked(looked.images[looked.frames[most]], masks[most])
    return Evidence(told, {"share_thin": share}, limits, reason, picture)


def thin(rho: np.ndarray) -> np.ndarray:
    """(h, w) bool of what is narrower than `THIN` pixels and clearly nearer than what is around it."""
    rho = np.asarray(rho, np.float32)
    return (rho - _wide(rho) > NEARER * rho) & (rho > 0)


def _wide(rho):
    """(h, w) rho without what is thin."""
    return cv2.morphologyEx(np.asarray(rho, np.float32), cv2.MORPH_OPEN, np.ones((THIN, THIN), np.uint8))
