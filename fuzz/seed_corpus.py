#!/usr/bin/env python3
"""Writes the seed corpus of every fuzz target to fuzz/corpus/: small valid inputs and their near misses.

Only the standard library is used. Golden images, where they are checked out, are added to the image seeds.
"""

import base64
import pathlib
import struct
import zlib

ROOT = pathlib.Path(__file__).resolve().parent
JPEG = base64.b64decode(
    "/9j/4AAQSkZJRgABAQEASABIAAD/2wBDAP//////////////////////////////////////////////////////////////////////////"
    "////////////wgALCAABAAEBAREA/8QAFBABAAAAAAAAAAAAAAAAAAAAAP/aAAgBAQABPxA="
)
WEBP_LOSSY = base64.b64decode("UklGRiIAAABXRUJQVlA4IBYAAAAwAQCdASoBAAEADsD+JaQAA3AAAAAA")
WEBP_LOSSLESS = base64.b64decode("UklGRhoAAABXRUJQVlA4TA0AAAAvAAAAEAcQERGIiP4HAA==")


def png(width, height, colour, depth, row_bytes, extra=b""):
    """A PNG with rows of a simple pattern; `colour` and `depth` as in its header."""
    rows = b"".join(b"\0" + bytes((x * 7 + y) & 255 for x in range(row_bytes)) for y in range(height))

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def palette(length=48):
    body = bytes(range(length))
    return struct.pack(">I", len(body)) + b"PLTE" + body + struct.pack(">I", zlib.crc32(b"PLTE" + body))


def scan_bomb(scans):
    """The JPEG with its one scan again and again before its end: each is a pass over the whole picture."""
    start = JPEG.rindex(b"\xff\xda")
    return JPEG + JPEG[start:] * (scans - 1) + b"\xff\xd9"


def segment(marker, body):
    return b"\xff" + bytes([marker]) + struct.pack(">H", len(body) + 2) + body


class Bits:
    """The bits of a JPEG's compressed data, with a zero behind each byte FF."""

    def __init__(self):
        self.bits = ""

    def put(self, value, count):
        self.bits += format(value & ((1 << count) - 1), f"0{count}b") if count else ""

    def value(self, value):
        """The bits behind a symbol that say which of the values of its size this is."""
        self.put(value if value >= 0 else value - 1, abs(value).bit_length())

    def finish(self):
        bits = self.bits + "1" * (-len(self.bits) % 8)
        return bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)).replace(b"\xff", b"\xff\0")


def jpeg(width, height, sampling, scans, progressive=False, interval=0, tables=True, ids=b"\1\2\3\4"):
    """A JPEG of blocks with a mean and two more coefficients.

    `scans` holds, for each scan, its components, its band, and the bit known before and after it. The code of a DC
    symbol is the symbol in four bits, that of an AC symbol in eight.
    """
    largest = [max(factors[i] for factors in sampling) for i in (0, 1)]
    units = [-(-side // (8 * most)) for side, most in zip((width, height), largest)]
    frame = struct.pack(">BHHB", 8, height, width, len(sampling))
    frame += b"".join(bytes([ids[i], h << 4 | v, 0]) for i, (h, v) in enumerate(sampling))
    out = b"\xff\xd8" + segment(0xDB, b"\0" + b"\5" * 64) + segment(0xC2 if progressive else 0xC0, frame)
    if tables:
        out += segment(0xC4, b"\x00" + bytes([0] * 3 + [12] + [0] * 12) + bytes(range(12)))
        out += segment(0xC4, b"\x10" + bytes([0] * 7 + [255] + [0] * 8) + bytes(range(255)))
    if interval:
        out += segment(0xDD, struct.pack(">H", interval))
    for components, (first, last), (high, low) in scans:
        parts = b"".join(bytes([ids[c], 0]) for c in components)
        out += segment(0xDA, bytes([len(components)]) + parts + bytes([first, last, high << 4 | low]))
        blocks = []
        if len(components) == 1:
            h, v = sampling[components[0]]
            across = -(-(-(-width * h // largest[0])) // 8)
            down = -(-(-(-height * v // largest[1])) // 8)
            blocks = [[components[0]]] * (across * down)
        else:
            unit = [c for c in components for _ in range(sampling[c][0] * sampling[c][1])]
            blocks = [unit] * (units[0] * units[1])
        step = interval or len(blocks)
        for number, start in enumerate(range(0, len(blocks), step)):
            out += bytes([0xFF, 0xD0 + (number - 1) % 8]) if number else b""
            bits, means = Bits(), [0] * 4
            for at, unit in enumerate(blocks[start : start + step], start):
                for component in unit:
                    block = {0: (at * 7 + component * 11) % 50 - 25, 1: 9 - at % 19, 8: component - 1}
                    encode_block(bits, block, component, means, (first, last), (high, low))
            out += bits.finish()
    return out + b"\xff\xd9"


def encode_block(bits, block, component, means, band, known):
    (first, last), (high, low) = band, known
    if first == 0 and high:
        bits.put(block[0] >> low, 1)
    elif first == 0:
        mean = block[0] >> low
        bits.put(abs(mean - means[component]).bit_length(), 4)
        bits.value(mean - means[component])
        means[component] = mean
    if last == 0:
        return
    zeros, corrections = 0, []
    for k in range(max(first, 1), last + 1):
        level = abs(block.get(k, 0)) >> low
        if level == 0:
            zeros += 1
        elif high and level > 1:
            corrections.append(level & 1)
        else:
            bits.put(zeros << 4 | (1 if high else level.bit_length()), 8)
            if high:
                bits.put(block[k] > 0, 1)
                for bit in corrections:
                    bits.put(bit, 1)
                corrections = []
            else:
                bits.value(level if block[k] > 0 else -level)
            zeros = 0
    if zeros or corrections:
        bits.put(0, 8)
        for bit in corrections:
            bits.put(bit, 1)


WHOLE = ((0, 63), (0, 0))
HALVED = [(2, 2), (1, 1), (1, 1)]
SEPARATE = [([c], *WHOLE) for c in range(3)]
PROGRESSIVE = (
    [([0, 1, 2], (0, 0), (0, 1))]
    + [([c], (1, 63), (0, 1)) for c in range(3)]
    + [([0, 1, 2], (0, 0), (1, 0))]
    + [([c], (1, 63), (1, 0)) for c in range(3)]
)


def jpeg_layouts():
    """JPEGs of the layouts that decoders treat each in its own way, and what viewers tolerate or miss."""
    whole = jpeg(70, 50, HALVED, [([0, 1, 2], *WHOLE)])
    restarts = jpeg(70, 50, HALVED, [([0, 1, 2], *WHOLE)], interval=2)
    progressive = jpeg(70, 50, HALVED, PROGRESSIVE, progressive=True)
    mark = restarts.index(b"\xff\xd0")
    return {
        "halved": whole,
        "large": jpeg(200, 120, [(1, 1)] * 3, [([0, 1, 2], *WHOLE)]),
        "separate": jpeg(70, 50, HALVED, SEPARATE),
        "separate_restarts": jpeg(70, 50, HALVED, SEPARATE, interval=3),
        "luma_then_colours": jpeg(70, 50, HALVED, [([0], *WHOLE), ([1, 2], *WHOLE)]),
        "progressive": progressive,
        "progressive_restarts": jpeg(70, 50, HALVED, PROGRESSIVE, progressive=True, interval=1),
        "progressive_coarse": jpeg(70, 50, HALVED, PROGRESSIVE[:3], progressive=True),
        "restarts": restarts,
        "stray_before_restart": restarts[:mark] + b"stray" + restarts[mark:],
        "without_restart": restarts[:mark] + restarts[mark + 2 :],
        "grey": jpeg(70, 50, [(2, 2)], [([0], *WHOLE)]),
        "inks": jpeg(70, 50, [(1, 1)] * 4, [([0, 1, 2, 3], *WHOLE)]),
        "red_green_blue": jpeg(70, 50, [(1, 1)] * 3, [([0, 1, 2], *WHOLE)], ids=b"RGB"),
        "quarter": jpeg(70, 50, [(4, 1), (1, 1), (1, 1)], [([0, 1, 2], *WHOLE)]),
        "third": jpeg(70, 50, [(3, 1), (2, 1), (1, 1)], [([0, 1, 2], *WHOLE)]),
        "small_luma": jpeg(70, 50, [(1, 1), (2, 2), (2, 2)], SEPARATE),
        "without_tables": jpeg(70, 50, HALVED, [([0, 1, 2], *WHOLE)], tables=False),
        "zeros_between": whole[:2] + segment(0xFE, b"") + b"\0\0" + whole[2:],
        "without_end": whole[:-2],
        "half_with_end": whole[: len(whole) // 2] + b"\xff\xd9",
        "two": whole + progressive,
        "means_and_nothing": jpeg(800, 800, [(1, 1)] * 3, PROGRESSIVE[:1], progressive=True),
    }


def tiff(orientation):
    """An EXIF block that says which side is up."""
    return b"II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)


def exif_jpeg(orientation, picture=JPEG):
    return picture[:2] + segment(0xE1, b"Exif\0\0" + tiff(orientation)) + picture[2:]


def exif_png(orientation):
    body = b"eXIf" + tiff(orientation)
    return png(5, 3, 2, 8, 15, struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body)))


def exif_webp(orientation, picture):
    block = tiff(orientation)
    canvas = b"VP8X\x0a\0\0\0\x08\0\0\0" + bytes(6)
    body = b"WEBP" + canvas + picture[12:] + b"EXIF" + struct.pack("<I", len(block)) + block
    return b"RIFF" + struct.pack("<I", len(body)) + body


def exif_seeds():
    def text(tag, value):
        return tag, 2, len(value) + 1, value + b"\0"

    def directory(at, entries):
        head, tail = struct.pack("<H", len(entries)), b""
        values_at = at + 2 + 12 * len(entries) + 4
        for tag, kind, count, data in entries:
            field = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", values_at + len(tail))
            head += struct.pack("<HHI", tag, kind, count) + field
            tail += data if len(data) > 4 else b""
        return head + bytes(4) + tail

    gps = [
        text(1, b"N"), (2, 5, 3, struct.pack("<6I", 48, 1, 51, 1, 30, 1)),
        text(3, b"W"), (4, 10, 3, struct.pack("<6i", 2, 1, 17, 1, 40, 1)),
        (7, 5, 3, struct.pack("<6I", 12, 1, 30, 1, 5, 1)), text(9, b"A"),
        (17, 12, 1, struct.pack("<d", 270.5)), text(29, b"2026:03:01"),
    ]
    exif = [text(0x9003, b"2026:03:01 14:30:05.847+02:00"), text(0x9011, b"+02:00"), text(0x9291, b"847")]
    exif_at = 8 + 2 + 12 * 3 + 4
    gps_at = exif_at + len(directory(exif_at, exif))
    first = [
        (0x0112, 3, 1, b"\x06\0"), (0x8769, 4, 1, struct.pack("<I", exif_at)),
        (0x8825, 4, 1, struct.pack("<I", gps_at)),
    ]
    whole = b"II*\0\x08\0\0\0" + directory(8, first) + directory(exif_at, exif) + directory(gps_at, gps)
    xmp = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description exif:GPSLatitude="48,51.5N" '
        b'exif:GPSLongitude="2,17.67E" drone-dji:GimbalYawDegree="-90.5"><xmp:CreateDate>'
        b"2026-03-01T14:30:05+02:00</xmp:CreateDate></rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    circle = b"II*\0\x08\0\0\0" + directory(8, [(0x8769, 4, 1, b"\x08\0\0\0"), (0x8825, 4, 1, b"\x08\0\0\0")])
    return {"whole": whole, "cut_off": whole[:-40], "circle": circle, "xmp": xmp, "xmp_cut_off": xmp[:120]}


def image_seeds():
    seeds = {
        "jpeg": JPEG,
        "jpeg_100_scans": scan_bomb(100),
        "jpeg_3000_scans": scan_bomb(3000),
        "webp_lossy": WEBP_LOSSY,
        "webp_lossless": WEBP_LOSSLESS,
        "png_rgb": png(5, 3, 2, 8, 15),
        "png_rgb16": png(4, 4, 2, 16, 24),
        "png_grey": png(6, 2, 0, 8, 6),
        "png_grey_alpha": png(3, 3, 4, 8, 6),
        "png_rgba": png(2, 5, 6, 8, 8),
        "png_palette": png(4, 4, 3, 4, 2, palette()),
        "png_palette_of_half_a_colour": png(4, 4, 3, 4, 2, palette(16)),
        "png_one_row": png(64, 1, 0, 1, 8),
        "png_truncated": png(5, 3, 2, 8, 15)[:-20],
        "png_huge_header": png(50000, 50000, 2, 8, 0)[:60],
        "text": b"this is not an image",
    }
    layouts = jpeg_layouts()
    seeds.update({f"jpeg_{name}": picture for name, picture in layouts.items()})
    for n in (1, 3, 6, 8):
        seeds[f"jpeg_exif_{n}"] = exif_jpeg(n)
        seeds[f"jpeg_progressive_exif_{n}"] = exif_jpeg(n, layouts["progressive"])
        seeds[f"png_exif_{n}"] = exif_png(n)
        seeds[f"webp_lossy_exif_{n}"] = exif_webp(n, WEBP_LOSSY)
        seeds[f"webp_lossless_exif_{n}"] = exif_webp(n, WEBP_LOSSLESS)
    for folder in (ROOT.parent / "tests" / "golden",):
        for picture in sorted(folder.glob("*.png"))[:1]:
            if picture.stat().st_size < 200_000:
                seeds[picture.stem] = picture.read_bytes()
    return seeds


def patch_blob(stride, columns, rows, counts, length=8):
    """A blob of the layout that crates/store/src/codec.rs describes."""
    n = sum(counts)
    blob = b"PFKP" + struct.pack("<HBBHHHHIII", 1, stride, 0, columns, rows, 14, length, *counts)
    blob += b"".join(struct.pack("<H", index) for count in counts for index in range(count))
    blob += struct.pack("<e", 1.5) * n + struct.pack("<f", 0.01) * n + bytes(i & 63 for i in range(length)) * n
    return blob + struct.pack("<I", zlib.crc32(blob))


def patch_seeds():
    whole = patch_blob(0, 8, 6, (4, 2, 1))
    return {
        "whole": whole,
        "empty": patch_blob(0, 32, 24, (0, 0, 0)),
        "stride_one": patch_blob(1, 8, 6, (2, 2, 2)),
        "default_length": patch_blob(0, 32, 24, (3, 1, 1), 384),
        "truncated": whole[:-9],
        "wrong_checksum": whole[:-1] + bytes([whole[-1] ^ 1]),
        "promises_too_much": whole[:16] + b"\xff" * 12 + whole[28:],
        "zeros": bytes(64),
    }


def multipart_seeds():
    def form(*parts, end=b"--X--\r\n"):
        return b"\0" + b"".join(b"--X\r\n" + head + b"\r\n\r\n" + body + b"\r\n" for head, body in parts) + end

    image = (b'Content-Disposition: form-data; name="image"; filename="a.jpg"\r\nContent-Type: image/jpeg', JPEG)
    options = (b'Content-Disposition: form-data; name="json"\r\nContent-Type: application/json', b'{"map":"a","top_k":3}')
    embedded = b'{"map":"a","image":"' + base64.b64encode(JPEG) + b'"}'
    return {
        "form": form(image, options),
        "form_without_image": form(options),
        "form_twice": form(image, image),
        "form_unended": form(image, end=b""),
        "json": b"\1" + embedded,
        "json_bad_base64": b'\1{"map":"a","image":"%%%"}',
        "json_deep": b"\1" + b"[" * 200,
        "raw": b"\2" + JPEG,
        "odd_boundary": b"\3" + form(image)[1:],
    }


QUERY_SEEDS = [
    "map=a",
    "map=a&top_k=10&candidates=100&rerank=true&deadline_ms=500",
    "map=a&near=52.2,0.12&radius_m=100",
    "map=a&captured_after=2024-01-01T00:00:00Z&captured_before=2025-01-01T00:00:00%2B02:00",
    "map=a&near=95,0&radius_m=NaN",
    "map=%00&top_k=-1",
    "map=a&map=b&unknown=1",
    "map=" + "a" * 300,
    "map=a&external_id=drive7/000123.jpg&lat=51.5&lon=-0.13&heading=270&captured_at=2026-05-17T09:30:00Z",
    "map=a&lat=95&lon=0",
    "map=a&lat=1",
    "map=a&heading=-1e-30&metadata=%7B%22camera%22:%22left%22%7D",
    "map=a&metadata=7",
    "map=a&limit=1000&cursor=at-1204",
    "limit=0",
    "external_id=a",
    "map=a&external_id=a",
    "reference_id=0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f",
    "reference_id=x",
    "for=query",
]

CONFIG_SEEDS = [
    '[http]\nlisten = "127.0.0.1:0"\nmax_connections = 10\n',
    "[extract]\ncaps = [400, 200, 50]\ntau = 1.0\n",
    '[extract]\npreset = "dinov2-vits14"\ninput_size = [448, 336]\nexit_block = 8\n',
    '[rerank]\nscales = ["1", "1+2", "2+3"]\n',
    '[auth]\n[[auth.keys]]\nname = "a"\nsha256 = "' + "0" * 64 + '"\nrole = "read"\n',
    "[pipeline]\nqueue_capacity = 64\ntop_k = 10\ncandidates = 100\n",
    '[log]\nformat = "json"\nfilter = "info"\n',
    "unknown = 1\n",
    "[http]\nmax_page = 99999999999999999999\n",
]


def numbered(texts):
    return {f"{index:02}": text.encode() for index, text in enumerate(texts)}


def main():
    corpora = {
        "image": image_seeds(),
        "exif": exif_seeds(),
        "patch_blob": patch_seeds(),
        "multipart": multipart_seeds(),
        "query_options": numbered(QUERY_SEEDS),
        "config": numbered(CONFIG_SEEDS),
    }
    for target, seeds in corpora.items():
        folder = ROOT / "corpus" / target
        folder.mkdir(parents=True, exist_ok=True)
        for name, body in seeds.items():
            (folder / f"seed_{name}").write_bytes(body)
        print(f"{target}: {len(seeds)} seeds")


if __name__ == "__main__":
    main()
