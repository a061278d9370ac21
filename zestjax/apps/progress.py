"""Progress bars and, of long work, what it will take: on standard error, as soon as that is known.

unit      what is done again and again: a frame, a step; the first one compiles
"""

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized

from tqdm import tqdm

from zestjax.apps.memory import peak_megabytes
from zestjax.base.types import T

LONG_SECONDS = 10.0  # that are left: who waits for less needs no estimate


class Estimate:
    """What a number of equal units will take, from the first of them.

    after: so many units it is known; what the second and those after it took, the others will take. seconds: in all,
    from the start of the first; None until it is known.
    """

    def __init__(self, label, unit, *, after=2, quiet=False):
        self.label, self.unit, self.after, self.quiet, self.seconds = label, unit, after, quiet, None
        self.start = self.compiled = time.perf_counter()
        self.done = 0

    def tick(self, left):
        """A unit has ended, and `left` are to come; the one that tells says it, if long work is ahead."""
        now = time.perf_counter()
        self.done += 1
        self.compiled = now if self.done == 1 else self.compiled
        if self.done != self.after:
            return
        each = (now - self.compiled) / (self.after - 1)
        self.seconds = now - self.start + left * each
        if not self.quiet and left * each >= LONG_SECONDS:
            tqdm.write(estimated(self.label, self.unit, each, self.seconds), file=sys.stderr)


def estimated(label, unit, each, seconds):
    """The line: seconds of a unit and in all, and the most memory so far where the system tells."""
    memory = peak_megabytes()
    held = "" if memory is None else f", {memory / 1000:.1f} GB"
    return f"{label}: about {each:.2g} s a {unit}, {seconds:.0f} s in all{held}"


def progress(items: Iterable[T], label: str, *, quiet: bool = False, unit: str | None = None) -> Iterator[T]:
    """The items, with a bar that shows how long the rest takes; of a `unit`, and a known number of them, also an
    `Estimate` in words."""
    bar = tqdm(items, desc=label, disable=quiet, file=sys.stderr, leave=False)
    if unit is None or not isinstance(items, Sized):
        yield from bar
        return
    estimate, count = Estimate(label, unit, quiet=quiet), len(items)
    for index, item in enumerate(bar):
        yield item
        estimate.tick(count - index - 1)


@contextlib.contextmanager
def progress_of(label: str, count: int, *, quiet: bool = False) -> Iterator[Callable[[], object]]:
    """Context: a bar of so many steps, as a function that counts one."""
    with tqdm(total=count, desc=label, disable=quiet, file=sys.stderr, leave=False) as bar:
        yield bar.update
