"""Where what can be made again is kept between runs: compiled programs and simulated clips."""

import functools
import os
import stat
import tempfile
from pathlib import Path

from zestjax.io.files import check_writable


def cache_folder():
    """The user's cache folder of zestjax; where there is no home that can be written to, a private temporary one."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zestjax"
        check_writable(folder)
    except (RuntimeError, OSError):  # Runtime: no home is known
        return _private_folder()
    return folder if folder.is_absolute() else _private_folder()


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
