"""Cameras and videos whose leaves are numpy arrays: what files and the host's own arithmetic give."""

from zestjax.cameras import Camera
from zestjax.video import Video


def host_camera(*leaves):
    """A `Camera` of arrays of any kind."""
    return Camera(*leaves)


def host_video(*leaves):
    """A `Video` of arrays of any kind."""
    return Video(*leaves)
