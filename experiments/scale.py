"""What the paper's whole study would cost: nine folds of four systems at full size, on this machine and on GPUs.

    python experiments/scale.py [--step-seconds zest=54] [--tflops 67] [--share 0.1 0.3]

A step's operations are read off the program as it is lowered, uncompiled; XLA counts a loop's body once, and rays are
computed in blocks, so they are too few, and a GPU's days with them. Seconds on this machine are those given by
`--step-seconds` (`experiments/benchmarks/model.py --preset paper --system NAME` measures them), else operations over
the rate that the given ones reach. A GPU's are operations over `--share` of its peak: what `small` reaches of a CPU's
(0.07 to 0.23) is the only measurement there is, so a range is given. No GPU was at hand: those columns are arithmetic.
"""

import argparse

import jax
from benchmarks.model import noise_clip  # type: ignore[import-not-found]

from zestjax.train import batches
from zestjax.train.recipes import recipe_of

SYSTEMS = ("zest", "mvsnerf", "svs", "nsff")
FOLDS = 9
STEPS = 1_170_000  # of a fold: 6,000 epochs of the eight other scenes' frames, as released
TUNING = 9_600  # of a scene: 400 epochs of its 24 frames, as released
DAY = 86_400


def operations(system):
    """Floating-point operations of one training step of the `paper` preset."""
    recipe = recipe_of("paper", system=system)
    recipe = recipe.of(recipe.system)
    init, step = recipe.trainer(steps=STEPS)
    prepared = batches.prepare_clip(jax.random.key(0), noise_clip(recipe), recipe.system)
    batch = batches.batch_from_clip(jax.random.key(1), prepared, recipe)
    params = jax.eval_shape(recipe.init, jax.random.key(2))
    lowered = jax.jit(step).lower(params, jax.eval_shape(init, params), batch)
    return float((lowered.cost_analysis() or {})["flops"])


def days(seconds):
    """Seconds as text."""
    return f"{seconds / DAY:,.1f} days" if seconds < 1000 * DAY else f"{seconds / DAY / 365.25:,.0f} years"


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description="What the paper's whole study would cost.")
    parser.add_argument("--step-seconds", nargs="+", default=["zest=54"], metavar="NAME=S", help="measured here")
    parser.add_argument("--tflops", type=float, default=67.0, help="peak of a GPU, float32 (H100 SXM's data sheet)")
    parser.add_argument("--share", nargs=2, type=float, default=(0.1, 0.3), help="of it that is reached")
    options = parser.parse_args()
    known = {name: float(seconds) for name, seconds in (given.split("=") for given in options.step_seconds)}
    each = {system: operations(system) for system in SYSTEMS}
    rate = sum(each[name] for name in known) / sum(known.values())
    here = {system: known.get(system, count / rate) for system, count in each.items()}
    print("| system | GFLOP a step | s a step here | all folds here | one GPU | eight GPUs |\n" + "|---" * 6 + "|")
    for system, count in each.items():
        print(f"| {system} | {count / 1e9:,.0f} | {here[system]:.0f} | {row(here[system], count, options)} |")
    print(f"| all four | | | {row(sum(here.values()), sum(each.values()), options)} |")


def row(seconds, count, options):
    """The last three cells, of the seconds and operations of a step."""
    steps = FOLDS * (STEPS + TUNING)
    on_gpu = [count / (1e12 * options.tflops * share) for share in options.share[::-1]]
    spans = [" to ".join(days(s * steps / gpus) for s in on_gpu) for gpus in (1, 8)]
    return " | ".join([days(seconds * steps), *spans])


if __name__ == "__main__":
    main()
