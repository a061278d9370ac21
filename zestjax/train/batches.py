"""Batches: one target of a simulated clip, with everything that is known about it.

R        rays of a step, a recipe's `Rays` of the target
V        source frames: of the static field, then of the dynamic one
h w      cells, a quarter of the image
planes   fractional plane index of a true depth, 0 at near
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from zestjax.cameras import Camera
from zestjax.frames.assembly import footage, video_evidence
from zestjax.frames.cells import cells_of
from zestjax.frames.evidence import Evidence
from zestjax.frames.exposure import Exposure, evened, exposed_as_target
from zestjax.frames.known import KnownFrames
from zestjax.simulate.clips import Clip
from zestjax.systems.system import System
from zestjax.systems.targets import target_inputs
from zestjax.train.measures import Known, Truth
from zestjax.train.recipes import Recipe
from zestjax.train.stand_ins import StandIns, find_stand_ins, looks, slots_evidence, stand_in_at
from zestjax.video import Inputs, Video

HOLES = 2  # of a clip's frames: a third of the targets then have no frame of their own time
FRAMES_PER_CLIP = 4  # of a `FrameBatch`


class Batch(NamedTuple):
    """inputs: `Inputs`. evidence: `Evidence` (V, ...) uint8, or None. truth: `Truth` of the rays.
    static_planes, moving_planes: (h, w) of the target view at cell centres, with their validities.
    frame_planes: (V, h, w). frame_moving: (V, 2h, 2w). frame_valid: (V,). Where depths are not known, all are None."""

    inputs: Inputs
    evidence: Evidence | None
    truth: Truth
    static_planes: Known = None
    static_planes_valid: Known = None
    moving_planes: Known = None
    moving_planes_valid: Known = None
    frame_planes: Known = None
    frame_moving: Known = None
    frame_valid: Known = None


class FrameBatch(NamedTuple):
    """Frames of several clips and what they show, as in `Batch`: for training what each frame says of itself."""

    evidence: Evidence
    frame_planes: np.ndarray
    frame_moving: np.ndarray
    frame_valid: np.ndarray


class PreparedClip(NamedTuple):
    """A `simulate.clips.Clip`, or `KnownFrames`, with its evidence; holes: frames that the video lacks, targets of the
    strict kind; hidden: frames that serve nothing and are no targets either. targets: frames that are targets and serve
    all the same, of a system that reads no frames. stand_ins: `StandIns` for holes, or None. exposure: `Exposure`, or
    None."""

    clip: Clip | KnownFrames
    evidence: Evidence | None
    holes: tuple
    hidden: tuple = ()
    targets: tuple = ()
    stand_ins: StandIns | None = None
    exposure: Exposure | None = None


def prepare_clip(key: jax.Array, clip: Clip, system: System) -> PreparedClip:
    """Evidence of a clip, computed once; the frames in `holes` serve no other frame, as if the video lacked them. Where
    others can stand in for them, they do, as where a view is rendered.

    Args:
      key: draws the holes.
      clip: `simulate.clips.Clip`.
      system: `System`; its frames' own maps need the evidence.
    """
    count = len(clip.images)
    holes = tuple(int(i) for i in jax.random.choice(key, count, (min(HOLES, count // 5),), replace=False))
    if system.frames is None and system.exposure is None:
        return PreparedClip(clip, None, holes)
    cameras, seen = Camera(clip.intrinsics, clip.camera_from_world), footage(clip.images)
    exposure = None if system.exposure is None else system.exposure(seen, exclude=holes)
    if system.frames is None:
        return PreparedClip(clip, None, holes, exposure=exposure)
    planes, video = system.frames.planes, Video(clip.images, cameras, clip.near, clip.far)
    even = evened(seen, exposure)
    evidence = video_evidence(even, cameras, clip.near, clip.far, planes=planes, exclude=holes)
    stand_ins = find_stand_ins(video, seen, holes if looks(system) else (), planes=planes, exposure=exposure)
    return PreparedClip(clip, evidence, holes, stand_ins=stand_ins, exposure=exposure)


def clip_from_arrays(arrays: Mapping[str, np.ndarray]) -> Clip:
    """`Clip` of a stored clip's arrays by name.

    Raises:
      ValueError: naming the fields that are missing.
    """
    missing = [name for name in Clip._fields if name not in arrays]
    if missing:
        raise ValueError(
            f"clip_from_arrays: the stored clip lacks {', '.join(missing)}; delete it, it is rendered again."
        )
    return Clip._make(arrays[name] for name in Clip._fields)


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
    times = clip.target_time if isinstance(clip, Clip) else ()
    return [("view", i, int(t)) for i, t in enumerate(times)] + [("frame", i, i) for i in holes]


def batch_from_clip(key: jax.Array, prepared: PreparedClip, recipe: Recipe, *, step: int = 0) -> Batch:
    """One target of a clip: which, and which rays of it, is drawn from `key`.

    A target at the time of a hole has no slot at its own time, or one that stands in; a hole is itself a target that no
    input has seen.

    Args:
      key: random key.
      prepared: `PreparedClip`.
      recipe: `Recipe`, whose system reads the frames and whose rays are drawn.
      step: number of the step it is for.

    Returns:
      `Batch` of host arrays.
    """
    clip, holes, system = prepared.clip, prepared.holes, recipe.system
    draw = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    views = _target_views(clip, (*holes, *prepared.targets))
    kind, index, time = views[draw.integers(len(views))]
    shown = _shown(clip, kind, index)
    inputs, evidence, frames = _inputs_of(prepared, shown["camera"], time, system)
    batch = Batch(inputs, evidence, _rays_of(shown, draw, recipe, step))
    if isinstance(clip, KnownFrames):
        return batch
    return batch._replace(**_planes_of(clip, shown, frames, inputs, system, holes))


def _inputs_of(prepared, camera, time, system):
    """`Inputs` of a target, their `Evidence` or None, and which frames they hold."""
    clip = prepared.clip
    images, cameras = clip.images, Camera(clip.intrinsics, clip.camera_from_world)
    standing = stand_in_at(prepared.stand_ins, time, images, cameras, system=system)
    if standing is not None:
        images, cameras = standing.images, standing.cameras
    inputs, frames = target_inputs(
        images, cameras, clip.near, clip.far, camera, time, system=system,
        exclude=(*prepared.holes, *prepared.hidden), stand_in=standing is not None,
    )  # fmt: skip
    inputs = exposed_as_target(inputs, frames, prepared.exposure)
    if prepared.evidence is None:
        return inputs, None, frames
    evidence = jax.tree.map(lambda x: x[frames], prepared.evidence)
    if standing is not None:
        count = len(inputs.key.valid)
        of_slots = slots_evidence(prepared.stand_ins, standing, np.asarray(frames)[count:])
        evidence = jax.tree.map(lambda key, slots: np.concatenate([key[:count], slots]), evidence, of_slots)
    return inputs, evidence, frames


def _planes_of(clip, shown, frames, inputs, system, holes):
    """Where the volumes' and the frames' surfaces truly are."""
    planes = lambda depth: _cells(_planes(depth, clip, system.space.planes, spacing=system.space.spacing))
    of_frames = _cells(_planes(clip.depth[frames], clip, evidence_planes(system)))
    return dict(
        static_planes=planes(shown["static_depth"]),
        static_planes_valid=_cells(shown["static_valid"]).astype(np.float32),
        moving_planes=planes(shown["depth"]),
        moving_planes_valid=_cells(shown["moving"]).astype(np.float32),
        frame_planes=of_frames,
        frame_moving=_half_mask(clip.moving[frames], of_frames.shape[1:]),
        frame_valid=_own_valid(inputs, frames, holes),
    )


def _own_valid(inputs, frames, holes):
    """(V,) 1 where a frame is there and its own: of one that stands in for a hole nobody knows the depths."""
    valid = np.concatenate([part.valid for part in (inputs.key, inputs.slots) if part is not None])
    return valid * ~np.isin(frames, holes)


def evidence_planes(system: System) -> int:
    """Planes on which the frames' own depths are found; those of the volumes where no frame is asked."""
    return system.space.planes if system.frames is None else system.frames.planes


def frame_batch(key: jax.Array, clips: Sequence[PreparedClip], system: System) -> FrameBatch:
    """Frames of several clips: many scenes in one step make its gradient steady.

    Args:
      key: draws the frames.
      clips: of `PreparedClip`, equally many frames of each.
      system: `System` whose frames are asked.

    Returns:
      `FrameBatch` of 4 frames of each clip, or of all if it has fewer.

    Raises:
      ValueError: the system asks nothing of single frames, or their depths are not known.
    """
    draw = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    parts = []
    for clip, evidence, *_ in clips:
        if not isinstance(clip, Clip):
            raise ValueError("frame_batch: a clip is of `KnownFrames`, whose depths nobody knows; give simulated ones.")
        if evidence is None:
            raise ValueError("frame_batch: the system asks nothing of single frames (`frames` is None); use `OwnMaps`.")
        chosen = draw.permutation(len(clip.images))[:FRAMES_PER_CLIP]
        planes = _cells(_planes(clip.depth[chosen], clip, evidence_planes(system)))
        moving = _half_mask(clip.moving[chosen], planes.shape[1:])
        parts.append(FrameBatch(jax.tree.map(lambda x, c=chosen: x[c], evidence), planes, moving,
                                np.ones(len(chosen), np.float32)))  # fmt: skip
    return jax.tree.map(lambda *rows: np.concatenate(rows), *parts)


def step_batches(batch_at: Callable[[int, int], Any], clips: int) -> Callable[[int], Any]:
    """`stacked` batches of a step's clips; batch_at: of (step, clip)."""
    return lambda step: stacked([batch_at(step, clip) for clip in range(clips)])


def stacked(batches: Sequence[Any]) -> Any:
    """The batches of several clips as one, for a recipe that sees so many a step; one batch is itself.

    Raises:
      ValueError: their arrays have not the same shapes.
    """
    if len(batches) == 1:
        return batches[0]
    shapes = [jax.tree.map(np.shape, batch) for batch in batches]
    if any(other != shapes[0] for other in shapes):
        raise ValueError(
            "stacked: the clips of one step differ in size or in what is known of them; bring all scenes to one size, "
            "or set the recipe's `clips` to 1."
        )
    return jax.tree.map(lambda *rows: np.stack(rows), *batches)


def _shown(clip, kind, index) -> dict[str, Any]:
    """Everything known about a target, whole image; what is not known is left out."""
    if kind == "view":
        camera = Camera(clip.target_intrinsics[index], clip.target_camera_from_world[index])
        moving = clip.target_moving[index]
        return dict(
            camera=camera, image=clip.target_images[index], moving=moving, mined=moving, known=np.ones_like(moving),
            depth=clip.target_depth[index], static=clip.target_static_images[index],
            static_depth=clip.target_static_depth[index], static_valid=clip.target_static_valid[index],
            flow=clip.target_scene_flow[index],
        )  # fmt: skip
    image, moving = clip.images[index], None if clip.moving is None else clip.moving[index]
    shown = dict(camera=Camera(clip.intrinsics[index], clip.camera_from_world[index]), image=image, mined=moving)
    if moving is not None:
        shown |= dict(moving=moving, static=image, static_valid=~moving)
    if isinstance(clip, Clip):
        nothing = np.zeros((2, *clip.depth[index].shape, 3), np.float16)
        depth = clip.depth[index]
        return shown | dict(depth=depth, static_depth=depth, flow=nothing, known=np.zeros_like(moving))
    if clip.mined is not None:
        shown |= dict(mined=clip.mined[index])
    if clip.disparity is not None:
        shown |= dict(disparity=clip.disparity[index])
    return shown if clip.flow is None else shown | dict(pixel_flow=clip.flow[index], flow_valid=clip.flow_valid[index])


def _rays_of(shown, draw, recipe, step):
    """`Truth` of the rays that a step looks at."""
    height, width = shown["image"].shape[:2]
    mined = np.zeros((height, width), bool) if shown["mined"] is None else shown["mined"]
    pixels = recipe.rays.draw(draw, mined, step)
    samples = getattr(recipe.system.sampler, "samples", 0) if recipe.rays.jittered else 0
    v, u = np.unravel_index(pixels, (height, width))
    at = lambda x: x.reshape(-1, *x.shape[2:])[pixels].astype(np.float32)
    plain = {"moving", "depth", "static_valid", "known", "disparity"} & shown.keys()
    place, image = np.stack([u, v], -1).astype(np.float32), at(shown["image"]) / 255
    numbers = {name: at(shown[name]) for name in plain}
    truth = Truth(place, image, **numbers)
    if "static" in shown:
        truth = truth._replace(static=at(shown["static"]) / 255)
    if "flow" in shown:
        flow = at(np.moveaxis(shown["flow"], 0, 2))
        truth = truth._replace(flow=flow, flow_valid=numbers["moving"] * numbers["known"])
    if "pixel_flow" in shown:
        flow, valid = (at(np.moveaxis(shown[name], 0, 2)) for name in ("pixel_flow", "flow_valid"))
        truth = truth._replace(pixel_flow=flow, pixel_flow_valid=valid)
    return truth._replace(jitter=draw.random((len(pixels), samples), np.float32) if samples else None)
