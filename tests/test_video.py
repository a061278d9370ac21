"""A video that no later stage could use is refused at the door."""

import numpy as np
import pytest

from zestjax.cameras import Camera
from zestjax.video import Video, check_video


def video(**changes):
    cameras = Camera(np.tile(np.eye(3, dtype="f"), (2, 1, 1)), np.tile(np.eye(4, dtype="f"), (2, 1, 1)))
    return Video(np.full((2, 4, 6, 3), 0.5, "f"), cameras, np.float32(1), np.float32(5))._replace(**changes)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"images": np.full((2, 4, 6, 3), 128, np.uint8)}, "floats in .0, 1., got uint8"),
        ({"images": np.full((2, 4, 6, 3), 1.5, "f")}, "from 1.5 to 1.5"),
        ({"images": np.full((2, 4, 6, 3), np.nan, "f")}, "from nan"),
        ({"images": np.zeros((3, 4, 6, 3), "f")}, "axis N"),
        ({"images": np.zeros((2, 4, 6, 4), "f")}, r"`images` should be \(N H W 3\), got shape \(2, 4, 6, 4\)"),
        ({"images": np.zeros((2, 0, 6, 3), "f")}, r"shape \(2, 0, 6, 3\)"),
        ({"cameras": Camera(np.zeros((2, 3, 3), "f"), np.tile(np.eye(4, dtype="f"), (2, 1, 1)))}, "intrinsics"),
        ({"near": np.float32(6)}, "0 < near < far"),
    ],
)
def test_a_broken_video_is_refused_by_its_fault(changes, words):
    check_video("render", video())
    with pytest.raises(ValueError, match=words) as error:
        check_video("render", video(**changes))
    assert str(error.value).startswith("render: ")
