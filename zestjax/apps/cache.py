"""Where what can be made again is kept between runs: compiled programs and simulated clips.

Clips lie in one folder for each seed, size and code of the simulator. A training holds its folder; when it starts it
removes those that no process holds and nothing was done with for `STALE_DAYS`, as killed runs leave them.

held  locked by a process that lives: the system lets go when it ends, however it ends
"""

import contextlib
import fcntl
import functools
import os
import re
import stat
import tempfile
import time
from pathlib import Path

import jax

from zestjax.io.files import check_writable, make_folder

STALE_DAYS = 30  # whoever resumes a run does it within weeks; later, its clips are rendered again, seconds each
LOCK = ".lock"
CLIPS = re.compile(r"\d+x\d+-\d+\+\d+-seed\d+-[0-9a-f]{8}")  # `clip_folder` of the cache; of --clips it has no digest
MADE = ("evidence-*/clip-*.npz", "evidence-*/.clip-*.part", "evidence-*", "clip-*.npz", ".clip-*.part", "producer*.log")
"""What such a folder holds, in the order it is removed. All else is somebody else's, and stays."""


def cache_folder():
    """The user's cache folder of zestjax; where there is no home that can be written to, a private temporary one."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zestjax"
        check_writable(folder)
    except (RuntimeError, OSError):  # Runtime: no home is known
        return _private_folder()
    return folder if folder.is_absolute() else _private_folder()


def keep_compiled():
    """Keep compiled programs in the cache folder, unless the user has named another."""
    if getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


@functools.cache
def _private_folder():
    """A folder under the temporary ones that nobody else can write to: compiled programs are run."""
    path = Path(tempfile.gettempdir()) / f"zestjax-{os.getuid()}"
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        found = path.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
            return Path(tempfile.mkdtemp(prefix="zestjax-"))
    return path


@contextlib.contextmanager
def held_clips(folder):
    """Context: no process removes this folder of clips, which is made; others may hold it too."""
    file = None
    while file is None:
        with contextlib.suppress(FileNotFoundError):  # removed between our making it and our opening the lock
            make_folder(folder)
            file = _locked(Path(folder) / LOCK, fcntl.LOCK_SH)
    try:
        with contextlib.suppress(OSError):  # its age counts from here, and from the end
            os.utime(file.fileno())
        yield
        with contextlib.suppress(OSError):
            os.utime(file.fileno())
    finally:
        file.close()


def remove_stale_clips(folder):
    """Remove what was left in the folders of clips beside this one that no process holds; what was removed, as paths.

    A folder stays for `STALE_DAYS` after a run began or ended with it or wrote to it, and where the file system has no
    locks for ever.
    """
    removed, oldest = [], time.time() - STALE_DAYS * 86400
    for other in sorted(Path(folder).parent.glob("*-seed*-*")):
        if other == Path(folder) or not CLIPS.fullmatch(other.name) or not _before(other, oldest):
            continue
        with contextlib.suppress(OSError):
            file = _locked(other / LOCK, fcntl.LOCK_EX | fcntl.LOCK_NB, needed=True)
            removed += [other] * (file is not None and _emptied(other))
            if file is not None:
                file.close()
    return removed


def _before(folder, oldest):
    """Whether nothing in a folder, nor itself, is newer than a time."""
    with contextlib.suppress(OSError):
        return all(path.stat().st_mtime < oldest for path in (folder, *folder.rglob("*")))
    return False


def _emptied(folder):
    """Whether anything that a training made was there to be removed; the lock goes last."""
    removed = 0
    for pattern in (*MADE, LOCK, ""):
        for path in folder.glob(pattern) if pattern else [folder]:
            with contextlib.suppress(OSError):  # not of the kind that a training makes, or not empty
                path.rmdir() if pattern in ("evidence-*", "") else path.unlink()
                removed += pattern in MADE
    return removed > 0


def _locked(path, kind, *, needed=False):
    """A lock's open file, or None if it was removed meanwhile; `needed`: an error where there are no locks."""
    file = path.open("a")
    try:
        fcntl.flock(file, kind)
    except OSError:
        if needed:
            file.close()
            raise
        return file
    if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
        return file
    file.close()
    return None
