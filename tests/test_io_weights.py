"""Weights and checkpoints: the same bits back, one clear error otherwise, and never half a file."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false, reportCallIssue=false

import errno
import json
import os
import struct
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save

from zestjax.io.checkpoints import latest_checkpoint, save_checkpoint
from zestjax.io.files import check_writable, replaced_folder, write_bytes
from zestjax.io.weights import DamagedFileError, WeightsError, load_weights, read_metadata, save_weights


class Layer(NamedTuple):
    kernel: jax.Array
    bias: jax.Array | None


CONFIG = {"preset": "tiny", "planes": 8, "near": 0.25}


@pytest.fixture
def params():
    rng = np.random.default_rng(0)
    layer = lambda n: Layer(jnp.asarray(rng.standard_normal((3, n)), jnp.float32), jnp.zeros(n, jnp.bfloat16) + 1.5)
    return {
        "static": (layer(4), layer(5)),
        "dynamic": Layer(jnp.arange(6, dtype=jnp.int32), None),
        "key": jax.random.key(7),
    }


@pytest.fixture
def full_disk(monkeypatch):
    """From now on nothing can be flushed to the disk."""

    def refuse(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)


def assert_same(a, b):
    raw = lambda leaf: np.asarray(
        jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
    )
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        assert raw(x).tobytes() == raw(y).tobytes()


def test_weights_come_back_bit_for_bit_with_their_metadata(tmp_path, params):
    path = tmp_path / "new" / "w.safetensors"
    save_weights(path, params, metadata=CONFIG)
    for like in (params, jax.eval_shape(lambda: params)):
        loaded, metadata = load_weights(path, like=like)
        assert_same(loaded, params)
        assert metadata == CONFIG
    assert read_metadata(path) == CONFIG
    assert sorted(load_weights(path)[0])[0] == "['dynamic'].kernel"


def test_the_memory_layout_of_an_array_does_not_matter(tmp_path):
    tree = {
        "a": np.asfortranarray(np.arange(12.0, dtype=np.float32).reshape(3, 4)),
        "b": np.arange(6)[::2].astype(np.int8),
    }
    save_weights(tmp_path / "w", tree, metadata={})
    np.testing.assert_array_equal(load_weights(tmp_path / "w", like=tree)[0]["a"], tree["a"])
    np.testing.assert_array_equal(load_weights(tmp_path / "w", like=tree)[0]["b"], [0, 2, 4])


def test_all_differences_from_the_wanted_tree_are_listed(tmp_path, params):
    save_weights(tmp_path / "w", params, metadata=CONFIG)
    other = dict(params, static=(Layer(jnp.zeros((3, 9)), None), Layer(jnp.zeros((3, 5), jnp.float16), jnp.zeros(5))))
    other["extra"] = jnp.zeros(2)
    with pytest.raises(WeightsError) as caught:
        load_weights(tmp_path / "w", like=other)
    message = str(caught.value)
    assert "another model or preset" in message and str(tmp_path / "w") in message
    for part in (
        "`['extra']` is missing",
        "[0].bias` is not wanted",
        "(3, 4), expected float32 (3, 9)",
        "expected float16",
    ):
        assert part in message
    assert not isinstance(caught.value, DamagedFileError)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_recognised(tmp_path, params, share):
    path = tmp_path / "w"
    save_weights(path, params, metadata=CONFIG)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DamagedFileError, match="truncated or not a safetensors file"):
        load_weights(path, like=params)


def test_an_altered_file_is_recognised_wherever_it_was_altered(tmp_path, params):
    path = tmp_path / "w"
    save_weights(path, params, metadata=CONFIG)
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    value = content[:-3] + bytes([content[-3] ^ 1]) + content[-2:]
    metadata = content[: 8 + length].replace(b"tiny", b"tidy") + content[8 + length :]
    for altered in (value, metadata):
        assert altered != content
        path.write_bytes(altered)
        with pytest.raises(DamagedFileError, match="altered after it was written"):
            load_weights(path, like=params)


def test_a_file_of_another_kind_is_refused(tmp_path, params):
    path = tmp_path / "w"
    path.write_bytes(save({"a": np.zeros(3, np.float32)}))
    with pytest.raises(DamagedFileError, match="zestjax did not write"):
        load_weights(path, like=params)
    path.write_text(json.dumps({"a": 1}))
    with pytest.raises(DamagedFileError, match="not a safetensors file"):
        load_weights(path, like=params)
    with pytest.raises(WeightsError, match="could not be read"):
        load_weights(tmp_path / "absent", like=params)


def test_a_full_disk_leaves_the_earlier_file_and_nothing_else(tmp_path, params, full_disk, monkeypatch):
    path = tmp_path / "w"
    with monkeypatch.context() as context:
        context.setattr(os, "fsync", lambda _: None)
        save_weights(path, params, metadata=CONFIG)
    before = path.read_bytes()
    with pytest.raises(WeightsError, match="No space left on device.*free some space"):
        save_weights(path, params, metadata={"other": 1})
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["w"]


def test_the_newest_checkpoint_is_read_and_the_oldest_removed(tmp_path):
    like = {"x": jnp.zeros(3)}
    assert latest_checkpoint(tmp_path / "absent", like) is None
    for step in (5, 10, 200):
        save_checkpoint(tmp_path, step, {"x": jnp.full(3, float(step))}, CONFIG, keep=2)
    found = latest_checkpoint(tmp_path, like)
    assert (found.step, found.metadata, found.warnings) == (200, CONFIG, ())
    np.testing.assert_array_equal(found.tree["x"], [200, 200, 200])
    assert sorted(os.listdir(tmp_path)) == ["step_000000010.safetensors", "step_000000200.safetensors"]
    with pytest.raises(ValueError, match="`keep` is 0"):
        save_checkpoint(tmp_path, 300, like, CONFIG, keep=0)


def test_a_damaged_newest_checkpoint_falls_back_to_the_one_before(tmp_path):
    like = {"x": jnp.zeros(3)}
    for step in (1, 2):
        save_checkpoint(tmp_path, step, {"x": jnp.full(3, float(step))}, CONFIG)
    newest = tmp_path / "step_000000002.safetensors"
    newest.write_bytes(newest.read_bytes()[:-4])
    found = latest_checkpoint(tmp_path, like)
    assert found.step == 1 and len(found.warnings) == 1 and str(newest) in found.warnings[0]
    found.path.write_bytes(b"")
    with pytest.raises(WeightsError, match="no checkpoint is whole"):
        latest_checkpoint(tmp_path, like)


def test_a_checkpoint_of_another_preset_is_refused_and_not_passed_over(tmp_path):
    save_checkpoint(tmp_path, 1, {"x": jnp.zeros(3)}, CONFIG)
    save_checkpoint(tmp_path, 2, {"x": jnp.zeros(4)}, CONFIG)
    with pytest.raises(WeightsError, match="another model or preset"):
        latest_checkpoint(tmp_path, {"x": jnp.zeros(3)})


def test_no_earlier_checkpoint_is_lost_when_the_disk_is_full(tmp_path, full_disk, monkeypatch):
    like = {"x": jnp.zeros(3)}
    with monkeypatch.context() as context:
        context.setattr(os, "fsync", lambda _: None)
        save_checkpoint(tmp_path, 1, like, CONFIG, keep=1)
    with pytest.raises(WeightsError, match="free some space"):
        save_checkpoint(tmp_path, 2, like, CONFIG, keep=1)
    assert latest_checkpoint(tmp_path, like).step == 1
    assert os.listdir(tmp_path) == ["step_000000001.safetensors"]


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path):
    place = tmp_path / "scene"
    for content in ("first", "second"):
        with replaced_folder(place, marker="mark") as fresh:
            (fresh / "mark").write_text(content)
    with pytest.raises(RuntimeError), replaced_folder(place, marker="mark") as fresh:
        (fresh / "mark").write_text("third")
        raise RuntimeError
    assert (place / "mark").read_text() == "second" and os.listdir(tmp_path) == ["scene"]
    (place / "mark").rename(place / "diary")
    with pytest.raises(ValueError, match="not an earlier result"), replaced_folder(place, marker="mark"):
        pass
    assert os.listdir(place) == ["diary"]


def test_written_files_have_ordinary_permissions(tmp_path):
    write_bytes(tmp_path / "a", b"x")
    (tmp_path / "b").write_bytes(b"x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def fill(place, content):
    with replaced_folder(place, marker="mark") as fresh:
        (fresh / "mark").write_text(content)
        (fresh / content).mkdir()


def test_a_folder_behind_a_link_is_replaced_and_the_link_stays(tmp_path):
    (tmp_path / "disk").mkdir()
    for name, target in (("link", "disk"), ("dangling", "later")):
        (tmp_path / name).symlink_to(target)
        for content in ("first", "second"):
            fill(tmp_path / name, content)
        assert (tmp_path / name).is_symlink() and sorted(os.listdir(tmp_path / target)) == ["mark", "second"]
        write_bytes(tmp_path / name / "more", b"x")
        assert (tmp_path / target / "more").read_bytes() == b"x"
    assert sorted(os.listdir(tmp_path)) == ["dangling", "disk", "later", "link"]


@pytest.mark.parametrize("why", ["where the process stands", "mount point", "unwritable parent"])
def test_a_folder_that_cannot_be_renamed_has_its_entries_replaced(tmp_path, monkeypatch, why):
    place, access = tmp_path / "scene", os.access
    place.mkdir()
    if why == "where the process stands":
        monkeypatch.chdir(place)
    elif why == "mount point":
        monkeypatch.setattr(os.path, "ismount", lambda path: path == place)
    else:
        monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path and access(path, mode))
    number = place.stat().st_ino
    (place / ".scene.killed.part").mkdir()
    for content in ("first", "second"):
        fill(Path(".") if why == "where the process stands" else place, content)
    assert sorted(os.listdir(place)) == ["mark", "second"] and place.stat().st_ino == number
    rename = Path.rename

    def full(source, target):
        if source.name == "third":
            raise OSError(28, "No space left on device")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(OSError, match="nothing was changed there"):
        fill(place, "third")
    assert sorted(os.listdir(place)) == ["mark", "second"] and (place / "mark").read_text() == "second"


@pytest.mark.parametrize(
    "number, words",
    [(28, "free some space"), (122, "free some space"), (30, "that can be written to"), (13, "that can be written to"),
     (36, "shorter name"), (20, "a file lies where a folder is needed"), (5, "another place")],
)  # fmt: skip
def test_every_error_of_the_disk_says_once_what_to_do(tmp_path, monkeypatch, number, words):
    def fail(*_):
        raise OSError(number, "failed")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError) as caught, replaced_folder(tmp_path / "scene", marker="mark") as fresh:
        write_bytes(fresh / "images/0.png", b"x")
    assert str(caught.value).count(words) == 1 and caught.value.filename == str(tmp_path / "scene")
    with pytest.raises(OSError, match="this file was not written"):
        write_bytes(tmp_path / "0.png", b"x")
    assert os.listdir(tmp_path) == []


def test_a_place_is_tried_without_being_made(tmp_path):
    check_writable(tmp_path / "a/b")
    (tmp_path / "link").symlink_to("nowhere/at/all")
    check_writable(tmp_path / "link")
    assert os.listdir(tmp_path) == ["link"]
    if Path("/proc/self").exists():
        with pytest.raises(OSError, match="choose another place|that can be written to"):
            check_writable("/proc/zestjax")
    for out, words in (("/proc/1/x", "Permission denied|Read-only|No such"), ("/dev/null/x", "Not a directory")):
        with pytest.raises(OSError, match=words):
            check_writable(out)


@pytest.mark.parametrize("number", [np.float32(1.5), np.float64(1.5), np.int64(3), np.bool_(True), np.float16(0.5)])
def test_numpys_numbers_are_stored_as_numbers(tmp_path, number):
    save_weights(tmp_path / "w", {"a": np.zeros(2)}, metadata={"rate": number, "deep": [{"x": (number, "text", None)}]})
    found = read_metadata(tmp_path / "w")
    assert found == {"rate": number.item(), "deep": [{"x": [number.item(), "text", None]}]}
    assert type(found["rate"]) is type(number.item())


@pytest.mark.parametrize(
    "metadata, words",
    [
        ({"a": {"b": [1, 1j]}}, r"`metadata\['a'\]\['b'\]\[1\]` is of type complex"),
        ({"a": np.zeros(3)}, r"`metadata\['a'\]` is of type ndarray"),
        ({"a": np.datetime64("2020-01-01")}, r"`metadata\['a'\]` is of type date"),
        ({"a": Path("x")}, r"`metadata\['a'\]` is of type"),
        ({"a": {1: 2}}, r"`metadata\['a'\]` has the key 1, expected text"),
        ([1], "`metadata` is of type list, expected a dict"),
    ],
)
def test_metadata_that_json_cannot_hold_is_named(tmp_path, metadata, words):
    with pytest.raises(WeightsError, match=f"save_weights: {words}"):
        save_weights(tmp_path / "w", {"a": np.zeros(2)}, metadata=metadata)
    assert not list(tmp_path.iterdir())
