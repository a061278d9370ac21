"""Where a point that stands still may go: the test of motion beyond the cameras', by known cameras and optical flow.

h w      rows and columns of half-resolution pixels
K        other frames that one is compared with
rho      inverse depth in the frame's camera, 1 / world units
track    where a still point of a pixel goes in another frame as its depth varies: a piece of its epipolar line, or a
         single point where the two cameras stand at one place
landed   where the optical flow goes, image pixels
"""

from typing import NamedTuple

import cv2
import numpy as np

from zestjax.cameras import Camera

SLACK = 1.25  # factor by which a depth may leave the bounds, which people round
FRONT = 0.05  # of a far point's depth in the other camera: nearer ones are not looked for
BEHIND = 1e-9  # homogeneous depth of a point that is not in front: it lands very far away
LEAST_SURE = 0.3  # of a flow that is believed: there and back are off by less than 1.6 pixels
TRIED = 24  # depths that colours are compared at, beside those of the flows: most of the time goes into them
BETWEEN = (-1 / 3, 1 / 3)  # steps of those about the best of them that are tried too
PATCH = 5  # half-resolution pixels across whose colours are compared: a guess that was never varied
LEAST = 1e-6  # weight of a patch that is divided by


class Track(NamedTuple):
    """a + rho b are homogeneous image pixels of the other frame. a, b: (h, w, 3). least, most: (h, w) of rho."""

    a: np.ndarray
    b: np.ndarray
    least: np.ndarray
    most: np.ndarray


class Compared(NamedTuple):
    """A frame and K others. image: (h, w, 3) colours. others: K of the same. tracks: K of `Track`. landed: K of
    (h, w, 2). sure: K of (h, w) in [0, 1], of the flows."""

    image: np.ndarray
    others: list[np.ndarray]
    tracks: list[Track]
    landed: list[np.ndarray]
    sure: list[np.ndarray]


def track_of(grid: np.ndarray, camera: Camera, other: Camera, near: float, far: float) -> Track:
    """`Track` of every pixel.

    Args:
      grid: (h, w, 3) homogeneous image pixels of the frame.
      camera: its `Camera`, host arrays.
      other: the other frame's.
      near: world units.
      far: world units.
    """
    relative = _double(other.camera_from_world) @ np.linalg.inv(_double(camera.camera_from_world))
    k, inverse = _double(other.intrinsics), np.linalg.inv(_double(camera.intrinsics))
    a = grid @ (k @ relative[:3, :3] @ inverse).T
    b = np.broadcast_to(k @ relative[:3, 3], a.shape)
    least, nearest = 1 / (SLACK * far), SLACK / near
    towards = b[..., 2] < 0  # the other camera is farther on: what is near enough lies behind it
    limit = (1 - FRONT) * a[..., 2] / np.where(towards, -b[..., 2], 1)
    most = np.where(towards, np.minimum(nearest, limit), nearest)
    return Track(a, b, np.full(a.shape[:2], least), np.maximum(most, least))


def pixel_on(track: Track, rho: np.ndarray) -> np.ndarray:
    """(h, w, 2) where a still point of inverse depth rho (h, w), brought within the track's, goes."""
    point = track.a + np.clip(rho, track.least, track.most)[..., None] * track.b
    return point[..., :2] / np.maximum(point[..., 2:], BEHIND)


def nearest_rho(track: Track, landed: np.ndarray) -> np.ndarray:
    """(h, w) the inverse depth whose still point comes nearest to `landed`; the least where all go to one place."""
    first, last = pixel_on(track, track.least), pixel_on(track, track.most)
    along = last - first
    squared = np.sum(along**2, -1)
    share = np.sum((landed - first) * along, -1) / np.where(squared > 0, squared, 1)
    goal = first + np.clip(share, 0, 1)[..., None] * along
    # On the longer of the two axes the goal is u = (a + rho b) / (a_z + rho b_z), which is solved for rho.
    down = np.abs(along[..., 1]) > np.abs(along[..., 0])
    pick = lambda x: np.where(down, x[..., 1], x[..., 0])
    above, below = pick(goal) * track.a[..., 2] - pick(track.a), pick(track.b) - pick(goal) * track.b[..., 2]
    turns = np.abs(below) <= BEHIND
    rho = np.where(turns, track.least, above / np.where(turns, 1, below))
    return np.clip(rho, track.least, track.most)


def still_gap(tracks: list[Track], landed: list[np.ndarray]) -> np.ndarray:
    """(h, w) image pixels by which a flow must be wrong for one still point to explain all K: the least, over inverse
    depths, of the largest distance."""
    own = [nearest_rho(track, there) for track, there in zip(tracks, landed, strict=True)]
    tried = own if len(own) == 1 else [*own, sum(own) / len(own)]
    away = lambda rho: [np.linalg.norm(pixel_on(t, rho) - x, axis=-1) for t, x in zip(tracks, landed, strict=True)]
    return np.min([np.max(away(rho), axis=0) for rho in tried], axis=0)


def excess(compared: Compared) -> np.ndarray:
    """(h, w) by how much worse the best still point explains the other frames' colours than the flow does: about 0
    where the flow is wrong, and where nothing can be told for want of texture; above where something moves."""
    _, _, tracks, landed, sure = compared
    weights = [_patches(s > LEAST_SURE) for s in sure]
    total = np.maximum(sum(weights), LEAST)

    def cost(places):
        each = (_patch_cost(compared.image, *of) for of in zip(compared.others, places, sure, strict=True))
        return sum(w * c for w, c in zip(weights, each, strict=True)) / total

    at = lambda rho: cost([pixel_on(track, rho) for track in tracks])
    own = [at(nearest_rho(track, there)) for track, there in zip(tracks, landed, strict=True)]
    least, most = np.max([t.least for t in tracks], axis=0), np.min([t.most for t in tracks], axis=0)
    step = np.maximum(most - least, 0) / (TRIED - 1)
    even = np.stack([at(least + k * step) for k in range(TRIED)])
    best = least + np.argmin(even, axis=0) * step
    between = [at(best + share * step) for share in BETWEEN]
    return np.min([*own, *even, *between], axis=0) - cost(landed)


def carried(other: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(h, w, 3) half-resolution colours of another frame at places (h, w, 2), image pixels."""
    at = ((places - 0.5) / 2).astype(np.float32)
    return cv2.remap(other, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _patch_cost(image, other, places, sure):
    """(h, w) mean absolute difference of colours over the believed pixels of a patch."""
    weight = (sure > LEAST_SURE).astype(np.float32)
    difference = np.abs(image - carried(other, places)).mean(-1)
    return _patches(weight * difference) / np.maximum(_patches(weight), LEAST)


def _patches(x):
    return cv2.blur(np.asarray(x, np.float32), (PATCH, PATCH))


def _double(x):
    return np.asarray(x, np.float64)
