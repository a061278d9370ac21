"""How seconds and memory grow with each size: a view's, and for the number of frames those of preparing a video.

    python experiments/benchmarks/growth.py [--preset small] [--repeats 3] [--only planes width] [--plot growth.png]

One size at a time is halved and doubled, the others stay the preset's. A guided ray has as many samples as there are
volumes' surfaces, so samples are counted with an even sampler. A JSON line for every point, then one for every size
with the exponent that fits best: 1 is in proportion, 0 does not matter. Where a part of the work does not grow with a
size, the exponent is below that of the part that does, and grows itself with the size.
"""

import argparse
import json
import os
import time
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from model import measure_view, noise_clip

from zestjax import novel_view
from zestjax.apps.memory import peak_megabytes, reset_peak
from zestjax.cameras import Camera
from zestjax.frames.selection import KeyFrames
from zestjax.systems.sampling import Even
from zestjax.train.recipes import RECIPES
from zestjax.video import Video

FACTORS = (0.5, 1, 2)
EVEN = 16  # samples of an even ray, about which they are halved and doubled
FRAMES = 12  # of the videos, about which their number is halved and doubled


def of_planes(recipe, factor):
    """The recipe with more planes of the volumes and of the frames' evidence."""
    system = recipe.system
    count = lambda n: max(2, round(factor * n))
    frames = None if system.frames is None else replace(system.frames, planes=count(system.frames.planes))
    space = replace(system.space, planes=count(system.space.planes))
    return count(system.space.planes), replace(recipe, system=replace(system, space=space, frames=frames))


def of_views(recipe, factor):
    """The recipe with more key-frames."""
    count = max(2, round(factor * recipe.system.static.frames.count))
    return count, replace(
        recipe, system=replace(recipe.system, static=replace(recipe.system.static, frames=KeyFrames(count)))
    )


def of_width(recipe, factor):
    """The recipe with wider fields."""
    width = max(1, round(factor * recipe.system.static.width))
    wide = lambda field: None if field is None else replace(field, width=width)
    system = replace(recipe.system, static=wide(recipe.system.static), dynamic=wide(recipe.system.dynamic))
    return width, replace(recipe, system=system)


def of_samples(recipe, factor):
    """The recipe with an even sampler of more samples."""
    count = round(factor * EVEN)
    return count, replace(recipe, system=replace(recipe.system, sampler=Even(count)))


def of_pixels(recipe, factor):
    """The recipe with larger pictures, of the same shape but for a rounding to cells."""
    side = lambda n: max(16, 4 * round(n * factor**0.5 / 4))
    height, width = side(recipe.height), side(recipe.width)
    return height * width, replace(recipe, height=height, width=width)


OF_A_VIEW = {"views": of_views, "planes": of_planes, "pixels": of_pixels, "samples": of_samples, "width": of_width}


def viewed(recipe, repeats):
    """Seconds and MB of a view. (XLA counts the operations of one block of its rays.)"""
    found = measure_view(recipe.system, noise_clip(recipe), repeats, 0)
    return {"seconds": found["best"], "temp_mb": found["temp_mb"], "compile": found["compile"]}


def prepared(recipe, frames, repeats):
    """Seconds and MB of preparing a video of so many frames, the best of those after the first."""
    clip = noise_clip(recipe, frames=frames)
    camera = Camera(clip.intrinsics, clip.camera_from_world)
    video = Video(clip.images, camera, clip.near, clip.far)
    params, seconds = recipe.system.init(jax.random.key(2)), []
    reset_peak()
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(novel_view.prepare(params, video, system=recipe.system).maps)
        seconds.append(time.perf_counter() - start)
    return {"seconds": min(seconds[1:]), "peak_mb": peak_megabytes(), "compile": seconds[0] - min(seconds[1:])}


def points(recipe, size, repeats):
    """[(value of the size, what was measured)]."""
    if size == "frames":
        counts = [round(factor * FRAMES) for factor in FACTORS]
        return [(count, prepared(recipe, count, repeats)) for count in counts]
    changed = [OF_A_VIEW[size](recipe, factor) for factor in FACTORS]
    return [(value, viewed(other, repeats)) for value, other in changed]


def exponents(found):
    """{quantity: exponent of the size} by least squares of the logarithms."""
    x = np.log([value for value, _ in found])
    slope = lambda name: float(np.polyfit(x, np.log([row[name] for _, row in found]), 1)[0])
    measured = [name for name, value in found[0][1].items() if name != "compile" and value is not None]
    return {name: slope(name) for name in measured}


def plot(path, table):
    """Seconds over each size, both as shares of the preset's."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for size, found in table.items():
        value, row = found[len(found) // 2]
        axes.loglog([v / value for v, _ in found], [r["seconds"] / row["seconds"] for _, r in found], "o-", label=size)
    axes.set(xlabel="size, of the preset's", ylabel="seconds, of the preset's", title="How the time grows")
    axes.legend()
    figure.savefig(path, dpi=100)


def main():
    """Measure, print, plot."""
    sizes = (*OF_A_VIEW, "frames")
    parser = argparse.ArgumentParser(description="How seconds and memory grow with each size.")
    parser.add_argument("--preset", default="small", choices=tuple(RECIPES))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="+", default=sizes, choices=sizes)
    parser.add_argument("--plot", metavar="FILE", help="write a picture of it")
    options = parser.parse_args()
    table: dict[str, Any] = {}
    rounded = lambda row: {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in row.items()}
    for size in options.only:
        table[size] = points(RECIPES[options.preset], size, options.repeats)
        for value, row in table[size]:
            print(json.dumps({"size": size, "value": value, **rounded(row), "load": os.getloadavg()[0]}), flush=True)
    for size, found in table.items():
        print(json.dumps({"size": size, "exponents": rounded(exponents(found))}), flush=True)
    if options.plot:
        plot(options.plot, table)


if __name__ == "__main__":
    main()
