"""Budgets: what is chosen from a stored frontier, on machines that are slower, faster and otherwise than told."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from zestjax.apps import budget, finetune, own, pilot, stored
from zestjax.apps.budget import Budget, Clock
from zestjax.apps.commands import megabytes
from zestjax.apps.paths import camera_path
from zestjax.apps.render import render_path
from zestjax.apps.scenes import open_scene
from zestjax.apps.settings import TRAINED, Setting
from zestjax.apps.stored import Frontier, Point
from zestjax.apps.weights import open_weights
from zestjax.systems.presets import ZEST

TOLD = {"height": 144, "width": 256, "video_frames": 24, "weights": "w"}
SCALES = {0.25: (0.07, -4.0), 0.5: (0.26, -1.5), 0.75: (0.57, -0.5), 1.0: (1.0, 0.0), 1.5: (2.3, 0.2)}


def frontier():
    """As trained at five sizes; with half the planes, a little faster; with more views and planes, dearer."""
    points = [Point(Setting(scale=s), cost, gain, gain, gain, 400 * s**2) for s, (cost, gain) in SCALES.items()]
    points.append(Point(Setting(planes=0.5), 0.8, 0.05, 0.0, 0.1, 300))
    points.append(Point(Setting(planes=1.5, views=1.5), 1.6, 0.15, 0.0, 0.3, 700))
    return Frontier(tuple(sorted(points, key=lambda p: p.cost)), 28.0, 1.2, 2.0, TOLD)


@pytest.fixture
def place(tmp_path):
    """A `Model` as far as budgets look at it, with a frontier beside its weights."""
    stored.write_frontier(tmp_path / stored.NAME, frontier())
    model: Any = SimpleNamespace(path=tmp_path / "w.safetensors", system=ZEST)
    return model


VIDEO: Any = SimpleNamespace(images=np.zeros((24, 144, 256, 3), np.uint8))


class Machine:
    """Renders nothing, and tells seconds: `speed` times the stored cost, bent by its own ways, and a fixed part."""

    def __init__(self, speed=1.0, fixed=0.0, bend=1.0, late=1.0):
        self.speed, self.fixed, self.bend, self.late, self.made = speed, fixed, bend, late, []

    def __call__(self, setting):
        cost = frontier().moved(nearest(setting), setting.scale).cost
        self.made.append(setting)
        return Rendering(self, self.fixed + self.speed * 1.2 * cost**self.bend, 2.0 * self.speed * setting.scale**2)


def nearest(setting):
    """The stored point of a setting's family."""
    own = [p for p in frontier().points if p.setting.family == setting.family]
    return min(own, key=lambda p: abs(np.log(p.setting.scale / setting.scale)))


class Rendering:
    """One setting of a `Machine`."""

    def __init__(self, machine, seconds, prepare):
        self.machine, self.seconds, self.prepare_seconds, self.shown = machine, seconds, prepare, 0

    def __call__(self, camera, frame_time, exclude=()):
        return None, self.seconds * (self.machine.late if frame_time else 1.0)


def piloted(model, machine, asked, frames=12):
    """A `Pilot`, and the seconds of all frames that it rendered."""
    flown = pilot.Pilot(model, VIDEO, asked, frames, (None, 0, ()), renderer_of=machine, quiet=True)
    return flown, [flown(None, 1 + i)[1] for i in range(frames)]


@pytest.mark.parametrize("machine", [
    Machine(), Machine(0.25), Machine(5.0), Machine(1.0, fixed=0.04), Machine(2.0, bend=0.8), Machine(0.5, bend=1.2),
], ids=["as told", "fast", "slow", "fixed part", "flat", "steep"])  # fmt: skip
@pytest.mark.parametrize("seconds", [0.1, 0.3, 1.0, 3.0, 10.0])
def test_a_frame_takes_what_it_may_or_as_much_as_is_of_use(place, machine, seconds):
    flown, spent = piloted(place, machine, Budget(frame_seconds=seconds))
    each = np.median(spent[2:])
    cheapest = machine(Setting(scale=0.112)).seconds
    if cheapest > seconds:
        assert not flown.choice.fits and "nothing fits" in flown.line
    else:
        assert flown.choice.fits and each <= 1.1 * seconds
        useful = [p.gain for p in flown.points if machine(p.setting).seconds <= 0.9 * seconds]
        assert each >= 0.9 * seconds or flown.choice.point.gain >= max(useful, default=-99) - 0.1


@pytest.mark.parametrize(
    "machine", [Machine(), Machine(3.0), Machine(1.0, fixed=0.02)], ids=["as told", "slow", "fixed"]
)
@pytest.mark.parametrize("seconds", [2.0, 6.0, 20.0])
def test_all_frames_and_preparing_take_what_they_may(place, machine, seconds):
    flown, spent = piloted(place, machine, Budget(seconds=seconds), frames=20)
    whole = (flown.prepare_seconds or 0.0) + sum(spent)
    assert whole <= 1.1 * seconds
    assert whole >= 0.85 * seconds or flown.choice.point.gain >= -0.6


def test_what_the_first_frames_told_wrong_is_corrected_after_the_second(place):
    flown, spent = piloted(place, Machine(late=2.0), Budget(frame_seconds=1.0), frames=8)
    assert spent[0] > 1.2 and 1 <= flown.switches <= 2 and all(each <= 1.1 for each in spent[3:])


def test_a_film_does_not_change_its_setting_again_and_again(place):
    class Nervous(Rendering):
        def __call__(self, camera, frame_time, exclude=()):
            return None, self.seconds * (1 + 2 * (frame_time % 2))

    def machine(setting):
        found = Machine()(setting)
        return Nervous(found.machine, found.seconds, found.prepare_seconds)

    flown, _ = piloted(place, machine, Budget(frame_seconds=0.8), frames=40)
    assert flown.switches <= pilot.SWITCHES


def choose(asked, *, clock=None, frames=10, level=28.0, held=500.0):
    found = budget.candidates(frontier(), 144, 256)
    return budget.choose(found, asked, clock or Clock(1.2, 2.0), frames, level=level, held_mb=held)


def test_no_more_is_spent_than_the_decibels_asked_for_need():
    free, modest = choose(Budget(at_least_db=27.9)), choose(Budget(at_least_db=26.0))
    assert free.enough and modest.enough and modest.seconds < 0.5 * free.seconds
    assert 26.0 <= 28.0 + modest.point.gain <= 26.3


def test_decibels_are_not_promised_of_sizes_that_nobody_saw():
    assert choose(Budget(at_least_db=10.0)).point.setting.scale >= min(SCALES)
    assert choose(Budget(frame_seconds=0.04)).point.setting.scale < min(SCALES)


def test_decibels_out_of_reach_get_the_best_there_is_and_a_word():
    choice = choose(Budget(at_least_db=40.0))
    assert not choice.enough and choice.point.gain > 0.15
    said = budget.told(choice, Budget(at_least_db=40.0), ZEST, level=28.0, own=True)
    assert "40 dB are out of reach" in said and said.count("\n") == 0
    hurried = choose(Budget(frame_seconds=0.1, at_least_db=27.9))
    assert hurried.fits and not hurried.enough and hurried.seconds <= 0.1


def test_memory_is_kept_to_where_it_is_known():
    choice = choose(Budget(memory_mb=620.0))
    assert choice.fits and choice.point.working_mb is not None and choice.point.working_mb <= 120
    assert not choose(Budget(memory_mb=100.0)).fits


def test_the_line_tells_what_the_next_second_buys():
    hurried, rich = choose(Budget(frame_seconds=0.3)), choose(Budget(frame_seconds=60.0))
    assert hurried.buys is not None and hurried.buys.gain > hurried.point.gain and rich.buys is None
    said = budget.told(hurried, Budget(frame_seconds=0.3), ZEST, level=28.0, own=False)
    assert "a second more a frame buys +" in said and "by the frontier of the shipped weights" in said
    assert "buys nothing" in budget.told(rich, Budget(frame_seconds=60.0), ZEST, level=28.0, own=True)


def test_a_clock_believes_what_was_measured_at_the_nearest_costs():
    clock = Clock(1.0, 2.0)
    assert clock.frame(0.5) == 0.5 and clock.prepare(Setting(scale=0.5)) == 0.5
    clock.learn(Setting(scale=0.5), 0.25, 0.5, 1.5)
    assert clock.frame(0.25) == 0.5 and clock.frame(1.0) == 2.0 and clock.prepare(Setting(scale=0.5)) == 1.5
    clock.learn(TRAINED, 1.0, 1.0)
    assert clock.frame(1.0) == 1.0 and clock.frame(0.25) == 0.5 and 0.5 < clock.frame(0.5) < 1.0


def test_a_frontier_is_read_as_it_was_written(tmp_path):
    path = tmp_path / stored.NAME
    stored.write_frontier(path, frontier())
    assert stored.read_frontier(path) == frontier()
    assert stored.frontier_of(tmp_path / "w.safetensors") == (frontier(), True)
    assert stored.frontier_of(tmp_path / "elsewhere/w.safetensors")[1] is False


@pytest.mark.parametrize("change", [
    lambda text: "[]", lambda text: text.replace('"cost"', '"price"'), lambda text: text.replace('"height": 144,', ""),
    lambda text: text.replace('"scale": 0.5', '"scale": -1'), lambda text: text.replace('"gain": ', '"loss": '),
])  # fmt: skip
def test_what_is_no_frontier_is_refused_by_name(tmp_path, change):
    path = tmp_path / stored.NAME
    stored.write_frontier(path, frontier())
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match="frontier.json"):
        stored.read_frontier(path)


def test_the_shipped_frontier_tells_of_the_shipped_weights():
    found, theirs = stored.frontier_of(stored.shipped_weights())
    assert theirs and found.told["weights"] == stored.shipped_weights().name
    assert {len(found.points), len(found.curve)}.isdisjoint({0, 1}) and 20 < found.psnr < 40
    assert any(point.setting == TRAINED and point.cost == 1 and point.gain == 0 for point in found.points)


@pytest.mark.parametrize("text, mb", [("800MB", 800), ("1.5GB", 1500), ("1GiB", 1073.741824), ("64 kb", 0.064)])
def test_sizes_of_memory_are_read_with_their_unit(text, mb):
    assert megabytes(text) == pytest.approx(mb)


@pytest.mark.parametrize("text", ["800", "much", "-1GB", "0MB", "1e3GB"])
def test_sizes_without_a_unit_are_refused(text):
    with pytest.raises(Exception, match="no size of memory"):
        megabytes(text)


def test_finetuning_gets_the_seconds_that_preparing_and_judging_leave(place):
    options = finetune.FinetuneOptions("scene", place.path.parent, budget=60.0, budget_seconds=30.0)
    left, flown = finetune.within_budget(options, place, VIDEO, (3, 7))
    assert left.budget == pytest.approx(30.0 - 2.0 - 4 * 1.2) and flown is None
    assert finetune.within_budget(replace(options, budget=5.0), place, VIDEO, (3, 7))[0].budget == 5.0
    assert finetune.within_budget(replace(options, budget_seconds=None), place, VIDEO, ())[0].budget == 60.0
    with pytest.raises(ValueError, match="--budget-seconds 3 leaves no time"):
        finetune.within_budget(replace(options, budget_seconds=3.0), place, VIDEO, (3, 7))


def test_a_scene_is_as_good_as_its_own_frames_that_nothing_read_tell():
    asked = []

    def view_of(camera, time, exclude):
        asked.append((time, exclude))
        return SimpleNamespace(colour=np.full((8, 12, 3), 0.5, np.float32)), 1.0

    video: Any = SimpleNamespace(images=np.full((9, 8, 12, 3), 0.4, np.float32), cameras=np.zeros(9))
    assert own.own_psnr(view_of, video, exclude=(3,)) == pytest.approx(20.0, abs=1e-3)
    assert len(asked) == own.FRAMES and all(exclude == (3, time) != (3, 3) for time, exclude in asked)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.1, 0.3, 1.0, 3.0, 10.0])
def test_a_real_frame_takes_what_it_may_or_as_much_as_is_of_use(seconds):
    """The shipped weights on zest-bench; the frames after the second, which corrects."""
    model = open_weights()
    scene = open_scene("bench:walker", model.recipe, protocol=None).scene
    path = camera_path("orbit", scene.video, count=10)
    views, timing = render_path(model, scene, path, budget=Budget(frame_seconds=seconds), quiet=True)
    spent = [spent for _, spent in views][2:]
    told = timing(spent)["budget"]
    within = lambda share: sum(share * seconds >= each for each in spent) / len(spent)
    assert not told["fits"] or within(1.1) >= 0.5, (told, spent)
    assert within(0.9) < 0.5 or "buys nothing" in told["said"] or told["expected_seconds"] > 0.9 * seconds, (
        told,
        spent,
    )
