"""Is there anything to predict a view from? The tests that stand between a user's files and the compiled program.

target   the camera to predict
"""

import numpy as np

from zestjax.cameras import Camera
from zestjax.io.layouts import select
from zestjax.video import check_video


def check_inputs(where, video):
    """Refuse a video that no view can be predicted from; see also `zestjax.video.check_video`.

    Args:
      where: name of the calling function or of the file, used in the message.
      video: `Video` of arrays with values.

    Raises:
      ValueError: shapes that disagree, colours or cameras that are not finite or degenerate, near >= far, fewer than
        two frames, or a camera that sees nothing of what the others see between near and far.
    """
    check_video(where, video)
    count, height, width = video.images.shape[:3]
    if count < 2:
        raise ValueError(f"{where}: `images` has {count} frame, expected at least 2: a single view has no parallax.")
    for i in range(count):
        others = select(video.cameras, [j for j in range(count) if j != i])
        if not _shares_view(select(video.cameras, i), others, video, height, width):
            raise ValueError(
                f"{where}: camera {i} sees nothing of what the other cameras see between near {float(video.near):g} "
                f"and far {float(video.far):g}; correct its pose or the depth bounds, or leave the frame out."
            )


def check_target(where, video, camera):
    """Refuse a target camera that sees nothing of what the input cameras see.

    Raises:
      ValueError: naming the camera's position.
    """
    height, width = video.images.shape[1:3]
    camera = Camera._make(map(np.asarray, camera))
    if not _shares_view(camera, video.cameras, video, height, width):
        raise ValueError(
            f"{where}: the target camera (pose {np.asarray(camera.camera_from_world)[:3].round(3).tolist()}) sees "
            "nothing of what the input cameras see; move it or turn it towards the scene."
        )


def _shares_view(camera, others, video, height, width):
    """Whether some point in the camera's view, on a 5 x 5 x 4 grid of pixels and depths, is in the view of another."""
    rows, columns = (np.linspace(0, size - 1, 5) for size in (height, width))
    depths = 1 / np.linspace(1 / float(video.near), 1 / float(video.far), 4)
    u, v, z = (a.ravel().astype(np.float32) for a in np.meshgrid(columns, rows, depths))
    k, pose = (np.asarray(leaf, np.float64) for leaf in camera)
    in_camera = np.linalg.solve(k, np.stack([u, v, np.ones_like(u)])) * z
    world = np.linalg.inv(pose) @ np.concatenate([in_camera, np.ones_like(z)[None]])
    k, pose = (np.asarray(leaf, np.float64) for leaf in others)
    image = k @ (pose @ world)[:, :3]
    depth = image[:, 2]
    pixels = image[:, :2] / np.where(depth > 0, depth, 1)[:, None]
    inside = (pixels >= 0) & (pixels <= np.array([width - 1, height - 1])[:, None])
    return bool(((depth > 0) & inside.all(1)).any())
