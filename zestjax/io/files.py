"""Writing files so that a reader, or a crash, never meets half of one.

A file or folder is written beside its destination under a temporary name, flushed to the disk, and renamed into place:
the destination holds either what it held before or all of the new content. Links are followed: what they point to is
written. A folder that cannot be renamed (a mount point, where a process stands, one whose parent is not writable) has
its entries moved one by one instead.
"""

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from zestjax.base.types import FilePath

_SPACE, _RIGHTS = "free some space or choose another place", "choose a place that can be written to"
_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _SPACE),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), _RIGHTS),
    **dict.fromkeys((errno.ENOTDIR, errno.EEXIST), "a file lies where a folder is needed: choose another place"),
    errno.ENOENT: "no file can be made there: choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
}


class WriteError(OSError):
    """Something could not be written; the message says why and what to do."""


def remedy(number: int | None) -> str:
    """What to do about an error of the system when writing, by its `errno`."""
    return _REMEDIES.get(number or 0, "choose another place")


def check_writable(folder: FilePath) -> None:
    """Refuse a folder that nothing can be written to, before any work is done for it. It may be missing.

    Raises:
      WriteError: it, or the nearest folder above it that exists, is a file, or takes none: a full or read-only disk,
        another user's, or no place for files at all, as /proc.
    """
    place = resolved(folder)
    while not place.exists():
        place = place.parent
    try:
        if not place.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "a file")
        tempfile.TemporaryFile(dir=place).close()  # rights alone do not tell: root has them in /proc too
    except OSError as error:
        number = error.errno or errno.EIO
        raise WriteError(number, f"{os.strerror(number)}; {remedy(number)}", str(folder)) from error


def resolved(path: FilePath) -> Path:
    """The absolute path behind links, also behind one to nothing yet."""
    return Path(os.path.realpath(path))


def make_folder(path: FilePath) -> None:
    """Make a folder, and those above it, where missing; the folder behind a link."""
    resolved(path).mkdir(parents=True, exist_ok=True)


def write_bytes(path: FilePath, content: bytes) -> None:
    """Write a file atomically; its folder is made when missing.

    Raises:
      OSError: the disk is full or the place not writable; it names the path and the remedy, and what was there is
        unchanged.
    """
    with _explained(path, "this file was not written"):
        _write(resolved(path), content)


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


def append_bytes(path: FilePath, content: bytes) -> None:
    """Add to the end of a file, which is made when missing.

    Raises:
      OSError: the disk is full or the place not writable; a part may have been added.
    """
    with _explained(path, "its last line may be cut short"), Path(path).open("ab") as file:
        file.write(content)


def remove_parts(folder: FilePath) -> None:
    """Remove what `write_bytes` left in a folder when its process was killed; nobody else may write there meanwhile."""
    for part in Path(folder).glob(".*.part"):
        if part.is_file():
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def replaced_folder(path: FilePath, *, marker: str) -> Iterator[Path]:
    """Context: yields an empty folder to fill, which takes the place of `path` once the block succeeds.

    Args:
      path: the destination: absent, an empty folder, or an earlier result, which is known by its `marker`.
      marker: name of a file that every such folder holds.

    Raises:
      ValueError: the destination holds something else, which is left alone.
      OSError: from the block or the renaming; the destination is unchanged and the new folder removed.
    """
    place = resolved(path)
    part = (f".{place.name}.", ".part")
    ours = lambda child: child.name.startswith(part[0]) and child.name.endswith(part[1])
    if place.exists() and not (place.is_dir() and ((place / marker).exists() or all(map(ours, place.iterdir())))):
        raise ValueError(
            f"{path}: holds files that are not an earlier result of this; choose an empty or a new folder."
        )
    with _explained(path, "nothing was changed there"):
        in_place = _stays(place)
        beside = place if in_place else place.parent
        beside.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=part[0], suffix=part[1], dir=beside))
    try:
        fresh, old = temporary / "new", temporary / "old"
        fresh.mkdir()
        with _explained(path, "nothing was changed there"):
            yield fresh
            (_swap_entries if in_place else _swap)(place, fresh, old, marker)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _stays(place):
    """Whether a folder must not, or cannot, be renamed."""
    return place.exists() and (
        os.path.ismount(place) or resolved(".").is_relative_to(place) or not os.access(place.parent, os.W_OK | os.X_OK)
    )


def _swap(place, fresh, old, marker):
    """Put a folder in the place of another, which becomes `old`."""
    if place.exists():
        place.rename(old)
    try:
        fresh.rename(place)
    except OSError:
        if old.exists():
            old.rename(place)
        raise


def _swap_entries(place, fresh, old, marker):
    """The same by the folders' entries: the marker leaves first and comes last."""
    old.mkdir()
    kept = old.parent
    leaving = sorted((child for child in place.iterdir() if child != kept), key=lambda child: child.name != marker)
    coming = sorted(fresh.iterdir(), key=lambda child: child.name == marker)
    moves = [(child, old / child.name) for child in leaving] + [(child, place / child.name) for child in coming]
    done = []
    try:
        for source, target in moves:
            source.rename(target)
            done.append((source, target))
    except OSError:
        for source, target in reversed(done):
            target.rename(source)
        raise


@contextlib.contextmanager
def _explained(path, outcome):
    """Context: an OSError leaves it as a `WriteError` of this path that says what to do and what has become of it."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        said = f"{os.strerror(error.errno)}; {remedy(error.errno)}; {outcome}"
        raise WriteError(error.errno, said, str(path)) from error


def _umask():
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
