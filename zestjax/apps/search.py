"""A search for the settings that no other beats: drawn jointly, halved on ever more targets, then improved by steps.

rung     a number of targets: every setting is measured on those of the first; the better half, and whatever nothing
         beats there, also on the next ones'
trial    dict of one setting's means over its targets: at least `seconds_per_frame` and `psnr_full`
front    the settings that no other beats in both
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from zestjax.apps.settings import Setting, distinct, neighbours

KEEP = 2  # of a rung every second setting goes on: with three, settings that later won were dropped after two targets

ROUNDS = 3  # of steps: each starts from what the one before has found


def beats(a, b):
    """Whether one (seconds, decibels) is at least as fast and as good as another, and better in one."""
    return a[0] <= b[0] and a[1] >= b[1] and a != b


def front(points) -> list[int]:
    """Which of a list of (seconds, decibels) no other beats."""
    return [i for i, own in enumerate(points) if not any(beats(other, own) for other in points)]


def margins(points) -> list[float]:
    """By how many decibels each of a list of (seconds, decibels) is better than the best that is no slower."""
    others = lambda i: [d for j, (s, d) in enumerate(points) if j != i and s <= points[i][0]]
    return [decibels - max(others(i), default=-np.inf) for i, (_, decibels) in enumerate(points)]


def halving(
    settings: Sequence[Setting],
    always: Sequence[Setting],
    rungs: Sequence[int],
    measured: Callable,
    *,
    beside: Sequence[Setting] = (),
) -> list[Setting]:
    """Measure settings on ever more targets, half as many on each rung.

    Args:
      settings: to begin with.
      always: of them, those that are measured to the end.
      rungs: numbers of targets, rising.
      measured: (setting, targets) -> (seconds, decibels); it keeps what it found, and finds it again without work.
      beside: settings that were measured on all targets, which those to go on should beat.

    Returns:
      The settings that were measured on the last rung.
    """
    left = list(settings)
    for place, targets in enumerate(rungs):
        in_turn = sorted(left, key=lambda setting: setting.scale)  # a video is prepared once a size
        found = {setting: measured(setting, targets) for setting in in_turn}
        if place + 1 == len(rungs):
            break
        points = [*found.values(), *(measured(setting, targets) for setting in beside)]
        worth = dict(zip(found, margins(points)[: len(found)], strict=True))
        best = sorted(left, key=lambda setting: -worth[setting])[: -(-len(left) // KEEP)]
        left = [setting for setting in left if setting in always or setting in best or worth[setting] > 0]
    return left


def search(
    first: Sequence[Setting],
    always: Sequence[Setting],
    system,
    *,
    rungs: Sequence[int],
    measured: Callable,
    tries: int,
) -> list[Setting]:
    """Settings measured on all targets: the best of `first`, then of the steps around those that nothing beats.

    Args:
      first: see `halving`.
      always: see `halving`.
      system: whose settings they are.
      rungs: see `halving`.
      measured: see `halving`.
      tries: how many more settings may be tried in steps.

    Returns:
      Settings, all measured on the last rung.
    """
    done = halving(distinct(first, system), always, rungs, measured)
    seen, at_once = distinct([*first, *always], system), max(1, tries // ROUNDS)
    while tries > 0:
        points = [measured(setting, rungs[-1]) for setting in done]
        dear_first = sorted(front(points), key=lambda i: -points[i][0])  # where most is to be had, and to be saved
        around = in_turns([neighbours(done[i]) for i in dear_first])
        new = distinct([*seen, *around], system)[len(seen) :][: min(tries, at_once)]
        if not new:
            break
        tries, seen = tries - len(new), [*seen, *new]
        done += halving(new, (), rungs, measured, beside=tuple(done))
    return done


def in_turns(lists):
    """The first of each list, then the second of each, and so on."""
    missing = object()
    return [x for row in itertools.zip_longest(*lists, fillvalue=missing) for x in row if x is not missing]
