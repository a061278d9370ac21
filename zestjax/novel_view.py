"""Novel views of a posed video: prepare a scene once, then render any camera at any of its times.

N        frames of the video
H W      rows and columns of a view, those of the video's images
exclude  frames that must serve nothing, because they are what is to be predicted
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_known, check_types, traced
from zestjax.base.precision import geometry_at, network_at
from zestjax.base.types import Array
from zestjax.cameras import Camera, project
from zestjax.frames.analysis import FrameMaps
from zestjax.frames.assembly import Footage, dequantised, footage, video_evidence
from zestjax.frames.between import with_stand_in
from zestjax.frames.exposure import Exposure, evened, exposed_as_target
from zestjax.frames.inputs import check_exclude, check_inputs, check_view
from zestjax.rays import pixel_grid
from zestjax.systems.system import Params, System
from zestjax.systems.targets import asks_for_own_time, target_inputs
from zestjax.video import Inputs, Video

BLOCK_ROWS = 8  # at most so many rows are rendered together, so that memory does not grow with the image
BLOCK_POINTS = 2**16  # and at most so many samples, unless a ray has more: the caches hold what they are computed from


class Prepared(NamedTuple):
    """A scene's cache. video: `Video` on the host. footage: `assembly.Footage`, and maps: `FrameMaps` of every frame;
    None in a system that asks nothing of single frames. exposure: `Exposure`, or None in a system that does not ask."""

    video: Video
    footage: Footage | None
    maps: FrameMaps | None
    exposure: Exposure | None = None


class View(NamedTuple):
    """A rendered view. colour, static: (H, W, 3) in [0, 1]; static is the scene without what moves. dynamic: (H, W, 3)
    the dynamic field alone, or None. depth: (H, W) world units. opacity, dynamicness: (H, W) in [0, 1].
    flow: (H, W, 2) pixels to the next time in the same camera, or None."""

    colour: jax.Array
    static: jax.Array
    dynamic: jax.Array | None
    depth: jax.Array
    opacity: jax.Array
    dynamicness: jax.Array
    flow: jax.Array | None


@functools.partial(jax.jit, static_argnames=("system",))
def _maps(params, evidence, *, system: System):
    assert system.frames is not None
    evidence = geometry_at(system.precision, dequantised(evidence))
    return system.frames(network_at(system.precision, params), evidence, still=system.dynamic is None)


def _frame_maps(params, seen, video, system, *, frames=None, exclude=()):
    """`FrameMaps` of all frames or of those named, whose evidence is found once each."""
    used, place = (None, None) if frames is None else np.unique(frames, return_inverse=True)
    with jax.ensure_compile_time_eval():  # the frames are known also where a camera is traced
        evidence = video_evidence(
            seen, video.cameras, video.near, video.far, planes=system.frames.planes, frames=used, exclude=exclude
        )
    evidence = evidence if place is None else jax.tree.map(lambda x: x[place], evidence)
    return _maps(params.analysis, evidence, system=system)


def prepare(params: Params, video: Video, *, system: System, exclude: Sequence[int] = ()) -> Prepared:
    """What a scene is asked for every view: each frame's own depth and moving pixels.

    Args:
      params: of the system.
      video: `Video`, whose images may be uint8.
      system: `System`.
      exclude: see the header.

    Returns:
      `Prepared`.

    Raises:
      ValueError: before anything is compiled, if no view can be predicted from the video (see `inputs.check_inputs`), a
        frame to exclude is not in it, or `params` are not those of the system.
    """
    video = check_inputs("novel_view.prepare", video, quantised=True)
    exclude = check_exclude("novel_view.prepare", len(video.images), exclude)
    check_params("novel_view.prepare", params, system)
    if system.frames is None and system.exposure is None:
        return Prepared(video, None, None)
    seen = footage(video.images)
    exposure = None if system.exposure is None else system.exposure(seen, exclude=exclude)
    if system.frames is None:
        return Prepared(video, seen, None, exposure)
    maps = _frame_maps(params, evened(seen, exposure), video, system, exclude=exclude)
    return Prepared(video, seen, maps, exposure)


@functools.lru_cache(maxsize=64)
def _structure(system):
    """[(path, shape)] of a system's parameters."""
    shapes = jax.eval_shape(system.init, jax.random.key(0))
    return [(jax.tree_util.keystr(path), leaf.shape) for path, leaf in jax.tree_util.tree_leaves_with_path(shapes)]


def check_params(where: str, params: Params, system: System) -> None:
    """Refuse parameters that are not those of a system.

    Raises:
      ValueError: naming the first that is missing, not wanted, or of another shape.
    """
    have = {jax.tree_util.keystr(path): np.shape(x) for path, x in jax.tree_util.tree_leaves_with_path(params)}
    want = dict(_structure(system))
    for path, shape in want.items():
        if path not in have:
            raise ValueError(f"{where}: `params` have no `{path}`, which `system` computes with; give its own weights.")
        if have[path] != shape:
            raise ValueError(f"{where}: `params{path}` has shape {have[path]}, expected {shape}; give its own weights.")
    if more := [path for path in have if path not in want]:
        raise ValueError(f"{where}: `params` have `{more[0]}`, which `system` lacks; give the weights' own system.")


def render_view(
    params: Params,
    prepared: Prepared,
    camera: Camera,
    time: int | Array,
    *,
    system: System,
    exclude: Sequence[int] = (),
) -> View:
    """A view from a camera at a time of the video; pure after `prepare`, for `jit`, `vmap` over cameras and times, and
    `grad` (which frames serve, and where guided rays are sampled, is held).

    Args:
      params: of the system.
      prepared: `Prepared` of the video.
      camera: `Camera` for an image of the video's size.
      time: int frame time.
      system: `System`.
      exclude: see the header; their traces in the other frames' maps are removed too. Where the frame of the target's
        own time is among them, and neither time nor video is traced, one made of its neighbours by optical flow
        (`frames.between`) takes its slot.

    Returns:
      `View`.

    Raises:
      ValueError: before anything is compiled, if the video cannot give the view (see `inputs.check_view`), `params`
        are not those of the system, `prepared` lacks what it needs, or is traced where frames are to be excluded.
    """
    where = "novel_view.render_view"
    check_types(where, prepared=(prepared, Prepared))
    check_params(where, params, system)
    video, maps = prepared.video, prepared.maps
    if maps is None and system.frames is not None:
        raise ValueError(f"{where}: `prepared` has no maps of its frames; prepare the video with the same `system`.")
    time, exclude = check_view(where, video, camera, time, exclude=exclude)
    if exclude and prepared.footage is not None:
        check_known(where, prepared=prepared)
        prepared = prepared._replace(exposure=_exposure_without(prepared, exclude, system))
    between = _stand_in(prepared, time, exclude, system)
    if between is not None:
        inputs, maps = _inputs_with(between, params, prepared, camera, time, system=system, exclude=exclude)
        return render_inputs(params, inputs, maps, system=system)
    inputs, frames = target_inputs(
        video.images, video.cameras, video.near, video.far, camera, time, system=system, exclude=exclude
    )
    if system.frames is None:
        maps = None
    elif exclude:
        seen: Any = prepared.footage
        maps = _maps_without(params, evened(seen, prepared.exposure), video, system, frames, exclude)
    else:
        maps = jax.tree.map(lambda x: x[frames], maps)
    return render_inputs(params, exposed_as_target(inputs, frames, prepared.exposure), maps, system=system)


def _exposure_without(prepared, exclude, system):
    """`Exposure` without what the frames to be excluded say of it."""
    if system.exposure is None:
        return None
    with jax.ensure_compile_time_eval():  # the video is known also where a camera is traced
        return system.exposure(prepared.footage, exclude=exclude, known=prepared.exposure)


def _stand_in(prepared, time, exclude, system):
    """(`Video`, `Footage`) where the frame of the target's time may not be read, and is made of its neighbours; None
    where it may, where nothing is known of it, or nobody asks for it."""
    if traced((prepared, time)) or time not in exclude or system.frames is None or not asks_for_own_time(system):
        return None
    with jax.ensure_compile_time_eval():  # the video is known also where a camera is traced
        return with_stand_in(prepared.video, prepared.footage, time, exclude=exclude)


def _inputs_with(between, params, prepared, camera, time, *, system, exclude):
    """`Inputs` and `FrameMaps` of a target whose own frame is stood in for: among the slots and in their maps."""
    video, seen = between
    inputs, frames = target_inputs(
        video.images, video.cameras, video.near, video.far, camera, time, system=system, exclude=exclude, stand_in=True
    )
    count, missing = len(inputs.key.valid), tuple(i for i in exclude if i != time)
    with jax.ensure_compile_time_eval():  # as above
        first, second = (evened(x, prepared.exposure) for x in (prepared.footage, seen))
    of_key = _maps_without(params, first, prepared.video, system, frames[:count], exclude)
    of_slots = _maps_without(params, second, video, system, frames[count:], missing)
    maps = jax.tree.map(lambda *parts: jnp.concatenate(parts), of_key, of_slots)
    return exposed_as_target(inputs, frames, prepared.exposure), maps


def _maps_without(params, seen, video, system, frames, exclude):
    """`FrameMaps` of frames, without what others have of those excluded: of all frames where it is not known which."""
    if not traced(frames):
        return _frame_maps(params, seen, video, system, frames=frames, exclude=exclude)
    return jax.tree.map(lambda x: x[frames], _frame_maps(params, seen, video, system, exclude=exclude))


@functools.partial(jax.jit, static_argnames=("system", "rows"))
def render_inputs(
    params: Params, inputs: Inputs, maps: FrameMaps | None, *, system: System, rows: int | None = None
) -> View:
    """The view of given inputs; a pure function, compiled once for a size and a system.

    Args:
      params: of the system.
      inputs: `Inputs`.
      maps: `FrameMaps` of the inputs' frames, or None.
      system: `System`.
      rows: how many of the first rows to render, all by default.

    Returns:
      `View`.
    """
    params = network_at(system.precision, params)
    inputs, maps = geometry_at(system.precision, (inputs, maps))
    scene = system.encode(params, inputs, maps)
    height, width = inputs.key.images.shape[1:3]
    height = height if rows is None else rows
    count, together = height * width, _together(system, scene, inputs, height)
    pixels = pixel_grid(height, width, dtype=inputs.key.images.dtype).reshape(-1, 2)
    blocks = -(-count // together)
    pixels = jnp.pad(pixels, [(0, blocks * together - count), (0, 0)], mode="edge").reshape(blocks, together, 2)
    block = lambda p: _view_block(system, system.render(params, scene, inputs, p), scene, inputs)
    image = lambda x: x.reshape(blocks * together, *x.shape[2:])[:count].reshape(height, width, *x.shape[2:])
    view = jax.tree.map(image, jax.lax.map(block, pixels))
    shown = lambda x: None if x is None else jnp.clip(x, 0, 1)
    images = {name: shown(getattr(view, name)) for name in ("colour", "static", "dynamic", "opacity")}
    return view._replace(**images)


def _together(system, scene, inputs, height):
    """Rays rendered together: whole rows, or fewer where a ray has many samples."""
    width, one = inputs.key.images.shape[2], jnp.zeros((1, 2), inputs.key.images.dtype)
    sampled = lambda scene, pixels: system.sampler.fractions(scene.guides, pixels, None)
    samples = jax.eval_shape(sampled, scene, one).shape[1]
    return max(1, min(min(BLOCK_ROWS, height) * width, BLOCK_POINTS // samples))


def _view_block(system, prediction, scene, inputs):
    p = prediction
    flow = None if p.dynamic is None else _induced_flow(p, system.place(scene, inputs), inputs.camera)
    return View(p.colour, p.static_colour, p.dynamic_colour, p.depth, p.opacity, p.dynamicness, flow)


def _induced_flow(prediction, place, camera):
    """(R, 2) pixels by which the rays' expected points move until the next time; what is static stays."""
    marched = prediction.marched
    moved = place.world(marched.coords + prediction.dynamic.flow_forward)
    flow = jnp.sum(prediction.dynamic_weights[..., None] * (moved - marched.points), axis=1)
    total = jnp.maximum(jnp.sum(prediction.weights, axis=1, keepdims=True), 1e-6)  # an empty ray has no point
    point = jnp.sum(prediction.weights[..., None] * marched.points, axis=1) / total
    before, after = project(camera, point), project(camera, point + flow / total)
    return jnp.where((before.in_front & after.in_front)[:, None], after.pixels - before.pixels, 0)
