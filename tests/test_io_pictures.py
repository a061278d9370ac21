"""Pictures and videos: exact where the format is, readable by others, and clear about what cannot be written."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false, reportCallIssue=false

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from zestjax.io import figures, pictures, video
from zestjax.io.claims import claimed_size, most_pixels


@pytest.fixture
def picture():
    return np.random.default_rng(0).integers(0, 256, (7, 9, 3)).astype(np.uint8)


def test_a_png_comes_back_exactly_in_rgb_order(tmp_path, picture):
    path = tmp_path / "deep" / "a.png"
    pictures.write_image(path, picture)
    np.testing.assert_array_equal(pictures.to_bytes(pictures.read_image(path)), picture)
    np.testing.assert_array_equal(cv2.imread(str(path))[..., 0], picture[..., 2])
    assert pictures.image_size(path) == (7, 9)


def test_a_mask_comes_back(tmp_path, picture):
    mask = picture[..., 0] > 100
    pictures.write_image(tmp_path / "m.png", mask)
    np.testing.assert_array_equal(pictures.read_mask(tmp_path / "m.png"), mask)


def test_floats_are_clipped_and_rounded():
    shades = np.array([[[-1.0, 0.0, 2.0], [0.5, 1 / 255, 0.999]]])
    assert pictures.to_bytes(shades).tolist() == [[[0, 0, 255], [128, 1, 255]]]


def test_what_is_no_picture_is_refused(tmp_path, picture):
    with pytest.raises(ValueError, match="cannot write pictures as `.xyz`"):
        pictures.write_image(tmp_path / "a.xyz", picture)
    with pytest.raises(ValueError, match="finite floats"):
        pictures.write_image(tmp_path / "a.png", np.full((4, 4, 3), np.nan))
    with pytest.raises(ValueError, match=r"should be \(..., H, W, 3\)"):
        pictures.write_image(tmp_path / "a.png", np.zeros((4, 4)))
    with pytest.raises(ValueError, match="could not be read"):
        pictures.read_image(tmp_path / "absent.png")
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(ValueError, match="text.png: is not a picture"):
        pictures.read_image(tmp_path / "text.png")
    assert os.listdir(tmp_path) == ["text.png"]


def test_depth_pictures_are_even_in_inverse_depth_and_black_where_there_is_none():
    depth = np.array([[1.0, 2.0, np.inf, -1.0, np.nan, 0.5]])
    shown = figures.depth_picture(depth, near=1.0, far=np.float32(4.0))
    assert shown.shape == (1, 6, 3) and shown.dtype == np.float32
    np.testing.assert_array_equal(shown[0, 2:5], 0)
    np.testing.assert_array_equal(shown[0, 5], shown[0, 0])


def test_error_pictures_grow_brighter_with_the_error():
    truth = np.zeros((1, 3, 3))
    guess = np.array([0.0, 0.1, 0.2])[None, :, None] * np.ones(3)
    brightness = figures.error_picture(guess, truth).sum(-1)[0]
    assert brightness[0] == pytest.approx(0, abs=0.1) and np.all(np.diff(brightness) > 0)


def test_area_resizing_is_the_mean_of_the_pixels_covered(picture):
    shades = np.repeat(np.repeat(picture / np.float32(255), 2, 0), 3, 1).astype(np.float32)
    np.testing.assert_allclose(pictures.resize_area(shades, 7, 9), picture / 255, atol=1e-6)
    bright = np.ones((60, 80, 3), np.float32)
    assert pictures.resize_area(bright, 23, 31).max() <= 1


def test_nearest_resizing_takes_the_pixel_at_the_centre():
    values = np.arange(6)[None].repeat(3, 0)
    np.testing.assert_array_equal(pictures.resize_nearest(values, 1, 2), [[1, 4]])
    np.testing.assert_array_equal(pictures.resize_nearest(values, 3, 12)[0], np.arange(6).repeat(2))


def test_sheets_hold_every_picture_in_its_place(picture):
    sheet = figures.side_by_side([picture, picture // 2, picture], labels=["a", "b", "c"], columns=2)
    assert sheet.shape == (4 + 2 * (7 + 18 + 4), 4 + 2 * (9 + 4), 3)
    np.testing.assert_array_equal(sheet[22:29, 17:26], picture // 2)
    np.testing.assert_array_equal(sheet[51:58, 4:13], picture)
    with pytest.raises(ValueError, match="one size"):
        figures.side_by_side([picture, picture[1:]])
    with pytest.raises(ValueError, match="`labels` has 1 entries, expected 2"):
        figures.side_by_side([picture, picture], labels=["a"])


def moving_bar(height, width, count):
    columns = np.arange(width)[None, None, :]
    bar = np.abs(columns - 4 * np.arange(count)[:, None, None]) < 6
    return np.broadcast_to(np.where(bar, 0.9, 0.2)[..., None], (count, height, width, 3)).copy()


@pytest.mark.parametrize("formats", ["as installed", "no WebM"])
def test_videos_can_be_read_back_and_look_the_same(tmp_path, formats, monkeypatch, capfd):
    if formats == "no WebM":
        monkeypatch.setattr(video, "_encode_webm", lambda *_: False)
    frames = moving_bar(33, 47, 5)
    path = video.write_video(tmp_path / "clips" / "bar", frames, fps=12)
    assert path.name == ("bar.webm" if formats == "as installed" else "bar.webp")
    shown = video.read_video(path)
    assert shown.shape == (5, 34, 48, 3)
    assert np.abs(shown[:, :33, :47] / 255 - frames).mean() < 0.03
    assert os.listdir(tmp_path / "clips") == [path.name] and capfd.readouterr().err == ""


def test_bad_frames_and_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="is empty"):
        video.write_video(tmp_path / "v", np.zeros((0, 4, 4, 3)))
    with pytest.raises(ValueError, match=r"should be \(T H W 3\)"):
        video.write_video(tmp_path / "v", np.zeros((4, 4, 3)))
    with pytest.raises(OSError, match="encodes neither"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(video, "_encode_webm", lambda *_: False)
        patch.setattr(video, "_encode_webp", lambda *_: False)
        video.write_video(tmp_path / "v", np.zeros((2, 4, 4, 3)))
    (tmp_path / "t.webp").write_text("no video")
    with pytest.raises(ValueError, match="is not a video"):
        video.read_video(tmp_path / "t.webp")
    assert os.listdir(tmp_path) == ["t.webp"]


def test_opencv_is_given_no_path_of_the_users(tmp_path, monkeypatch):
    """Native code takes `run:` for a protocol, and dies of a name that is not UTF-8."""
    temporary = tmp_path / "zwischenablage-\N{LATIN SMALL LETTER U WITH DIAERESIS}"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    monkeypatch.chdir(tmp_path)
    frames = moving_bar(32, 48, 3)
    for name in ("run:1", os.fsdecode(b"caf\xe9"), "clip%05d"):
        path = video.write_video(Path(name) / "film", frames)
        assert path.suffix == ".webm" and video.read_video(path).shape == (3, 32, 48, 3)
    assert os.listdir(temporary) == []


def test_a_film_that_was_cut_short_by_a_full_disk_is_not_kept(tmp_path, monkeypatch):
    encode = video._encode_webm
    monkeypatch.setattr(video, "_encode_webm", lambda path, bgr, fps: encode(path, bgr[:-1], fps))
    assert video.write_video(tmp_path / "film", moving_bar(32, 48, 3)).suffix == ".webp"


def test_a_png_whose_chunk_claims_more_than_the_file_has_is_refused_before_memory_is_taken(tmp_path):
    whole = cv2.imencode(".png", np.full((8, 9, 3), 7, np.uint8))[1].tobytes()
    data = whole.index(b"IDAT") - 4
    for content in (whole[:data] + (2**31 - 1).to_bytes(4) + whole[data + 4 :], whole[:-12], whole[:-1]):
        assert claimed_size(content) is None
    assert claimed_size(whole) == (8, 9)
    flat = whole[:16] + (9000).to_bytes(4) + (9000).to_bytes(4) + whole[24:]
    assert most_pixels(flat) < 9000 * 9000  # no stream of so few bytes holds so many
