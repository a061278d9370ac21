"""Undo one guard of the numeric core at a time and show that a test fails: `python experiments/mutations.py`.

Each mutation is one replacement in a copy of the package; the tests of that module and the hard cases then run until
the first failure. Printed for each: killed, and by which test; or SURVIVED, which makes the exit code 1.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
MUTATIONS = {
    "base/numerics": [
        ("jnp.sqrt(jnp.where(positive, x, 1))", "jnp.sqrt(x)"),
        ("_quotient(numerator, jnp.where(zero, 1, denominator))", "_quotient(numerator, denominator)"),
        ("(tangents[0] - quotient * tangents[1]) / primals[1]",
         "tangents[0] / primals[1] - primals[0] * tangents[1] / primals[1] ** 2"),
        ("jnp.sum(jnp.where(mask > 0, x, 0) * mask)", "jnp.sum(x * mask)"),
        ("/ jnp.where(count > 0, count, 1)", "/ count"),
        ("jnp.concatenate([zero, jnp.cumsum(x[..., :-1], axis=-1)], axis=-1)", "jnp.cumsum(x, axis=-1) - x"),
    ],
    "cameras": [("/ jnp.where(in_front, depth, 1)[..., None]", "/ depth[..., None]")],
    "rendering": [
        ("return -jnp.expm1(-thickness)", "return (1 - jnp.exp(-thickness))"),
        ("return -jnp.expm1(-jnp.multiply(*jnp.broadcast_arrays(density, lengths)))",
         "return 1 - jnp.exp(-jnp.multiply(*jnp.broadcast_arrays(density, lengths)))"),
        ("exclusive_cumprod((1 - static) * (1 - dynamic))",
         "jnp.exp(exclusive_cumsum(jnp.log((1 - static) * (1 - dynamic))))"),
        ("jax.lax.stop_gradient(weights) if hold_weights else weights", "weights"),
    ],
    "depth": [
        ("(total + EMPTY * depths[..., -1]) / (opacity + EMPTY)", "total / opacity"),
        ("jnp.where(half[..., 0] > EMPTY / 2, jnp.argmax(reached >= half, axis=-1), depths.shape[-1] - 1)",
         "jnp.argmax(reached >= half, axis=-1)"),
        ("return 1 / jnp.maximum(depth, nearest)", "return 1 / depth"),
        ("return jnp.where(count > 0, found, 0)", "return found"),
        ("spread = jnp.maximum(spread, least)", "spread = spread"),
        ("jnp.where(mask > 0, values - centre[..., None], 0)", "(values - centre[..., None])"),
        ("unit = jnp.where(varied, unit, 1)", "unit = unit"),
    ],
    "flow": [
        ("/ jnp.maximum(jnp.sum(weights, axis=-1), EMPTY)[..., None]", "/ jnp.sum(weights, axis=-1)[..., None]"),
        ("jnp.where(visible[..., None], seen.pixels, pixels)", "seen.pixels"),
    ],
    "planesweep": [
        ("safe = jnp.where(in_front, share, 1)", "safe = share"),
        ("jnp.where(in_front, u, outside)", "u"),
    ],
    "resample": [
        ("lower = jnp.where(floor >= 0, jnp.minimum(floor, max(size - 2, 0)), 0)",
         "lower = jnp.minimum(floor, max(size - 2, 0))"),
        ("values = jnp.where(cells.inside[..., None], values, 0)", "values = values"),
        ("_cells(jnp.where(cells.inside, u, 0), jnp.where(cells.inside, v, 0), height, width)",
         "_cells(u, v, height, width)"),
        ("if border == \"zero\":\n        cells = jnp.where(inside[..., None], cells, 0)", "if False:\n        pass"),
        ("return jnp.where(inside[..., None], values, 0) if border == \"zero\" else values", "return values"),
    ],
    "frames/trust": [
        ("tolerance = jnp.maximum(tolerance, NARROWEST)", "tolerance = tolerance"),
        ("return jnp.where(far, FARTHEST, distance / jnp.where(far, 1, tolerance))", "return distance / tolerance"),
    ],
    "frustum": [
        ("jnp.maximum(depth, NEAREST * near)", "depth"),
        ("jnp.maximum(1 / near - z * (1 / near - 1 / far), NEAREST / far)", "(1 / near - z * (1 / near - 1 / far))"),
        ("return jnp.maximum(jnp.asarray(size) - 1, 1)", "return jnp.asarray(size) - 1"),
    ],
    "cost_volume/plane_statistics": [
        ("point = 1 / jnp.where(seen, placed.share * depth[:, None, None], 1)",
         "point = 1 / (placed.share * depth[:, None, None])"),
        ("share = weight / jnp.where(count > 0, count, 1)", "share = weight / count"),
        ("variance = spread / jnp.where(count > 0, count, 1)[..., None]", "variance = spread / count[..., None]"),
    ],
    "losses/means": [
        ("cost = jnp.where(mask > 0, residual, 0)", "cost = residual * mask"),
        ("confidence = jnp.where(mask > 0, confidence, 0)", "confidence = confidence * mask"),
    ],
    "losses/regularisers": [
        ("jnp.log(jnp.maximum(b, LEAST))", "jnp.log(b)"),
    ],
    "losses/supervision": [("jnp.where(share > 0, log_probability, 0)", "log_probability")],
    "metrics": [
        ("jnp.maximum(error, 10 ** (-PSNR_CAP / 10))", "error"),
        ("jnp.abs(depth - jnp.where(known, truth, 1)) / jnp.where(known, truth, 1)", "jnp.abs(depth - truth) / truth"),
        ("flow - jnp.where(known[..., None], truth, 0)", "flow - truth"),
    ],
    "adam": [
        ("safe_sqrt(debiased(square, b2))", "jnp.sqrt(debiased(square, b2))"),
        ("keep = lambda new, old: jnp.where(good, new, old)", "keep = lambda new, old: new"),
        ("clip_norm / jnp.maximum(norm, clip_norm)", "clip_norm / norm"),
    ],
    "nets/layers": [("(x - mean) * (rate", "(x) * (rate"), ("lax.rsqrt(_mean(jnp.square(x - mean)) + epsilon)",
                     "lax.rsqrt(_mean(jnp.square(x - mean)))")],
    "fields/conditioning": [
        ("jnp.where(seen, values[:, 5], 1)", "values[:, 5]"),
        ("1 / jnp.where(seen, depth, 1)", "1 / depth"),
        ("jnp.where(front & front_beyond, shift, 200.0)", "shift"),
        ("1 / jnp.where(front, depth, 1)", "1 / depth"),
    ],
    "fields/trunk": [("mean / jnp.maximum(total, 1e-9)[None]", "mean / total[None]")],
}  # fmt: skip
"""Module: (guard, what stands in its place)."""

TESTS = {
    "cost_volume/plane_statistics": ["cost_volume", "trust"], "losses/means": ["losses"],
    "losses/regularisers": ["losses"], "losses/supervision": ["losses"], "adam": ["solve"],
    "nets/layers": ["nets_layers"],
    "fields/conditioning": ["fields"], "fields/trunk": ["fields"],
}  # fmt: skip


def main():
    """Run the mutations whose module or guard matches the pattern."""
    parser = argparse.ArgumentParser(description="undo one guard at a time; some test must fail")
    parser.add_argument("--only", default="", help="regular expression on `module: guard`")
    only, survived = re.compile(parser.parse_args().only), []
    chosen = [(m, *pair) for m, pairs in MUTATIONS.items() for pair in pairs if only.search(f"{m}: {pair[0]}")]
    with tempfile.TemporaryDirectory() as folder:
        for part in ("zestjax", "tests", "pyproject.toml"):
            copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
            copy(ROOT / part, Path(folder) / part)
        for number, (module, guard, instead) in enumerate(chosen, 1):
            start, killer = time.perf_counter(), killed_by(Path(folder), module, guard, instead)
            survived += [] if killer else [f"{module}: {guard}"]
            verdict = f"killed by {killer}" if killer else "SURVIVED"
            took = time.perf_counter() - start
            print(f"[{number}/{len(chosen)}] {module}: {guard[:60]}  {verdict}  {took:.0f} s", flush=True)
    print(f"mutations: {len(chosen)}, survived: {len(survived)}", *survived, sep="\n  ")
    return 1 if survived else 0


def killed_by(folder, module, guard, instead):
    """The test that fails with a guard undone, or None."""
    path = folder / "zestjax" / f"{module}.py"
    source = path.read_text()
    if guard not in source:
        raise SystemExit(f"mutations: `{guard}` is no longer in {module}.py; bring the list up to date.")
    path.write_text(source.replace(guard, instead))
    files = [f"tests/test_{name}.py" for name in (*TESTS.get(module, [module.rsplit("/")[-1]]), "hard_cases")]
    flags = "--xla_backend_optimization_level=1"
    environment = os.environ | {"PYTHONPATH": str(folder), "XLA_FLAGS": flags, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    path.write_text(source)
    if done.returncode == 0:
        return None
    found = re.search(r"^(?:FAILED|ERROR) (?:tests/)?(\S+)", done.stdout, re.MULTILINE)
    return found[1] if found else f"exit code {done.returncode}"


if __name__ == "__main__":
    sys.exit(main())
