"""Middlebury's `.flo` files of optical flow, as estimators write them: a tag, width, height, then (u, v) by rows."""

from pathlib import Path

import numpy as np

from zestjax.base.types import Array, FilePath
from zestjax.io.files import write_bytes
from zestjax.io.reading import read_regular

TAG = b"PIEH"  # 202021.25 as float32
UNKNOWN = 1e9  # a component beyond it marks a pixel whose flow is not known


def read_flo(path: FilePath) -> tuple[np.ndarray, np.ndarray]:
    """(flow (H, W, 2) float32 pixels, 0 where not known; known (H, W) bool).

    Raises:
      ValueError: not such a file, or one whose length is not what its size asks for.
    """
    path = Path(path)
    content = read_regular(path)
    size = np.frombuffer(content[4:12], "<i4") if content[:4] == TAG and len(content) >= 12 else ()
    if len(size) != 2 or min(size) < 1 or len(content) != 12 + 8 * int(size[0]) * int(size[1]):
        raise ValueError(f"{path}: is not a whole .flo file ({len(content)} bytes); copy or write it again.")
    flow = np.frombuffer(content[12:], "<f4").reshape(int(size[1]), int(size[0]), 2)
    known = np.all(np.abs(flow) < UNKNOWN, axis=-1)  # false of NaN too
    return np.where(known[..., None], flow, 0).astype(np.float32), known


def write_flo(path: FilePath, flow: Array, *, known: Array | None = None) -> None:
    """Write a flow (H, W, 2) in pixels, atomically; where `known` (H, W) is false it is marked as not known.

    Raises:
      ValueError: not (H, W, 2).
    """
    flow = np.asarray(flow, "<f4")
    if flow.ndim != 3 or flow.shape[2] != 2:
        raise ValueError(f"write_flo: `flow` should be (H, W, 2), got shape {flow.shape}.")
    flow = flow if known is None else np.where(np.asarray(known)[..., None], flow, np.float32(10 * UNKNOWN))
    write_bytes(path, TAG + np.array(flow.shape[1::-1], "<i4").tobytes() + np.ascontiguousarray(flow, "<f4").tobytes())
