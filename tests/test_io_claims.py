"""What a picture's header claims, in every format that is read, is known before its pixels are decoded."""

import struct
import tracemalloc

import cv2
import numpy as np
import pytest

from zestjax.io import pictures
from zestjax.io.claims import claimed_size

PICTURE = np.random.default_rng(0).integers(0, 256, (37, 53, 3)).astype(np.uint8)
LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]


def encoded(suffix, picture=PICTURE, flags=()):
    return cv2.imencode(suffix, picture, list(flags))[1].tobytes()


def tiff(height, width, *, order="<", large=False, tile=None):
    """The directory of a TIFF, without pixels."""
    start = struct.pack(order + ("HHHQ" if large else "HI"), *((43, 8, 0, 16) if large else (42, 8)))
    tags = {256: width, 257: height} | ({322: tile[1], 323: tile[0]} if tile else {})
    entry = lambda tag, value: struct.pack(order + ("HHQQ" if large else "HHII"), tag, 16 if large else 4, 1, value)
    entries = b"".join(entry(tag, value) for tag, value in tags.items())
    return (
        (b"II" if order == "<" else b"MM") + start + struct.pack(order + ("Q" if large else "H"), len(tags)) + entries
    )


def patched(content, place, form, *values):
    size = struct.calcsize(form)
    return content[:place] + struct.pack(form, *values) + content[place + size :]


def jpeg(height, width, before=b""):
    content = encoded(".jpg")
    at = content.index(b"\xff\xc0")
    return patched(content[:at] + before + content[at:], at + len(before) + 5, ">HH", height, width)


def bmp_of_os2(height, width):
    return b"BM" + struct.pack("<IHHIIHHHH", 26, 0, 0, 26, 12, width, height, 1, 24)


@pytest.mark.parametrize(
    "content",
    [
        encoded(".png"), encoded(".jpg"), encoded(".jpg", flags=[cv2.IMWRITE_JPEG_PROGRESSIVE, 1]), encoded(".bmp"),
        encoded(".tiff"), encoded(".webp", flags=LOSSLESS), encoded(".webp", flags=[cv2.IMWRITE_WEBP_QUALITY, 50]),
        encoded(".webp", np.dstack([PICTURE, PICTURE[..., :1]]), [cv2.IMWRITE_WEBP_QUALITY, 50]),
        encoded(".png", PICTURE.astype(np.uint16) * 257), encoded(".tiff", PICTURE[..., 0]),
        patched(encoded(".bmp"), 22, "<i", -37), bmp_of_os2(37, 53),
        tiff(37, 53), tiff(37, 53, order=">"), tiff(37, 53, large=True), tiff(37, 53, order=">", large=True),
        jpeg(37, 53, b"\xff\xff\xff"), jpeg(37, 53, b"garbage"), jpeg(37, 53, b"\xff\xd0\xff\x01"),
    ],
)  # fmt: skip
def test_the_claim_is_the_size(content):
    assert claimed_size(content) == (37, 53)
    assert all(claimed_size(content[:end]) in (None, (37, 53)) for end in range(len(content[:400])))


CLAIMS = {
    "png": patched(encoded(".png"), 16, ">II", 40_000, 30_000),
    "jpg": jpeg(30_000, 40_000),
    "filled.jpg": jpeg(30_000, 40_000, b"\xff\xff"),
    "odd.jpg": jpeg(30_000, 40_000, b"garbage\xff\xd0"),
    "bmp": patched(encoded(".bmp"), 18, "<ii", 40_000, -30_000),
    "os2.bmp": bmp_of_os2(30_000, 40_000),
    "webp": patched(encoded(".webp", flags=[cv2.IMWRITE_WEBP_QUALITY, 50]), 26, "<HH", 16_383, 16_383),
    "lossless.webp": patched(encoded(".webp", flags=LOSSLESS), 21, "<I", 16_382 | 16_382 << 14),
    "canvas.webp": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + b"\xff\xff\0" * 2,
    "tif": tiff(30_000, 40_000),
    "other.tif": tiff(30_000, 40_000, order=">"),
    "large.tif": tiff(30_000, 40_000, large=True),
    "tiles.tif": tiff(48, 64, tile=(32_000, 32_000)),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_claim_of_more_pixels_than_are_read_is_refused_before_memory_is_taken(tmp_path, name):
    path = tmp_path / f"a.{name}"
    path.write_bytes(CLAIMS[name])
    tracemalloc.start()
    with pytest.raises(ValueError, match=rf"{name}: claims \d+x\d+ pixels \(HxW\), more than the 134,217,728"):
        pictures.read_image(path)
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()


@pytest.mark.parametrize("suffix", [".pgm", ".ppm", ".hdr", ".jp2", ".gif", ".sr"])
def test_other_formats_under_a_pictures_name_are_refused(tmp_path, suffix):
    """Their claims are not looked at, so they are not decoded; folders are searched for none of them."""
    picture = PICTURE[..., 0] if suffix == ".pgm" else PICTURE / np.float32(255) if suffix == ".hdr" else PICTURE
    (tmp_path / "a.png").write_bytes(encoded(suffix, picture))
    with pytest.raises(ValueError, match="a.png: is not a picture that can be read .*none of PNG, JPEG, BMP, WebP and"):
        pictures.read_image(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", pictures.SUFFIXES)
def test_every_format_is_still_read(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(encoded(suffix))
    assert pictures.read_image(tmp_path / f"a{suffix}").shape == PICTURE.shape
