"""`zestjax simulate`: a simulated scene on disk, with everything that is known of it."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from zestjax.apps.progress import progress
from zestjax.apps.scenes import target_from_answers
from zestjax.apps.tables import counted
from zestjax.io.nsff import write_nsff

OTHERS = 11  # held-out views of a time


@dataclasses.dataclass(frozen=True)
class SimulateOptions:
    """The flags of `zestjax simulate`: scene (of zest-bench) or random (a number)."""

    out: Path
    scene: str | None = None
    random: int | None = None
    size: tuple = (144, 256)
    frames: int = 24
    seed: int = 0
    quiet: bool = False


def simulate(options):
    """Run `zestjax simulate`.

    Returns:
      str, the summary line.

    Raises:
      ValueError: no such scene, fewer than two frames or more than the scene has, or a folder of something else.
    """
    from zestjax.simulate.footage import answers, input_video

    simulated = _scene(options)
    count, noise = simulated.frames, jax.random.key(options.seed)
    frames = answers(simulated, range(count), simulated.taken)
    bounds = np.float32(0.95 * frames.depth.min()), np.float32(1.05 * frames.depth.max())
    near, far = (simulated.near, simulated.far) if options.random is None else bounds
    video = jax.tree.map(np.asarray, input_video(simulated, noise=noise))._replace(near=near, far=far)

    def targets():
        for time in progress(range(count), "simulate", quiet=options.quiet):
            cameras = _others(simulated, time)
            shown = answers(simulated, [time] * len(cameras), cameras)
            yield from (target_from_answers(shown, i, camera, "held-out") for i, camera in enumerate(cameras))

    forward, backward = ((frames.flow[:, i], frames.visible[:, i]) for i in (0, 1))
    truth = [{"depth": frames.depth[i], "scene_flow": frames.scene_flow[i]} for i in range(count)]
    write_nsff(
        options.out, simulated.name, video, motion_masks=frames.moving, disparity=1 / frames.depth,
        flow_forward=forward, flow_backward=backward, truth=truth, held_out=targets(),
    )  # fmt: skip
    height, width = video.images.shape[1:3]
    return f"simulate: {simulated.name}, {counted(count, 'frame')} of {height}x{width}: {options.out}"


def _scene(options):
    """The `SimulatedScene` that the flags ask for."""
    from zestjax.simulate.bench import bench_scene
    from zestjax.simulate.random import random_scene
    from zestjax.simulate.types import SimulatedScene

    size = dict(height=options.size[0], width=options.size[1])
    if options.frames < 2:
        raise ValueError(f"simulate: {options.frames} frame is no video; give --frames 2 or more.")
    if options.scene is None:
        drawn = random_scene(jax.random.key(options.random), frames=options.frames, **size)
        name, taken = f"random_{options.random}", np.arange(options.frames)
        return SimulatedScene(name, drawn.scene, drawn.cameras, taken, 0.1, 100.0, *options.size)
    simulated = bench_scene(options.scene.removeprefix("bench:"), **size)
    if options.frames > simulated.frames:
        raise ValueError(
            f"simulate: {simulated.name} has {simulated.frames} frames; give --frames {simulated.frames} or fewer."
        )
    return dataclasses.replace(simulated, taken=simulated.taken[: options.frames])


def _others(simulated, time):
    """At most `OTHERS` cameras that stand elsewhere than the one that took a frame, evenly along the rig."""
    poses = simulated.rig.camera_from_world
    elsewhere = np.abs(poses - poses[simulated.taken[time]]).max((1, 2)) > 1e-6
    _, first = np.unique(poses.round(6), axis=0, return_index=True)
    cameras = np.sort(first[elsewhere[first]])
    return [int(i) for i in cameras[np.round(np.linspace(0, len(cameras) - 1, min(OTHERS, len(cameras)))).astype(int)]]
