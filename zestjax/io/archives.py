"""One file out of a packed archive (.tar.gz), in memory: nothing is extracted, and what is unpacked has a limit.

member   a file inside an archive
"""

import gzip
import io
import itertools
import tarfile
import zlib
from pathlib import Path

from zestjax.base.types import FilePath
from zestjax.io.reading import open_regular

GZIP = b"\x1f\x8b"  # how every gzip file begins
MOST_MEMBERS = 1000  # of an archive that are looked at; a larger one is not what was asked for
UNREADABLE = (
    gzip.BadGzipFile, EOFError, zlib.error, tarfile.TarError, ValueError, IndexError, OverflowError, RecursionError,
)  # fmt: skip


class ArchiveError(ValueError):
    """Not an archive, a damaged one, or one without the file that was asked for. Names the archive."""


def is_gzip(path: FilePath) -> bool:
    """Whether a file begins as a gzip file does; False for what is no regular file.

    Raises:
      OSError: the file cannot be read.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(GZIP)) == GZIP


def read_member(path: FilePath, name: str, *, most: int, most_unpacked: int) -> bytes:
    """The content of one member. What follows it in the archive is not read.

    Args:
      path: the archive.
      name: the member's full name; the first that bears it is read.
      most: bytes that the member may have.
      most_unpacked: bytes of the archive that may be unpacked on the way to its end.

    Returns:
      bytes.

    Raises:
      ArchiveError: no regular file, one that cannot be read, no gzip file, a damaged one, no such member, one that is
        no plain file, or more bytes than allowed.
    """
    try:
        with open_regular(path) as (file, _):
            return _member(path, file, name, most, most_unpacked)
    except ArchiveError:
        raise
    except ValueError as error:
        raise ArchiveError(str(error).removesuffix(".")) from error


def _member(path, file, name, most, most_unpacked):
    try:
        with gzip.open(file) as packed, tarfile.open(fileobj=_Limited(packed, most_unpacked), mode="r|") as archive:
            for member in itertools.islice(archive, MOST_MEMBERS):
                if member.name == name:
                    return _content(archive, member, most)
                if member.size > most_unpacked:  # to skip it takes as long as it says it is, however short the file
                    raise ArchiveError(_larger(most_unpacked))
    except ArchiveError as error:
        raise ArchiveError(f"{path}: {error}") from None
    except UNREADABLE as error:
        raise ArchiveError(f"{path}: is damaged, or no .tar.gz ({type(error).__name__}: {error})") from error
    raise ArchiveError(f"{path}: holds no `{name}`")


def _content(archive, member, most):
    if not member.isreg() or member.issparse():
        raise ArchiveError(f"its `{member.name}` is a link, a device or a folder, not a plain file")
    if member.size > most:
        raise ArchiveError(f"its `{member.name}` has {member.size:,} bytes, more than the {most:,} expected at most")
    file = archive.extractfile(member)
    content = b"" if file is None else file.read()
    if len(content) != member.size:
        raise EOFError(f"{len(content):,} bytes of {member.size:,}")
    return content


class _Limited(io.RawIOBase):
    """A stream to read from that refuses to give more than a number of bytes in all."""

    def __init__(self, stream, most):
        super().__init__()
        self._stream, self._left, self._most = stream, most, most

    def readable(self):
        return True

    def readinto(self, buffer):
        count = self._stream.readinto(buffer)
        self._left -= count
        if self._left < 0:
            raise ArchiveError(_larger(self._most))
        return count


def _larger(most):
    return f"unpacks to more than the {most:,} bytes expected at most"
