"""Training clips on disk, rendered ahead of the trainer by a process of its own.

    python -m zestjax.apps.clips --out DIR [--seed S] [--size HxW] [--count N]

fills a folder ahead of a run; `zestjax.apps.producer` runs it beside a trainer. Clip i of seed s is a function of
(s, i) and of the simulator's code alone.

origin   what a clip is a function of, as text; it is stored with the clip and compared when it is read
"""

import argparse
import dataclasses
import functools
import hashlib
import io
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zestjax.apps.cache import cache_folder
from zestjax.io.files import write_bytes
from zestjax.io.reading import read_arrays

ORIGIN = "origin"
EVIDENCE = "evidence_"
STAND_IN, EXPOSURE = "stand_in_", "exposure_"
"""Before the names of the evidence's arrays, of the frames that stand in for holes, and of the exposures, which share a
dict with the clip's."""


class ClipSpec(NamedTuple):
    """Which clips: the seed they are drawn from, rows and columns, input frames and targets of each, and the depth
    planes of the frames' evidence, which is found ahead too; 0: none."""

    seed: int
    height: int
    width: int
    frames: int = 16
    targets: int = 8
    planes: int = 0


def clip_folder(spec, *, root=None):
    """Folder of a spec's clips under `root`; in the cache (None) it also names the simulator's code that makes them."""
    name = f"{spec.height}x{spec.width}-{spec.frames}+{spec.targets}-seed{spec.seed}"
    if root is not None:
        return Path(root) / name
    return cache_folder() / "clips" / f"{name}-{code_digest('simulate/*.py')}"


def evidence_folder(folder, planes):
    """Where the evidence of a folder's clips lies: by planes and by the code that finds it."""
    parts = ("frames/along", "frames/evidence", "frames/cells", "frames/optical_flow", "frames/assembly",
             "frames/selection", "frames/between", "frames/exposure", "train/stand_ins", "planesweep", "resample",
             "cameras")  # fmt: skip
    code = code_digest(*(f"{name}.py" for name in parts))
    return Path(folder) / f"evidence-{planes}-{code}"


@functools.cache
def code_digest(*patterns):
    """Eight digits that change with the source files of the package that match; read once, as the code itself is."""
    package = Path(__file__).parents[1]
    found = [sorted(package.glob(pattern)) for pattern in patterns]
    if not all(found):
        missing = [pattern for pattern, paths in zip(patterns, found, strict=True) if not paths]
        raise ValueError(f"{package}: has no {', '.join(missing)}, which tells clips apart; install zestjax again.")
    sources = [path for paths in found for path in paths]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]


def clip_path(folder, index):
    """The file of clip `index`."""
    return Path(folder) / f"clip-{index:06d}.npz"


def origin_of(spec, index):
    """What clip `index` of a spec is a function of, and so its evidence in the folder that names how it is found."""
    size = f"{spec.height}x{spec.width}, {spec.frames}+{spec.targets} frames"
    return f"clip {index} of seed {spec.seed}, {size}, simulator {code_digest('simulate/*.py')}"


def read_clip(path, origin):
    """A clip's arrays by name.

    Raises:
      ValueError: the file is damaged, or holds what has another origin.
      FileNotFoundError: there is none.
    """
    try:
        arrays = read_arrays(path)
    except ValueError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise error.__cause__ from None
        said = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{path}: is not a readable clip ({said}); delete it.") from error
    found = str(arrays.pop(ORIGIN, "a clip of an earlier version"))
    if found != origin:
        raise ValueError(f"{path}: holds {found}, expected {origin}; delete it.")
    return arrays


def write_clip(path, arrays, origin):
    """Write arrays by name, atomically; those that are None are left out."""
    buffer = io.BytesIO()
    known: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    known[ORIGIN] = np.array(origin)
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
    if spec.planes and not found.exists():
        from zestjax.frames.analysis import OwnMaps
        from zestjax.systems.presets import ZEST
        from zestjax.train.batches import clip_from_arrays, prepare_clip

        clip, key = clip_from_arrays(_clip_arrays(spec, path, index)), hole_key(spec.seed, index)
        prepared = prepare_clip(key, clip, dataclasses.replace(ZEST, frames=OwnMaps(spec.planes)))
        assert prepared.evidence is not None  # of a system with maps of its frames
        write_clip(found, _stored_evidence(prepared), origin_of(spec, index))
    if not path.exists():
        _clip_arrays(spec, path, index)


def _stored_evidence(prepared):
    """Arrays by name of what `train.batches.prepare_clip` adds to a clip."""
    named = lambda before, arrays: {f"{before}{name}": array for name, array in arrays.items()}
    arrays = named(EVIDENCE, prepared.evidence._asdict()) | {"holes": np.array(prepared.holes, int)}
    if prepared.exposure is not None:
        arrays |= named(EXPOSURE, {name: x for name, x in prepared.exposure._asdict().items() if x is not None})
    if prepared.stand_ins is None:
        return arrays
    *plain, evidence = prepared.stand_ins
    arrays |= named(STAND_IN, dict(zip(prepared.stand_ins._fields, plain, strict=False)))
    return arrays | named(f"{STAND_IN}{EVIDENCE}", evidence._asdict())


def _clip_arrays(spec, path, index):
    """The arrays of clip `index`, rendered and written if its file is missing, damaged or another clip's."""
    origin = origin_of(spec, index)
    try:
        return read_clip(path, origin)
    except (FileNotFoundError, ValueError):
        arrays = {name: np.asarray(v) for name, v in render_clip(spec, index)._asdict().items() if v is not None}
        write_clip(path, arrays, origin)
        return arrays


def hole_key(seed, index):
    """The key that draws which frames clip `index` lacks."""
    import jax

    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), index), 1)


def main(arguments=None):
    """Render clips 0 to `--count`, or those named on standard input with `--follow`; says each one's number."""
    import jax

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
    with jax.enable_x64(False):
        for index in (int(index) for indices in lines for index in indices):
            make_clip(spec, folder, index)
            print(index, file=sys.stdout, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
