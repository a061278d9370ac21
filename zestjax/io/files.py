"""Writing files so that a reader, or a crash, never meets half of one.

A file or folder is written beside its destination under a temporary name, flushed to the disk, and renamed into place:
the destination holds either what it held before or all of the new content.
"""

import contextlib
import os
import shutil
import tempfile
from pathlib import Path


def write_bytes(path, content):
    """Write a file atomically; its folder is made when missing.

    Raises:
      OSError: the disk is full or the place not writable; it names the path and the remedy, and what was there is
        unchanged.
    """
    path = Path(path)
    with _explained(path):
        _write(path, content)


def _write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise


def remove_parts(folder):
    """Remove what `write_bytes` left in a folder when its process was killed; nobody else may write there meanwhile."""
    for part in Path(folder).glob(".*.part"):
        if part.is_file():
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def replaced_folder(path, *, marker):
    """Context: yields an empty folder to fill, which takes the place of `path` once the block succeeds.

    Args:
      path: the destination: absent, an empty folder, or an earlier result, which is known by its `marker`.
      marker: name of a file that every such folder holds.

    Raises:
      ValueError: the destination holds something else, which is left alone.
      OSError: from the block or the renaming; the destination is unchanged and the new folder removed.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and ((path / marker).exists() or not any(path.iterdir()))):
        raise ValueError(
            f"{path}: holds files that are not an earlier result of this; choose an empty or a new folder."
        )
    with _explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent))
    try:
        fresh, old = temporary / "new", temporary / "old"
        fresh.mkdir()
        with _explained(path):
            yield fresh
            if path.exists():
                path.rename(old)
            try:
                fresh.rename(path)
            except OSError:
                if old.exists():
                    old.rename(path)
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def _explained(path):
    """Context: an OSError leaves it once more, saying what to do; one that already does is left alone."""
    remedy = "free some space or choose another place; nothing was changed there"
    try:
        yield
    except OSError as error:
        if error.errno is None or remedy in str(error.strerror):
            raise
        raise OSError(error.errno, f"{error.strerror}; {remedy}", str(path)) from error


def _umask():
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
