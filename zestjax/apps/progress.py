"""Progress bars, on standard error."""

import sys

from tqdm import tqdm


def progress(items, label, *, quiet=False):
    """The items, with a bar that shows how long the rest takes."""
    return tqdm(items, desc=label, disable=quiet, file=sys.stderr, leave=False)
