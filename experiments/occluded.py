"""Where an adversary helps: weights compared by how many input frames see a pixel's surface.

    python experiments/occluded.py WEIGHTS WEIGHTS... [--scenes walker lattice] [--targets 6,16] [--size 72x128]

PSNR, and `detail`: the mean slope of the rendered picture over the true one's, 1 where it is as sharp. What no frame
sees has to be made up: a mean picture is best there for PSNR, an adversary asks for detail.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from zestjax import novel_view
from zestjax.apps.commands import numbers, size
from zestjax.apps.scenes import open_scene
from zestjax.apps.weights import open_weights
from zestjax.simulate.bench import BENCH

REGIONS = {"no frame": (0, 0), "1 to 4": (1, 4), "5 and more": (5, 10**6)}
"""By name: least and most frames that see a pixel's surface."""


def slopes(image):
    """(H, W) mean absolute difference to the pixels below and to the right."""
    image = np.asarray(image, np.float64)
    down = np.abs(np.diff(image, axis=0, append=image[-1:]))
    right = np.abs(np.diff(image, axis=1, append=image[:, -1:]))
    return (down + right).mean(-1)


def measured(model, options):
    """{region: sums of (pixels, squared error, slope, true slope)} over all targets."""
    sums = {name: np.zeros(4) for name in REGIONS}
    for name in options.scenes:
        opened = open_scene(f"bench:{name}", model.recipe, size=options.size, targets=options.targets)
        video = jax.tree.map(jax.numpy.asarray, opened.scene.video)
        assert opened.ceiling is not None  # of zest-bench, held out
        prepared = novel_view.prepare(model.params, video, system=model.system)
        for target in opened.scene.targets:
            camera = jax.tree.map(jax.numpy.asarray, target.camera)
            view = novel_view.render_view(model.params, prepared, camera, target.time, system=model.system)
            image, views = np.clip(np.asarray(view.colour), 0, 1), np.asarray(opened.ceiling(target).views)
            error = ((image - target.image) ** 2).mean(-1)
            for region, (least, most) in REGIONS.items():
                inside = (least <= views) & (views <= most)
                maps = (inside, error * inside, slopes(image) * inside, slopes(target.image) * inside)
                sums[region] += [float(x.sum()) for x in maps]
    return sums


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description="Scores by how many input frames see a pixel's surface.")
    parser.add_argument("weights", nargs="+", type=Path)
    parser.add_argument("--scenes", nargs="+", default=list(BENCH), choices=BENCH)
    parser.add_argument("--targets", type=numbers, default=(6, 16))
    parser.add_argument("--size", type=size, default=(72, 128))
    options = parser.parse_args()
    print("| weights | seen by | share | PSNR | detail |\n|---|---|---|---|---|")
    for path in options.weights:
        model = open_weights(path)
        terms = ", ".join(name for name, _ in model.recipe.weights.terms)
        sums = measured(model, options)
        pixels = sum(count for count, *_ in sums.values())
        for region, (count, error, slope, true_slope) in sums.items():
            psnr = -10 * np.log10(error / max(count, 1)) if error else float("nan")
            said = f"{count / pixels:.1%} | {psnr:.2f} | {slope / max(true_slope, 1e-9):.2f}"
            print(f"| {path} ({model.name}: {terms}) | {region} | {said} |", flush=True)


if __name__ == "__main__":
    main()
