"""Effects are found where they are, not where they are not, and in doubt they stay on."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage

from zestjax import effects
from zestjax.apps.cli import main
from zestjax.apps.effects import choose, over_scenes
from zestjax.cameras import Camera
from zestjax.effects.found import EFFECTS, NO, SWITCHES, UNKNOWN, YES, Evidence, chosen, judged
from zestjax.effects.pairs import image_pixels
from zestjax.effects.recording import noise_of
from zestjax.effects.standing import nearest_rho, pixel_on, still_gap, track_of
from zestjax.effects.surfaces import thin
from zestjax.effects.systems import priors_for
from zestjax.encoding import Volume
from zestjax.frames.analysis import without_mode
from zestjax.frames.known import known_frames
from zestjax.io.nsff import write_nsff
from zestjax.io.scenes import Scene
from zestjax.systems import presets
from zestjax.systems.sampling import Guided
from zestjax.video import Video

HEIGHT, WIDTH, FRAMES = 64, 96, 6
WALL, CARD, NEAR, FAR = 4.0, 2.0, 1.6, 5.0
FOCAL = 90.0
PLACES = 0.06 * np.array([0, 1.0, 2.2, 3.1, 4.3, 5.0])
INTRINSICS = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]], np.float32)


def texture(x, y, kind):
    """(..., 3) colours of a plane at its own coordinates: waves that no two places share."""
    rng = np.random.default_rng(kind)
    waves = rng.normal(0, 9, (12, 2)), rng.uniform(0, 6.3, (12, 3)), rng.uniform(0.3, 1, (12, 3))
    sums = sum(a * np.sin(w[0] * x[..., None] + w[1] * y[..., None] + p) for w, p, a in zip(*waves, strict=True))
    return 0.5 + 0.1 * sums


def shot(place, card, wall):
    """A frame from (place, 0, 0): a wall whose texture is shifted by `wall`, and a card shifted by `card`."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    ray = (u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL
    far, near = ((place + z * ray[0], z * ray[1]) for z in (WALL, CARD))
    on_card = (np.abs(near[0] - 0.15 - card[0]) < 0.35) & (np.abs(near[1] - card[1]) < 0.35)
    shown = texture(far[0] - wall[0], far[1] - wall[1], 1)
    return np.where(on_card[..., None], texture(near[0] - card[0], near[1] - card[1], 2), shown)


def poses(places):
    pose = np.tile(np.eye(4, dtype=np.float32), (len(places), 1, 1))
    pose[:, 0, 3] = -np.asarray(places)
    return Camera(np.tile(INTRINSICS, (len(places), 1, 1)), pose)


def made(places=PLACES, *, card=(0.0, 0.0), wall=(0.0, 0.0), gain=0.0, noise=0.0):
    """A `Video`; card and wall: world units a frame; gain: of the last frame above the first."""
    images = [shot(x, t * np.asarray(card), t * np.asarray(wall)) for t, x in enumerate(places)]
    images = np.stack(images) * np.linspace(1, 1 + gain, len(places))[:, None, None, None] / (1 + max(gain, 0))
    images = np.clip(images + np.random.default_rng(0).normal(0, noise, images.shape), 0, 1)
    return Video(np.round(255 * images).astype(np.uint8), poses(places), np.float32(NEAR), np.float32(FAR))


def told(video, name="motion", **options):
    found = effects.inspect(video, **({"smallest": 0} | options))
    assert set(found) == set(EFFECTS)
    json.dumps(effects.as_told(found), allow_nan=False)
    return found[name].told


def test_a_still_point_lies_on_its_track_and_a_moved_one_beside_it():
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] * 0.02
    here, there = poses([0.0, 0.0])[1].copy()
    there[:3, :3] = np.eye(3) + turn - turn.T  # nearly a rotation: the test's own projection uses the same numbers
    there[:3, 3] = [0.3, -0.1, 0.2]
    one, other = Camera(INTRINSICS, here), Camera(INTRINSICS, there)
    grid = image_pixels(HEIGHT // 2, WIDTH // 2)
    depth = rng.uniform(NEAR, FAR, grid.shape[:2])
    points = (grid @ np.linalg.inv(INTRINSICS.astype(float)).T) * depth[..., None]
    landed = (points @ there[:3, :3].T.astype(float) + there[:3, 3]) @ INTRINSICS.T.astype(float)
    landed = landed[..., :2] / landed[..., 2:]
    track = track_of(grid, one, other, NEAR, FAR)
    np.testing.assert_allclose(pixel_on(track, 1 / depth), landed, atol=1e-5)
    np.testing.assert_allclose(nearest_rho(track, landed), 1 / depth, rtol=1e-4)
    assert still_gap([track], [landed]).max() < 1e-4
    along = pixel_on(track, track.most) - pixel_on(track, track.least)
    across = np.stack([-along[..., 1], along[..., 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
    np.testing.assert_allclose(still_gap([track], [landed + 3 * across]), 3, rtol=1e-3)


def test_where_cameras_stand_at_one_place_the_gap_is_the_flow_beyond_the_turn():
    camera, grid = Camera(INTRINSICS, np.eye(4, dtype=np.float32)), image_pixels(4, 6)
    track = track_of(grid, camera, camera, NEAR, FAR)
    np.testing.assert_allclose(still_gap([track], [grid[..., :2] + [3.0, 4.0]]), 5.0, rtol=1e-6)


def test_two_depths_of_one_pixel_are_no_still_point():
    """Along its epipolar line a point that moves has another depth in every pair: two pairs tell."""
    grid, cameras = image_pixels(4, 6), poses([0.0, 0.1, 0.2])
    at = lambda i: Camera(*(leaf[i] for leaf in cameras))
    tracks = [track_of(grid, at(0), at(i), NEAR, FAR) for i in (1, 2)]
    seen = lambda rho, other: [pixel_on(tracks[0], np.full((4, 6), rho)), pixel_on(tracks[1], np.full((4, 6), other))]
    assert still_gap(tracks, seen(0.3, 0.3)).max() < 1e-6
    alone = [still_gap([track], [there]).max() for track, there in zip(tracks, seen(0.3, 0.5), strict=True)]
    assert max(alone) < 1e-6 and still_gap(tracks, seen(0.3, 0.5)).min() > 0.5


def test_nothing_moves_where_only_the_camera_does():
    assert told(made()) == NO
    assert told(made(noise=0.02)) == NO
    assert told(made(np.zeros(FRAMES))) == NO  # a still camera


@pytest.mark.parametrize("places", [PLACES, np.zeros(FRAMES)], ids=["moving camera", "still camera"])
def test_what_moves_is_found(places):
    video = made(places, card=(0.0, 0.05))
    assert told(video) == YES
    picture = effects.inspect(video)["motion"].picture
    assert picture is not None and picture.shape == (HEIGHT // 2, WIDTH // 2, 3)
    red = picture[..., 0] - picture[..., 1] > 0.5
    columns, rows = np.flatnonzero(red.any(0)), np.flatnonzero(red.any(1))
    assert columns.min() > 8 and rows.size and red.mean() < 0.4  # the card, and not the wall


def test_motion_stays_on_where_the_frames_cannot_tell():
    black = made()._replace(images=np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8))
    assert told(black) == UNKNOWN and told(black, "exposure") == UNKNOWN
    assert told(made(PLACES[:2])) == UNKNOWN  # two frames
    assert told(made()) == NO and told(made(), smallest=HEIGHT + 1) == UNKNOWN  # too small for what is slow
    assert told(made(), exclude=range(1, FRAMES)) == UNKNOWN  # one is left
    assert told(made(), exclude=(1, 3, 5)) == UNKNOWN  # none is left beside its neighbour
    assert told(made(card=(0.03, 0.0)), exclude=(1, 4)) in (
        UNKNOWN,
        YES,
    )  # 0 and 5 have no neighbour, 2 and 3 each other
    grey = made()._replace(images=np.full((FRAMES, HEIGHT, WIDTH, 3), 128, np.uint8))
    assert told(grey) == UNKNOWN


def test_all_that_moves_is_motion():
    assert told(made(wall=(0.0, 0.06), card=(0.0, -0.05))) == YES


def test_an_exposure_that_drifts_is_no_motion():
    video = made(gain=0.4)
    assert told(video, "exposure") == YES and told(video) == NO
    assert told(made(), "exposure") == NO
    assert told(made(gain=0.4, card=(0.0, 0.05))) == YES


def test_noise_is_measured():
    for level in (0.01, 0.03):
        image = np.full((80, 90, 3), 0.5) + np.random.default_rng(0).normal(0, level, (80, 90, 3))
        assert abs(noise_of(image) / level - 1) < 0.05
    ramp = np.repeat(np.linspace(0, 1, 90)[None, :, None], 3, -1) * np.ones((80, 1, 1))
    assert noise_of(ramp) < 1e-9


def test_thin_things_are_narrower_than_what_stands():
    rho = np.full((40, 60), 0.2)
    rho[:, 20:24], rho[10:30, 35:55] = 0.5, 0.5  # a pole, and a box
    expected = np.zeros_like(rho, bool)
    expected[:, 20:24] = True
    np.testing.assert_array_equal(thin(rho), expected)


def test_given_priors_are_believed_where_the_frames_agree():
    video = made()
    flow = np.zeros((FRAMES, 2, HEIGHT, WIDTH, 2), np.float32)
    for i in range(FRAMES):
        for side, j in ((0, min(i + 1, FRAMES - 1)), (1, max(i - 1, 0))):
            flow[i, side, ..., 0] = FOCAL * (PLACES[i] - PLACES[j]) / WALL
    known = known_frames(video, flow=flow, flow_valid=np.ones(flow.shape[:-1], bool))
    assert told(video, "flow_prior", given=known) == YES
    assert told(video, "flow_prior", given=known._replace(flow=flow + 6)) == NO
    assert told(video, "flow_prior") == told(video, "depth_prior") == NO
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depths = np.stack([np.where(card_pixels(x), 1 / CARD, 1 / WALL) for x in PLACES])
    assert told(video, "depth_prior", given=known_frames(video, disparity=depths)) != NO
    assert told(video, "depth_prior", given=known_frames(video, disparity=-depths)) == NO
    assert told(video, "depth_prior", given=known_frames(video, disparity=np.full_like(depths, np.nan))) == UNKNOWN
    none = priors_for(known, ())
    assert none.flow is None and none.flow_valid is None and priors_for(known, SWITCHES).flow is not None


def card_pixels(place):
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    x, y = place + CARD * (u - (WIDTH - 1) / 2) / FOCAL, CARD * (v - (HEIGHT - 1) / 2) / FOCAL
    return (np.abs(x - 0.15) < 0.35) & (np.abs(y) < 0.35)


def test_doubt_keeps_an_effect_on():
    assert [judged(x, least=1, most=2, name="x", what="y")[0] for x in (0.5, 1.5, 2.0, np.nan)] == [
        NO, UNKNOWN, YES, UNKNOWN,
    ]  # fmt: skip
    assert Evidence(UNKNOWN, {}, {}, "").on and Evidence(YES, {}, {}, "").on and not Evidence(NO, {}, {}, "").on


def test_a_choice_of_effects():
    found = {name: Evidence(NO if name == "motion" else YES, {}, {}, "") for name in EFFECTS}
    assert chosen(found, "auto") == set(EFFECTS) - {"motion"}
    assert chosen({}, "all") == set(EFFECTS) and not chosen({}, "none")
    assert chosen({}, "motion,exposure") == chosen({}, ["exposure", "motion"]) == {"motion", "exposure"}
    with pytest.raises(ValueError, match="'mtion' is none; expected one of auto, all, none, motion"):
        chosen({}, "mtion")


def test_what_is_off_is_not_in_the_system():
    """The same value as that of a system which never had it: the same compiled program, so the same operations."""
    whole = presets.ZEST
    assert effects.system_for(whole, EFFECTS) == whole
    assert effects.system_for(whole, ()) == dataclasses.replace(presets.STILL, exposure=None)
    assert effects.system_for(whole, ("disocclusion", "exposure")) == dataclasses.replace(
        presets.STILL, sampler=Guided(2)
    )
    assert effects.system_for(whole, ("motion",)) == dataclasses.replace(whole, exposure=None)
    assert effects.system_for(presets.PAPER, ("disocclusion",)) == presets.SVS  # rays that nothing guides
    assert effects.system_for(presets.MOTION, ("exposure",)) == presets.MOTION  # whose dynamic field shows everything
    assert effects.system_for(presets.SVS, ()) == presets.SVS


def test_params_without_what_is_off_are_those_of_the_system():
    still = effects.system_for(stage.MINI, ())
    params = effects.params_for(still, stage.params_of(stage.MINI))
    shapes = lambda tree: jax.tree.map(lambda x: x.shape, tree)
    assert shapes(params) == shapes(jax.eval_shape(still.init, jax.random.key(0)))


def test_rays_are_guided_to_both_surfaces_of_a_cell():
    logits = np.full((12, 2, 3), -6.0, np.float32)  # (E, h, w)
    logits[2], logits[9] = 3.0, 2.0
    volume = Volume(cells=jnp.zeros((12, 2, 3, 1)), logits=jnp.asarray(logits))
    one, two = (np.asarray(Guided(n).guide([volume])) for n in (1, 2))
    np.testing.assert_allclose(one, np.full((1, 2, 3), 2 / 11), atol=0.01)
    np.testing.assert_allclose(two, np.broadcast_to(np.array([2, 9])[:, None, None] / 11, (2, 2, 3)), atol=0.01)
    assert np.isfinite(np.asarray(without_mode(jnp.zeros((2, 3))))).all()  # all planes are next to the mode
    with pytest.raises(ValueError, match="modes"):
        Guided(0)


def test_inspect_tells_of_a_scene_as_text_and_as_json(tmp_path, capsys):
    write_nsff(tmp_path / "scene", "toy", made(card=(0.0, 0.05)))
    flags = ["--scene", str(tmp_path / "scene"), "--size", f"{HEIGHT}x{WIDTH}"]
    assert main(["inspect", *flags, "--json", "--out", str(tmp_path / "out")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scene"]["frames"] == FRAMES and report["effects"].keys() == set(EFFECTS)
    assert all(effect.keys() >= {"on", "evidence"} for effect in report["effects"].values())
    assert report["effects"]["motion"]["on"] and not report["effects"]["exposure"]["on"]
    assert (tmp_path / "out/motion.png").exists()
    assert json.loads((tmp_path / "out/effects.json").read_text()) == report
    assert main(["inspect", *flags]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("inspect: toy is rendered without exposure, flow prior, depth prior")
    assert any(line.startswith("  motion") and "  on   yes: " in line for line in lines)
    assert main(["inspect", *flags, "--quiet"]) == 0 and not capsys.readouterr().out
    assert main(["inspect", "--scene", str(tmp_path / "nothing")]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_the_effects_of_a_command_are_those_of_its_scene(capsys, monkeypatch):
    monkeypatch.setattr("zestjax.apps.effects.inspect", functools.partial(effects.inspect, smallest=0))
    still, moving = (
        Scene(name, made(card=card), ()) for name, card in (("still", (0.0, 0.0)), ("moving", (0.0, 0.05)))
    )
    found = choose("auto", still)
    assert "motion" not in found.on and found.told["off"][:1] == ["motion"] and found.told["seconds"] > 0
    assert "effects: still: no motion (" in capsys.readouterr().err
    assert "motion" in choose("auto", moving, quiet=True).on
    assert "motion" not in choose("auto", moving, still=True, quiet=True).on
    assert choose("all", still).on == EFFECTS and not choose("none", still).on and not capsys.readouterr().err
    assert choose("auto", still, exclude=range(4)).on == EFFECTS  # two frames are left to tell
    assert "too many frames are held back" in capsys.readouterr().err
    on = over_scenes("auto", [still, moving], quiet=True)
    assert "motion" in on[0] and "motion" in on[1] and "flow_prior" not in on[0]
    assert over_scenes("auto", []) == [EFFECTS] and over_scenes("none", []) == [()]


def test_a_wrong_effect_is_refused_before_anything_is_read(tmp_path, capsys):
    for command in ("evaluate", "render", "finetune"):
        flags = ["--scene", str(tmp_path / "nothing"), "--out", str(tmp_path / "out"), "--effects", "motion,fog"]
        assert main([command, *flags]) == 2
        assert "'fog' is none" in capsys.readouterr().err
    assert main(["train", "--preset", "tiny", "--out", str(tmp_path / "out"), "--effects", "fog"]) == 2
    assert "'fog' is none" in capsys.readouterr().err
