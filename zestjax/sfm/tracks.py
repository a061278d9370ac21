"""Tracks: one point of the scene, and where frames show it.

M        observations
P        tracks
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from zestjax.sfm.features import Features
from zestjax.sfm.matching import Pair


class Tracks(NamedTuple):
    """frame: (M,) int. track: (M,) int in [0, P), in order. pixels: (M, 2)."""

    frame: np.ndarray
    track: np.ndarray
    pixels: np.ndarray

    @property
    def total(self) -> int:
        """P."""
        return int(self.track[-1]) + 1 if len(self.track) else 0


def join_matches(features: Sequence[Features], pairs: Sequence[Pair]) -> Tracks:
    """The tracks that matches make, each seen by two frames or more.

    A point is at one place in a frame: where matches say two, that frame's are left out of the track.
    """
    starts = np.cumsum([0, *(len(f.pixels) for f in features)])
    ends = [pair.matches + [starts[pair.first], starts[pair.second]] for pair in pairs]
    joined = np.concatenate([np.zeros((0, 2), int), *ends])
    total = int(starts[-1])
    graph = coo_array((np.ones(len(joined), np.int8), tuple(joined.T)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    frame = np.repeat(np.arange(len(features)), np.diff(starts))
    _, inverse, times = np.unique(np.stack([label, frame]), axis=1, return_inverse=True, return_counts=True)
    once = times[inverse.ravel()] == 1
    seen = np.bincount(label[once], minlength=total)
    kept = np.flatnonzero(once & (seen[label] >= 2))
    kept = kept[np.lexsort((frame[kept], label[kept]))]
    _, track = np.unique(label[kept], return_inverse=True)
    pixels = np.concatenate([np.zeros((0, 2)), *(f.pixels for f in features)])
    return Tracks(frame[kept], track.ravel(), pixels[kept])
