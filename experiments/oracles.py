"""What the right answer to one question would be worth: weights scored with true answers in place of their own.

    python experiments/oracles.py [--weights W] [--scenes walker crowd] [--targets 2,6,10,14,18,22] [--size 144x256]

own        as it is
depth      the frames' depths of what moves are the true ones
mask       the frames' moving pixels are the true ones
both       both
blend      the picture is the dynamic field's where the target truly moves, the static field's elsewhere

Beside it, how far the frames' own answers are off: the depth of what moves and of what stands still, in shares of the
way from near to far (inverse depth), and the moving pixels' intersection over union. `flow` and `along` are the depth
of what moves by the optical flow alone: to the two neighbours, and along a point's path (`zestjax.frames.along`), where
the mean gap of 5 x 5 cells is least.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import uniform_filter

from zestjax import novel_view
from zestjax.apps.commands import numbers, size
from zestjax.apps.scenes import open_scene
from zestjax.apps.scoring import score_image
from zestjax.apps.weights import open_weights
from zestjax.frames.assembly import footage, video_evidence
from zestjax.frames.exposure import evened
from zestjax.simulate.bench import BENCH, bench_scene
from zestjax.simulate.footage import answers
from zestjax.train.batches import _cells, _half_mask

CERTAIN = 8.0  # logit of a true mask
ORDER = ("own", "depth", "mask", "both", "blend")
AROUND = 5  # cells that a gap is averaged over, as the analysis of frames does
SHARP = 0.7  # planes within which a true depth lies, the least that a frame's own may say


def true_maps(name, video, height, width):
    """(coordinates (N, h, w), moving share of the half-resolution pixels (N, 2h, 2w) and of the cells (N, h, w))."""
    simulated = bench_scene(name, height=height, width=width)
    shown = answers(simulated, list(range(simulated.frames)), [int(camera) for camera in simulated.taken])
    near, far, depth = float(video.near), float(video.far), np.maximum(np.asarray(shown.depth), 1e-6)
    coordinate = _cells(((1 / near - 1 / depth) / (1 / near - 1 / far)).astype(np.float32))
    half = _half_mask(np.asarray(shown.moving) > 0, coordinate.shape[1:])
    cells = half.reshape(len(half), coordinate.shape[1], 2, coordinate.shape[2], 2).mean((2, 4))
    return coordinate, half, cells > 0.5


def oracles(maps, coordinate, half, moving):
    """`FrameMaps` by name."""
    planes = maps.logits.shape[-1]
    peaked = -np.square((np.arange(planes) / (planes - 1) - coordinate[..., None]) * (planes - 1) / SHARP)
    picked = lambda true, own: jnp.asarray(np.where(moving, true, np.asarray(own)), jnp.float32)
    depth = maps._replace(
        logits=jnp.asarray(np.where(moving[..., None], peaked, np.asarray(maps.logits)), jnp.float32),
        coordinate=picked(coordinate, maps.coordinate), tolerance=picked(SHARP / (planes - 1), maps.tolerance),
    )  # fmt: skip
    mask = jnp.asarray(np.where(half > 0.5, CERTAIN, -CERTAIN), jnp.float32)
    return {
        "own": maps, "depth": depth, "mask": maps._replace(moving_logits=mask),
        "both": depth._replace(moving_logits=mask),
    }  # fmt: skip


def scored(model, name, options):
    """({oracle: mean PSNR full, dynamic, static}, errors of the frames' own answers) of a scene."""
    opened = open_scene(f"bench:{name}", model.recipe, size=options.size, targets=options.targets)
    video = opened.scene.video
    prepared = novel_view.prepare(model.params, video, system=model.system)
    own: Any = prepared.maps
    coordinate, half, moving = true_maps(name, video, *options.size)
    rows: dict[str, list] = {}
    for oracle, maps in oracles(own, coordinate, half, moving).items():
        for target in opened.scene.targets:
            camera = jax.tree.map(jnp.asarray, target.camera)
            view = novel_view.render_view(
                model.params, prepared._replace(maps=maps), camera, target.time, system=model.system
            )
            rows.setdefault(oracle, []).append(_psnr(view.colour, target))
            if oracle == "own":
                moves: Any = view.dynamic
                blend = np.where(np.asarray(target.dynamic)[..., None], moves, view.static)
                rows.setdefault("blend", []).append(_psnr(blend, target))
    error, by_flow = np.abs(np.asarray(own.coordinate) - coordinate), _by_flow(model, video, coordinate, moving)
    found = np.asarray(own.moving_logits) > 0
    overlap = np.sum(found & (half > 0.5)) / max(np.sum(found | (half > 0.5)), 1)
    mean = lambda x: float(x.mean()) if x.size else float("nan")
    return rows, (mean(error[moving]), mean(error[~moving]), float(overlap), *by_flow)


def _by_flow(model, video, coordinate, moving):
    """How far the depth of what moves is off by the flow to the neighbours, and along a point's path."""
    seen = footage(video.images)
    exposure = model.system.exposure and model.system.exposure(seen)
    planes = model.system.frames.planes
    found = video_evidence(evened(seen, exposure), video.cameras, video.near, video.far, planes=planes)
    for gaps in (found.moving, found.moving_along):
        around = uniform_filter(gaps.astype(np.float32), AROUND, axes=(1, 2))
        yield float(np.abs(around.argmin(-1) / (planes - 1) - coordinate)[moving].mean())


def _psnr(image, target):
    score = score_image(np.clip(np.asarray(image), 0, 1), target.image, target.dynamic)
    found: list[Any] = [score[region] for region in ("full", "dynamic", "static")]
    return [np.nan if one is None else one["psnr"] for one in found]


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description="What the right answer to one question would be worth.")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--scenes", nargs="+", default=[name for name in BENCH if name != "still_life"], choices=BENCH)
    parser.add_argument("--targets", type=numbers, default=(2, 6, 10, 14, 18, 22))
    parser.add_argument("--size", type=size, default=(144, 256))
    options = parser.parse_args()
    model, total, off = open_weights(options.weights), {}, []
    print("| scene | own | depth | mask | both | blend | depth off: moving | static | mask IoU | flow | along |")
    print("|---" * 11 + "|")
    said = lambda row: " / ".join("–" if np.isnan(x) else f"{x:.2f}" for x in row)
    for name in options.scenes:
        rows, errors = scored(model, name, options)
        means = {oracle: np.mean(found, 0) for oracle, found in rows.items()}
        for oracle, mean in means.items():
            total.setdefault(oracle, []).append(mean)
        off.append(errors)
        columns = [said(means[oracle]) for oracle in ORDER] + [f"{x:.3f}" for x in errors]
        print(f"| {name} | {' | '.join(columns)} |", flush=True)
    errors = [f"{x:.3f}" for x in np.nanmean(off, 0)]
    means = [said(np.nanmean(total[oracle], 0)) for oracle in ORDER]
    print(f"| mean | {' | '.join(means)} | {' | '.join(errors)} |")


if __name__ == "__main__":
    main()
