"""Files that are damaged, hostile or merely odd: one ValueError each, which names the file, and never much memory."""

import io
import os
import re
import socket
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

import zestjax
from zestjax.io.reading import in_order, numbers_of, read_array, read_arrays, read_json, read_regular, visible


def npy(array, **options):
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def claiming(shape, descr="<f8"):
    """A header alone, written by hand as numpy's format says."""
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text


def refused(path, content, message, read):
    """A file of this content is one line that names it."""
    path.write_bytes(content)
    with pytest.raises(ValueError) as caught:
        read(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ") and message in said and "\n" not in said


BAD_ARRAYS = {
    "empty": (b"", "magic"),
    "text": (b"hello", "magic"),
    "an archive": (b"PK\x03\x04", "is an archive of arrays"),
    "half an array": (npy(np.zeros(1000))[:500], "more than the"),
    "13 TB claimed": (claiming((10**12, 13)), "more than the 0 bytes"),
    "more than can be counted": (claiming((10**30,)), "more than the"),
    "negative": (claiming((-1,)), "claims"),
    "nested": (claiming((1,), descr="(" * 3000 + ")" * 3000), "not a numpy file"),
    "text inside": (npy(np.array(["a", "b"])), "is of type <U1, expected numbers"),
    "complex": (npy(np.array([1j])), "expected numbers"),
    "dates": (npy(np.array(["2020-01-01"], "M8[D]")), "expected numbers"),
    "objects": (npy(np.array([{}]), allow_pickle=True), "Python objects"),
    "rank": (npy(np.zeros((2, 3, 4))), "has shape (2, 3, 4), expected any x 3"),
    "version 9": (b"\x93NUMPY\x09\0" + npy(np.zeros(3))[8:], "not a numpy file"),
}


@pytest.mark.parametrize("fault", BAD_ARRAYS)
def test_a_bad_array_is_one_error_that_names_the_file(tmp_path, fault):
    refused(tmp_path / "a.npy", *BAD_ARRAYS[fault], lambda path: read_array(path, shape=(None, 3)))


@pytest.mark.parametrize(
    "array", [np.zeros((0, 3)), np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.ones((1, 3)) > 0]
)
def test_a_good_array_comes_back(tmp_path, array):
    for version in ((1, 0), (2, 0), (3, 0)):
        with open(tmp_path / "a.npy", "wb") as file:
            np.lib.format.write_array(file, array, version=version)
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy", shape=(None, 3)), array)


def archive(members, compression=zipfile.ZIP_DEFLATED):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as packed:
        for name, content in members.items():
            packed.writestr(name, content)
    return stream.getvalue()


def flipped(content, place):
    return content[:place] + bytes([content[place] ^ 255]) + content[place + 1 :]


WHOLE = archive({"a.npy": npy(np.arange(100.0))})
BAD_ARCHIVES = {
    "empty": (b"", "not a numpy file"),
    "half": (WHOLE[: len(WHOLE) // 2], "not a numpy file"),
    "altered": (flipped(WHOLE, 60), "not a numpy file"),
    "an array": (npy(np.zeros(3)), "holds one array (.npy)"),
    "a claim inside": (archive({"a.npy": claiming((10**12,))}), "more than the"),
    "objects": (archive({"a.npy": npy(np.array([{}]), allow_pickle=True)}), "Python objects"),
    "3 GB of zeros": (archive({f"{i}.npy": bytes(2**26) for i in range(17)}), "more than 1,073,741,824 bytes"),
}


@pytest.mark.parametrize("fault", BAD_ARCHIVES)
def test_a_bad_archive_is_one_error_that_names_the_file(tmp_path, fault):
    refused(tmp_path / "a.npz", *BAD_ARCHIVES[fault], read_arrays)


def test_only_the_arrays_wanted_are_read(tmp_path):
    (tmp_path / "a.npz").write_bytes(archive({"a.npy": npy(np.arange(3)), "b.npy": b"broken"}))
    assert read_arrays(tmp_path / "a.npz", names=("a", "c"))["a"].tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="a.npz"):
        read_arrays(tmp_path / "a.npz")


TEXT = '{"name": "Straße"}'
GOOD_JSON = [
    TEXT.encode(), TEXT.encode("utf-8-sig").replace(b" ", b"\r\n"), TEXT.encode("utf-16"),
    b"\xfe\xff" + TEXT.encode("utf-16-be"), TEXT.encode("utf-32"),
]  # fmt: skip


@pytest.mark.parametrize("content", GOOD_JSON, ids=["plain", "mark and CRLF", "UTF-16", "UTF-16 big", "UTF-32"])
def test_json_is_read_in_the_encoding_that_it_says_not_the_locales(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    assert read_json(tmp_path / "a.json") == {"name": "Straße"}


BAD_JSON = {
    "empty": (b"", "Expecting value"),
    "a list": (b"[]", "holds a list, expected an object"),
    "a number": (b"5", "holds a int"),
    "Latin-1": (TEXT.encode("latin-1"), "can't decode"),
    "deep": (b'{"a":' * 100_000, "nested too deeply"),
    "deep list": (b"[" * 100_000 + b"]" * 100_000, "nested too deeply"),
    "5000 digits": (b'{"a": ' + b"1" * 5000 + b"}", "digits"),
    "NaN": (b'{"a": NaN}', "holds NaN"),
    "infinite": (b'{"a": -Infinity}', "holds -Infinity"),
    "half": (TEXT.encode()[:7], "not JSON"),
}


@pytest.mark.parametrize("fault", BAD_JSON)
def test_bad_json_is_one_error_that_names_the_file(tmp_path, fault):
    refused(tmp_path / "a.json", *BAD_JSON[fault], read_json)


def test_only_regular_files_are_opened_and_only_so_large(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "loop").symlink_to("loop")
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(2**31)
    with socket.socket(socket.AF_UNIX) as server:
        here = os.getcwd()
        os.chdir(tmp_path)  # a socket's path may not be long
        server.bind("socket")
        os.chdir(here)
        for name, message in {
            "fifo": "is a fifo, a device or a socket", "zero": "is a fifo, a device", "socket": "is a fifo",
            "folder": "is a folder", "dangling": "could not be read", "loop": "could not be read",
            "sparse": "has more than",
        }.items():  # fmt: skip
            with pytest.raises(ValueError, match=f"{name}: {message}"):
                read_regular(tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "plain")
    (tmp_path / "plain").write_bytes(b"123")
    assert read_regular(tmp_path / "link") == b"123"
    with pytest.raises(ValueError, match="more than 2 bytes"):
        read_regular(tmp_path / "plain", most=2)


def paths(*names):
    return [Path(name) for name in names]


def test_names_are_in_order_of_their_numbers_where_only_numbers_differ(tmp_path):
    for name in ("img_10.png", "img_9.png", "img_1.png", ".img_2.png", "._img_3.png", "__MACOSX"):
        (tmp_path / name).touch()
    assert [p.name for p in visible(tmp_path)] == ["img_1.png", "img_9.png", "img_10.png"]
    assert visible(tmp_path / "absent") == ()
    assert [p.name for p in in_order(paths("b2.png", "a10.png", "a9.png"))] == ["a10.png", "a9.png", "b2.png"]


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("a1.png", "a02.jpg"), (1, 2)),
        (("7_frame1", "7_frame3"), (1, 3)),
        (("1_2", "2_1"), None),
        (("left", "right"), None),
        (("a1", "b2"), None),
        (("1", "01"), None),
        (("5_7.png",), (7,)),
        ((), None),
    ],
)
def test_the_number_of_a_name_is_the_run_of_digits_that_varies(names, numbers):
    assert numbers_of(paths(*names)) == numbers


def test_users_files_are_read_in_one_place():
    """So are a run's log, its clips, and the record that `check_parity` is given; its own folders it lists itself."""
    package = Path(zestjax.__file__).parent
    pattern = re.compile(
        r"np\.load\(|json\.loads?\(|np\.fromfile|cv2\.imread\(|\.iterdir\(\)|np\.genfromtxt|np\.loadtxt"
    )
    found = {str(p.relative_to(package)) for p in package.rglob("*.py") if pattern.search(p.read_text())}
    assert found - {"io/files.py", "simulate/textures.py"} == {"io/reading.py"}
    assert not pattern.search((package.parent / "experiments/check_parity.py").read_text())


def test_memory_is_taken_for_what_is_there_not_for_what_may_be(tmp_path):
    (tmp_path / "small").write_bytes(b"123")
    tracemalloc.start()
    assert read_regular(tmp_path / "small") == b"123"
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()
    if Path("/proc/self/status").exists():  # a regular file that says it is empty
        assert read_regular("/proc/self/status").startswith(b"Name:")
