"""Which camera of a rig took a held-out picture, where only the pictures' names and the frames can tell.

    number    the last digits of a picture's name: from 1 as published, from 0, or serial numbers with gaps
    rank      the place of a number among all numbers of all times
    C         cameras of the rig: how many numbers there are, and more where some have no picture at all
    place     of a camera in the rig, 0 to C - 1: frame t was taken by the camera of place t mod C, so its pose is that
              of the frame of its place
    own       of a frame: the camera that took it, and that camera's picture of that time, which is the frame itself

By convention the place is the rank. It is never taken on trust: a frame and its own picture are one photograph, perhaps
compressed again or resized, and where no own picture is there, it must be the one that is missing at each time. Where
the photographs contradict the ranks, every constant shift of them is tried, with any number of cameras that have no
picture; the reading that explains most is taken, if no other explains as much. Otherwise the folder is refused.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.base.types import FilePath
from zestjax.io.pictures import read_image, resize_area

GRID = (48, 64)  # most rows and columns at which photographs are compared: compression and resizing even out
SHRINK = 2  # and the least shrinking: JPEG stores colour at half size
SAME = 0.03  # most RMS difference of one photograph: JPEG of quality 50 at 72 x 128 has 0.026, a neighbour camera 0.032
OTHER = 0.1  # most of one that was also toned or sharpened and only has to be the best: another scene has 0.11
MARGIN = 1.02  # a picture is as good as the best if it differs no more than so many times as much: compression's chance
ROUNDING = 2e-4  # and a twentieth of a grey level
CLEAR = 2  # the best is clearly so if others differ so many times as much: 5 for JPEG of quality 90, 1.6 of 50
PROBES = 16  # times compared at first: every camera of the usual 12, in either half of the video
MOST_TIMES = 64  # times compared where the convention fails: some seconds
ABSENT = 2  # a rig may have up to so many times as many cameras as have pictures: with more, too little is known


class Rig(NamedTuple):
    """size: C. numbers: number by place, for the places that have pictures."""

    size: int
    numbers: Mapping[int, int]

    def own(self, time: int) -> int | None:
        """The number of the camera that took a frame, or None where no picture has its number."""
        return self.numbers.get(time % self.size)


class _Look(NamedTuple):
    """The pictures of a time. numbers: all. alike: that may be the frame. itself: the one that must be it, or None."""

    numbers: frozenset[int]
    alike: frozenset[int]
    itself: int | None


def numbered(by_time: Mapping[int, Sequence[Path]]) -> dict[int, dict[int, Path]]:
    """Files by number.

    Args:
      by_time: {time: picture files}.

    Returns:
      {time: {number: file}}, without times that have no file.

    Raises:
      ValueError: a name without a number, or two pictures of one number at one time.
    """
    pictures = {}
    for time, files in by_time.items():
        for file in files:
            digits = re.findall(r"\d+", file.stem)
            if not digits:
                raise ValueError(f"{file}: has no number that tells its camera; name it camNN, or remove it.")
            first = pictures.setdefault(time, {}).setdefault(int(digits[-1]), file)
            if first != file:
                raise ValueError(f"{file}: has the number of {first.name}, {int(digits[-1])}; remove or rename one.")
    return pictures


def find_rig(folder: FilePath, images: Sequence[Path], pictures: Mapping[int, Mapping[int, Path]]) -> Rig:
    """Find which camera has which number.

    Args:
      folder: of the pictures, named in errors.
      images: files of the N frames.
      pictures: {time: {number: file}}, see `numbered`.

    Returns:
      `Rig`.

    Raises:
      ValueError: the photographs contradict every reading of the numbers, or do not tell one from another.
    """
    numbers = sorted({number for files in pictures.values() for number in files})
    convention = Rig(len(numbers), dict(enumerate(numbers)))
    pictures = {time: files for time, files in sorted(pictures.items()) if time < len(images)}
    looks = _looks(images, pictures, _probes(list(pictures), convention.size))
    if not _contradictions(convention, looks) and (_shown(convention, looks) or _left_out(convention, pictures)):
        return convention
    looks |= _looks(images, pictures, [time for time in _spread(list(pictures), MOST_TIMES) if time not in looks])
    fitting = [rig for rig in _readings(numbers) if not _contradictions(rig, looks)]
    most = max((_explained(rig, looks, numbers) for rig in fitting), default=0)
    best = [rig for rig in fitting if _explained(rig, looks, numbers) == most]
    if 2 * most > len(looks) and len({tuple(targets_of(rig, pictures, len(images))) for rig in best}) == 1:
        return best[0]
    raise ValueError(f"{folder}: {_reason(convention, looks, pictures)}")


def targets_of(rig: Rig, pictures: Mapping[int, Mapping[int, Path]], count: int) -> list[tuple[int, int, int]]:
    """[(time, number, place)] of the pictures that are held out of `count` frames.

    Left out are the frames' own pictures, and those of cameras whose place has no frame, so that no pose is known.
    """
    places = {number: place for place, number in rig.numbers.items()}
    return [
        (time, number, places[number])
        for time, files in sorted(pictures.items())
        for number in sorted(files)
        if time < count and places[number] < count and number != rig.own(time)
    ]


def _probes(times, size):
    """Times at which each camera took the frame, early and late ones in turn, and the last one."""
    turns = [[time for time in times if time % size == place] for place in range(size)]
    return _spread(sorted({turn[i % len(turn)] for i, turn in enumerate(turns) if turn} | set(times[-1:])), PROBES)


def _spread(times, most):
    return [times[i] for i in np.unique(np.linspace(0, len(times) - 1, min(most, len(times))).round().astype(int))]


def _looks(images, pictures, times):
    return {time: _look(_differences(images[time], pictures[time])) for time in times}


def _look(differences):
    best, *others = sorted(differences, key=lambda number: differences[number])
    least = differences[best]
    clear = bool(others) and all(differences[other] > CLEAR * least + ROUNDING for other in others)
    alike = (number for number in differences if differences[number] <= MARGIN * least + ROUNDING)
    known = least <= (OTHER if others else SAME)
    return _Look(frozenset(differences), frozenset(alike if known else ()), best if clear and least <= SAME else None)


def _differences(frame, files):
    """{number: RMS difference of its picture from the frame}."""
    frame, shown = _small(frame), {number: _small(file) for number, file in files.items()}
    grid = np.min([picture.shape[:2] for picture in (frame, *shown.values())], 0)
    frame = resize_area(frame, *grid)
    rms = lambda picture: float(np.sqrt(np.square(resize_area(picture, *grid) - frame).mean()))
    return {number: rms(picture) for number, picture in shown.items()}


def _small(file):
    picture = read_image(file)
    return resize_area(picture, *np.clip(np.array(picture.shape[:2]) // SHRINK, 1, GRID))


def _contradictions(rig, looks):
    """The times at which the rig's own picture is not the frame, or another must be where it has none."""

    def contradicts(own, look):
        return own not in look.alike if own in look.numbers else look.itself is not None

    return [time for time, look in sorted(looks.items()) if contradicts(rig.own(time), look)]


def _shown(rig, looks):
    """Whether most of the frames are there as their own pictures."""
    return 2 * sum(rig.own(time) in look.alike for time, look in looks.items()) > len(looks)


def _left_out(rig, pictures):
    """Whether at each of several times just the frame's own picture is missing."""
    numbers = set(rig.numbers.values())
    return len(pictures) > 1 and all(numbers - set(files) == {rig.own(time)} for time, files in pictures.items())


def _explained(rig, looks, numbers):
    """At how many times the camera that took the frame is known, be its picture there or missing."""
    return sum(rig.own(time) in numbers for time in looks)


def _readings(numbers):
    """Every `Rig` whose numbers go up with the places, from any place on, with cameras that have no pictures."""
    count, steps = len(numbers), {tuple(range(len(numbers))), tuple(number - numbers[0] for number in numbers)}
    for offsets in sorted(steps):
        least = offsets[-1] + 1
        for size in range(least, ABSENT * count + 1):
            for shift in range(size):
                yield Rig(size, {(place + shift) % size: n for place, n in zip(offsets, numbers, strict=True)})


def _reason(convention, looks, pictures):
    """Why no reading is taken, and what to do."""
    remedy = "or use the protocol `strict`, which needs none of these pictures."
    said = []
    for time in _contradictions(convention, looks)[:3]:
        itself, alike, files = looks[time].itself, looks[time].alike, pictures[time]
        found = f"most like {files[min(alike)].name}" if alike else "none of them"
        found = found if itself is None else files[itself].name
        own = files.get(convention.own(time))
        said.append(f"frame {time} is {found}, not {'missing' if own is None else own.name}")
    if not said:
        return (
            "the cameras of these pictures cannot be told: too few of the frames are among them, and those that are "
            f"missing fit several orders. Add to each time the picture that is its frame, {remedy}"
        )
    return (
        f"the numbers in these names are not in the order in which {convention.size} cameras took the frames: "
        f"{'; '.join(said)}. Rename them so that the camera of the first frame has the lowest number, that of the "
        f"second the next, and so on, add pictures that are missing, {remedy}"
    )
