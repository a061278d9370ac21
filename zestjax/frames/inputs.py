"""Is there anything to predict a view from? What stands between a user's arrays and the compiled program.

N        frames of the video
target   the camera, and the time, to predict
blind    said of a camera that sees nothing of what the others see between near and far
reading  another convention that a pose may have been written in
"""

from typing import Any, NamedTuple

import numpy as np

from zestjax.base.checks import check_known, check_shapes, check_types, traced
from zestjax.cameras import Camera, check_camera
from zestjax.video import Video, check_video

ROUNDING = 1e-9  # a gap between two views, as a share of their extent, that float64 may have made
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # of a camera's y and z axis: OpenGL's to OpenCV's, and back
OPENGL = (
    "OpenGL's (y up, z backward), change the signs of the second and third row of a camera_from_world; "
    "`cameras.camera_from_opengl_pose` takes a world_from_camera"
)
READINGS = (
    (OPENGL, lambda pose: FLIP @ pose),
    (OPENGL, lambda pose: FLIP @ np.linalg.inv(pose)),
    ("world_from_camera, invert it", np.linalg.inv),
)
"""What poses (..., 4, 4) may have been meant as, with what to do then, and what they are then."""


class Sight(NamedTuple):
    """What cameras (...) see, float64, world axes. centre: (..., 3). rays: (..., 4, 3) to the image's corners, of depth
    1. edges: (..., 6, 3) directions of the view's edges. corners: (..., 8, 3) of the view from near to far."""

    centre: np.ndarray
    rays: np.ndarray
    edges: np.ndarray
    corners: np.ndarray


def check_inputs(where: str, video: Video, *, quantised: bool = False) -> Video:
    """Refuse a video that no view can be predicted from; see also `zestjax.video.check_video`.

    Args:
      where: name of the calling function or of the file, used in the message.
      video: `Video` of arrays with values.
      quantised: uint8 images will do as well.

    Returns:
      `Video` with images and cameras on the host.

    Raises:
      ValueError: shapes that disagree, colours or cameras that are not finite or degenerate, near >= far, fewer than
        two frames, or a camera that sees nothing of what the others see between near and far.
    """
    video = check_video(where, video, quantised=quantised)
    if (count := len(video.images)) < 2:
        raise ValueError(f"{where}: `images` has {count} frame, expected at least 2: a single view has no parallax.")
    if blind := _blind(video, video.cameras):
        raise ValueError(
            f"{where}: camera {blind[0]} sees nothing of what the other cameras see between near {float(video.near):g} "
            f"and far {float(video.far):g}; correct its pose or the depth bounds, or leave the frame out."
            f"{_hint(lambda read: _video_mended(video, blind[0], read))}"
        )
    return video


def check_target(where: str, video: Video, camera: Camera) -> None:
    """Refuse a target camera that cannot be used, or that sees nothing of what the input cameras see.

    Args:
      where: name of the calling function or of the scene, used in the message.
      video: `Video` that `check_inputs` lets pass.
      camera: `Camera` for an image of the video's size.

    Raises:
      ValueError: not one `Camera`, a degenerate one, or a blind one, whose pose is named.
    """
    check_one_camera(where, camera)
    check_camera(where, camera)
    pose, seen = np.asarray(camera.camera_from_world, np.float64), _sight(video, video.cameras)
    sees = lambda pose: _share(_sight(video, Camera(camera.intrinsics, pose)), seen).any()
    if not sees(pose):
        raise ValueError(
            f"{where}: the target camera (pose {pose[:3].round(3).tolist()}) sees nothing of what the input cameras "
            f"see; move it or turn it towards the scene.{_hint(lambda read: sees(read(pose)))}"
        )


def check_view(
    where: str, video: Video, camera: Camera, time: Any, *, exclude: Any = ()
) -> tuple[Any, tuple[int, ...]]:
    """Refuse a view that a video cannot give.

    Args:
      where: name of the calling function, used in the message.
      video: `Video` that `check_inputs` lets pass.
      camera: the target's `Camera`.
      time: an integer, a time of the video.
      exclude: frames that must serve nothing.

    Returns:
      (time, exclude) as an int, or what is traced, and a tuple of ints.

    Raises:
      ValueError: what `check_target` or `check_exclude` refuses, or a time that is no integer or not in the video. Of
        what is traced only types and shapes can be looked at: a camera that sees nothing renders a last resort, and
        at a time outside the video no slot is valid.
    """
    count = len(video.images)
    if traced(time):
        check_shapes(where, time=(time, ""))
        if time.dtype.kind not in "iu":
            raise ValueError(f"{where}: `time` is a traced {time.dtype}, expected an integer, a frame of the video.")
    elif not _is_frame(time, count):
        raise ValueError(f"{where}: `time` is {time!r}, expected {_frames(count)}.")
    exclude = check_exclude(where, count, exclude)
    if traced((video, camera)):
        check_one_camera(where, camera)
    else:
        check_target(where, video, camera)
    return time if traced(time) else int(time), exclude


def check_one_camera(where: str, camera: Any) -> None:
    """Refuse what is not one `Camera`; its values need not be known.

    Raises:
      ValueError: another type, a batch, or a pose without its last row.
    """
    check_types(where, camera=(camera, Camera))
    if np.ndim(camera.camera_from_world) > 2 or np.ndim(camera.intrinsics) > 2:
        raise ValueError(
            f"{where}: `camera` is a batch of shape {np.shape(camera.camera_from_world)}; map over it by jax.vmap."
        )
    check_shapes(where, intrinsics=(camera.intrinsics, "3 3"), camera_from_world=(camera.camera_from_world, "4 4"))


def check_exclude(where: str, count: int, exclude: Any) -> tuple[int, ...]:
    """Refuse frames to exclude that a video of `count` frames does not have, or all of them.

    Returns:
      tuple of ints, each once.

    Raises:
      ValueError: naming the function and what is no frame.
    """
    try:
        listed = list(exclude)
    except TypeError:
        raise ValueError(f"{where}: `exclude` is {exclude!r}, expected a sequence of frame numbers.") from None
    check_known(where, exclude=listed)
    if wrong := [i for i in listed if not _is_frame(i, count)]:
        raise ValueError(f"{where}: `exclude` holds {wrong[0]!r}, expected {_frames(count)}.")
    frames = sorted({int(i) for i in listed})
    if len(frames) == count:
        raise ValueError(f"{where}: `exclude` names all {count} frames, expected at least one left to use.")
    return tuple(frames)


def _frames(count):
    return f"an integer from 0 to {count - 1}, one of the video's {count} frames"


def _is_frame(value, count):
    value = np.asarray(value)
    return value.ndim == 0 and value.dtype.kind in "iu" and 0 <= int(value) < count


def _sight(video, cameras):
    """`Sight` of cameras (...) for images of the video's size."""
    intrinsics, pose = (np.asarray(leaf, np.float64) for leaf in cameras)
    height, width = video.images.shape[1:3]
    ends = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [width, height] - 0.5  # the pixels' own edges
    homogeneous = np.concatenate([ends, np.ones((4, 1))], -1)
    rays = np.swapaxes(np.linalg.inv(intrinsics) @ homogeneous.T, -1, -2) @ pose[..., :3, :3]
    centre = -(pose[..., None, :3, 3] @ pose[..., :3, :3])
    edges = np.concatenate([rays, rays[..., 1:3, :] - rays[..., :2, :]], -2)
    corners = np.concatenate([centre + float(bound) * rays for bound in (video.near, video.far)], -2)
    return Sight(centre[..., 0, :], rays, edges, corners)


def _share(a, b):
    """(...) bool: something between near and far in one camera's view is in the other's, at any depth there."""
    return _meet(a, b) | _meet(b, a)


def _meet(a, b):
    """(...) bool: a's view from near to far and b's from its centre on meet. Two convex bodies do unless they are apart
    along the normal of a face of either, or along what is normal to an edge of each."""
    corners = a.corners - b.centre[..., None, :]
    reach = np.linalg.norm(corners, axis=-1).max(-1)[..., None, None]
    pyramid = reach * np.concatenate([np.zeros_like(b.rays[..., :1, :]), b.rays], -2)
    edges = np.concatenate(np.broadcast_arrays(a.edges, b.edges), -2)
    axes = np.cross(edges[..., :, None, :], edges[..., None, :, :]).reshape(*edges.shape[:-2], -1, 3)
    p, q = (axes @ np.swapaxes(points, -1, -2) for points in (corners, pyramid))
    gap = np.maximum(p.min(-1) - q.max(-1), q.min(-1) - p.max(-1))
    return (gap <= ROUNDING * reach[..., 0] * np.linalg.norm(axes, axis=-1)).all(-1)


def _blind(video, cameras):
    """Which of a video's cameras are blind. Most share a view with the next one, and no other is tried for them."""
    sight = _sight(video, cameras)
    at = lambda i: Sight(*(leaf[i] for leaf in sight))
    every = np.arange(len(sight.centre))
    shares = _share(sight, at(np.roll(every, -1)))
    alone = np.flatnonzero(~(shares | np.roll(shares, 1)))
    return [int(i) for i in alone if not _share(at(i), at(np.flatnonzero(every != i))).any()]


def _hint(mended):
    """A sentence on the first reading with which all would be well, if there is one."""
    return next((f" If its pose is {reading}." for reading, read in READINGS if mended(read)), "")


def _video_mended(video, i, read):
    """Whether camera i is not blind with a reading of its pose alone, or no camera is with that of all poses."""
    poses = np.asarray(video.cameras.camera_from_world, np.float64)
    one = np.where((np.arange(len(poses)) == i)[:, None, None], read(poses), poses)
    blind = lambda poses: _blind(video, video.cameras._replace(camera_from_world=poses))
    return not blind(read(poses)) or i not in blind(one)
