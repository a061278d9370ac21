"""Pixels that move by themselves: where optical flow leaves the epipolar line of a still point.

H W      rows and columns
flow     (H, W, 2) pixels to another frame; sure (H, W) in [0, 1], see `zestjax.frames.optical_flow`

A point that moves along its epipolar line at a speed that some depth would explain cannot be told by two frames.
"""

import cv2
import numpy as np

FEWEST = 4e-4  # share of the picture: smaller spots of movement are errors of the flow, and smaller holes in one too
THRESHOLD = 1.5  # pixels: DIS is off by half a pixel where it is sure
LEAST_SURE = 0.3  # of a flow that is believed: there and back are off by less than 1.6 pixels
GROWN = 5  # pixels across, by which a mask is closed


def fundamental_matrix(relative: np.ndarray, focal: float, centre: np.ndarray) -> np.ndarray:
    """(3, 3) F with x'^T F x = 0 for pixels x of a still point in one frame and x' in another.

    Args:
      relative: (4, 4) or (3, 4), the other camera from this one.
      focal: pixels.
      centre: (2,) principal point, pixels.
    """
    x, y, z = relative[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    inverse = np.array([[1 / focal, 0, -centre[0] / focal], [0, 1 / focal, -centre[1] / focal], [0, 0, 1.0]])
    return inverse.T @ essential @ inverse


def epipolar_distance(flow: np.ndarray, fundamental: np.ndarray) -> np.ndarray:
    """(H, W) pixels by which both ends of a flow must move for a still point to explain it (Sampson's distance).

    0 where the two cameras stand at one place: the epipolar line is then not defined.
    """
    height, width = flow.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float64)
    here = np.stack([u, v, np.ones_like(u)], -1)
    there = here + np.concatenate([flow, np.zeros((height, width, 1))], -1)
    line, back = here @ fundamental.T, there @ fundamental
    length = np.sqrt(np.sum(line[..., :2] ** 2, -1) + np.sum(back[..., :2] ** 2, -1))
    return np.abs(np.sum(there * line, -1)) / np.where(length > 0, length, np.inf)


def moving_pixels(distances: np.ndarray, sure: np.ndarray, *, threshold: float = THRESHOLD) -> np.ndarray:
    """(H, W) bool mask of the pixels that no depth lets stand still, without specks and pinholes.

    Args:
      distances: (K, H, W) of `epipolar_distance`, or `turning_distance`, to K other frames.
      sure: (K, H, W) of their flows.
      threshold: pixels of distance that all of the other frames must see.
    """
    return cleaned(np.all((sure > LEAST_SURE) & (distances > threshold), axis=0))


def turning_distance(flow: np.ndarray, rotation: np.ndarray, focal: float, centre: np.ndarray) -> np.ndarray:
    """(H, W) pixels between a flow and the one that a camera makes which only turns.

    Args:
      flow: (H, W, 2) pixels to the other frame.
      rotation: (3, 3), the other camera from this one.
      focal: pixels.
      centre: (2,) principal point, pixels.
    """
    height, width = flow.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float64)
    rays = np.stack([(u - centre[0]) / focal, (v - centre[1]) / focal, np.ones_like(u)], -1) @ rotation.T
    landed = focal * rays[..., :2] / np.maximum(rays[..., 2:], 1e-6) + centre
    return np.linalg.norm(np.stack([u, v], -1) + flow - landed, axis=-1)


def cleaned(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) bool closed over gaps, without its smallest spots and holes."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (GROWN, GROWN))
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel[1:-1, 1:-1])
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel)
    least = max(FEWEST * mask.size, 4)
    return ~_without_small(~_without_small(closed > 0, least), least)


def _without_small(mask, least):
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return large[label]
