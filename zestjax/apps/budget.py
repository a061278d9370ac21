"""The setting that a budget affords: chosen from a stored frontier, by what frames take on the machine at hand.

limit      seconds that a frame may take
level      decibels (PSNR, full image) that a scene has as trained; a setting's are the level plus its gain
candidate  `stored.Point` at any size of the picture, its cost and gain moved along the frontier's curve
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from zestjax.apps.settings import LEAST_SIDE, Setting
from zestjax.apps.stored import Frontier, Point

AIM = 0.95  # of a limit: what two frames take is known to about 5 %, and a limit is not to be passed
STEP = 1.02  # between sizes: 4 % of the pixels, so that some size is within 10 % of any limit
NEAR = 1.3  # times the sizes at which a family was measured, either way: farther, its gain was never seen
SAME = 0.01  # dB: of gains this close the cheaper setting is taken
LEAST_SCALE = 0.1  # of a side: what is smaller is a stamp, not a picture


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a run may take. seconds: of preparing and of all frames. frame_seconds: of each. at_least_db: of the
    pictures. memory_mb: of the process while it renders. None: no limit."""

    seconds: float | None = None
    frame_seconds: float | None = None
    at_least_db: float | None = None
    memory_mb: float | None = None

    @classmethod
    def of(cls, options) -> "Budget":
        """That of a command's flags."""
        frame = None if options.frame_ms is None else options.frame_ms / 1000
        return cls(options.budget_seconds, frame, options.at_least_db, options.memory)

    def __bool__(self):
        return self != Budget()


class Clock:
    """Seconds of a frame, and of preparing, by cost: as stored until something was measured, then as measured at the
    costs nearest to it.

    frame, prepare: seconds as trained, as far as they are known before anything is measured.
    """

    def __init__(self, frame: float, prepare: float):
        self._guess, self._found = {"frame": frame, "prepare": prepare}, {"frame": {}, "prepare": {}}

    def learn(self, setting: Setting, cost: float, frame: float, prepare: float | None = None) -> None:
        """Seconds measured of a setting of that cost; the last ones count."""
        self._found["frame"][cost] = frame
        if prepare is not None:
            self._found["prepare"][setting.scale**2] = prepare

    def frame(self, cost: float) -> float:
        """Seconds of a frame of that cost."""
        return self._at("frame", cost)

    def prepare(self, setting: Setting) -> float:
        """Seconds of preparing the video at a setting's size."""
        return self._at("prepare", setting.scale**2)

    def _at(self, what, cost):
        found = sorted(self._found[what].items())
        if not found:
            return self._guess[what] * cost
        costs, seconds = np.array(found).T
        return float(cost * np.interp(np.log(cost), np.log(costs), seconds / costs))


class Choice(NamedTuple):
    """point: the candidate. seconds: of a frame, as expected. limit: on them, inf without one. fits: whether time and
    memory allow it. enough: whether it gives the decibels asked for. buys: the candidate that a second more a frame
    affords, where it gives more, else None."""

    point: Point
    seconds: float
    limit: float
    fits: bool
    enough: bool
    buys: Point | None


def candidates(frontier: Frontier, height: int, width: int) -> list[Point]:
    """All settings of a frontier at the sizes at which something is known of them; the cheapest also smaller."""
    families: dict = {}
    for point in frontier.points:
        families.setdefault(point.setting.family, []).append(point)
    cheapest, largest = frontier.points[0].setting.family, frontier.curve[-1].setting.scale
    floor = max(LEAST_SCALE, LEAST_SIDE / min(height, width))
    found, known = [], [point.setting.scale for point in frontier.curve]
    for family, points in families.items():
        measured = [point.setting.scale for point in points]
        low = floor if family == cheapest else max(floor, min(measured) / NEAR)
        for scale in sorted({*sizes(low, min(largest, max(measured) * NEAR)), *measured}):
            if blurred_alike(scale, known):
                continue
            nearest = points[int(np.argmin(np.abs(np.log(measured) - np.log(scale))))]
            point = frontier.moved(nearest, scale)
            found.append(point if scale >= min(known) else point._replace(gain_low=-np.inf))  # nobody saw one so small
    return found


def blurred_alike(scale: float, known) -> bool:
    """Whether a size lies between full size and the sizes beside it in the curve: any resampling blurs at once, so that
    what is known of full size says nothing of a picture almost as large."""
    below, above = [s for s in known if s < 1], [s for s in known if s > 1]
    return max(below, default=1.0) < scale < 1 or 1 < scale < min(above, default=1.0)


def sizes(low: float, high: float) -> list[float]:
    """Scales from one to another in even steps, 1 among them."""
    first, last = np.ceil(np.log(low) / np.log(STEP)), np.floor(np.log(high) / np.log(STEP))
    return [round(float(STEP**k), 4) for k in np.arange(first, last + 1)]


def limit_of(budget: Budget, clock: Clock, setting: Setting, frames: int) -> float:
    """Seconds that a frame of a setting may take."""
    limits = [budget.frame_seconds or np.inf]
    if budget.seconds is not None:
        limits.append((budget.seconds - clock.prepare(setting)) / frames)
    return min(limits)


def choose(
    points: list[Point],
    budget: Budget,
    clock: Clock,
    frames: int,
    *,
    level: float,
    held_mb: float = 0.0,
    growth: float = 1.0,
    aim: float = AIM,
) -> Choice:
    """The best candidate that a budget affords; of those that are good enough, where it says what is, the cheapest.

    Args:
      points: candidates.
      budget: `Budget`.
      clock: `Clock`.
      frames: how many are to be rendered.
      level: see the header.
      held_mb: memory that is held while nothing is rendered.
      growth: factor on the stored memory of a frame.
      aim: share of a limit that is used.

    Returns:
      `Choice`; where nothing fits, the candidate that comes nearest to fitting.
    """
    memory = lambda p: held_mb + growth * (p.working_mb or 0.0)
    roomy = [p for p in points if budget.memory_mb is None or memory(p) <= budget.memory_mb]
    in_memory = roomy or [min(points, key=memory)]
    over = lambda p: clock.frame(p.cost) / max(aim * limit_of(budget, clock, p.setting, frames), 1e-9)
    fitting = [p for p in in_memory if over(p) <= 1]
    if not fitting:
        point, fits = min(in_memory, key=lambda p: (over(p), p.cost)), False
    else:
        point, fits = best_of(fitting, clock, level, budget.at_least_db), bool(roomy)
    enough = budget.at_least_db is None or level + point.gain >= budget.at_least_db
    seconds = clock.frame(point.cost)
    more = best_of([p for p in in_memory if clock.frame(p.cost) <= seconds + 1], clock, level, None)
    buys = more if more.gain > point.gain + SAME else None
    return Choice(point, seconds, limit_of(budget, clock, point.setting, frames), fits, enough, buys)


def best_of(points: list[Point], clock: Clock, level: float, at_least_db: float | None) -> Point:
    """The fastest of those good enough; where none is, or nobody asks, the fastest of the best."""
    known = [p for p in points if np.isfinite(p.gain_low)]
    good = [p for p in known if at_least_db is not None and level + p.gain >= at_least_db]
    if not good:
        most = max(p.gain for p in points)
        good = [p for p in points if p.gain >= most - SAME]
    return min(good, key=lambda p: (clock.frame(p.cost), -p.gain))


def told(choice: Choice, budget: Budget, system, *, level: float, own: bool) -> str:
    """The line: what was chosen, what it gives, and what the next second would buy."""
    point = choice.point
    within = f" of {choice.limit:.2g}" if np.isfinite(choice.limit) and choice.limit > 0 else ""
    said = [f"`{point.setting.named(system)}`, {choice.seconds:.2g} s a frame{within}"]
    said.append(f"{point.gain:+.2f} dB on as trained, about {level + point.gain:.1f} dB")
    if not choice.fits:
        said.append("nothing fits the budget, this comes nearest")
    if not choice.enough:
        said.append(f"{budget.at_least_db:g} dB are out of reach")
    by = "" if own else ", by the frontier of the shipped weights"
    if choice.buys is None:
        said.append(f"a second more a frame buys nothing{by}")
    else:
        gain = choice.buys.gain - point.gain
        said.append(f"a second more a frame buys {gain:+.2f} dB (`{choice.buys.setting.named(system)}`){by}")
    return "; ".join(said)
