"""PyTorch's files are read without PyTorch, and nothing in them is run."""

import collections
import io
import pickle
import sys
import types
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.io.torch_files import LEGACY_MAGIC, TorchFileError, read_torch

KINDS = {"<f4": "FloatStorage", "<i8": "LongStorage", "<f2": "HalfStorage"}


class Window:
    """A tensor as PyTorch pickles it: a function's name, and a storage by its key."""

    def __init__(self, values, shape, strides, offset=0, key="0", parameter=False):
        self.values, self.shape, self.strides, self.offset = np.asarray(values), shape, strides, offset
        self.key, self.parameter = key, parameter


@pytest.fixture
def fake_torch(monkeypatch):
    """The names that a PyTorch file holds, so that pickle can write them."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    for name in (*KINDS.values(), "Size"):
        setattr(torch, name, type(name, (), {"__module__": "torch", "__qualname__": name}))
    for name in ("_rebuild_tensor_v2", "_rebuild_parameter"):
        exec(f"def {name}(*args): raise AssertionError('run')", utils.__dict__)
        getattr(utils, name).__module__ = "torch._utils"
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "torch._utils", utils)
    return torch, utils


def dumped(saved, fake, stored, *, legacy=False):
    torch, utils = fake

    class Pickler(pickle.Pickler):
        def persistent_id(self, thing):
            if isinstance(thing, Stored):
                stored[thing.key] = thing.values
                kind = getattr(torch, KINDS[thing.values.dtype.str])
                view = (None,) if legacy else ()
                return ("storage", kind, thing.key, "cpu", thing.values.size, *view)
            return None

        def reducer_override(self, thing):
            if not isinstance(thing, Window):
                return NotImplemented
            storage = Stored(thing.key, thing.values)
            built = (storage, thing.offset, thing.shape, thing.strides, False, collections.OrderedDict())
            if thing.parameter:
                plain = Window(thing.values, thing.shape, thing.strides, thing.offset, thing.key)
                return utils._rebuild_parameter, (plain, True, collections.OrderedDict())
            return utils._rebuild_tensor_v2, built

    stream = io.BytesIO()
    Pickler(stream, 2).dump(saved)
    return stream.getvalue()


class Stored:
    def __init__(self, key, values):
        self.key, self.values = key, values


def write_zip(path, saved, fake):
    stored = {}
    content = dumped(saved, fake, stored)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/data.pkl", content)
        for key, values in stored.items():
            archive.writestr(f"model/data/{key}", values.tobytes())


def write_legacy(path, saved, fake):
    stored = {}
    content = dumped(saved, fake, stored, legacy=True)
    head = [pickle.dumps(x, 2) for x in (LEGACY_MAGIC, 1001, {"little_endian": True})]
    tail = [pickle.dumps(sorted(stored), 2)]
    tail += [len(stored[key]).to_bytes(8, "little") + stored[key].tobytes() for key in sorted(stored)]
    path.write_bytes(b"".join([*head, content, *tail]))


@pytest.mark.parametrize("write", [write_zip, write_legacy])
def test_tensors_views_and_parameters_come_back(tmp_path, fake_torch, write):
    flat = np.arange(12, dtype=np.float32)
    saved = {
        "step": 7,
        "net": collections.OrderedDict(
            whole=Window(flat, (3, 4), (4, 1)),
            transposed=Window(flat, (4, 3), (1, 4)),
            part=Window(flat, (2, 2), (4, 1), offset=5),
            half=Window(flat.astype(np.float16), (12,), (1,), key="1"),
            count=Window(np.array([181104]), (), (), key="2"),
            learned=Window(flat, (12,), (1,), parameter=True),
        ),
    }
    write(tmp_path / "m.tar", saved, fake_torch)
    read = read_torch(tmp_path / "m.tar")
    net, whole = read["net"], flat.reshape(3, 4)
    assert read["step"] == 7 and net["count"].shape == () and int(net["count"]) == 181104
    assert net["half"].dtype == np.float16 and net["whole"].dtype == np.float32
    for name, expected in dict(whole=whole, transposed=whole.T, part=whole[1:, 1:3], half=flat, learned=flat).items():
        np.testing.assert_array_equal(net[name], expected)
    assert jnp.asarray(net["transposed"]).shape == (4, 3)


class Runs:
    def __reduce__(self):
        return exec, ("raise SystemExit('it was run')",)


@pytest.mark.parametrize("write", [write_zip, write_legacy])
def test_nothing_in_a_file_is_run(tmp_path, fake_torch, write):
    write(tmp_path / "m.pth", {"net": Runs()}, fake_torch)
    with pytest.raises(TorchFileError, match=r"m.pth: asks for `(builtins|__builtin__).exec`, which is no array"):
        read_torch(tmp_path / "m.pth")


def test_a_tensor_outside_its_storage_is_refused(tmp_path, fake_torch):
    for window in (Window(np.zeros(4, np.float32), (3, 2), (2, 1)), Window(np.zeros(4, np.float32), (2,), (-1,))):
        write_zip(tmp_path / "m.pth", {"x": window}, fake_torch)
        with pytest.raises(TorchFileError, match="a tensor"):
            read_torch(tmp_path / "m.pth")


@pytest.mark.parametrize("write", [write_zip, write_legacy])
def test_a_truncated_file_is_named(tmp_path, fake_torch, write):
    write(tmp_path / "m.pth", {"x": Window(np.arange(4, dtype=np.float32), (4,), (1,))}, fake_torch)
    content = (tmp_path / "m.pth").read_bytes()
    for length in (0, 3, len(content) // 3, len(content) - 9):
        (tmp_path / "m.pth").write_bytes(content[:length])
        with pytest.raises(TorchFileError, match="m.pth: is not a PyTorch file, or a damaged one"):
            read_torch(tmp_path / "m.pth")


def test_other_files_are_named(tmp_path):
    for content in (pickle.dumps({"a": 1}), b"hello", pickle.dumps(3) * 4):
        (tmp_path / "x.pth").write_bytes(content)
        with pytest.raises(TorchFileError, match="x.pth"):
            read_torch(tmp_path / "x.pth")


@pytest.mark.parametrize("name", ["alex", "vgg", "squeeze"])
def test_files_that_pytorch_wrote(name):
    folder = Path(__file__).parents[2] / "shared" / "data" / "lpips_linear"
    if not folder.exists():
        pytest.skip("needs shared/data/lpips_linear beside the repository")
    read, expected = read_torch(folder / "v0.1" / f"{name}.pth"), np.load(folder / f"{name}_v0.1.npz")
    assert len(read) == len(expected.files)
    for ours, theirs in zip(read.values(), (expected[key] for key in expected.files), strict=True):
        np.testing.assert_array_equal(ours.reshape(theirs.shape), theirs)


def crafted(path, *objects):
    """A file whose pickle, written instruction by instruction, is `objects`; storage 0 has four floats."""
    storage = b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x04tQ"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/data.pkl", b"\x80\x02" + b"".join(objects).replace(b"STORAGE", storage) + b".")
        archive.writestr("model/data/0", np.arange(4, dtype=np.float32).tobytes())


TENSOR = b"ctorch._utils\n_rebuild_tensor_v2\n(%sK\0%s%s\x89ccollections\nOrderedDict\n)RtR"
wide = lambda number: b"J" + number.to_bytes(4, "little")
WIDE = TENSOR % (b"STORAGE", wide(10**5) + b"\x85", b"K\0\x85")  # one value, 100,000 times
CRAFTED = {
    "stride 0": (WIDE, "reaches value 0 of a storage of 4"),
    "a tensor for a storage": (
        TENSOR % (TENSOR % (b"STORAGE", b"K\x04\x85", b"K\1\x85"), b"K\x04\x85", b"K\1\x85"), "no window on a storage"),
    "a list for a storage": (TENSOR % (b"]", b"K\0\x85", b"K\1\x85"), "no window"),
    "a float for a size": (TENSOR % (b"STORAGE", b"G?\xf0\0\0\0\0\0\0\x85", b"K\1\x85"), "a tensor of shape"),
    "a flag for a stride": (TENSOR % (b"STORAGE", b"K\1\x85", b"\x88\x85"), "a tensor of shape"),
    "a list for a shape": (TENSOR % (b"STORAGE", b"]K\1a", b"K\1\x85"), "no window"),
    "a note far out": (b"K\1r\xff\xff\xff\x7f", "notes value 2147483647"),
    "a note far out, in text": (b"K\1p99999999999\n", "notes value 99999999999"),
    "a function altered": (
        b"ctorch._utils\n_rebuild_tensor_v2\n(N}X\x08\0\0\0functionK\1stb", "damaged"),
    "memory claimed": (b"\x96\0\0\0\0\0\1\0\0", "m.pth"),
    "another name's class": (b"ctorch\nFloatStorage\n)R", "damaged"),
    "nothing crafted": (TENSOR % (b"STORAGE", b"K\1\x85", b"K\1\x85"), None),
}  # fmt: skip


@pytest.mark.parametrize("kind", CRAFTED)
def test_a_crafted_file_reads_nothing_but_its_own_storages(tmp_path, kind):
    pickled, message = CRAFTED[kind]
    crafted(tmp_path / "m.pth", pickled)
    if message is None:
        assert read_torch(tmp_path / "m.pth").tolist() == [0]
        return
    with pytest.raises(TorchFileError, match=message):
        read_torch(tmp_path / "m.pth")


def test_an_archive_that_unpacks_to_more_than_it_is_is_refused(tmp_path, fake_torch):
    flat = np.zeros(10**6, np.float32)
    stored = {}
    content = dumped({"x": Window(flat, (10**6,), (1,))}, fake_torch, stored)
    with zipfile.ZipFile(tmp_path / "m.pth", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model/data.pkl", content)
        archive.writestr("model/data/0", flat.tobytes())
    with pytest.raises(TorchFileError, match="compressed, which PyTorch never does"):
        read_torch(tmp_path / "m.pth")


@pytest.mark.parametrize("write", [write_zip, write_legacy])
def test_a_storage_larger_than_the_file_is_refused_before_memory_is_taken(tmp_path, fake_torch, write):
    write(tmp_path / "m.pth", {"x": Window(np.zeros(7, np.float32), (7,), (1,))}, fake_torch)
    content = (tmp_path / "m.pth").read_bytes()
    enlarged = lambda pickled: pickled.replace(b"K\x07", b"J\xff\xff\xff\x7f", 1)  # the storage's size stands first
    if write is write_legacy:
        (tmp_path / "m.pth").write_bytes(enlarged(content))
    else:
        pickled = zipfile.ZipFile(tmp_path / "m.pth").read("model/data.pkl")
        with zipfile.ZipFile(tmp_path / "m.pth", "w") as archive:
            archive.writestr("model/data.pkl", enlarged(pickled))
            archive.writestr("model/data/0", bytes(28))
    with pytest.raises(TorchFileError, match="claim more than the file has"):
        read_torch(tmp_path / "m.pth")


def test_what_is_no_regular_file_is_refused(tmp_path):
    (tmp_path / "m.pth").mkdir()
    with pytest.raises(TorchFileError, match="m.pth: is a folder"):
        read_torch(tmp_path / "m.pth")
