"""The size that the header of a picture claims, read before memory is taken for it: of PNG, JPEG, BMP, WebP and TIFF.

claim   (height, width) in pixels; where a header may state several, the largest of each
"""

import struct

JPEG_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # kinds of the segment that has a JPEG's size
PNG = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by kind of colour
DEFLATED = 1032  # times its size is the most that a deflated stream, such as a PNG's, can hold
LONE = tuple(bytes([kind]) for kind in (0, 1, *range(0xD0, 0xD9)))  # kinds that nothing follows, no length either
TIFF_SIZES = {257: 0, 256: 1, 323: 0, 322: 1}  # tag -> axis: of the picture, and of the tiles that it is stored in
TIFF_TYPES = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 16: "Q", 17: "q"}  # of whole numbers


def claimed_size(content: bytes) -> tuple[int, ...] | None:
    """The claim of a picture's bytes; None where they are of another format, or end before it."""
    read = next((read for mark, read in FORMATS.items() if content.startswith(mark)), None)
    try:
        return None if read is None else read(content)
    except struct.error:  # too short
        return None


def most_pixels(content: bytes) -> int | None:
    """Most pixels that these bytes can hold, where the format bounds them by its length; else None."""
    if not content.startswith(PNG) or len(content) < 26:
        return None
    bits = max(1, content[24]) * PNG_CHANNELS.get(content[25], 1)
    return DEFLATED * 8 * len(content) // bits


def _png(content):
    """None where a chunk claims more bytes than the file has: decoders take memory for it first."""
    at, size = len(PNG), struct.unpack_from(">II", content, 16)[::-1]
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        at += length + 12  # length, kind and checksum
        if at > len(content):
            return None
        if kind == b"IEND":
            return size
    return None


def _jpeg(content):
    """Segments are looked for as decoders do: whatever stands between two is passed over."""
    at = 2
    while (at := content.find(b"\xff", at)) >= 0:
        while content[at + 1 : at + 2] == b"\xff":
            at += 1
        if content[at + 1 : at + 2] in LONE:
            at += 2
            continue
        kind, length, _, height, width = struct.unpack_from(">BHBHH", content, at + 1)
        if kind in JPEG_SIZES:
            return height, width
        at += 2 + length
    return None


def _bmp(content):
    if struct.unpack_from("<I", content, 14)[0] == 12:  # OS/2's header
        return struct.unpack_from("<HH", content, 18)[::-1]
    width, height = struct.unpack_from("<ii", content, 18)
    return abs(height), abs(width)


def _webp(content):
    kind = content[12:16]
    if content[8:12] != b"WEBP":
        return None
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", content, 26)
        return height & 0x3FFF, width & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        return (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1
    width, height = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (24, 27))
    return (height, width) if kind == b"VP8X" and len(content) >= 30 else None


def _tiff(content):
    order = "<" if content[:2] == b"II" else ">"
    large = struct.unpack_from(f"{order}H", content, 2)[0] == 43  # BigTIFF
    start, entries, size = (8, "Q", 20) if large else (4, "H", 12)
    (at,) = struct.unpack_from(f"{order}{'Q' if large else 'I'}", content, start)
    if at >= len(content):
        return None
    (count,) = struct.unpack_from(f"{order}{entries}", content, at)
    claim, first = [0, 0], at + struct.calcsize(f"={entries}")
    for entry in range(first, min(first + size * count, len(content)), size):
        tag, kind = struct.unpack_from(f"{order}HH", content, entry)
        if tag in TIFF_SIZES and kind in TIFF_TYPES:
            (value,) = struct.unpack_from(f"{order}{TIFF_TYPES[kind]}", content, entry + (12 if large else 8))
            claim[TIFF_SIZES[tag]] = max(claim[TIFF_SIZES[tag]], value)
    return (claim[0], claim[1]) if min(claim) > 0 else None


FORMATS = {
    PNG: _png, b"\xff\xd8\xff": _jpeg, b"BM": _bmp, b"RIFF": _webp,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _tiff),
}  # fmt: skip
"""By how a file begins: what reads its claim, or raises `struct.error` where it is too short."""
