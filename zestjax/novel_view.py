"""Novel views of a posed video: prepare a scene once, then render any camera at any of its times.

N        frames of the video
H W      rows and columns of a view, those of the video's images
exclude  frames that must serve nothing, because they are what is to be predicted
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.analysis import FrameMaps, frame_maps
from zestjax.assembly import Footage, dequantised, footage, target_inputs, video_evidence
from zestjax.cameras import project
from zestjax.checks import check_types
from zestjax.frustum import world_from_frustum
from zestjax.inputs import check_exclude, check_inputs, check_view
from zestjax.model import encode
from zestjax.precision import geometry_at, network_at
from zestjax.prediction import render_rays
from zestjax.rays import pixel_grid
from zestjax.video import Video

BLOCK_ROWS = 8  # rows rendered together: memory does not grow with the image


class Prepared(NamedTuple):
    """A scene's cache. video: `Video` on the host. footage: `assembly.Footage`, and maps: `FrameMaps` of every frame;
    None with an encoder that has none."""

    video: Video
    footage: Footage | None
    maps: FrameMaps | None


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


@functools.partial(jax.jit, static_argnames=("still", "precision"))
def _maps(params, evidence, *, still, precision):
    evidence = geometry_at(precision, dequantised(evidence))
    return frame_maps(network_at(precision, params), evidence, still=still)


def _frame_maps(params, seen, video, config, *, frames=None, exclude=()):
    """`FrameMaps` of all frames or of those named, whose evidence is found once each."""
    used, place = (None, None) if frames is None else np.unique(frames, return_inverse=True)
    evidence = video_evidence(
        seen, video.cameras, video.near, video.far, planes=config.evidence_planes, frames=used, exclude=exclude
    )
    evidence = evidence if place is None else jax.tree.map(lambda x: x[place], evidence)
    return _maps(params.analysis, evidence, still=not config.dynamic, precision=config.precision)


def prepare(params, video, *, config, exclude=()):
    """What a scene is asked for every view: each frame's own depth and moving pixels.

    Args:
      params: `model.ZestParams`.
      video: `Video`, whose images may be uint8.
      config: `presets.Config`.
      exclude: see the header.

    Returns:
      `Prepared`.

    Raises:
      ValueError: before anything is compiled, if no view can be predicted from the video (see `inputs.check_inputs`), a
        frame to exclude is not in it, or `params` lack what `config` computes.
    """
    video = check_inputs("novel_view.prepare", video, quantised=True)
    exclude = check_exclude("novel_view.prepare", len(video.images), exclude)
    _check_params("novel_view.prepare", params, config)
    if params.analysis is None:
        return Prepared(video, None, None)
    seen = footage(video.images)
    return Prepared(video, seen, _frame_maps(params, seen, video, config, exclude=exclude))


def _check_params(where, params, config):
    """Refuse parameters without a part that the configuration computes."""
    parts = dict(
        analysis=config.analysed, geometry=config.geometry, motion=config.motion_volume, dynamic=config.dynamic
    )
    if lacking := [name for name, needed in parts.items() if needed and getattr(params, name) is None]:
        raise ValueError(
            f"{where}: `params` have no `{lacking[0]}`, which `config` asks for; give the configuration of the weights."
        )


def render_view(params, prepared, camera, time, *, config, exclude=()):
    """A view from a camera at a time of the video.

    Args:
      params: `model.ZestParams`.
      prepared: `Prepared` of the video.
      camera: `Camera` for an image of the video's size.
      time: int frame time.
      config: `presets.Config`.
      exclude: see the header; their traces in the other frames' maps are removed too.

    Returns:
      `View`.

    Raises:
      ValueError: before anything is compiled, if the video cannot give the view (see `inputs.check_view`), or `params`
        lack what `config` computes or `prepared` what they need.
    """
    where = "novel_view.render_view"
    check_types(where, prepared=(prepared, Prepared))
    _check_params(where, params, config)
    video, maps = prepared.video, prepared.maps
    if maps is None and params.analysis is not None:
        raise ValueError(f"{where}: `prepared` has no maps of its frames; prepare the video with the same `params`.")
    time, exclude = check_view(where, video, camera, time, exclude=exclude)
    inputs, frames = target_inputs(
        video.images, video.cameras, video.near, video.far, camera, time, config=config, exclude=exclude
    )
    if maps is not None and exclude:
        maps = _frame_maps(params, prepared.footage, video, config, frames=frames, exclude=exclude)
    elif maps is not None:
        maps = jax.tree.map(lambda x: x[frames], maps)
    return render_inputs(params, inputs, maps, config=config)


@functools.partial(jax.jit, static_argnames=("config", "rows"))
def render_inputs(params, inputs, maps, *, config, rows=None):
    """The view of given inputs; a pure function, compiled once for a size and a configuration.

    Args:
      params: `model.ZestParams`.
      inputs: `model.Inputs`.
      maps: `FrameMaps` of the inputs' frames, or None.
      config: `presets.Config`.
      rows: how many of the first rows to render, all by default.

    Returns:
      `View`.
    """
    params = network_at(config.precision, params)
    inputs, maps = geometry_at(config.precision, (inputs, maps))
    encoding = encode(params, inputs, maps, config=config)
    height, width = inputs.key.images.shape[1:3]
    height = height if rows is None else rows
    together = min(BLOCK_ROWS, height)
    blocks = -(-height // together)
    pixels = pixel_grid(blocks * together, width, dtype=inputs.key.images.dtype).reshape(blocks, -1, 2)
    block = lambda p: _view_block(render_rays(params, encoding, inputs, p, config=config), encoding, inputs, p, config)
    image = lambda x: x.reshape(blocks * together, width, *x.shape[2:])[:height]
    view = jax.tree.map(image, jax.lax.map(block, pixels))
    shown = lambda x: None if x is None else jnp.clip(x, 0, 1)
    images = {name: shown(getattr(view, name)) for name in ("colour", "static", "dynamic", "opacity")}
    return view._replace(**images)


def _view_block(prediction, encoding, inputs, pixels, config):
    p = prediction
    flow = None if p.dynamic is None else _optical_flow(p, encoding.frustum, inputs.camera, pixels, config)
    return View(p.colour, p.static_colour, p.dynamic_colour, p.depth, p.opacity, p.dynamicness, flow)


def _optical_flow(prediction, frustum, camera, pixels, config):
    """(R, 2) pixels by which the rays' expected points move until the next time; what is static stays."""
    marched = prediction.marched
    moved = world_from_frustum(frustum, marched.coords + prediction.dynamic.flow_forward, spacing=config.spacing)
    flow = jnp.sum(prediction.dynamic_weights[..., None] * (moved - marched.points), axis=1)
    total = jnp.maximum(jnp.sum(prediction.weights, axis=1, keepdims=True), 1e-6)
    point = jnp.sum(prediction.weights[..., None] * marched.points, axis=1) / total
    before, after = project(camera, point), project(camera, point + flow / total)
    return jnp.where((before.in_front & after.in_front)[:, None], after.pixels - before.pixels, 0)
