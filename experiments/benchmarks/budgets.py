"""Budgets, told and taken: frames of one scene by the shipped weights within so many seconds each.

    python experiments/benchmarks/budgets.py [--scene walker] [--budgets 0.1 0.3 1 3 10] [--frames 8]
        [--processor]

A JSON line for each budget: the setting in force at the end, the median seconds of the frames after the second (which
corrects the setting) and their share of the budget. With `--processor` seconds are the processor's own, for which the
budget is kept, too: on one core, what else it does is no part of them.
"""

import argparse
import json
import os
import time

import numpy as np

from zestjax.apps import evaluate
from zestjax.apps.budget import Budget
from zestjax.apps.cache import keep_compiled
from zestjax.apps.paths import camera_path
from zestjax.apps.render import render_path
from zestjax.apps.scenes import open_scene
from zestjax.apps.weights import open_weights
from zestjax.simulate.bench import BENCH


def timed_by_processor(function):
    """As `evaluate.timed`: (result, seconds)."""
    start = time.process_time()
    result = function()
    return result, time.process_time() - start


def line(model, scene, seconds, frames):
    """What a budget was told and what it took."""
    path = camera_path("orbit", scene.video, count=frames)
    views, timing = render_path(model, scene, path, budget=Budget(frame_seconds=seconds), quiet=True)
    spent = [each for _, each in views]
    told, median = timing(spent[2:])["budget"], float(np.median(spent[2:]))
    found = {"what": f"budget {seconds:g} s", "setting": told["setting"], "seconds": median, "share": median / seconds}
    return found | {"fits": told["fits"], "calibration_s": told["calibration_seconds"], "said": told["said"]}


def main():
    """Print a line for each budget."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="walker", choices=BENCH)
    parser.add_argument("--budgets", nargs="+", type=float, default=[0.1, 0.3, 1.0, 3.0, 10.0], metavar="SECONDS")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--processor", action="store_true", help="seconds are the processor's own")
    options = parser.parse_args()
    if options.processor:
        evaluate.timed = timed_by_processor
    keep_compiled()
    model = open_weights()
    scene = open_scene(f"bench:{options.scene}", model.recipe, protocol=None).scene
    for seconds in options.budgets:
        found = line(model, scene, seconds, options.frames) | {"load": os.getloadavg()[0]}
        print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in found.items()}), flush=True)


if __name__ == "__main__":
    main()
