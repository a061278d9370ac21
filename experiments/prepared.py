"""How well `zestjax prepare` finds what the simulator knows: cameras, flow, what moves, depth, and the price in dB.

    python experiments/prepared.py --out runs/prepared [--scenes walker crowd] [--random 1 2] [--targets 5,10,17]
                                   [--size 144x256] [--no-scores]

Each scene's input video is written as pictures, prepared from them alone, and compared with the exact answers once its
poses are aligned by a similarity. Scores are of the `strict` protocol, each frame predicted without itself, with the
true cameras and with the estimated ones. `--folder F` prepares a scene that has cameras, and compares with those.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

from zestjax.apps.commands import natural, numbers, size
from zestjax.apps.evaluate import EvaluateOptions, evaluate
from zestjax.apps.prepare import PrepareOptions, prepare
from zestjax.apps.simulate import SimulateOptions
from zestjax.apps.simulate import _scene as simulated_scene
from zestjax.io.nsff import read_nsff, write_nsff
from zestjax.io.pictures import read_mask
from zestjax.io.reading import read_array, read_arrays, read_json
from zestjax.io.scenes import load_scene
from zestjax.sfm.gauge import align_poses, pose_errors
from zestjax.simulate.bench import BENCH
from zestjax.simulate.footage import answers, input_video

HEAD = ("scene", "frames", "degrees", "most", "% of path", "most", "focal %", "+-", "flow px", "mask IoU", "depth", "s",
        "dB true", "dB estimated")  # fmt: skip


def written_truth(out, options):
    """A simulated scene's frames with its true cameras in the NSFF layout, and its `Answers`."""
    simulated = simulated_scene(options)
    shown = answers(simulated, range(simulated.frames), simulated.taken)
    bounds = np.float32(0.95 * shown.depth.min()), np.float32(1.05 * shown.depth.max())
    near, far = (simulated.near, simulated.far) if options.random is None else bounds
    video = jax.tree.map(np.asarray, input_video(simulated))._replace(near=near, far=far)
    write_nsff(out, simulated.name, video, motion_masks=shown.moving)
    return shown


def compared(folder, true_poses, true_focal):
    """{column: value} of a prepared scene's cameras against true ones; `true_poses`: (N, 4, 4) world_from_camera."""
    record, quality = read_nsff(folder), read_json(folder / "quality.json")
    poses = np.linalg.inv(np.asarray(record.cameras.camera_from_world, np.float64))
    error = pose_errors(poses, true_poses)
    found = float(record.cameras.intrinsics[0, 0, 0])
    return {
        "frames": f"{len(poses)}/{quality['frames']['chosen']}",
        "degrees": error.degrees.mean(), "most": error.degrees.max(), "% of path": 100 * error.share.mean(),
        "most ": 100 * error.share.max(), "focal %": 100 * (found / true_focal - 1),
        "+-": 100 * (quality["focal"]["relative_error"] or 0), "doubts": [d["what"] for d in quality["doubts"]],
    }  # fmt: skip


def of_maps(folder, shown, frames, true_poses):
    """Flow error where the next frame sees the point, overlap of masks, median relative error of depth, aligned."""
    record = read_nsff(folder)
    poses = np.linalg.inv(np.asarray(record.cameras.camera_from_world, np.float64))
    scale = align_poses(poses, true_poses).scale
    both, either, flow, depth = 0, 0, [], []
    for i, frame in enumerate(frames):
        mask = read_mask(record.motion_masks[i])
        both, either = both + (mask & shown.moving[frame]).sum(), either + (mask | shown.moving[frame]).sum()
        if i + 1 < len(frames) and frames[i + 1] == frame + 1:
            there = read_arrays(record.flow_forward[i])["flow"]
            gap = np.linalg.norm(there - shown.flow[frame, 0], axis=-1)
            flow.append(gap[shown.visible[frame, 0]].mean())
        if i in record.disparity:
            found = scale / read_array(record.disparity[i])
            depth.append(np.median(np.abs(found / shown.depth[frame] - 1)))
    return {
        "flow px": np.mean(flow), "mask IoU": both / either if either else None,
        "depth": np.mean(depth) if depth else None,
    }  # fmt: skip


def strict_psnr(folder, out, targets):
    """Mean PSNR of the `strict` protocol."""
    evaluate(
        EvaluateOptions(str(folder), out, protocol="strict", targets=targets, pictures=False, effects="all", quiet=True)
    )
    return read_json(out / "metrics.json")["mean"]["full"]["psnr"]


def of_simulated(out, options, targets):
    """A row: prepared, compared, and scored at `targets` unless they are None."""
    shown = written_truth(out / "true", options)
    start = time.monotonic()
    prepare(PrepareOptions(out / "true/images", out / "prepared", frames=len(shown.images), quiet=True))
    seconds = time.monotonic() - start
    sources = read_json(out / "prepared/quality.json")["frames"]["sources"]
    frames = [int(Path(name).stem) for name in sources]
    poses = np.linalg.inv(np.asarray(shown.cameras.camera_from_world, np.float64))[frames]
    row = compared(out / "prepared", poses, float(shown.cameras.intrinsics[0, 0, 0]))
    row |= of_maps(out / "prepared", shown, frames, poses) | {"s": seconds}
    if targets is not None and len(frames) == len(shown.images):
        row |= {"dB true": strict_psnr(out / "true", out / "scored_true", targets)}
        row |= {"dB estimated": strict_psnr(out / "prepared", out / "scored_prepared", targets)}
    return row


def of_folder(out, folder, count):
    """A row of a scene that has cameras."""
    scene = load_scene(folder, height=288)
    images = [Path(path) for path in sorted((Path(folder) / "images").iterdir())]
    start = time.monotonic()
    prepare(PrepareOptions(images[0].parent, out / "prepared", frames=count, quiet=True))
    seconds = time.monotonic() - start
    names = [path.name for path in images]
    index = [names.index(name) for name in read_json(out / "prepared/quality.json")["frames"]["sources"]]
    cameras, height = scene.video.cameras, read_nsff(out / "prepared").size[0]
    poses = np.linalg.inv(np.asarray(cameras.camera_from_world, np.float64))[index]
    focal = float(cameras.intrinsics[0, 0, 0]) * height / scene.video.images.shape[1]
    return compared(out / "prepared", poses, focal) | {"s": seconds}


def shown_row(name, row):
    """A row of the table."""
    text = lambda value: "-" if value is None else value if isinstance(value, str) else f"{value:.3g}"
    keys = [*HEAD[1:3], "most", "% of path", "most ", *HEAD[6:]]
    cells = [f"{row[key]:.2f}" if key[:2] == "dB" and key in row else text(row.get(key)) for key in keys]
    return "| " + " | ".join([name, *cells]) + f" | {', '.join(row['doubts'])}"


def main():
    """Print a table as its rows come, and write them to `rows.json`."""
    parser = argparse.ArgumentParser(description="What `zestjax prepare` finds, against exact answers.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=list(BENCH), choices=BENCH)
    parser.add_argument("--random", nargs="*", type=natural, default=())
    parser.add_argument("--folder", help="a scene with cameras")
    parser.add_argument("--frames", type=natural, default=24, help="of the folder")
    parser.add_argument("--targets", type=numbers, default=(5, 10, 17))
    parser.add_argument("--size", type=size, default=(144, 256))
    parser.add_argument("--no-scores", dest="scores", action="store_false")
    options = parser.parse_args()
    rows = {}
    print("| " + " | ".join(HEAD) + " | in doubt\n" + "|---" * (len(HEAD) + 1) + "|", flush=True)
    asked = [(name, dict(scene=name)) for name in options.scenes]
    asked += [(f"random {key}", dict(random=key)) for key in options.random]
    targets = options.targets if options.scores else None
    for name, which in asked:
        place = options.out / name.replace(" ", "_")
        rows[name] = of_simulated(place, SimulateOptions(place, size=options.size, **which), targets)
        print(shown_row(name, rows[name]), flush=True)
    if options.folder:
        rows[options.folder] = of_folder(options.out / "folder", options.folder, options.frames)
        print(shown_row(Path(options.folder).name, rows[options.folder]), flush=True)
    (options.out / "rows.json").write_text(json.dumps(rows, indent=1, default=float))


if __name__ == "__main__":
    main()
