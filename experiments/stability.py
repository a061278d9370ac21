"""2,000 training steps of `tiny` over random scenes, the nasty ones among them: nothing may cease to be finite.

    python experiments/stability.py --out runs/stability [--steps 2000] [--losses paper] [--system svs]

Each kind of scene is drawn several times; a step learns from one of them in turn. The exit code is 1 if a step was
skipped, or a loss or a parameter is not finite. Writes `stability.json`: losses by kind of scene, and the seconds.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

from zestjax.apps.progress import progress
from zestjax.apps.results import write_record
from zestjax.base.trees import first_nonfinite
from zestjax.losses.objective import PAPER_WEIGHTS
from zestjax.simulate.clips import clip
from zestjax.simulate.random import random_scene
from zestjax.train import batches
from zestjax.train.learn import SIMULATED_WEIGHTS
from zestjax.train.recipes import SYSTEMS, recipe_of
from zestjax.train.training import scalars

GREY = np.uint32(0x80808080)
LOSSES = {"simulated": SIMULATED_WEIGHTS, "paper": PAPER_WEIGHTS}


def of_bodies(drawn, change):
    """The drawn scene with the `Bodies` of both kinds changed."""
    scene = drawn.scene
    return drawn._replace(scene=scene._replace(boxes=change(scene.boxes), balls=change(scene.balls)))


def moving(drawn, factor):
    """Every motion times a factor."""

    def change(bodies):
        parts = ("velocity", "sway", "spin", "swing", "strain")
        scaled = {name: np.asarray(getattr(bodies.motion, name)) * np.float32(factor) for name in parts}
        return bodies._replace(motion=bodies.motion._replace(**scaled))

    return of_bodies(drawn, change)


def all_moving(drawn):
    """Every body that hangs in the world sways, the room too."""

    def change(bodies):
        motion = bodies.motion
        size = np.abs(np.asarray(bodies.shape)[:, :3, :3]).max((1, 2))[:, None]
        sway = np.where(np.asarray(motion.parent)[:, None] < 0, np.array([0.03, 0, 0.02], np.float32) * size, 0)
        rate = np.where(np.asarray(motion.rate) == 0, np.float32(0.4), motion.rate)
        return bodies._replace(motion=motion._replace(sway=motion.sway + sway, rate=rate))

    return of_bodies(drawn, change)


def still_camera(drawn, step=0.0):
    """All frames from the first one's camera, moved by `step` world units a frame."""
    count = len(drawn.cameras.intrinsics)
    intrinsics, poses = (np.repeat(np.asarray(leaf)[:1], count, 0) for leaf in drawn.cameras)
    poses[:, 0, 3] += np.arange(count, dtype=np.float32) * np.float32(step)
    return drawn._replace(cameras=drawn.cameras._replace(intrinsics=intrinsics, camera_from_world=poses))


def lit(drawn, gain):
    """The scene's exposure times a gain."""
    effects = drawn.scene.effects
    return drawn._replace(scene=drawn.scene._replace(effects=effects._replace(exposure=effects.exposure * gain)))


KINDS = {
    "as drawn": lambda drawn: drawn,
    "a camera that stands still": still_camera,
    "nothing moves": lambda drawn: moving(drawn, 0),
    "everything moves": all_moving,
    "no texture": lambda d: d._replace(scene=d.scene._replace(atlas=np.full_like(d.scene.atlas, GREY))),
    "near-duplicate frames": lambda drawn: still_camera(moving(drawn, 1e-4), 1e-5),
    "nothing moves, nor the camera": lambda drawn: still_camera(moving(drawn, 0)),
    "black": lambda drawn: lit(drawn, np.float32(0)),
    "saturated": lambda drawn: lit(drawn, np.float32(1e3)),
}
"""What makes a scene nasty, as a change of a `RandomScene`."""


def prepared_clips(recipe, options):
    """[(kind, `PreparedClip`)] of every kind in turn."""
    size, found = dict(height=recipe.height, width=recipe.width), []
    for index in progress(range(options.scenes), "scenes", quiet=options.quiet):
        key = jax.random.fold_in(jax.random.key(options.seed), index)
        drawn = random_scene(key, frames=8, targets=4, **size)
        for name, change in KINDS.items():
            taken = clip(key, change(drawn), **size, slack=(0.1, 0.1))
            found.append((name, batches.prepare_clip(key, taken, recipe.system)))
    return found


def trained(recipe, clips, options):
    """The last parameters, how many steps were skipped, the losses of each kind, and the seconds of a step."""
    init, step = recipe.trainer(steps=options.steps)
    step, params = jax.jit(step, donate_argnums=(0, 1)), recipe.init(jax.random.key(options.seed))
    state, losses, seconds = init(params), {name: [] for name in KINDS}, []
    for number in progress(range(options.steps), "steps", quiet=options.quiet):
        kind, prepared = clips[number % len(clips)]
        batch = batches.batch_from_clip(jax.random.key(number), prepared, recipe)
        start = time.perf_counter()
        params, state, terms = step(params, state, batch)
        losses[kind].append(scalars(terms) | {"step": number})
        seconds.append(time.perf_counter() - start)
    return params, int(state.skipped), losses, float(np.median(seconds))


def by_fifths(losses, steps):
    """Each term's mean over every fifth of the run, over all scenes."""
    rows = sorted((row for rows in losses.values() for row in rows), key=lambda row: row["step"])
    fifths = [rows[steps * i // 5 : steps * (i + 1) // 5] for i in range(5)]
    mean = lambda part, name: round(float(np.mean([row[name] for row in part])), 4)
    return {name: [mean(part, name) for part in fifths if part] for name in rows[0] if name != "step"}


def stability(options):
    """Run it; the report, whose `finite` says whether everything was."""
    recipe = recipe_of("tiny", system=options.system, precision=options.precision)
    recipe = recipe.weighted(LOSSES[options.losses]) if options.system == "zest" else recipe.of(recipe.system)
    params, skipped, losses, seconds = trained(recipe, prepared_clips(recipe, options), options)
    totals = {kind: np.array([row["total"] for row in rows]) for kind, rows in losses.items()}
    finite = all(np.isfinite(list(row.values())).all() for rows in losses.values() for row in rows)
    lost = first_nonfinite(params)
    report = {
        "steps": options.steps, "system": options.system, "losses": options.losses,
        "precision": options.precision, "skipped": skipped,
        "finite": finite and lost is None and skipped == 0, "first_nonfinite_parameter": lost,
        "seconds_per_step": seconds, "terms": by_fifths(losses, options.steps),
        "kinds": {k: {"steps": len(t), "first": float(t[: len(t) // 4].mean()), "last": float(t[-len(t) // 4 :].mean()),
                      "greatest": float(t.max())} for k, t in totals.items() if len(t)},
    }  # fmt: skip
    write_record(Path(options.out) / "stability.json", report)
    return report


def parsed(arguments=None):
    """The command's options."""
    parser = argparse.ArgumentParser(description="Training steps over nasty scenes; nothing may cease to be finite.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--system", choices=SYSTEMS, default="zest")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--scenes", type=int, default=6, help="drawn of each kind")
    parser.add_argument("--losses", choices=tuple(LOSSES), default="simulated")
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args(arguments)


def main():
    """Run it and print the report."""
    report = stability(parsed())
    print(json.dumps(report, indent=1))
    return 0 if report["finite"] else 1


if __name__ == "__main__":
    sys.exit(main())
