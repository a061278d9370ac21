"""Batches: one target of a simulated clip, with everything that is known about it.

R        rays of the crop: config.crop_rows whole rows of the target
V        source frames, key-frames then slots
h w      cells, a quarter of the image
planes   fractional plane index of a true depth, 0 at near
"""

from typing import NamedTuple

import jax
import numpy as np

from zestjax.assembly import footage, target_inputs, video_evidence
from zestjax.cameras import Camera
from zestjax.evidence import Evidence
from zestjax.measures import Truth
from zestjax.model import Inputs, cells_of
from zestjax.simulate.clips import Clip

HOLES = 3
FRAMES_PER_CLIP = 4  # of a `FrameBatch`


class Batch(NamedTuple):
    """inputs: `Inputs`. evidence: `Evidence` (V, ...) uint8, or None. truth: `Truth` of the crop.
    static_planes, moving_planes: (h, w) of the target view at cell centres, with their validities.
    frame_planes: (V, h, w). frame_moving: (V, 2h, 2w). frame_valid: (V,)."""

    inputs: Inputs
    evidence: Evidence | None
    truth: Truth
    static_planes: jax.Array | np.ndarray
    static_planes_valid: jax.Array | np.ndarray
    moving_planes: jax.Array | np.ndarray
    moving_planes_valid: jax.Array | np.ndarray
    frame_planes: jax.Array | np.ndarray
    frame_moving: jax.Array | np.ndarray
    frame_valid: jax.Array | np.ndarray


class FrameBatch(NamedTuple):
    """Frames of several clips and what they show, as in `Batch`: for training what each frame says of itself."""

    evidence: Evidence
    frame_planes: np.ndarray
    frame_moving: np.ndarray
    frame_valid: np.ndarray


class PreparedClip(NamedTuple):
    """A `simulate.clips.Clip` with its evidence; holes: frames that the video lacks, targets of the strict kind;
    hidden: frames that serve nothing and are no targets either."""

    clip: Clip
    evidence: Evidence | None
    holes: tuple
    hidden: tuple = ()


def prepare_clip(key, clip, config):
    """Evidence of a clip, computed once; the frames in `holes` serve no other frame, as if the video lacked them.

    Args:
      key: draws the holes.
      clip: `simulate.clips.Clip`.
      config: `presets.Config`.
    """
    count = len(clip.images)
    holes = tuple(int(i) for i in jax.random.choice(key, count, (min(HOLES, count // 5),), replace=False))
    if config.encoder != "frames":
        return PreparedClip(clip, None, holes)
    cameras = Camera(clip.intrinsics, clip.camera_from_world)
    evidence = video_evidence(
        footage(clip.images), cameras, clip.near, clip.far, planes=config.evidence_planes, exclude=holes
    )
    return PreparedClip(clip, evidence, holes)


def clip_from_arrays(arrays):
    """`Clip` of a stored clip's arrays by name.

    Raises:
      ValueError: naming the fields that are missing.
    """
    missing = [name for name in Clip._fields if name not in arrays]
    if missing:
        raise ValueError(
            f"clip_from_arrays: the stored clip lacks {', '.join(missing)}; delete it, it is rendered again."
        )
    return Clip(**{name: arrays[name] for name in Clip._fields})


def _planes(depth, clip, count, *, spacing="inverse"):
    near, far, depth = clip.near, clip.far, np.maximum(depth, 1e-6)
    share = (1 / near - 1 / depth) / (1 / near - 1 / far) if spacing == "inverse" else (depth - near) / (far - near)
    return (share * (count - 1)).astype(np.float32)


def _cells(x):
    """(..., H, W) maps at the cells' centres, (..., h, w) with h the cells of the evidence."""
    height, width = x.shape[-2:]
    size = [cells_of(n) for n in (height, width)]
    rows, columns = (np.minimum(4 * np.arange(s) + 2, n - 1) for s, n in zip(size, (height, width), strict=True))
    return x[..., rows[:, None], columns]


def _half_mask(moving, cells):
    """(V, H, W) bool to the share of moving pixels at half resolution, (V, 2h, 2w)."""
    count, height, width = moving.shape
    padded = np.pad(moving, [(0, 0), (0, 4 * cells[0] - height), (0, 4 * cells[1] - width)], mode="edge")
    return padded.reshape(count, 2 * cells[0], 2, 2 * cells[1], 2).mean((2, 4), dtype=np.float32)


def _target_views(clip, holes):
    """Every target of a clip: (kind, index, time); kind `view` is another camera, `frame` one of the holes."""
    return [("view", i, int(t)) for i, t in enumerate(clip.target_time)] + [("frame", i, i) for i in holes]


def batch_from_clip(key, prepared, config):
    """One target of a clip: which, and which rows of it, is drawn from `key`.

    A target at the time of a hole has no slot at its own time; a hole is itself a target that no input has seen.

    Args:
      key: random key.
      prepared: `PreparedClip`.
      config: `presets.Config`.

    Returns:
      `Batch` of host arrays.
    """
    clip, holes = prepared.clip, prepared.holes
    draw = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    views = _target_views(clip, holes)
    kind, index, time = views[draw.integers(len(views))]
    cameras = Camera(clip.intrinsics, clip.camera_from_world)
    shown = _shown(clip, kind, index)
    inputs, frames = target_inputs(
        clip.images,
        cameras,
        clip.near,
        clip.far,
        shown["camera"],
        time,
        config=config,
        exclude=(*holes, *prepared.hidden),
    )
    cells = _cells(clip.depth[:1]).shape[1:]
    planes = lambda depth: _cells(_planes(depth, clip, config.planes, spacing=config.spacing))
    moving = _cells(shown["moving"])
    return Batch(
        inputs, None if prepared.evidence is None else jax.tree.map(lambda x: x[frames], prepared.evidence),
        _crop(shown, draw, config),
        planes(shown["static_depth"]), _cells(shown["static_valid"]).astype(np.float32),
        planes(shown["depth"]), moving.astype(np.float32),
        _cells(_planes(clip.depth[frames], clip, config.evidence_planes)), _half_mask(clip.moving[frames], cells),
        np.concatenate([inputs.key.valid, inputs.slots.valid]),
    )  # fmt: skip


def frame_batch(key, clips, config):
    """Frames of several clips: many scenes in one step make its gradient steady.

    Args:
      key: draws the frames.
      clips: of `PreparedClip`, equally many frames of each.
      config: `presets.Config`.

    Returns:
      `FrameBatch` of 4 frames of each clip, or of all if it has fewer.

    Raises:
      ValueError: the preset's frames have no evidence.
    """
    draw = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    parts = []
    for clip, evidence, *_ in clips:
        if evidence is None:
            raise ValueError(f"frame_batch: encoder `{config.encoder}` asks nothing of single frames; use `frames`.")
        chosen = draw.permutation(len(clip.images))[:FRAMES_PER_CLIP]
        planes = _cells(_planes(clip.depth[chosen], clip, config.evidence_planes))
        moving = _half_mask(clip.moving[chosen], planes.shape[1:])
        parts.append(FrameBatch(jax.tree.map(lambda x, c=chosen: x[c], evidence), planes, moving,
                                np.ones(len(chosen), np.float32)))  # fmt: skip
    return jax.tree.map(lambda *rows: np.concatenate(rows), *parts)


def _shown(clip, kind, index):
    """Everything known about a target, whole image."""
    if kind == "view":
        camera = Camera(clip.target_intrinsics[index], clip.target_camera_from_world[index])
        return dict(
            camera=camera, image=clip.target_images[index], depth=clip.target_depth[index],
            moving=clip.target_moving[index], static=clip.target_static_images[index],
            static_depth=clip.target_static_depth[index], static_valid=clip.target_static_valid[index],
            flow=clip.target_scene_flow[index], flow_known=True,
        )  # fmt: skip
    camera = Camera(clip.intrinsics[index], clip.camera_from_world[index])
    still = ~clip.moving[index]
    return dict(
        camera=camera, image=clip.images[index], depth=clip.depth[index], moving=clip.moving[index],
        static=clip.images[index], static_depth=clip.depth[index], static_valid=still,
        flow=np.zeros((2, *still.shape, 3), np.float16), flow_known=False,
    )  # fmt: skip


def _drawn_pixels(draw, moving, config):
    """(R,) flat indices: whole rows, or pixels drawn uniformly and more from what moves, if anything does."""
    height, width = moving.shape
    if config.rays == "rows":
        first = draw.integers(0, height - config.crop_rows + 1)
        return np.arange(first * width, (first + config.crop_rows) * width)
    uniform = draw.choice(height * width, config.crop_rows * width, replace=False)
    mined = np.flatnonzero(moving) if moving.any() else np.arange(height * width)
    return np.concatenate([uniform, draw.choice(mined, config.mined_rays)])


def _crop(shown, draw, config):
    pixels = _drawn_pixels(draw, shown["moving"], config)
    size = shown["depth"].shape
    v, u = np.unravel_index(pixels, size)
    flat = lambda x: x.reshape(-1, *x.shape[2:])[pixels]
    colour = lambda x: flat(x).astype(np.float32) / 255
    moving = flat(shown["moving"]).astype(np.float32)
    return Truth(
        np.stack([u, v], -1).astype(np.float32), colour(shown["image"]), colour(shown["static"]),
        flat(shown["static_valid"]).astype(np.float32), moving, flat(shown["depth"]).astype(np.float32),
        flat(np.moveaxis(shown["flow"], 0, 2)).astype(np.float32),
        moving * float(shown["flow_known"]), np.full(moving.shape, float(shown["flow_known"]), np.float32),
    )  # fmt: skip
