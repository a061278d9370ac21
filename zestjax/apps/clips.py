"""Training clips on disk, rendered ahead of the trainer by a process of its own.

    python -m zestjax.apps.clips --out DIR [--seed S] [--size HxW] [--count N]

fills a folder ahead of a run. A trainer asks its own producer for what is missing: one line of clip indices on the
producer's standard input, in the order they are wanted. The input closes with the trainer, however it ends, and the
producer with the input. Clip i of seed s is a function of (s, i) and of the simulator's code alone.
"""

import argparse
import contextlib
import functools
import hashlib
import io
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zestjax.io.files import write_bytes

EVIDENCE = "evidence_"
"""Before the names of the evidence's arrays, which share a dict with the clip's."""


class ClipSpec(NamedTuple):
    """Which clips: the seed they are drawn from, rows and columns, input frames and targets of each, and the depth
    planes of the frames' evidence, which is found ahead too; 0: none."""

    seed: int
    height: int
    width: int
    frames: int = 16
    targets: int = 8
    planes: int = 0


def cache_folder():
    """The user's cache folder of zestjax."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zestjax"


def clip_folder(spec, *, root=None):
    """Folder of a spec's clips under `root`; in the cache (None) it also names the simulator's code that makes them."""
    name = f"{spec.height}x{spec.width}-{spec.frames}+{spec.targets}-seed{spec.seed}"
    if root is not None:
        return Path(root) / name
    return cache_folder() / "clips" / f"{name}-{_code('simulate/*.py')}"


def evidence_folder(folder, planes):
    """Where the evidence of a folder's clips lies: by planes and by the code that finds it."""
    parts = ("evidence", "optical_flow", "assembly", "selection", "planesweep", "resample")
    code = _code(*(f"{name}.py" for name in parts))
    return Path(folder) / f"evidence-{planes}-{code}"


@functools.cache
def _code(*patterns):
    """Eight digits that change with the source files of the package that match; read once, as the code itself is."""
    package = Path(__file__).parents[1]
    sources = [path for pattern in patterns for path in sorted(package.glob(pattern))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]


def clip_path(folder, index):
    """The file of clip `index`."""
    return Path(folder) / f"clip-{index:06d}.npz"


def read_clip(path):
    """A clip's arrays by name.

    Raises:
      ValueError: the file is damaged.
    """
    try:
        with np.load(path) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, KeyError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"{path}: is not a readable clip ({error}); delete it, it is rendered again.") from error


def write_clip(path, arrays):
    """Write arrays by name, atomically; those that are None are left out."""
    buffer = io.BytesIO()
    known: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    np.savez(buffer, **known)
    write_bytes(path, buffer.getvalue())


def render_clip(spec, index):
    """Clip `index` of a spec, a `zestjax.simulate.clips.Clip`."""
    import jax

    from zestjax.simulate.clips import training_clip

    key = jax.random.fold_in(jax.random.key(spec.seed), index)
    return training_clip(key, height=spec.height, width=spec.width, frames=spec.frames, targets=spec.targets)


def make_clip(spec, folder, index):
    """Render clip `index` and find its evidence, those that `folder` lacks."""
    path, found = clip_path(folder, index), clip_path(evidence_folder(folder, spec.planes), index)
    if not path.exists():
        write_clip(path, render_clip(spec, index)._asdict())
    if spec.planes and not found.exists():
        from zestjax.batches import clip_from_arrays, prepare_clip
        from zestjax.presets import preset

        clip, key = clip_from_arrays(read_clip(path)), hole_key(spec.seed, index)
        prepared = prepare_clip(key, clip, preset("small", evidence_planes=spec.planes))
        assert prepared.evidence is not None  # of the preset's encoder
        evidence = {f"{EVIDENCE}{name}": array for name, array in prepared.evidence._asdict().items()}
        write_clip(found, evidence | {"holes": np.array(prepared.holes, int)})


def hole_key(seed, index):
    """The key that draws which frames clip `index` lacks."""
    import jax

    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), index), 1)


class Producer:
    """A process that renders the clips it is asked for; a context that ends it."""

    def __init__(self, spec, folder):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.folders = (self.folder, evidence_folder(folder, spec.planes)) if spec.planes else (self.folder,)
        size, counts = f"{spec.height}x{spec.width}", ["--frames", str(spec.frames), "--targets", str(spec.targets)]
        counts += ["--planes", str(spec.planes)]
        command = [sys.executable, "-m", "zestjax.apps.clips", "--follow", "--out", str(folder), "--size", size]
        environment = os.environ | {"PJRT_NPROC": "1", "OMP_NUM_THREADS": "1"}
        self.log = (self.folder / f"producer-{os.getpid()}.log").open("w+")
        self.process = subprocess.Popen(
            [*command, "--seed", str(spec.seed), *counts],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self.log, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
        assert self.process.stdin is not None
        self.asked = self.process.stdin

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        with contextlib.suppress(OSError):
            self.asked.close()
        self.log.close()
        Path(self.log.name).unlink(missing_ok=True)

    def paths(self, index):
        """The files of clip `index`; the last is written last."""
        return [clip_path(folder, index) for folder in self.folders]

    def ask(self, indices):
        """Have these clips rendered, in this order, those that exist left out."""
        missing = [str(index) for index in indices if not all(path.exists() for path in self.paths(index))]
        if missing:
            with contextlib.suppress(BrokenPipeError):  # `wait` reports what ended it
                self.asked.write(" ".join(missing) + "\n")
                self.asked.flush()

    def wait(self, index):
        """The arrays of clip `index`, once it is there.

        Raises:
          RuntimeError: the producer ended, with what it said last.
        """
        paths = self.paths(index)
        while not all(path.exists() for path in paths):
            if self.process.poll() is not None:
                self.log.seek(0)
                said = self.log.read().strip().splitlines()
                raise RuntimeError(f"the process that renders clips ended: {said[-1] if said else 'no message'}")
            time.sleep(0.02)
        return {name: array for path in paths for name, array in read_clip(path).items()}


class ClipSource:
    """Clips by index, the last `alive` of them held in memory, those ahead asked for; a context."""

    def __init__(self, spec, folder, *, alive, evict):
        self.evict, self.waited, self._asked = evict, 0.0, None
        self.producer = Producer(spec, folder)
        self._load = functools.lru_cache(maxsize=alive)(self._read)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.producer.__exit__()

    def _read(self, index):
        try:
            return self.producer.wait(index)
        except ValueError:
            for path in self.producer.paths(index):
                path.unlink(missing_ok=True)
            self.producer.ask([index])
            return self.producer.wait(index)

    def clip(self, index, ahead):
        """Arrays of clip `index`; `ahead`: the indices that may be wanted soon, soonest first."""
        ahead = tuple(ahead)
        if ahead != self._asked:
            self._asked = ahead
            self.producer.ask(dict.fromkeys((index, *ahead)))
            if self.evict:
                self._remove_below(min(ahead, default=index))
        start = time.perf_counter()
        arrays = self._load(index)
        self.waited += time.perf_counter() - start
        return arrays

    def _remove_below(self, oldest):
        for folder in self.producer.folders:
            for path in folder.glob("clip-*.npz"):
                if int(path.stem.removeprefix("clip-")) < oldest:
                    path.unlink(missing_ok=True)


def main(arguments=None):
    """Render clips 0 to `--count`, or those named on standard input with `--follow`."""
    parser = argparse.ArgumentParser(
        prog="python -m zestjax.apps.clips", description="Render training clips ahead of a run."
    )
    parser.add_argument("--out", required=True, help="folder, or with --follow the spec's own folder")
    parser.add_argument("--size", default="144x256")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=ClipSpec._field_defaults["frames"])
    parser.add_argument("--targets", type=int, default=ClipSpec._field_defaults["targets"])
    parser.add_argument("--planes", type=int, default=32, help="of the frames' evidence; 0: none")
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--follow", action="store_true")
    options = parser.parse_args(arguments)
    os.nice(5)
    height, width = (int(side) for side in options.size.split("x"))
    spec = ClipSpec(options.seed, height, width, options.frames, options.targets, options.planes)
    folder = Path(options.out) if options.follow else clip_folder(spec, root=options.out)
    lines = (line.split() for line in sys.stdin) if options.follow else [range(options.count)]
    for indices in lines:
        for index in map(int, indices):
            make_clip(spec, folder, index)
            if not options.follow:
                print(f"clip {index}", file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
