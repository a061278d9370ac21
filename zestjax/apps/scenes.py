"""A scene by the name a user gives it: a folder in any supported layout, or `bench:NAME` of zest-bench."""

import hashlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_option
from zestjax.cameras import project, unproject
from zestjax.io.files import resolved
from zestjax.io.layouts import select
from zestjax.io.pictures import SUFFIXES
from zestjax.io.scenes import FIXED_VIEW_FRAMES, PROTOCOLS, Scene, Target, load_scene
from zestjax.simulate.bench import BENCH

BENCH_SIZE = (144, 256)


class Opened(NamedTuple):
    """scene: `Scene`. ceiling: function of a `Target` to `simulate.ceiling.Ceiling`, of simulated scenes
    with held-out targets; else None."""

    scene: Scene
    ceiling: Callable | None


def open_scene(name, recipe, *, size=None, protocol: str | None = "held-out", targets=None, layout=None, exclude=()):
    """Open a scene.

    Args:
      name: folder, or `bench:NAME`.
      recipe: `Recipe`, whose height is the default of a folder's pictures; zest-bench is 144 x 256 by default.
      size: (height, width), or None.
      protocol: one of `io.scenes.PROTOCOLS`; None where no target is wanted.
      targets: times to predict, or None for all. Of zest-bench all means every time, by one held-out camera each.
      layout: of the folder, recognised unless told.
      exclude: frames that are never read; they are black.

    Returns:
      `Opened`.

    Raises:
      ValueError: no such scene, protocol or target.

    Warns:
      UserWarning: no size was asked for, and a folder's pictures are smaller than the preset's.
    """
    name = str(name)
    if name.startswith("bench:"):
        check_option("open_scene", protocol=(protocol, (*PROTOCOLS, None)))
        return _open_bench(name.removeprefix("bench:"), size or BENCH_SIZE, protocol, targets, exclude)
    if not Path(name).exists():
        hint = f"; did you mean bench:{name}?" if name in BENCH else f", one of {', '.join(BENCH)}."
        raise ValueError(f"{name}: is not a folder; give one that holds a scene, or bench:NAME of zest-bench{hint}")
    height, width = size or (recipe.height, None)
    scene = load_scene(
        name, height=height, width=width, layout=layout, protocol=protocol or "strict", targets=targets, exclude=exclude
    )
    if size is None:
        _tell_enlarged(name, scene)
    return Opened(scene, None)


def _tell_enlarged(name, scene):
    """Warn of pictures that are brought to a height which they do not have and nobody asked for."""
    have, now = scene.stored, scene.video.images.shape[1:3]
    if have[0] < now[0]:
        warnings.warn(
            f"{name}: pictures of {have[0]}x{have[1]} (HxW) are enlarged to {now[0]}x{now[1]}, the preset's height; "
            "`--size HxW`, where a command has it, sets another.",
            stacklevel=3,
        )


def place_of(name):
    """Where a scene lies, for people: a run is compared by `digest`."""
    return str(name) if str(name).startswith("bench:") else str(resolved(name))


def same_pictures(folders):
    """Two of these folders that hold the same pictures, whatever they and the pictures are called, or None."""
    sizes = {folder: _pictures(folder) for folder in folders}
    alike = lambda folder: sorted(size for size, _ in sizes[folder])
    for i, second in enumerate(folders):
        for first in folders[:i]:
            if sizes[first] and alike(first) == alike(second) and _contents(sizes[first]) == _contents(sizes[second]):
                return first, second
    return None


def _pictures(folder):
    """[(bytes, path)] of the pictures anywhere in a folder."""
    found = (path for path in Path(folder).rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    return [(path.stat().st_size, path) for path in found]


def _contents(pictures):
    """What tells pictures apart, in an order that their names do not change."""
    return sorted(hashlib.sha256(path.read_bytes()).hexdigest() for _, path in pictures)


def digest(video):
    """What tells one scene's frames, cameras and size from another's, wherever they lie."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(video):
        array = np.ascontiguousarray(leaf)
        found.update(f"{array.shape} {array.dtype}".encode())
        found.update(array.tobytes())
    return found.hexdigest()[:12]


def _open_bench(name, size, protocol, targets, exclude):
    from zestjax.simulate.bench import bench_scene
    from zestjax.simulate.ceiling import ceiling
    from zestjax.simulate.footage import answers, input_video

    simulated = bench_scene(name, height=size[0], width=size[1])
    if outside := [i for i in exclude if not 0 <= i < simulated.frames]:
        raise ValueError(f"bench:{name}: no frame {outside[0]} to exclude; it has 0 to {simulated.frames - 1}.")
    video = jax.tree.map(np.array, input_video(simulated))
    video.images[list(exclude)] = 0
    if protocol is None:
        return Opened(Scene(name, video, (), layout="bench"), None)
    first, there = int(simulated.taken[0]), range(simulated.frames)
    if protocol == "fixed-view":
        video = jax.tree.map(lambda x: x[:FIXED_VIEW_FRAMES] if x.ndim else x, video)
        there = [time for time in there[:FIXED_VIEW_FRAMES] if int(simulated.taken[time]) != first]
    times = there if targets is None else targets
    if outside := [time for time in times if time not in there]:
        raise ValueError(f"bench:{name}: no target {outside[0]}; its times are {there[0]} to {there[-1]}.")
    camera_at = {"held-out": lambda t: held_out_camera(simulated, t), "fixed-view": lambda t: first}
    cameras = [camera_at.get(protocol, lambda t: int(simulated.taken[t]))(t) for t in times]
    shown = answers(simulated, list(times), cameras)
    listed = [target_from_answers(shown, i, cameras[i], protocol) for i in range(len(times))]
    limit = lambda target: ceiling(simulated, video, target.camera, target.time)
    return Opened(Scene(name, video, listed, layout="bench"), limit if protocol == "held-out" else None)


def held_out_camera(simulated, time):
    """The rig's camera that a time is judged by: another than the frame's own, all distances to it in turn."""
    count = len(simulated.rig.intrinsics)
    return (int(simulated.taken[time]) + 1 + 5 * time % (count - 1)) % count


def target_from_answers(shown, i, camera, protocol):
    """The i-th of `Answers` as a `Target`; its flow is towards the next time, as its own camera would see it."""
    time, view = int(shown.times[i]), select(shown.cameras, i)
    return Target(
        time=time,
        camera_name="input" if protocol in ("strict", "paper") else f"cam{camera + 1:02d}",  # numbered as published
        camera=view,
        image=shown.images[i],
        dynamic=shown.moving[i],
        exclude=(time,) if protocol == "strict" else (),
        depth=shown.depth[i],
        flow=_flow_in_place(view, shown.depth[i], shown.scene_flow[i, 0]),
    )


def _flow_in_place(camera, depth, displacement):
    """(H, W, 2) pixels by which the points of a view move in a camera that stands still; NaN where they leave it."""
    pixels = np.stack(np.meshgrid(*(np.arange(side, dtype=np.float32) for side in depth.shape[::-1])), -1)
    known = np.isfinite(depth)
    camera = jax.tree.map(jnp.asarray, camera)
    points = unproject(camera, jnp.asarray(pixels), jnp.asarray(np.where(known, depth, 1)))
    landed = project(camera, points + jnp.asarray(displacement, jnp.float32))
    known &= np.asarray(landed.in_front)
    return np.where(known[..., None], np.asarray(landed.pixels) - pixels, np.nan).astype(np.float32)
