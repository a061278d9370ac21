"""What a scene's files say of each pixel: masks, optical flow, disparity and truth, at the size asked for.

record   `zestjax.io.layouts.Record`, which names the files and the size of the pictures that they belong to
N        frames
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.io.flow_files import read_flo
from zestjax.io.layouts import Record
from zestjax.io.pictures import check_fits, doubted_mask, mask_warning, resize_nearest
from zestjax.io.reading import FileWarning, check_numbers, read_array, read_arrays


class FlowMaps(NamedTuple):
    """Optical flow of every frame. vectors: (N, H, W, 2) pixels, 0 where not valid. valid: (N, H, W) bool."""

    vectors: np.ndarray
    valid: np.ndarray


def truth_of(record: Record, path: Path | None, size: tuple[int, int]) -> dict:
    """`depth` and `flow` of a truth file at a size, those that it has."""
    if path is None:
        return {}
    arrays = read_arrays(path, names=("depth", "flow"))
    known = {key: resize_nearest(_map(record, path, array, key), *size) for key, array in arrays.items()}
    if "flow" in known:
        known["flow"] = known["flow"] * _flow_scale(arrays["flow"].shape, size)
    return known


def masks_of(record: Record, size: tuple[int, int]) -> np.ndarray | None:
    """(N, H, W) moving pixels of the frames, or None unless all have a mask; warns of those that are doubtful."""
    doubts = {}

    def read(file):
        mask, doubt = doubted_mask(file, native=record.size)
        doubts.update({file: doubt} if doubt else {})
        return resize_nearest(mask, *size)

    masks = _stack(record.motion_masks, len(record.images), read)
    if doubts:
        warnings.warn(mask_warning(doubts), FileWarning, stacklevel=3)  # of the line that loads the scene
    return masks


def flow_of(record: Record, files: Mapping[int, Path], size: tuple[int, int]) -> FlowMaps | None:
    """`FlowMaps` of the frames, not valid where a frame has no file; None when none has."""
    if not files:
        return None
    count = len(record.images)
    vectors, valid = np.zeros((count, *size, 2), np.float32), np.zeros((count, *size), bool)
    for i, file in files.items():
        stored, mask = _stored_flow(record, file)
        valid[i] = resize_nearest(mask, *size) > 0
        flow = resize_nearest(stored, *size) * _flow_scale(stored.shape, size)
        valid[i] &= np.isfinite(flow).all(-1)
        vectors[i] = np.where(valid[i][..., None], flow, 0)
    return FlowMaps(vectors, valid)


def _stored_flow(record, path):
    """(flow (H, W, 2), mask (H, W)) of a file."""
    if path.suffix == ".flo":
        flow, mask = read_flo(path)
    else:
        arrays = read_arrays(path)
        if not {"flow", "mask"} <= arrays.keys():
            raise ValueError(f"{path}: should hold `flow` and `mask`, got {sorted(arrays)[:5]}; compute it again.")
        flow, mask = arrays["flow"], arrays["mask"]
    flow = _map(record, path, flow, "flow")
    return flow, check_numbers(path, mask, shape=flow.shape[:2], name="mask")


def disparity_of(record: Record, size: tuple[int, int]) -> np.ndarray | None:
    """(N, H, W) disparity of the frames, or None unless all have a file."""
    read = lambda file: resize_nearest(_map(record, file, read_array(file), "disparity"), *size)
    return _stack(record.disparity, len(record.images), read)


def _map(record, path, array, name):
    """Numbers by pixel (H, W), of a flow (H, W, 2), as floats, if they are of the shape of the record's pictures."""
    array = check_numbers(path, array, shape=(None, None, 2) if name == "flow" else (None, None), name=name)
    if min(array.shape) < 1:
        raise ValueError(f"{path}: `{name}` is empty, {array.shape}; write it again.")
    check_fits(path, array.shape[:2], record.size)
    with np.errstate(over="ignore"):
        return array if array.dtype.kind == "f" and array.dtype.itemsize <= 4 else array.astype(np.float32)


def _flow_scale(have, size):
    return np.array([size[1] / have[1], size[0] / have[0]], np.float32)


def _stack(files, count, read):
    """One array for all frames; None unless every frame has a file."""
    return np.stack([read(files[i]) for i in range(count)]) if all(i in files for i in range(count)) else None
