"""Weights and camera paths that somebody crafted, or that are of another program: one error that names the file."""

import hashlib
import json
import struct

import numpy as np
import pytest
from stage import video

from zestjax.apps.paths import camera_path
from zestjax.apps.weights import open_weights
from zestjax.io.weights import WeightsError, load_weights


def signed(text):
    """A file that is right in all but its metadata's text."""
    values = np.zeros(3, np.float32)
    digest = hashlib.sha256(text.encode() + f"\na float32 {values.shape}\n".encode() + values.tobytes()).hexdigest()
    header = {
        "__metadata__": {"format": "zestjax", "metadata": text, "sha256": digest},
        "a": {"dtype": "F32", "shape": [3], "data_offsets": [0, 12]},
    }
    content = json.dumps(header).encode()
    return struct.pack("<Q", len(content)) + content + values.tobytes()


def config(**changes):
    return json.dumps({"config": {"name": "tiny", "field_width": 16, **changes}})


METADATA = {
    "text": "hello", "deep": '{"a":' * 9000 + "1" + "}" * 9000, "a list": "[1, 2]", "a number": "5", "null": "null",
    "no configuration": "{}", "a configuration of text": '{"config": "tiny"}', "a list for it": '{"config": [1]}',
    "MVSNeRF without statistics": '{"system": "mvsnerf"}',
    "MVSNeRF with a list": '{"system": "mvsnerf", "statistics": ["batch"]}',
    "text for a flag": config(geometry="x"), "a number for a flag": config(motion=1),
    "text for a size": config(planes="8"), "a float": config(planes=8.5), "below 0": config(field_width=-1),
    "no widths": config(frame_widths=[]), "a width of text": config(volume_widths=["a"]),
    "a nested width": config(frame_widths=[[8]]), "as deep as never": config(field_depth=10**8),
    "as wide as never": config(field_width=10**12), "too many levels": config(point_levels=10**6),
    "an unknown choice": config(spacing="x"), "a list for a choice": config(encoder=["frames"]),
    "unknown fields": config(tomorrow=1), "no name": '{"config": {}}', "width 0": config(field_width=0),
    "5000 digits": '{"config": {"name": "tiny", "planes": ' + "1" * 5000 + "}}",
}  # fmt: skip


@pytest.mark.parametrize("kind", METADATA)
def test_odd_metadata_is_one_error_that_names_the_file(tmp_path, kind):
    path = tmp_path / "w.safetensors"
    path.write_bytes(signed(METADATA[kind]))
    with pytest.raises(WeightsError) as caught:
        open_weights(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    assert "altered" not in str(caught.value)


def header(content, *, length=None):
    return struct.pack("<Q", len(content) if length is None else length) + content


HEADERS = {
    "deep": header(b'{"a":' * 100_000),
    "a list": header(b"[]"),
    "2 GB claimed": header(b"{}", length=2**31),
    "all there can be": header(b"{}", length=2**64 - 1),
    "metadata a list": header(b'{"__metadata__": []}'),
    "metadata of numbers": header(b'{"__metadata__": {"format": "zestjax", "metadata": 5}}'),
    "not UTF-8": header(b'{"\xff": 1}'),
}


@pytest.mark.parametrize("kind", HEADERS)
def test_an_odd_header_is_one_error_that_names_the_file(tmp_path, kind):
    path = tmp_path / "w.safetensors"
    path.write_bytes(HEADERS[kind])
    with pytest.raises(WeightsError) as caught:
        load_weights(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_a_file_of_two_gigabytes_is_not_read_to_be_refused(tmp_path):
    with open(tmp_path / "w", "wb") as file:
        file.truncate(2**31)
    with pytest.raises(WeightsError, match="w: has more than"):
        load_weights(tmp_path / "w")
    with pytest.raises(WeightsError, match="is a folder"):
        load_weights(tmp_path)


def path_file(**changes):
    return {
        "intrinsics": np.tile([[40.0, 0, 8], [0, 40, 6], [0, 0, 1]], (2, 1, 1)).tolist(),
        "camera_from_world": np.tile(np.eye(4), (2, 1, 1)).tolist(),
        "times": [0, 1],
        **changes,
    }


def test_a_camera_path_is_read_in_any_encoding(tmp_path):
    shown = video()
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / "p.json").write_bytes(json.dumps(path_file()).encode(encoding))
        assert camera_path(str(tmp_path / "p.json"), shown).times.tolist() == [0, 1]
    np.savez(tmp_path / "p.npz", **path_file(), note=np.array(["a word"]))
    assert camera_path(str(tmp_path / "p.npz"), shown).times.tolist() == [0, 1]


PATHS = {
    "half a time": {"times": [0, 0.5]}, "text": {"times": ["0", "1"]}, "nothing": {"times": None},
    "too many times": {"times": [0, 1, 1]}, "a time that is not": {"times": [0, 10**6]},
    "a number that is none": {"times": [0, 10**400]}, "ragged": {"intrinsics": [[1], [1, 2]]},
    "no rotation": {"camera_from_world": np.ones((2, 4, 4)).tolist()},
    "singular": {"intrinsics": np.zeros((2, 3, 3)).tolist()}, "one camera": {"intrinsics": np.eye(3).tolist()},
    "not finite": {"intrinsics": np.full((2, 3, 3), np.inf).tolist()},
    "too large": {"camera_from_world": np.full((2, 4, 4), 1e300).tolist()},
    "an object": {"times": {"a": 1}},
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".json", ".npz"])
@pytest.mark.parametrize("kind", PATHS)
def test_a_bad_camera_path_is_one_error_that_names_the_file(tmp_path, kind, suffix):
    path, content = tmp_path / f"p{suffix}", path_file(**PATHS[kind])
    if suffix == ".json":
        path.write_text(json.dumps(content))
    else:
        arrays = {
            name: np.array(value, object) if kind == "ragged" else np.array(value) for name, value in content.items()
        }
        np.savez(path, **arrays)
    with pytest.raises(ValueError) as caught:
        camera_path(str(path), video())
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_a_path_of_poses_without_their_last_row_is_told_so(tmp_path, suffix):
    path, content = tmp_path / f"p{suffix}", path_file(camera_from_world=np.zeros((2, 3, 4)).tolist())
    path.write_text(json.dumps(content)) if suffix == ".json" else np.savez(path, **content)
    with pytest.raises(ValueError, match=r"has shape \(2, 3, 4\), .* A 3x4 pose needs the row 0 0 0 1 under it"):
        camera_path(str(path), video())


@pytest.mark.parametrize("suffix", [".json", ".npz"])
@pytest.mark.parametrize("content", [b"", b"[]", b"PK\3\4", b'{"a": 1}', b"[" * 10**5])
def test_a_file_that_is_no_camera_path_is_named(tmp_path, suffix, content):
    (tmp_path / f"p{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=f"p{suffix}: "):
        camera_path(str(tmp_path / f"p{suffix}"), video())
