"""The floors on scenes whose best answer is known: a textured plane, exact copies, missing neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax import metrics
from zestjax.cameras import Camera, look_at, project, unproject
from zestjax.judge import floors
from zestjax.rays import pixel_grid
from zestjax.video import Video

HEIGHT, WIDTH, DEPTH = 20, 32, 4.0


def texture(points):
    """Smooth colours of world points (..., 3)."""
    x, y = points[..., 0], points[..., 1]
    waves = [np.sin(5 * x + 2 * y), np.sin(3 * y - 4 * x + 1), np.cos(6 * y + x)]
    return np.stack(waves, -1).astype(np.float32) / 2 + 0.5


def camera_at(x, y=0.0):
    intrinsics = jnp.array([[30.0, 0, (WIDTH - 1) / 2], [0, 30.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    position = jnp.array([x, y, 0.0])
    return Camera(intrinsics, look_at(position, position + jnp.array([0.0, 0, 1]), up=jnp.array([0.0, -1, 0])))


def picture_from(camera):
    """What the camera sees of the textured plane z = DEPTH."""
    points = unproject(camera, pixel_grid(HEIGHT, WIDTH), jnp.full((HEIGHT, WIDTH), DEPTH))
    return texture(np.asarray(points))


@pytest.fixture(scope="module")
def video():
    cameras = [camera_at(x) for x in (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4)]
    images = jnp.stack([jnp.asarray(picture_from(camera)) for camera in cameras])
    return Video(images, jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras), jnp.float32(2), jnp.float32(8))


@pytest.fixture(scope="module")
def warp_of():
    """One compiled program for all: the list of excluded frames has a fixed length."""
    compiled = jax.jit(lambda *args: floors.plane_warp(*args[:3], exclude=args[3], planes=16))
    padded = lambda exclude: jnp.array([*exclude, *[-1] * (5 - len(exclude))])
    return lambda video, camera, time, exclude=(): compiled(video, camera, jnp.int32(time), padded(exclude))


def frame(video, i):
    return jax.tree.map(lambda leaf: leaf[i], video.cameras)


def test_the_nearest_frame_is_nearest_in_time_and_then_in_position(video):
    index = lambda camera, time, exclude=(): int(floors.nearest_frame(video, camera, time, exclude=exclude).frame)
    assert index(camera_at(-5.0), 3) == 3
    assert index(camera_at(-5.0), 3, (3,)) == 2
    assert index(camera_at(5.0), 3, (3,)) == 4
    assert index(camera_at(5.0), 3, (2, 3, 4)) == 5
    assert index(camera_at(5.0), 0, jnp.array([0, 0, 1])) == 2


def test_the_nearest_frame_is_returned_unchanged_under_jit(video):
    nearest = jax.jit(floors.nearest_frame)(video, camera_at(1.0), jnp.int32(2), exclude=jnp.array([2]))
    assert int(nearest.frame) == 3
    np.testing.assert_array_equal(nearest.image, video.images[3])


def test_a_plane_is_found_at_its_depth_and_reproduced(video, warp_of):
    camera = camera_at(0.07, 0.03)
    warped = warp_of(video, camera, 2)
    assert float(warped.depth) == pytest.approx(DEPTH, rel=0.1)
    seen = np.asarray(warped.seen)
    assert seen.mean() > 0.9
    assert float(metrics.psnr(warped.image, picture_from(camera), mask=seen)) > 30


def test_the_target_itself_is_not_a_neighbour(video, warp_of):
    """Frame 2 spoilt: its own camera must not use it at slot 0, nor may anyone when it is excluded."""
    spoilt = video._replace(images=video.images.at[2].set(0.0))
    for exclude in ((), (2,)):
        warped = warp_of(spoilt, frame(video, 2), 2, exclude)
        assert float(metrics.psnr(warped.image, video.images[2], mask=warped.seen)) > 30


def test_slot_zero_of_another_camera_is_used(video, warp_of):
    """With every other neighbour gone, the one left cannot agree with any: the image is the nearest frame."""
    alone = warp_of(video, camera_at(0.1), 2, (0, 1, 3, 4, 5))
    assert float(alone.overlap) == 0 and not np.any(alone.seen)
    np.testing.assert_array_equal(alone.image, video.images[2])
    pair = warp_of(video, camera_at(0.1), 2, (0, 1, 4, 5))
    assert float(pair.overlap) > 0.5


def test_pixels_no_neighbour_sees_are_the_nearest_frames(video, warp_of):
    aside = camera_at(2.5)
    warped = warp_of(video, aside, 2)
    unseen = ~np.asarray(warped.seen)
    assert 0 < unseen.mean() < 1
    np.testing.assert_array_equal(np.asarray(warped.image)[unseen], np.asarray(video.images[2])[unseen])


def test_at_the_ends_of_the_video_missing_slots_do_not_repeat_frames(video, warp_of):
    """The first frame spoilt: at time 0 slots -2 and -1 would repeat it three times over if they were clamped."""
    spoilt = video._replace(images=video.images.at[0].set(0.0))
    warped = warp_of(spoilt, frame(video, 0), 0, (0,))
    assert float(metrics.psnr(warped.image, video.images[0], mask=warped.seen)) > 25


def test_disagreement_is_the_mean_squared_difference_of_pairs():
    rng = np.random.default_rng(1)
    values, seen = rng.random((3, 2, 4, 3)).astype(np.float32), rng.random((3, 2, 4)) > 0.3
    per_pixel = []
    for row in range(2):
        for column in range(4):
            views = [v for v in range(3) if seen[v, row, column]]
            pairs = [(a, b) for a in views for b in views if a < b]
            if pairs:
                differences = [np.mean((values[a, row, column] - values[b, row, column]) ** 2) for a, b in pairs]
                per_pixel.append(np.mean(differences))
    difference, overlap = floors._disagreement(jnp.asarray(values), jnp.asarray(seen, jnp.float32))
    assert float(difference) == pytest.approx(np.mean(per_pixel), rel=1e-5)
    assert float(overlap) == pytest.approx(len(per_pixel) / 8)


def test_a_camera_turned_away_gets_the_nearest_frame(video, warp_of):
    away = look_at(jnp.zeros(3), jnp.array([0.0, 0, -1]), up=jnp.array([0.0, -1, 0]))
    camera = Camera(camera_at(0.0).intrinsics, away)
    assert not np.any(project(camera, jnp.array([0.0, 0, DEPTH])).in_front)
    warped = warp_of(video, camera, 3)
    np.testing.assert_array_equal(warped.image, video.images[3])


def test_excluding_every_frame_is_refused(video):
    for floor in (floors.nearest_frame, floors.plane_warp):
        with pytest.raises(ValueError, match=f"{floor.__name__}: `exclude` names all 6 frames"):
            floor(video, camera_at(0.0), 0, exclude=range(6))
