"""What long work will take, said as soon as it is known."""

import pytest

from zestjax.apps import progress as module
from zestjax.apps.progress import Estimate, progress


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    now = [100.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(module, "peak_megabytes", lambda: 1234.0)
    return now


def rendered(clock, seconds, **options):
    """Units of these seconds done under `progress`."""
    for index in progress(range(len(seconds)), "render", unit="frame", **options):
        clock[0] += seconds[index]


def test_the_first_frame_compiles_and_the_second_tells(clock, capsys):
    rendered(clock, [9.0, *[0.5] * 39])
    assert "render: about 0.5 s a frame, 28 s in all, 1.2 GB" in capsys.readouterr().err


@pytest.mark.parametrize("seconds, quiet", [([9.0] + [0.5] * 10, False), ([9.0] + [5.0] * 10, True), ([9.0], False)])
def test_short_or_quiet_work_says_nothing(clock, capsys, seconds, quiet):
    rendered(clock, seconds, quiet=quiet)
    assert "about" not in capsys.readouterr().err


def test_steps_are_a_mean_of_several_and_known_without_words(clock):
    estimate = Estimate("train", "step", after=4, quiet=True)
    for index, seconds in enumerate([50.0, 1.0, 2.0, 3.0, 9.0]):
        clock[0] += seconds
        estimate.tick(100 - index - 1)
    assert estimate.seconds == 56 + 96 * 2.0


def test_where_the_system_tells_no_memory_it_is_left_out(clock, capsys, monkeypatch):
    monkeypatch.setattr(module, "peak_megabytes", lambda: None)
    rendered(clock, [1.0, *[2.0] * 20])
    assert "render: about 2 s a frame, 41 s in all\n" in capsys.readouterr().err
