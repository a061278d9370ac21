"""What no view can be predicted from is refused at the door of both systems, by its fault, before anything compiles."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation
from stage import MINI, PAPER, STILL

from zestjax import novel_view
from zestjax.cameras import Camera, look_at
from zestjax.frames import inputs
from zestjax.frames.inputs import FLIP, check_inputs, check_target
from zestjax.io.layouts import select
from zestjax.systems.mvsnerf import MVSNERF
from zestjax.systems.presets import TINY
from zestjax.systems.targets import target_inputs
from zestjax.video import Video

CAMERA = stage.camera(0.1)
LAST = stage.FRAMES - 1


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch):
    """What comes after the checks is out of order, so that whatever is refused is refused before."""

    def fail(*args, **kwargs):
        raise AssertionError("computed what should have been refused")

    for name in ("footage", "_maps", "target_inputs", "render_inputs"):
        monkeypatch.setattr(novel_view, name, fail)


def posed(change):
    """A camera's poses changed; of a video's too."""

    def changed(value):
        if isinstance(value, Video):
            return value._replace(cameras=changed(value.cameras))
        return value._replace(camera_from_world=change(np.array(value.camera_from_world)).astype(np.float32))

    return changed


def lensed(change):
    def changed(value):
        if isinstance(value, Video):
            return value._replace(cameras=changed(value.cameras))
        return value._replace(intrinsics=change(np.array(value.intrinsics)))

    return changed


def painted(change):
    return lambda video: video._replace(images=change(video.images))


def entry(*index, value):
    def changed(matrix):
        matrix[(..., *index)] = value
        return matrix

    return changed


class Bad(NamedTuple):
    """what: str. change: of a good one. words: regex of the message after the function's name."""

    what: str
    change: object
    words: str


MATRICES = [
    Bad("a focal length of 0", lensed(entry(0, 0, value=0)), "`intrinsics` is singular: a focal length is 0"),
    Bad("a focal length below 0", lensed(entry(1, 1, value=-9)), "`intrinsics` has a focal length below 0"),
    Bad("K that does not end in 1", lensed(entry(2, 2, value=2)), r"`intrinsics` is not upper .* \(0, 0, 1\)"),
    Bad("K that is infinite", lensed(entry(0, 2, value=np.inf)), "`intrinsics` has an entry that is not finite"),
    Bad("a pose that is NaN", posed(entry(0, 3, value=np.nan)), "`camera_from_world` has an entry that is not finite"),
    Bad("a scaled pose", posed(lambda p: p * 2), "`camera_from_world` is not rigid"),
    Bad("a mirror", posed(lambda p: np.diag([-1, 1, 1, 1]) @ p), "`camera_from_world` is a reflection"),
    Bad("a pose's last row", posed(entry(3, 0, value=1)), r"`camera_from_world` does not end in \(0, 0, 0, 1\)"),
    Bad("a pose of three rows", posed(lambda p: p[..., :3, :]), r"4 4\), got shape .*3, 4\). A 3x4 pose needs"),
]
VIDEOS = [
    *MATRICES,
    Bad("times 255", painted(lambda i: i * 255), r"`images` should be floats in \[0, 1\], .*; divide bytes by 255"),
    Bad("integers", painted(lambda i: np.int32(i * 255)), r"`images` should be floats .*int32.*; divide bytes by 255"),
    Bad("below 0", painted(lambda i: 2 * i - 1), r"`images` should be floats .* got float32 .* from -0\.\d+ to"),
    Bad("a colour that is NaN", painted(lambda i: np.where(i > 0.8, np.nan, i)), "`images` should be .* from nan"),
    Bad("four channels", painted(lambda i: i[..., [0, 1, 2, 0]]), r"`images` .* 3\), got shape \(6, 16, 24, 4\)"),
    Bad("one image", painted(lambda i: i[0]), r"`images` should be \(N H W 3\), got shape \(16, 24, 3\)"),
    Bad("one frame", lambda v: v._replace(images=v.images[:1], cameras=select(v.cameras, [0])), "has 1 frame"),
    Bad("a camera too few", lambda v: v._replace(cameras=select(v.cameras, slice(LAST))),
        "axis N of `intrinsics` is 5, expected 6 from `images`"),
    Bad("one K for all", lensed(lambda k: k[0]), r"`intrinsics` should be \(N 3 3\), got shape \(3, 3\)"),
    Bad("near and far swapped", lambda v: v._replace(near=v.far, far=v.near), r"0 < near < far, got near 6.* far 1\.5"),
    Bad("near 0", lambda v: v._replace(near=np.float32(0)), r"0 < near < far, got near 0\.0 and far 6"),
    Bad("far infinite", lambda v: v._replace(far=np.inf), "0 < near < far, got near 1.5 and far inf"),
    Bad("bounds of every frame", lambda v: v._replace(near=np.full(6, 1.5)), r"`near` should be \(\), got .*\(6,\)"),
    Bad("no Video", tuple, "`video` should be a `Video`, got `tuple`"),
    Bad("no Camera", lambda v: v._replace(cameras=tuple(v.cameras)), "`cameras` should be a `Camera`, got `tuple`"),
    Bad("a frame in OpenGL's axes", posed(lambda p: np.where(np.arange(6)[:, None, None] == 2, FLIP @ p, p)),
        "camera 2 sees nothing of what .* If its pose is OpenGL's"),
]  # fmt: skip
TARGETS = [
    *(Bad(bad.what, lambda v, bad=bad: v | {"camera": bad.change(v["camera"])}, bad.words) for bad in MATRICES),
    *(Bad(what, lambda v, c=change: v | {"camera": c(v["camera"])}, words) for what, change, words in [
        ("a plain tuple", tuple, "`camera` should be a `Camera`, got `tuple`"),
        ("a batch of one", lambda c: jax.tree.map(lambda x: x[None], c), r"`camera` is a batch of shape \(1, 4, 4\)"),
        ("OpenGL's axes", posed(lambda p: FLIP @ p), "target camera .* sees nothing .* If its pose is OpenGL's"),
        ("OpenGL's world_from_camera", posed(lambda p: np.linalg.inv(FLIP @ p)), "nothing .*camera_from_opengl_pose"),
        ("a camera far aside", posed(entry(0, 3, value=99)), "target camera .* sees nothing .* towards the scene.$"),
    ]),
    *(Bad(f"time {time!r}", lambda v, t=time: v | {"time": t}, "`time` is .*, expected an integer from 0 to 5,")
      for time in (6, -1, 5.5, 5.0, True, None, "2", np.array([2]), np.float32(2))),
    *(Bad(f"exclude {frames!r}", lambda v, f=frames: v | {"exclude": f}, words) for frames, words in [
        ((6,), "`exclude` holds 6, expected an integer from 0 to 5,"),
        ((0, -1), "`exclude` holds -1, expected"),
        ((1.5,), "`exclude` holds 1.5, expected"),
        (2, "`exclude` is 2, expected a sequence"),
        (range(6), "`exclude` names all 6 frames, expected at least one left"),
    ]),
]  # fmt: skip


@pytest.fixture(scope="module")
def params():
    return stage.params_of(MINI)


@pytest.fixture(params=[MINI, MVSNERF], ids=["zest", "mvsnerf"])
def system(request):
    """prepare, and render_view of (video, camera, time, exclude), of a prepared scene that nobody looks into."""
    params = jax.eval_shape(request.param.init, jax.random.key(0))
    given = dict(system=request.param)

    def render_view(video, camera, time, exclude):
        prepared = novel_view.Prepared(video, None, "maps")
        return novel_view.render_view(params, prepared, camera, time, exclude=exclude, **given)

    return lambda video, **k: novel_view.prepare(params, video, **given, **k), render_view


@pytest.mark.parametrize("bad", VIDEOS, ids=lambda bad: bad.what)
@pytest.mark.parametrize("host", [True, False], ids=["numpy", "jax"])
def test_a_video_is_refused_by_its_fault(system, bad, host):
    prepare, _ = system
    video = bad.change(stage.video())
    video = video if host else jax.tree.map(jnp.asarray, video)
    with pytest.raises(ValueError, match=f"^novel_view.prepare: .*{bad.words}"):
        prepare(video)


@pytest.mark.parametrize("bad", TARGETS, ids=lambda bad: bad.what)
def test_a_target_is_refused_by_its_fault(system, bad):
    _, render_view = system
    asked = dict(camera=CAMERA, time=2, exclude=())
    with pytest.raises(AssertionError, match="computed"):
        render_view(stage.video(), **asked)
    with pytest.raises(ValueError, match=f"^novel_view.render_view: .*{bad.words}"):
        render_view(stage.video(), **bad.change(asked))


@pytest.mark.parametrize("time", [np.int64(2), np.uint8(2), np.array(2), jnp.int32(2)], ids=lambda t: type(t).__name__)
def test_integers_of_any_kind_are_times_and_frames_to_exclude(system, time):
    asked = jax.tree.map(jnp.asarray, CAMERA), time
    for exclude in ((), [np.int32(1), 1], np.array([1, 3]), jnp.array([0]), {4}):
        with pytest.raises(AssertionError, match="computed"):
            system[1](stage.video(), *asked, exclude)


def test_what_is_to_be_excluded_is_checked_when_preparing(system):
    with pytest.raises(ValueError, match="^novel_view.prepare: `exclude` holds 6, expected an integer from 0 to 5"):
        system[0](stage.video(), exclude=(6,))


def test_a_traced_video_is_not_prepared(system):
    with pytest.raises(ValueError, match="^novel_view.prepare: `video` is traced, expected an array with values"):
        jax.jit(system[0])(stage.video())


def test_what_does_not_belong_together_is_named(params):
    render = lambda prepared, params=params: novel_view.render_view(params, prepared, CAMERA, 2, system=MINI)
    with pytest.raises(ValueError, match="`prepared` should be a `Prepared`, got `Video`"):
        render(stage.video())
    with pytest.raises(ValueError, match="`prepared` has no maps of its frames"):
        render(novel_view.Prepared(stage.video(), None, None))
    lacking = params._replace(dynamic=params.dynamic._replace(volume=None))
    for refused in (lambda: render(novel_view.Prepared(stage.video(), None, "maps"), lacking),
                    lambda: novel_view.prepare(lacking, stage.video(), system=MINI)):  # fmt: skip
        with pytest.raises(ValueError, match=r"`params` have no `.dynamic.volume.*`, which `system` computes with"):
            refused()
    with pytest.raises(ValueError, match="`params` have no `.analysis"):
        novel_view.prepare(stage.params_of(PAPER), stage.video(), system=MINI)
    with pytest.raises(ValueError, match="`params` have `.dynamic.*`, which `system` lacks"):
        novel_view.prepare(params, stage.video(), system=STILL)
    with pytest.raises(ValueError, match=r"`params.analysis.*` has shape .*, expected .*; give its own weights"):
        novel_view.prepare(params, stage.video(), system=TINY)


def test_bytes_are_taken_for_what_they_show():
    shown = stage.video()
    quantised = shown._replace(images=np.round(shown.images * 255).astype(np.uint8))
    shown_by = lambda video: target_inputs(*video, CAMERA, 2, system=MVSNERF)[0].key.images
    assert shown_by(quantised).dtype == jnp.float32
    np.testing.assert_allclose(shown_by(quantised), shown_by(shown), atol=0.5 / 255 + 1e-6)
    with pytest.raises(AssertionError, match="computed"):
        novel_view.prepare(stage.params_of(MINI), quantised, system=MINI)


def test_a_colour_may_leave_its_range_by_rounding():
    check_inputs("test", painted(lambda i: np.where(i > 0.8, np.float32(1 + 1e-6), i))(stage.video()))


def ring(count, *, radius=4.0, view=40, near=2.0, far=6.0, turn=2 * np.pi, inwards=True, size=(48, 64)):
    """`Video` of cameras on a circle that look at its middle, or away from it; `view` in degrees."""
    angle = np.arange(count) / count * turn
    place = radius * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1).astype(np.float32)
    pose = look_at(place, 0 * place if inwards else 2 * place, up=np.array([0, -1, 0], np.float32))
    focal = size[1] / 2 / np.tan(np.radians(view) / 2)
    k = np.array([[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]], np.float32)
    cameras = Camera(np.tile(k, (count, 1, 1)), np.asarray(pose))
    return Video(np.zeros((count, *size, 3), np.float32), cameras, np.float32(near), np.float32(far))


@pytest.mark.parametrize(
    "video",
    [
        ring(8), ring(2, view=2, near=1, far=16, turn=np.pi), ring(12, radius=0.3, inwards=False, near=1, far=20),
        ring(3, size=(1, 1)), stage.video(), stage.video((1, 1)), jax.tree.map(jnp.asarray, stage.video()),
    ],
    ids=["inwards", "telephotos that cross", "a panorama", "a pixel", "a walk", "a pixel's walk", "on the device"],
)  # fmt: skip
def test_no_false_alarm(video):
    check_inputs("test", video)
    for i in range(len(video.images)):
        check_target("test", video, select(video.cameras, i))


def test_a_whole_video_in_opengls_axes_is_told_where_its_cameras_look_apart():
    with pytest.raises(ValueError, match="camera 0 sees nothing .* If its pose is OpenGL's"):
        check_inputs("test", posed(lambda p: FLIP @ p)(ring(8)))
    with pytest.raises(ValueError, match="camera 0 sees nothing .* If its pose is world_from_camera, invert it"):
        check_inputs("test", posed(np.linalg.inv)(ring(2, view=5, turn=np.pi)))
    check_inputs("test", posed(lambda p: FLIP @ p)(stage.video()))  # side by side both readings are sound


def test_views_meet_where_a_linear_program_finds_a_point_in_both():
    rng, count = np.random.default_rng(0), 24
    pose, k = np.tile(np.eye(4), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3))
    k[:, [0, 1], [0, 1]] = rng.uniform(20, 200, (count, 2))
    k[:, :2, 2] = rng.uniform(0, 48, (count, 2))
    video = Video(np.zeros((count, 48, 64, 3), np.float32), Camera(k, pose), 1.0, 4.0)
    sight = inputs._sight(video, video.cameras)
    at = lambda i: inputs.Sight(*(leaf[i] for leaf in sight))

    def point_in_both(a, b):  # a mean of a's corners is b's centre and some of b's rays
        system = np.block([[a.corners.T, -b.rays.T], [np.ones((1, 8)), np.zeros((1, 4))]])
        return linprog(np.zeros(12), A_eq=system, b_eq=[*b.centre, 1], bounds=(0, None)).status == 0

    expected = [[point_in_both(at(i), at(j)) for j in range(count)] for i in range(count)]
    np.testing.assert_array_equal([inputs._meet(at(i), sight) for i in range(count)], expected)
    assert 0.05 < np.mean(expected) < 0.95
