"""Clips that killed runs left in the cache are removed; what somebody uses, keeps or may resume is not."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from zestjax.apps import cache, train
from zestjax.apps.clips import ClipSpec, clip_folder, clip_path, evidence_folder, write_clip
from zestjax.apps.train import TrainOptions
from zestjax.train.recipes import TINY

NAME = "144x256-16+8-seed{}-0123abcd"
HOLDER = """
import sys
from zestjax.apps.cache import held_clips
with held_clips(sys.argv[1]):
    print(1, flush=True)
    input()
"""


@pytest.fixture
def clips(tmp_path, monkeypatch):
    """The cache's folder of clips."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return clip_folder(ClipSpec(0, 16, 24)).parent


def filled(folder, *, days):
    """A folder of one clip with its evidence, last touched so many days ago."""
    for place in (folder, evidence_folder(folder, 8)):
        write_clip(clip_path(place, 3), {"images": np.zeros(3)}, "a clip")
        (place / ".clip-000004.npz.x.part").touch()
    aged(folder, days=days)
    return folder


def aged(folder, *, days):
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (time.time() - 86400 * days,) * 2)


def test_only_stale_folders_of_clips_are_removed(clips):
    own, stale = filled(clips / NAME.format(0), days=400), filled(clips / NAME.format(1), days=31)
    young, given = filled(clips / NAME.format(2), days=29), filled(clips / "144x256-16+8-seed3", days=400)
    assert cache.remove_stale_clips(own) == [stale]
    assert not stale.exists() and all(clip_path(place, 3).exists() for place in (own, young, given))
    assert cache.remove_stale_clips(own) == []


def test_what_others_put_beside_clips_stays(clips):
    folder = filled(clips / NAME.format(1), days=31)
    (folder / "144x256-16+8-seed0").mkdir()  # --clips of a user who chose this very folder
    (folder / "144x256-16+8-seed0/clip-000000.npz").touch()
    (folder / "evidence-notes.txt").touch()
    aged(folder, days=31)
    assert cache.remove_stale_clips(clips / "own") == [folder]
    assert {path.name for path in folder.rglob("*")} == {"144x256-16+8-seed0", "clip-000000.npz", "evidence-notes.txt"}
    aged(folder, days=31)
    assert cache.remove_stale_clips(clips / "own") == [] and not (folder / cache.LOCK).exists()


def test_a_folder_that_a_living_process_holds_stays_however_old(clips):
    folder = filled(clips / NAME.format(1), days=0)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "1\n"
        aged(folder, days=400)
        with cache.held_clips(folder):  # two may hold it
            assert cache.remove_stale_clips(clips / "own") == []
        aged(folder, days=400)
        assert cache.remove_stale_clips(clips / "own") == [] and clip_path(folder, 3).exists()
        other.kill()
        other.wait()
    assert cache.remove_stale_clips(clips / "own") == [folder] and not folder.exists()


def test_a_run_that_begins_or_ends_keeps_its_clips_for_as_long_again(clips):
    folder = filled(clips / NAME.format(1), days=400)
    with cache.held_clips(folder):
        pass
    assert cache.remove_stale_clips(clips / "own") == [] and clip_path(folder, 3).exists()


@pytest.mark.parametrize("quiet", [False, True])
def test_a_training_says_which_clips_it_removed_and_leaves_given_ones(clips, tmp_path, capsys, quiet):
    stale = filled(clips / NAME.format(1), days=31)
    with train.batches(TINY, TrainOptions(tmp_path / "out", clips=tmp_path / "kept", quiet=quiet)):
        assert stale.exists() and not list(tmp_path.glob("kept/*/.lock"))
    with train.batches(TINY, TrainOptions(tmp_path / "out", quiet=quiet)):
        assert not stale.exists()
        (own,) = clips.iterdir()
        assert (own / cache.LOCK).exists()
    said = capsys.readouterr().err
    assert said == ("" if quiet else f"train: removed clips that no run has used for 30 days: {stale}\n")
