"""Trainings killed inside their writes and at random times, and resumed: nothing may differ from an unbroken run.

    python experiments/kills.py --out runs/kills [--kills 100] [--seed 0]

`train` and `finetune` of `tiny` are killed by SIGKILL again and again until each has ended; half of the kills come
before a random one of their writes (with half of its bytes written, where it writes), half at a random time. Each
lineage is compared with a run that nobody killed: parameters, optimiser state, the log's steps, the files left. Prints
a table; the exit code is 1 if anything differs.

event    a call that changes a run's folder: a file opened, flushed, renamed or removed
lineage  one run, killed and resumed until it ends
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from zestjax.apps import finetune, train
from zestjax.apps.log import read_log
from zestjax.apps.simulate import SimulateOptions, simulate
from zestjax.io.weights import load_weights

STEPS = {"train": 60, "finetune": 24}
KILLS_A_LINEAGE = 5  # then it is left to end: most of a short run's seconds are imports
CHECKPOINT_SECONDS = 0.3  # a few checkpoints in each part
LOGGED = 10  # steps between two lines of the log


class Killer:
    """Ends this process before event `number` (from 1; 0: never), with half of the bytes written where it writes."""

    def __init__(self, number, out):
        self.number, self.out, self.count = number, str(out), 0
        for module, name in ((os, "fsync"), (os, "replace"), (os, "unlink")):
            setattr(module, name, self.before(name, getattr(module, name)))
        self.fdopen, self.open = os.fdopen, Path.open
        os.fdopen = lambda *arguments, **options: self.half("half a file", self.fdopen(*arguments, **options))
        setattr(Path, "open", lambda *arguments, **options: self.opened(*arguments, **options))  # noqa: B010  # typed

    def before(self, name, function):
        def call(*arguments, **options):
            if name == "fsync" or self.out in str(arguments[0]):
                self.event(f"before {name}")
            return function(*arguments, **options)

        return call

    def opened(self, path, mode="r", *arguments, **options):
        file = self.open(path, mode, *arguments, **options)
        return self.half("half a log line", file) if mode == "ab" and self.out in str(path) else file

    def half(self, name, file):
        return _Watched(file, lambda content: self.event(name, lambda: (file.write(content), file.flush())))

    def event(self, name, last=lambda: None):
        self.count += 1
        if self.count == self.number:
            last()
            (Path(self.out) / "killed").write_text(name)
            os.kill(os.getpid(), signal.SIGKILL)


class _Watched:
    """A file whose writes are told of, with the first half of what is to be written."""

    def __init__(self, file, told):
        self.file, self.told = file, told

    def __getattr__(self, name):
        return getattr(self.file, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()

    def write(self, content):
        self.told(content[: len(content) // 2])
        return self.file.write(content)


def child(command, out, root, number):
    """Run or resume a training in this process, which its `Killer` may end; says how many events there were."""
    killer = Killer(number, out)
    if command == "train":
        train.train(train.TrainOptions(
            out, preset="tiny", steps=STEPS["train"], resume=True, clips=root / "clips", clip_count=2,
            steps_per_clip=3, checkpoint_minutes=CHECKPOINT_SECONDS / 60, quiet=True,
        ))  # fmt: skip
    else:
        finetune.CHECKPOINT_SECONDS = CHECKPOINT_SECONDS
        finetune.finetune(finetune.FinetuneOptions(
            str(root / "scene"), out, root / "start/weights.safetensors", budget=1e6, steps=STEPS["finetune"],
            resume=True, quiet=True,
        ))  # fmt: skip
    print(killer.count)


def run(command, out, root, *, number=0, seconds=None):
    """Start a part of a lineage; the kill that ended it, or None if it ended by itself, and how many events it had."""
    given = [sys.executable, __file__, "--child", command, str(number), "--out", str(out), "--root", str(root)]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(root / "compiled")}
    process = subprocess.Popen(given, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        said, wrong = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return "at a random time", 0
    if process.returncode == -signal.SIGKILL:
        return (out / "killed").read_text(), 0
    if process.returncode:
        raise RuntimeError(f"{command} ended with {process.returncode}: {wrong[-2000:]}")
    return None, int(said.split()[-1])


def lineage(command, out, root, draw, events, seconds):
    """Kill and resume one run until it ends; the list of its kills."""
    kills = []
    while True:
        more = len(kills) < KILLS_A_LINEAGE
        timed = more and draw.random() < 0.5
        number = draw.randint(1, events) if more and not timed else 0
        kill, _ = run(command, out, root, number=number, seconds=draw.uniform(0.5, 1) * seconds if timed else None)
        if kill is None:
            return kills
        kills.append(kill)


def differences(command, out, whole):
    """What a lineage left that an unbroken run did not, in words."""
    found = []
    newest = lambda folder: max((folder / "checkpoints").glob("step_*.safetensors"))
    for name, path in (("weights", lambda folder: folder / "weights.safetensors"), ("checkpoint", newest)):
        (one, told), (other, _) = load_weights(path(out)), load_weights(path(whole))
        different = [n for n in other if n not in one or not np.array_equal(one[n], other[n], equal_nan=True)]
        found += [f"{len(different)} leaves of the {name}"] * bool(different)
        found += ["the weights' step"] * (name == "weights" and told["step"] != STEPS[command])
    lines, odd = read_log(out / "log.jsonl")
    steps = [line["step"] for line in lines]
    if odd or steps != sorted(set(steps)) or not set(range(LOGGED, STEPS[command] + 1, LOGGED)) <= set(steps):
        found.append(f"the log's steps: {steps}")
    expected = {"weights.safetensors", "log.jsonl", "curve.png", "checkpoints", "killed"}
    left = {path.name for path in (*out.iterdir(), *out.glob("checkpoints/.*"))} - expected
    return found + [f"files left: {', '.join(sorted(left))}"] * bool(left)


def study(options):
    """Kill as often as asked; a row of the table a kind of kill, and what differed."""
    root, draw = options.out, random.Random(options.seed)
    shutil.rmtree(root, ignore_errors=True)
    simulate(SimulateOptions(root / "scene", scene="walker", size=(32, 48), frames=6, quiet=True))
    # Fine-tuning starts from a system that does not ask its frames what moves: after a few steps' training all of them
    # seems to, and there would be nothing to learn from.
    train.train(train.TrainOptions(
        root / "start", preset="tiny", system="zest-none", steps=4, clips=root / "clips", clip_count=2,
        steps_per_clip=3, quiet=True,
    ))  # fmt: skip
    rows, wrong, measures = Counter(), [], {}
    for command in STEPS:
        run(command, root / command, root)  # compiles
        shutil.rmtree(root / "again", ignore_errors=True)
        start = time.perf_counter()
        _, events = run(command, root / "again", root)
        measures[command] = (events, time.perf_counter() - start)
        wrong += [f"{command}, not killed: {what}" for what in differences(command, root / "again", root / command)]
    start, end = (load_weights(root / name / "weights.safetensors")[0] for name in ("start", "finetune"))
    wrong += ["fine-tuning learned nothing"] * all(np.array_equal(start[name], end[name]) for name in start)
    number = 0
    while sum(rows.values()) < options.kills:
        command, number = tuple(STEPS)[number % 2], number + 1
        out = root / f"{command}-{number}"
        kills = lineage(command, out, root, draw, *measures[command])
        rows.update((command, kill) for kill in kills)
        found = differences(command, out, root / command)
        wrong += [f"{out.name}, killed {', '.join(kills)}: {what}" for what in found]
        print(f"{out.name}: {len(kills)} kills, {'; '.join(found) or 'equal'}", file=sys.stderr, flush=True)
        if not found:
            shutil.rmtree(out)
    return rows, wrong


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", nargs=2, metavar=("COMMAND", "EVENT"), help=argparse.SUPPRESS)
    parser.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.child[0], options.out, options.root, int(options.child[1]))
        return 0
    options.out = options.out.resolve()
    rows, wrong = study(options)
    print("| run | killed | times |\n|---|---|---|")
    for (command, kill), count in sorted(rows.items()):
        print(f"| {command} | {kill} | {count} |")
    print(f"{sum(rows.values())} kills; " + ("; ".join(wrong) or "every run ended with the bits of an unbroken one"))
    (options.out / "kills.json").write_text(
        json.dumps({"kills": [[*key, count] for key, count in rows.items()], "wrong": wrong}, indent=1) + "\n"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
