"""`zestjax` with a training and a scoring of no cost, for the tests of what is around them.

    python crossval_stub.py ARGUMENTS...

A fold's training sleeps, step by step, and resumes at the step that it saved; what it does is told by the
environment: STUB_SECONDS (a step), STUB_FAILS (name of a scene that fails), STUB_KILLS (one at whose third step the
process is killed, once), STUB_FULL (one at which the disk is full).
"""

import errno
import json
import os
import signal
import sys
import time
from types import SimpleNamespace

import jax
import numpy as np

from zestjax.apps import evaluate, launchers, train
from zestjax.apps.cli import main
from zestjax.base.parts import to_stored
from zestjax.io.files import append_bytes, write_bytes
from zestjax.io.weights import WeightsError, save_weights
from zestjax.train.recipes import TINY, recipe_of
from zestjax.train.settings import with_settings


def stub_train(options):
    """Some steps of sleep, each of them saved."""
    out, asked = options.out, []
    before = signal.signal(signal.SIGTERM, lambda *_: asked.append(1))
    out.mkdir(parents=True, exist_ok=True)
    held = (set(os.environ.get("STUB_SCENES", "").split()) - {str(s) for s in options.scenes}) or {""}
    (scene,) = held
    if scene == os.environ.get("STUB_FAILS"):
        raise ValueError("the loss was not finite")
    if scene == os.environ.get("STUB_FULL"):  # as `save_weights` tells it
        raise WeightsError(f"{out}: {os.strerror(errno.ENOSPC)}; free some space") from OSError(errno.ENOSPC, "full")
    step = int((out / "step").read_text()) if (out / "step").exists() else 0
    with open(out / "starts", "a") as file:
        file.write(f"{step} ")
    while step < options.steps and not asked:
        time.sleep(float(os.environ.get("STUB_SECONDS", "0")))
        step += 1
        append_bytes(out / "log.jsonl", (json.dumps({"step": step}) + "\n").encode())
        write_bytes(out / "step", str(step).encode())
        if scene == os.environ.get("STUB_KILLS") and step == 3 and (out / "starts").read_text() == "0 ":
            os.kill(os.getpid(), signal.SIGKILL)
    signal.signal(signal.SIGTERM, before)
    recipe = with_settings(recipe_of("tiny", system=options.system), options.settings)
    shapes = jax.eval_shape(TINY.system.init, jax.random.key(0))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    save_weights(out / "weights.safetensors", zeros, metadata={"recipe": to_stored(TINY), "preset": "tiny"})
    write_bytes(out / "recipe.json", json.dumps(to_stored(recipe)).encode())
    return SimpleNamespace(weights=out / "weights.safetensors", result=SimpleNamespace(finished=not asked))


def stub_evaluate(options):
    """Scores that depend on the scene's name and the weights' folder's settings alone."""
    worth = (
        20.0
        + len(options.scene)
        + (5.0 if "motion" in str(json.loads((options.out / "train/recipe.json").read_text())["system"]) else 0.0)
    )
    scores = lambda i: {"psnr": worth + i, "ssim": 0.5, "lpips": None}
    rows = [{"time": i, "camera": "input", "full": scores(i), "dynamic": None, "static": scores(i), "seconds": 0.1,
             "file": f"pictures/{i:05d}_input.png"} for i in range(3)]  # fmt: skip
    mean = {"full": scores(1), "dynamic": None, "static": scores(1), "seconds_per_frame": 0.1}
    report = {"scene": options.scene, "mean": mean, "targets": rows, "device": "stub", "weights": "?"}
    write_bytes(options.out / "metrics.json", json.dumps(report).encode())
    return "evaluate: done"


def stubbed(arguments):
    """Run a command with them; its exit code."""
    command = launchers.command_of
    train.train, evaluate.evaluate = stub_train, stub_evaluate
    launchers.command_of = lambda *given: [sys.executable, __file__, *command(*given)[3:]]
    return main(arguments)


if __name__ == "__main__":
    sys.exit(stubbed(sys.argv[1:]))
