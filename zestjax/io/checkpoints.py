"""Checkpoints of a training run: one weights file per saved step; a run resumes from the newest that is whole.

tree     whatever the run needs to continue: parameters, optimiser state, key
step     how many steps the tree has seen; it is in the file's name
"""

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from zestjax.base.types import FilePath, Tree
from zestjax.io.weights import DamagedFileError, UnreadableFileError, WeightsError, load_weights, save_weights

_NAME = re.compile(r"step_(\d{9,})\.safetensors")


class Checkpoint(NamedTuple):
    """A checkpoint read back.

    step: int. tree: the arrays, in the structure asked for. metadata: dict given when it was saved. path: its file.
    warnings: one sentence for each newer checkpoint that is damaged or cannot be read and was passed over.
    """

    step: int
    tree: Tree
    metadata: dict
    path: Path
    warnings: tuple[str, ...]


def save_checkpoint(folder: FilePath, step: int, tree: Tree, metadata: Mapping[str, Any], *, keep: int = 2) -> Path:
    """Write `step_<step>.safetensors`, then remove all but the newest `keep` checkpoints.

    Older ones go only after the new one is complete on the disk: a full disk costs the new one alone.

    Args:
      folder: where the run's checkpoints live; made when missing.
      step: int >= 0. A folder of the file's name is moved aside.
      tree: pytree of arrays.
      metadata: dict of what JSON can hold, with the full configuration.
      keep: how many to leave, at least 1.

    Returns:
      `Path` of the new file.

    Raises:
      ValueError: keep < 1.
      WeightsError: it could not be written; earlier checkpoints are unchanged.
    """
    if keep < 1:
        raise ValueError(f"save_checkpoint: `keep` is {keep}, expected at least 1.")
    path = Path(folder) / f"step_{step:09d}.safetensors"
    if path.is_dir():
        path.rename(Path(tempfile.mkdtemp(prefix=f"not_{path.name}.", dir=folder)) / path.name)
    save_weights(path, tree, metadata=metadata)
    others = [old for _, old in _found(folder) if old != path and not old.is_dir()]
    for old in others[keep - 1 :]:
        old.unlink(missing_ok=True)
    return path


def latest_checkpoint(folder: FilePath, like: Tree) -> Checkpoint | None:
    """The newest checkpoint that is whole, or None when the folder holds none.

    Args:
      folder: where the run's checkpoints live; may be missing.
      like: tree of arrays or `jax.ShapeDtypeStruct`s with the structure that was saved.

    Returns:
      `Checkpoint`, whose `warnings` tell of newer ones that are damaged or cannot be read.

    Raises:
      WeightsError: the newest whole one is of another preset, or none can be read; nothing is removed.
    """
    warnings = []
    for step, path in _found(folder):
        try:
            tree, metadata = load_weights(path, like=like)
        except (DamagedFileError, UnreadableFileError) as error:
            warnings.append(str(error))
            continue
        return Checkpoint(step, tree, metadata, path, tuple(warnings))
    if warnings:
        raise WeightsError(f"{folder}: no checkpoint is whole; remove the folder to start afresh. {' '.join(warnings)}")
    return None


def _found(folder):
    """[(step, path)], newest first."""
    paths = Path(folder).glob("step_*.safetensors")
    matches = [(match, path) for path in paths if (match := _NAME.fullmatch(path.name))]
    return sorted(((int(match[1]), path) for match, path in matches), reverse=True)
