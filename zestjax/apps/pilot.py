"""Views of a video within a budget: the setting is chosen, timed, and corrected until it keeps to what it may take.

Compiling is no part of a budget, nor are the frames that are rendered to be timed: they are told beside it.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.apps.budget import AIM, SAME, Budget, Choice, Clock, candidates, choose, limit_of, told
from zestjax.apps.memory import held_megabytes, peak_megabytes, reset_peak
from zestjax.apps.own import own_psnr
from zestjax.apps.scaled import Renderers
from zestjax.apps.settings import TRAINED
from zestjax.apps.stored import Point, frontier_of

TRIES = 3  # settings timed before the first frame: each may compile for a quarter of a minute
SWITCHES = 2  # of the setting once frames are shown: a film should not flicker
OFF = 0.1  # of a limit: within it, seconds are as asked
TIMED_SECONDS = 0.5  # frames are timed for so long, three at most: short ones vary more


class Pilot:
    """As `evaluate.Renderer`, within a `Budget`; views are of the video's own size.

    choice: `Choice` in force. line: what is to be said of it. calibration_seconds: spent on timing and compiling.
    """

    def __init__(self, model, video, budget: Budget, frames: int, first, *, clock: Clock | None = None,
                 renderer_of: Callable | None = None, quiet: bool = False):  # fmt: skip
        """first: (camera, time, exclude) of a frame that may be rendered to be timed. clock: of an earlier video of the
        same size. renderer_of: setting -> renderer, for tests."""
        self.model, self.budget, self.frames, self.first, self.quiet = model, budget, frames, first, quiet
        self.frontier, self.own = frontier_of(model.path)
        height, width = video.images.shape[1:3]
        self.clock = clock or self.clock_of(model, video)
        self.points = candidates(self.frontier, height, width)
        self.video = video if renderer_of else jax.tree.map(jnp.asarray, video)
        self._make = renderer_of or Renderers(model, video)
        self.growth, self.shown, self.switches, self.since = area_of(self.frontier, video), [], 0, 0
        start = time.perf_counter()
        if not quiet:
            print(f"budget: up to {TRIES} settings are compiled and timed before the first frame", file=sys.stderr)
        self.held, self.level = held_megabytes() or 0.0, self._level(video)
        self.renderer, self.choice = self._settled()
        self.calibration_seconds = time.perf_counter() - start
        self._say()

    def __call__(self, camera, frame_time, exclude=()):
        """(`View`, seconds); after the second frame, and where the rest would be too slow, the setting is corrected."""
        view, seconds = self.renderer(camera, frame_time, exclude)
        self.shown.append(seconds)
        if len(self.shown) >= 2 and len(self.shown) < self.frames and self.switches < SWITCHES:
            self._correct()
        return view, seconds

    @staticmethod
    def clock_of(model, video) -> Clock:
        """The `Clock` of a video before anything is measured: as where the frontier was, in proportion to its size."""
        frontier = frontier_of(model.path)[0]
        area = area_of(frontier, video)
        prepare = frontier.prepare_seconds * area * len(video.images) / frontier.told["video_frames"]
        return Clock(frontier.seconds * area, prepare)

    @property
    def prepare_seconds(self):
        """Of the video, at the setting in force."""
        return self.renderer.prepare_seconds

    @property
    def first_seconds(self):
        """As `prepare_seconds`: what compiled was not counted."""
        return self.prepare_seconds

    @property
    def compile_seconds(self):
        """Of all that was timed and compiled before the first frame."""
        return self.calibration_seconds

    @property
    def line(self) -> str:
        """What was chosen, and what a second more would buy."""
        return told(self.choice, self.budget, self.model.system, level=self.level, own=self.own)

    @property
    def record(self) -> dict[str, Any]:
        """For a command's JSON."""
        setting, choice = self.choice.point.setting, self.choice
        return {
            "setting": setting.named(self.model.system), "scale": setting.scale, "fits": choice.fits,
            "expected_seconds": choice.seconds, "expected_db": self.level + choice.point.gain, "said": self.line,
            "calibration_seconds": self.calibration_seconds,
        }  # fmt: skip

    def _say(self):
        if not self.quiet:
            print(f"budget: {self.line} (timed in {self.calibration_seconds:.0f} s)", file=sys.stderr)

    def _level(self, video):
        """Decibels as trained: of the frontier's scenes, or of this one, by frames predicted without themselves."""
        if self.budget.at_least_db is None or self.frontier.told.get("own_psnr") is None:
            return self.frontier.psnr
        own = own_psnr(self._make(TRAINED), video, exclude=self.first[2])
        return self.frontier.psnr + own - self.frontier.told["own_psnr"]

    def _chosen(self, left=None) -> Choice:
        budget, frames = self.budget, self.frames
        if left is not None:  # seconds that are left, of preparing none
            frames = self.frames - len(self.shown)
            each = min(left / frames, budget.frame_seconds or np.inf)
            budget = Budget(None, max(each, 1e-6), budget.at_least_db, budget.memory_mb)
        return choose(
            self.points, budget, self.clock, frames, level=self.level, held_mb=self.held, growth=self.growth, aim=AIM
        )

    def _settled(self):
        """The renderer of a setting that was timed and keeps to the budget, and its `Choice`."""
        tried: dict = {}
        for _ in range(TRIES):
            choice = self._chosen()
            setting = choice.point.setting
            if setting in tried:
                break
            tried[setting] = self._time(choice.point), choice.point
            seconds, limit = self.clock.frame(choice.point.cost), choice.limit
            if choice.fits and (1 - OFF) * limit <= seconds <= limit:
                break
        choice = self._chosen()
        if choice.point.setting not in tried:  # the tries are used up: the best that was seen to fit
            more = choice.buys or choice.point
            choice = choose(
                [point for _, point in tried.values()], self.budget, self.clock, self.frames, level=self.level,
                held_mb=self.held, growth=self.growth, aim=1.0,
            )  # fmt: skip
            choice = choice._replace(buys=more if more.gain > choice.point.gain + SAME else None)
        return tried[choice.point.setting][0], choice

    def _time(self, point: Point):
        """The renderer of a candidate, its seconds and its memory learned."""
        renderer = self._make(point.setting)
        renderer(*self.first)  # compiles, in a renderer that does not tell by itself
        reset_peak()
        held, seconds = held_megabytes(), []
        while len(seconds) < 3 and (not seconds or sum(seconds) < TIMED_SECONDS):
            seconds.append(renderer(*self.first)[1])
        self.clock.learn(point.setting, point.cost, float(np.median(seconds)), renderer.prepare_seconds)
        peak = peak_megabytes()
        if peak is not None and held is not None and point.working_mb:
            self.growth = max(self.growth, (peak - held) / point.working_mb) if self.budget.memory_mb else self.growth
        return renderer

    def _correct(self):
        """Another setting where the frames shown so far say that this one does not keep to the budget."""
        point, each = self.choice.point, float(np.median(self.shown[self.since :][-3:]))
        self.clock.learn(point.setting, point.cost, each)
        limit, left = limit_of(self.budget, self.clock, point.setting, self.frames), None
        if self.budget.seconds is not None:
            left = self.budget.seconds - (self.prepare_seconds or 0) - sum(self.shown)
            limit = min(left / (self.frames - len(self.shown)), self.budget.frame_seconds or np.inf)
        slack = len(self.shown) == 2 and each < (1 - 2 * OFF) * limit
        if not slack and each <= (1 + OFF) * limit:
            return
        choice = self._chosen(left)
        if choice.point.setting != point.setting:
            self.switches, self.since = self.switches + 1, len(self.shown)
            self.renderer, self.choice = self._time(choice.point), choice
            self._say()


def area_of(frontier, video) -> float:
    """Pixels of a video's frames, as a multiple of those that a frontier was measured with."""
    (height, width), told = video.images.shape[1:3], frontier.told
    return height * width / (told["height"] * told["width"])
