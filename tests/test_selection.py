"""Which frames serve a target."""

import numpy as np
import pytest

from zestjax.frames.selection import RANKS, key_frames, neighbours

LINE = np.stack([np.arange(12.0), np.zeros(12), np.zeros(12)], -1)  # frame i stands at x = i


def nearest_by_loop(positions, target, time, count, exclude=()):
    """Frames by distance, then by time; of them the ranks that are wanted."""
    usable = [i for i in range(len(positions)) if i not in exclude]
    order = sorted(usable, key=lambda i: (np.linalg.norm(positions[i] - target), abs(i - time)))
    wanted = [r for r in RANKS[:count] if r < len(order)]
    wanted += [r for r in range(len(order)) if r not in wanted][: count - len(wanted)]
    return [order[r] for r in sorted(wanted)]


@pytest.mark.parametrize("count", [1, 3, 8, 10, 12])
@pytest.mark.parametrize("exclude", [(), (4,), (0, 3, 11)])
def test_the_nearest_frames_are_those_of_a_loop(count, exclude):
    positions = np.random.default_rng(0).normal(size=(15, 3))
    chosen = key_frames(positions, count, target=np.zeros(3), time=7, exclude=exclude)
    expected = nearest_by_loop(positions, np.zeros(3), 7, count, exclude)
    assert chosen.frames.tolist() == expected and chosen.valid.tolist() == [1] * count


def test_the_nearest_comes_first_and_ranks_grow_sparser():
    chosen = key_frames(LINE, 8, target=LINE[0] - 0.1, time=0)
    assert chosen.frames.tolist() == list(RANKS)


def test_time_settles_ties():
    still = np.zeros((9, 3))
    assert key_frames(still, 3, target=np.zeros(3), time=5).frames[0] == 5
    assert set(key_frames(still, 3, target=np.zeros(3), time=5).frames) == {4, 5, 6}


def test_an_excluded_frame_is_never_chosen():
    for choice in ("nearest", "spread"):
        chosen = key_frames(LINE, 8, target=LINE[5], time=5, choice=choice, exclude=(5, 0))
        assert not {5, 0} & set(chosen.frames)
    assert 5 not in neighbours(12, 5, offsets=(-1, 0, 1), exclude=(5,)).frames


@pytest.mark.parametrize("choice", ["nearest", "spread"])
def test_a_short_video_leaves_slots_empty(choice):
    chosen = key_frames(LINE[:3], 5, target=LINE[0], choice=choice)
    assert chosen.valid.tolist() == [1, 1, 1, 0, 0] and set(chosen.frames) == {0, 1, 2}


def test_spread_frames_reach_both_ends_in_order():
    chosen = key_frames(LINE, 4, choice="spread")
    assert chosen.frames.tolist() == [0, 4, 7, 11]
    assert key_frames(LINE, 12, choice="spread").frames.tolist() == list(range(12))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_choice_does_not_depend_on_the_worlds_units_axes_or_origin(scale):
    rng = np.random.default_rng(3)
    positions, target = rng.normal(size=(15, 3)), rng.normal(size=3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    move = lambda x: scale * (x @ turn + 5)
    first = key_frames(positions, 6, target=target, time=2)
    assert key_frames(move(positions), 6, target=move(target), time=2).frames.tolist() == first.frames.tolist()


def test_slots_are_the_neighbours_that_exist():
    chosen = neighbours(6, 5, offsets=(-2, -1, 0, 1, 2))
    assert chosen.frames.tolist() == [3, 4, 5, 5, 5] and chosen.valid.tolist() == [1, 1, 1, 0, 0]
    chosen = neighbours(6, 2, offsets=(-2, -1, 1, 2), exclude=(2, 3))
    assert chosen.frames.tolist() == [0, 1, 4, 4] and chosen.valid.tolist() == [1, 1, 0, 1]
    assert neighbours(6, 90, offsets=(-1, 0)).valid.tolist() == [0, 0]


def test_bad_choices_are_refused():
    with pytest.raises(ValueError, match="leave at least one"):
        key_frames(LINE, 3, target=LINE[0], exclude=range(12))
    with pytest.raises(ValueError, match="choice"):
        key_frames(LINE, 3, target=LINE[0], choice="random")
