"""Progress bars, on standard error."""

import sys
from collections.abc import Iterable

from tqdm import tqdm

from zestjax.base.types import T


def progress(items: Iterable[T], label: str, *, quiet: bool = False) -> Iterable[T]:
    """The items, with a bar that shows how long the rest takes."""
    return tqdm(items, desc=label, disable=quiet, file=sys.stderr, leave=False)
