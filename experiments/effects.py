"""How surely are a scene's effects found? `python experiments/effects.py --out runs/effects [--count 200] [--seed 0]`.

Random simulated scenes, whose truth is exact, are inspected as a user's video would be; a line of `scenes.jsonl` each,
so that the command goes on where it was. The table then has, of each effect, how many of the scenes that have it were
given it (found, or kept on in doubt), and how many of those that lack it. Thresholds were set on 74 clips of training
and 142 scenes of 12 frames (`--frames 12`), and are checked on scenes of eight. A scene that has only a trace of an
effect counts on neither side.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.apps.cache import keep_compiled
from zestjax.effects import as_told, inspect, motion, recording, surfaces
from zestjax.effects.found import NO, UNKNOWN, YES
from zestjax.frames.exposure import Gains
from zestjax.io.files import write_bytes
from zestjax.simulate.clips import shots, take_camera, without_noise
from zestjax.simulate.random import random_scene
from zestjax.simulate.render import render
from zestjax.video import Video

SIZE = dict(height=144, width=256)
SIDES = {
    "motion": (0.0, 2e-3),  # share of the pixels that move half a pixel a frame or more
    "disocclusion": (1e-3, 5e-3),  # share of the pixels whose point the next frame hides
    "exposure": (0.04, 0.08),  # change of a channel's gain over the video
    "view_dependence": (5e-4, 5e-3),  # share of the pixels whose highlight changes by 2 % of white two frames later
    "noise": (0.004, 0.008),  # standard deviation, of white
    "thin_structures": (2e-3, 1e-2),  # share of the pixels of thin things, by exact depths
}
"""Of an effect, the truth up to which a scene lacks it, and from which it has it."""

NUMBERS = {
    "motion": ("share_moving", motion.LEAST, motion.MOST),
    "disocclusion": ("share_hidden", surfaces.HIDDEN_LEAST, surfaces.HIDDEN_MOST),
    "exposure": ("drift", Gains().least, Gains().least),
    "view_dependence": ("share_changed", surfaces.CHANGED_LEAST, surfaces.CHANGED_MOST),
    "noise": ("noise", recording.NOISY_LEAST, recording.NOISY_MOST),
    "thin_structures": ("share_thin", surfaces.THIN_LEAST, surfaces.THIN_MOST),
}
"""Of an effect, the number that decides, and its thresholds."""

_frame = jax.jit(render, static_argnames=("height", "width", "samples"))


def main():
    """Inspect scenes and write the table."""
    parser = argparse.ArgumentParser(description="detection rate and false alarms of every effect, on random scenes")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=8)
    options = parser.parse_args()
    keep_compiled()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "scenes.jsonl"
    done = read_rows(path)
    for index in range(options.count):
        if (options.seed, index) in {(row["seed"], row["index"]) for row in done}:
            continue
        row = {"seed": options.seed, "index": index, **scene_row(options.seed, index, options.frames)}
        done.append(row)
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(
            f"{index}: {row['seconds']:.1f} s, motion {row['truth']['motion']:.4f}: {told(row, 'motion')}", flush=True
        )
    rows = [row for row in done if row["seed"] == options.seed and row["index"] < options.count]
    text = table(rows)
    write_bytes(options.out / f"table-seed{options.seed}.md", text.encode())
    print(text)


def read_rows(path):
    """What earlier runs wrote; a line that a kill cut off is left out."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def scene_row(seed, index, frames):
    """The truth of a random scene, and what is found in it."""
    draw, noise = jax.random.split(jax.random.fold_in(jax.random.key(seed), index))
    drawn = random_scene(draw, frames=frames, targets=1, **SIZE)
    scene = jax.tree.map(jnp.asarray, drawn.scene)
    seen = shots(noise, scene, drawn.cameras, range(frames), **SIZE)
    video = Video(seen.image, drawn.cameras, np.float32(0.9 * seen.depth.min()), np.float32(1.1 * seen.depth.max()))
    start = time.perf_counter()
    found = inspect(video)
    seconds = time.perf_counter() - start
    return {"truth": truth_of(scene, drawn.cameras, seen), "found": as_told(found), "seconds": round(seconds, 2)}


def truth_of(scene, cameras, seen):
    """{effect: how much of it there is}; see `SIDES`."""
    focal = np.asarray(cameras.intrinsics)[:, 0, 0][:, None, None]
    moved = np.linalg.norm(seen.flow.astype(np.float32), axis=-1).max(1) * focal / seen.depth
    gains = np.log(np.asarray(scene.effects.exposure))
    return {
        "motion": float((seen.moving & (moved > 0.5)).mean()), "any_motion": float(seen.moving.mean()),
        "disocclusion": float(np.mean([hidden(cameras, seen, i) for i in range(len(focal) - 1)])),
        "exposure": float(np.expm1(np.ptp(gains, axis=0).max())),
        "view_dependence": highlights(scene, cameras, seen),
        "noise": float(scene.effects.noise),
        "thin_structures": float(np.mean([surfaces.thin(1 / depth[::2, ::2]).mean() for depth in seen.depth])),
    }  # fmt: skip


def carried(cameras, seen, i, there, *, moved=True):
    """(row, column, inside, depth), each (H, W), of where the points of frame i lie in another one; moved: as they move
    until the next frame, else as they stand."""
    height, width = seen.depth.shape[1:]
    v, u = np.mgrid[:height, :width].astype(np.float64)
    pose, other = (np.asarray(cameras.camera_from_world, np.float64)[k] for k in (i, there))
    k, k_there = (np.asarray(cameras.intrinsics, np.float64)[j] for j in (i, there))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(k).T
    world = (rays * seen.depth[i][..., None] - pose[:3, 3]) @ pose[:3, :3]
    world = world + seen.flow[i, 0] if moved else world
    point = (world @ other[:3, :3].T + other[:3, 3]) @ k_there.T
    column, row = (np.round(point[..., j] / np.maximum(point[..., 2], 1e-6)).astype(int) for j in (0, 1))
    inside = (point[..., 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1), inside, point[..., 2]


def hidden(cameras, seen, i):
    """Share of the pixels of frame i whose points lie within the next one and are hidden there."""
    row, column, inside, depth = carried(cameras, seen, i, i + 1)
    return float((inside & (depth > 1.03 * seen.depth[i + 1][row, column])).mean())


def highlights(scene, cameras, seen):
    """Share of the pixels whose highlight differs by 2 % of white or more in the frame after the next, of two frames;
    of what both see and what stands still."""
    if not float(scene.effects.specular):
        return 0.0
    clean = without_noise(scene)
    dull = clean._replace(effects=clean.effects._replace(specular=jnp.zeros(())))

    def gloss(i):
        shown = [_frame(x, take_camera(cameras, i), jnp.float32(i), samples=1, **SIZE).image for x in (clean, dull)]
        return np.asarray((shown[0] - shown[1]).mean(-1))

    shares = []
    for i in (1, len(seen.image) - 4):
        row, column, inside, depth = carried(cameras, seen, i, i + 2, moved=False)
        same = inside & (np.abs(depth / seen.depth[i + 2][row, column] - 1) < 0.03) & ~seen.moving[i]
        shares.append(float((same & (np.abs(gloss(i) - gloss(i + 2)[row, column]) > 0.02)).mean()))
    return float(np.mean(shares))


def table(rows):
    """Markdown: of every effect the scenes that have it and lack it, and how often each side was told what."""
    lines = [f"{len(rows)} scenes, {np.mean([row['seconds'] for row in rows]):.1f} s each", ""]
    lines += [
        "| effect | have it | kept on | told yes | lack it | kept on | told yes |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (lacks, has) in SIDES.items():
        cells = []
        for side in (lambda x, has=has: x >= has, lambda x, lacks=lacks: x <= lacks):
            verdicts = [told(row, name) for row in rows if side(truth(row, name))]
            share = lambda test, verdicts=verdicts: f"{np.mean([test(v) for v in verdicts]):.0%}" if verdicts else "–"
            cells += [str(len(verdicts)), share(lambda v: v != NO), share(lambda v: v == YES)]
        lines.append("| " + " | ".join([name.replace("_", " "), *cells]) + " |")
    return "\n".join(lines) + "\n"


def told(row, name):
    """What today's thresholds make of the numbers of a row: another threshold needs no new scenes."""
    number, least, most = NUMBERS[name]
    evidence = row["found"][name]["evidence"]
    value = evidence.get(number)
    if value is None or (name == "motion" and value < most and evidence["share_told"] < motion.FEWEST_TOLD):
        return UNKNOWN
    return NO if value < least else YES if value >= most else UNKNOWN


def truth(row, name):
    """How much of an effect a scene has; nothing moves only where not a single pixel does."""
    value = row["truth"][name]
    return max(value, 1e-9) if name == "motion" and row["truth"]["any_motion"] > 0 else value


if __name__ == "__main__":
    main()
