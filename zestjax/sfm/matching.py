"""Pairs of features that show one point: alike, each other's best, and on one epipolar geometry.

M        matches of a pair of images
matches  (M, 2) indices into the features of the first and of the second image
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from zestjax.sfm.features import Features

RATIO = 0.9  # of the distances to the best and to the second best; geometry removes what this lets through
LEAST = 16  # matches of a pair that count: an epipolar geometry takes 7, and chance finds a dozen
ALL_PAIRS = 40  # frames up to which every pair is tried: 780 pairs
REACH = 8  # frames in time that are always tried
THRESHOLD = 1.0  # pixels from the epipolar line: SIFT finds a place to half a pixel


class Pair(NamedTuple):
    """first, second: frames. matches: (M, 2) int. shift: pixels, median distance of the matches. parallax: pixels, the
    distance that the best homography leaves of all but a tenth of them: none where the camera only turned."""

    first: int
    second: int
    matches: np.ndarray
    shift: float
    parallax: float


def frame_pairs(count: int) -> list[tuple[int, int]]:
    """Pairs of frames worth matching: all of a short video, else those near in time and ever rarer ones far apart."""
    if count <= ALL_PAIRS:
        return list(combinations(range(count), 2))
    steps = [*range(1, REACH + 1)]
    while steps[-1] < count:
        steps.append(steps[-1] * 2)
    return [(i, i + step) for step in steps for i in range(count - step)]


def mutual_matches(a: Features, b: Features, *, ratio: float = RATIO) -> np.ndarray:
    """(M, 2) pairs of features that are each other's nearest, and nearer than `ratio` times the second nearest."""
    if min(len(a.pixels), len(b.pixels)) < 2:
        return np.zeros((0, 2), int)
    alike = a.descriptors @ b.descriptors.T
    there, back = alike.argmax(1), alike.argmax(0)
    rows = np.flatnonzero(back[there] == np.arange(len(there)))
    best, second = np.partition(alike[rows], -2, axis=1)[:, -2:].T[::-1]
    distance = lambda cosine: np.sqrt(np.maximum(2 - 2 * cosine, 0))
    rows = rows[distance(best) < ratio * distance(second)]
    return np.stack([rows, there[rows]], -1)


def verified_pair(first: int, second: int, features: Sequence[Features], *, seed: int = 0) -> Pair | None:
    """The matches of two frames that agree on an epipolar geometry; None where fewer than `LEAST` do."""
    a, b = features[first], features[second]
    matches = mutual_matches(a, b)
    if len(matches) < LEAST:
        return None
    ours, theirs = a.pixels[matches[:, 0]], b.pixels[matches[:, 1]]
    _, kept = _fitted(cv2.findFundamentalMat, ours, theirs, consensus(THRESHOLD, seed=seed))
    flat, _ = _fitted(cv2.findHomography, ours, theirs, consensus(2 * THRESHOLD, seed=seed))
    kept = np.zeros(len(ours), bool) if kept is None else kept.ravel() > 0
    if flat is not None:  # what a homography explains needs no epipolar geometry, which is then not unique
        kept |= _left_by(flat, ours, theirs) < THRESHOLD
    if kept.sum() < LEAST:
        return None
    ours, theirs = ours[kept], theirs[kept]
    shift = float(np.median(np.linalg.norm(theirs - ours, axis=1)))
    parallax = shift if flat is None else float(np.quantile(_left_by(flat, ours, theirs), 0.9))
    return Pair(first, second, matches[kept], shift, parallax)


def consensus(threshold: float, *, seed: int = 0) -> cv2.UsacParams:
    """OpenCV's parameters of a robust fit (MAGSAC++, Barath et al. 2020), the same at every call of one seed.

    Args:
      threshold: pixels.
      seed: of its samples.
    """
    params = cv2.UsacParams()
    params.threshold, params.confidence, params.maxIterations = threshold, 0.999, 5000
    params.score, params.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.final_polisher = cv2.LOCAL_OPTIM_SIGMA, cv2.MAGSAC
    params.randomGeneratorState = seed
    return params


def _fitted(fit, ours, theirs, params):
    """A robust fit of OpenCV's; nothing where no sample gives a model, which some versions raise."""
    try:
        return fit(ours, theirs, params)
    except cv2.error:
        return None, None


def _left_by(flat, ours, theirs):
    """(M,) pixels between what a homography makes of our pixels and theirs."""
    moved = np.c_[ours, np.ones(len(ours))] @ flat.T
    return np.linalg.norm(moved[:, :2] / np.where(np.abs(moved[:, 2:]) < 1e-12, 1e-12, moved[:, 2:]) - theirs, axis=1)
