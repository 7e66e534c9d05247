"""Bad files of every format, made of good ones: what is done to them, and the error."""

import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from good_files import COLMAP_TEXT, META, POSES, STEP, entries, npy


class Bad(NamedTuple):
    """``change`` makes the bytes of a bad file of good ones; ``wanted``: the error."""

    file: str
    change: Callable[[bytes], bytes]
    wanted: str


def swap(old: bytes | str, new: bytes | str):
    """Replaces what occurs, once."""
    old, new = (x.encode() if isinstance(x, str) else x for x in (old, new))

    def change(data: bytes) -> bytes:
        assert old in data, old
        return data.replace(old, new, 1)

    return change


def put(at: int, form: str, *values):
    """Overwrites numbers at a byte."""
    raw = struct.pack("<" + form, *values)
    return lambda data: data[:at] + raw + data[at + len(raw) :]


def unpacked(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """What is done to what a gzip file holds."""
    return lambda data: gzip.compress(change(gzip.decompress(data)))


def constant(data: bytes | str):
    return lambda _: data.encode() if isinstance(data, str) else data


def changed(edit: Callable):
    """Changes a JSON value in place."""

    def change(data: bytes) -> bytes:
        value = json.loads(data)
        edit(value)
        return json.dumps(value).encode()

    return change


def at(*keys, to):
    """Sets, in JSON, what keys lead to."""

    def edit(value):
        for key in keys[:-1]:
            value = value[key]
        value[keys[-1]] = to

    return changed(edit)


def frame(key, to):
    return at("frames", 1, key, to=to)


def npy_of(header: str) -> bytes:
    """A .npy file of 8 bytes, with a header of its own."""
    head = struct.pack("<H", len(header)) + header.encode()
    return b"\x93NUMPY\1\0" + head + bytes(8)


def meta(key, to):
    """Another value in the checkpoint's JSON."""

    def edit(found):
        value = json.loads(found[META].split(b"\n", 1)[1])
        value[key] = to
        text = json.dumps(value).encode()
        found[META] = npy(np.frombuffer(text, np.uint8))

    return entries(edit)


def first_array(found):
    return next(name for name in found if "means" in name)


def values(name: str, edit: Callable):
    """Other values in an array of the checkpoint, whose checksums are right."""

    def change(found):
        array = np.load(io.BytesIO(found[name + ".npy"]))
        found[name + ".npy"] = npy(edit(array))

    return entries(change)


def spoilt(index, value):
    """Puts a value into an array."""

    def edit(array):
        array[index] = value
        return array

    return edit


def webp(width: int, height: int) -> bytes:
    """A lossless WebP of 34 bytes, of which little but the size is there."""
    bits = struct.pack("<BI", 0x2F, (width - 1) | (height - 1) << 14) + bytes(9)
    chunk = b"VP8L" + struct.pack("<I", len(bits)) + bits
    return b"RIFF" + struct.pack("<I", len(chunk) + 4) + b"WEBP" + chunk


def jpeg_of(width: int, height: int):
    """Another size in the frame of a baseline JPEG."""

    def change(data: bytes) -> bytes:
        start = data.index(b"\xff\xc0")
        return put(start + 5, "4s", struct.pack(">HH", height, width))(data)

    return change


def tiff_of(width: int, height: int):
    """Another size, and as many rows in the one strip, in a little-endian TIFF."""

    def change(data: bytes) -> bytes:
        (start,) = struct.unpack_from("<I", data, 4)
        (count,) = struct.unpack_from("<H", data, start)
        wanted = {256: width, 257: height, 278: height}
        for entry in range(start + 2, start + 2 + 12 * count, 12):
            (tag,) = struct.unpack_from("<H", data, entry)
            if tag in wanted:
                data = put(entry + 2, "HII", 4, 1, wanted.pop(tag))(data)
        assert not wanted
        return data

    return change


def png(width, height, color=2) -> bytes:
    def chunk(kind, body):
        crc = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + crc

    head = struct.pack(">IIBBBBB", width, height, 8, color, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*each) for each in chunks)


NAN = struct.pack("<f", np.nan)
DEEP = "[" * 9_000  # deeper than Python parses, and not yet a multitude
NPY = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s), }\n"
CAMERAS, IMAGES, POINTS = (
    f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")
)
LEAVING = "the name .* is not that of a file within the dataset's folder; copy"
BAD = {
    # PLY
    "ply empty": Bad("scene.ply", constant(b""), "byte 0: expected a PLY file.*got b''"),
    "ply of zeros": Bad("scene.ply", lambda d: bytes(len(d)), "byte 0: expected a PLY"),
    "ply magic": Bad("scene.ply", constant(png(4, 4)), "byte 0: .*got .*PNG"),
    "ply endless header": Bad(
        "scene.ply", constant(b"ply\n" + b"comment\n" * 300_000), "no line 'end_header'"
    ),
    "ply count": Bad(
        "scene.ply",
        swap("vertex 4", "vertex 4000000000"),
        r"body \(from byte \d+\) is truncated: .*272000000000 bytes.* got 272;",
    ),
    "ply count of 20 digits": Bad(
        "scene.ply", swap("vertex 4", "vertex " + "9" * 20), "truncated"
    ),
    "ply negative count": Bad(
        "scene.ply", swap("vertex 4", "vertex -4"), r"header line 3 \(byte 36\)"
    ),
    "ply type": Bad(
        "scene.ply", swap("float x", "half x"), "line 4 .byte 53.*'property half x'"
    ),
    "ply list": Bad(
        "scene.ply", swap("float nx", "list uchar int nx"), r"list properties \['nx'\]"
    ),
    "ply property": Bad("scene.ply", swap("opacity", "opaque"), "lacks .* opacity"),
    "ply not finite": Bad(
        "scene.ply", lambda d: d[:-4] + NAN, r"in 1 of 4 Gaussians .*quats: 1.*\[3\]"
    ),
    "ply of points": Bad(
        "scene.ply",
        constant(
            "ply\nformat ascii 1.0\nelement vertex 0\n"
            + "".join(
                f"property float {n}\n" for n in ("x", "y", "z", "red", "green", "blue")
            )
            + "end_header\n"
        ),
        "this is a point cloud",
    ),
    "ply word": Bad("ascii.ply", swap("\n-", "\none "), r"vertex \d.*(got 18|one)"),
    "ply underscore": Bad(
        "ascii.ply",
        lambda d: d[:-2] + b"1_0\n",
        r"vertex 3 \(byte \d+\): .*got .1_0",
    ),
    "ply row endless": Bad(
        "ascii.ply",
        lambda d: d[: d.index(b"end_header") + 11] + b"1 " * 500_000,
        r"vertex 0 \(byte \d+\): expected 17 numbers, got a line of \d+ bytes",
    ),
    "ply digits": Bad(
        "ascii.ply",
        lambda d: d[:-2] + "\uff11\n".encode(),
        r"vertex 3 \(byte \d+\): expected 17 numbers, got",
    ),
    # SPZ
    "spz empty": Bad("scene.spz", constant(b""), "expected an SPZ header.*got b''"),
    "spz of something": Bad(
        "scene.spz", constant(png(4, 4)), "not an SPZ file, or damaged .*gzip"
    ),
    "spz magic": Bad(
        "scene.spz", unpacked(swap("NGSP", "PSGN")), "expected an SPZ header.*got b'PSGN"
    ),
    "spz of later": Bad("scene.spz", gzip.decompress, "got 4 or later"),
    "spz version": Bad("scene.spz", unpacked(put(4, "I", 9)), "version 2 to 3, got 9"),
    "spz degree": Bad("scene.spz", unpacked(put(12, "B", 7)), "degree 0 to 4, got 7"),
    "spz fraction": Bad("scene.spz", unpacked(put(13, "B", 99)), "fraction 0 to 24, got 99"),
    "spz count": Bad(
        "scene.spz", unpacked(put(8, "I", 4_000_000_000)), "bytes cannot hold"
    ),
    "spz count, a little": Bad(
        "scene.spz", unpacked(put(8, "I", 5)), "expected 20 bytes of quats, got 0"
    ),
    "spz cut within": Bad("scene.spz", unpacked(lambda d: d[:-5]), "bytes of quats, got"),
    "spz checksum": Bad(
        "scene.spz", lambda d: d[:-8] + bytes(4) + d[-4:], "damaged .*CRC"
    ),
    "cloud without y": Bad(
        "cloud.ply", swap("float y", "float why"), "expected scalar properties x, y, z"
    ),
    "cloud not finite": Bad(
        "cloud.ply", swap("0 0.5", "0 inf"), r"in 1 of 2 points.*\[0\]"
    ),
    # COLMAP, binary
    "camera count": Bad(CAMERAS, put(0, "Q", 2**62), "byte 0: the count says 4611"),
    "camera model": Bad(
        CAMERAS, put(12, "i", 99), r"camera 0 \(byte 8\): .*99 is unkn"
    ),
    "camera model unsupported": Bad(
        CAMERAS, put(12, "i", 10), "byte 8.*THIN_PRISM_FISHEYE|takes"
    ),
    "camera size": Bad(CAMERAS, put(16, "Q", 0), r"\(byte 8\): image size 0 × 24"),
    "camera focal": Bad(CAMERAS, put(32, "d", -1), r"\(byte 8\): focal lengths -1"),
    "camera twice": Bad(CAMERAS, put(64, "I", 1), r"\(byte 64\): the id 1 is that of"),
    "camera longer": Bad(CAMERAS, lambda d: d + b"abc", "3 bytes follow the last of 2"),
    "camera text": Bad(CAMERAS, constant(COLMAP_TEXT["cameras"]), "byte 0: the count"),
    "image quaternion": Bad(
        IMAGES,
        put(12, "4d", 0, 0, 0, 0),
        r"image 0 \(byte 8\): the quaternion of 'view",
    ),
    "image pose": Bad(IMAGES, put(12, "d", np.nan), r"\(byte 8\): pose \[nan"),
    "image name endless": Bad(
        IMAGES, swap("view_00.png\0", "v" * 2000), r"\(byte 72\) has no end within"
    ),
    "image name no text": Bad(IMAGES, swap("view_00", b"view\xff0"), "is not UTF-8"),
    "image name empty": Bad(IMAGES, swap("view_00.png", ""), "name of .* is empty"),
    "image observations": Bad(
        IMAGES, put(84, "Q", 2**60), r"byte 92: the 1152\d+ 2D points of image 0"
    ),
    "point not finite": Bad(
        POINTS, put(16, "d", np.inf), r"1 of 4 points .*point \[1\]"
    ),
    "point twice": Bad(POINTS, put(8 + 51, "Q", 1), r"have an id that another .*\[1\]"),
    "point track": Bad(POINTS, put(51, "Q", 2**61), "byte 8: point 0 takes 1844"),
    # COLMAP, text
    "text few": Bad(
        "text/cameras.txt", swap(" 40 42 15.5 12.25", ""), "line 3: found 0 param"
    ),
    "text word": Bad("text/cameras.txt", swap("15.5", "here"), "line 3: .*'here'"),
    "text underscore": Bad("text/cameras.txt", swap("42", "4_2"), "line 3: .*4_2"),
    "text number": Bad("text/cameras.txt", swap("32 24", "32 2.4"), "height is '2.4'"),
    "text binary": Bad("text/images.txt", constant(b"\x89\xff\0"), "line 0: not UTF-8"),
    "text pose": Bad("text/images.txt", swap("3 1 v", "nan 1 v"), "line 3: pose .*nan"),
    "text observations": Bad(
        "text/images.txt", swap("1.5 2 1", "1 2"), "line 4: 2 val"
    ),
    "text no observations": Bad(
        "text/images.txt",
        swap("1.5 2 1", "7 1 0 0 0 0 0 1 1 IMG (2) a.png"),
        "line 4: 12 values, the last 'a.png'; X Y POINT3D_ID",
    ),
    "text colour": Bad("text/points3D.txt", swap("255", "256"), "line 3: colour .256"),
    "text track": Bad("text/points3D.txt", swap("2 1\n", "2\n"), "line 3: the track"),
    "text point": Bad("text/points3D.txt", swap("0.5 1", "0.5 1_"), "line 3: .*1_"),
    "text digits": Bad(
        "text/cameras.txt", swap("42", "\uff14\uff12"), "line 3: could not convert"
    ),
    "text point digits": Bad(
        "text/points3D.txt", swap("0.5 1", "0.\uff15 1"), "line 3: could not convert"
    ),
    "text point id": Bad(
        "text/points3D.txt", swap("\n1 ", "\n1.0 "), "line 3: the point id is '1.0'"
    ),
    "text point id long": Bad(
        "text/points3D.txt", swap("\n1 ", "\n18446744073709551616 "), "line 3: the poi"
    ),
    "text track of nan": Bad(
        "text/points3D.txt",
        swap("1 0 2 1\n", "1 nan 2 1\n"),
        "line 3: a value of the track is 'nan'; a whole number",
    ),
    "text point control": Bad(
        "text/points3D.txt", swap("0.5 1", "0.5\x1c1"), "after line 0: characters that"
    ),
    "text camera endless": Bad(
        "text/cameras.txt",
        constant("1 PINHOLE 640 480 " + "5 " * 500_000),
        "line 1: a line of more than 16384 characters",
    ),
    "text image endless": Bad(
        "text/images.txt",
        constant("# a\n" + "1 " * 500_000),
        "line 2: a line of more than 16384 characters",
    ),
    "text comment endless": Bad(
        "text/images.txt",
        constant("#" * 500_000),
        "line 1: a line of more than 16384 characters",
    ),
    "text track endless": Bad(
        "text/points3D.txt",
        constant("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 0" + " 1 2" * 500_000),
        "line 2: a line of more than 1048576 characters",
    ),
    # transforms.json
    "json empty": Bad("transforms.json", constant(b""), "not JSON: .*char 0"),
    "json deep": Bad("transforms.json", constant(DEEP), "not JSON"),
    "json of braces": Bad(
        "transforms.json",
        constant('{"frames":[' + "{}," * 50_000 + "{}]}"),
        "50003 objects and lists in 150015 bytes",
    ),
    "json of keys": Bad(
        "transforms.json",
        constant("{" + "".join(f'"k{i}":1,' for i in range(50_000)) + '"frames":[]}'),
        "50001 keys in 1 objects, which no list of cameras has",
    ),
    "json of numbers": Bad(
        "transforms.json",
        constant('{"frames":[' + "1.5," * 50_000 + "1]}"),
        "50000 values in 1 objects and 200014 bytes",
    ),
    "json of words": Bad(
        "transforms.json",
        constant('{"frames":[' + '"a",' * 50_000 + "1]}"),
        "50000 values in 1 objects and 200014 bytes",
    ),
    "json encoding": Bad("transforms.json", constant(b"\xff\xfe\xff"), "not JSON"),
    "json list": Bad(
        "transforms.json", constant("[1]"), r"the top is \[1\], an object"
    ),
    "json no frames": Bad("transforms.json", at("frames", to={}), "'frames' is {}"),
    "json frame": Bad("transforms.json", at("frames", 0, to=3), r"frames\[0\] is 3"),
    "json matrix": Bad(
        "transforms.json",
        frame("transform_matrix", [[1, 2]]),
        r"frames\[1\]: transform_",
    ),
    "json matrix huge": Bad(
        "transforms.json",
        at("frames", 1, "transform_matrix", 0, 3, to=10**400),
        r"frames\[1\]: transform_matrix has values that are no finite",
    ),
    "json matrix zero": Bad(
        "transforms.json",
        frame("transform_matrix", [[0] * 4] * 3),
        r"frames\[1\]: .*no rotation",
    ),
    "json size": Bad(
        "transforms.json", frame("w", 10**9), r"\[1\]: image size w 1e\+09"
    ),
    "json number": Bad(
        "transforms.json", frame("cx", 1e300), r"\[1\]: cx is 1e\+300; a"
    ),
    "json text": Bad("transforms.json", frame("fl_x", "40"), r"\[1\]: fl_x is '40'; a"),
    "json focal": Bad("transforms.json", frame("fl_x", 0), r"\[1\]: focal lengths 0"),
    "json lens": Bad("transforms.json", frame("camera_model", "SPHERE"), "'SPHERE'"),
    "json lens endless": Bad(
        "transforms.json", frame("camera_model", "A" * 500_000), "A' is not|A'? is not"
    ),
    "json path number": Bad("transforms.json", frame("file_path", 7), "file_path is 7"),
    "json path up": Bad(
        "transforms.json", frame("file_path", "../../etc/passwd"), rf"\[1\]: {LEAVING}"
    ),
    "json path absolute": Bad(
        "transforms.json", frame("file_path", "/etc/passwd"), rf"\[1\]: {LEAVING}"
    ),
    "json path of Windows": Bad(
        "transforms.json", frame("file_path", "..\\a.png"), rf"\[1\]: {LEAVING}"
    ),
    "json path with 0": Bad(
        "transforms.json", frame("file_path", "a\0.png"), rf"\[1\]: {LEAVING}"
    ),
    "json path long": Bad(
        "transforms.json", frame("file_path", "a" * 5000), r"\[1\]: .* has 5000 bytes"
    ),
    "json path unpaired": Bad(
        "transforms.json", frame("file_path", "\ud800.png"), rf"\[1\]: {LEAVING}"
    ),
    "json mask up": Bad(
        "transforms.json", frame("mask_path", "../mask.png"), rf"\[1\]: {LEAVING}"
    ),
    "json points up": Bad(
        "transforms.json", at("ply_file_path", to="/etc/passwd"), LEAVING
    ),
    # LLFF
    "npy magic": Bad("poses_bounds.npy", constant(b"PK\3\4 zip"), r"is no \.npy file"),
    "npy objects": Bad(
        "poses_bounds.npy",
        constant(npy(np.asarray([{}]))),
        r"header \(byte 10\).*descr",
    ),
    "npy size": Bad(
        "poses_bounds.npy",
        constant(npy_of(NPY % "999999999999, 17")),
        "8 bytes follow the header, .* takes 135999999999864",
    ),
    "npy negative": Bad(
        "poses_bounds.npy", constant(npy_of(NPY % "-1, 17")), r"header .*\(shape\)"
    ),
    "npy deep": Bad("poses_bounds.npy", constant(npy_of("(" * 60_000)), "header"),
    "npy columns": Bad("poses_bounds.npy", constant(npy(POSES[:, :15])), r"\[2, 15\]"),
    "npy whole numbers": Bad(
        "poses_bounds.npy", constant(npy(POSES.astype(int))), "int64"
    ),
    "npy not finite": Bad("poses_bounds.npy", put(128 + 17 * 8, "d", np.nan), "row 1"),
    "npy rows": Bad(
        "poses_bounds.npy", constant(npy(POSES[:1])), "1 rows, but .* has 2"
    ),
    "npy mirrored": Bad("poses_bounds.npy", put(128 + 8, "d", -1), "row 0: .*mirrors"),
    # photographs
    "photo empty": Bad("photo.png", constant(b""), "the file is empty"),
    "photo kind": Bad("photo.png", constant(b"GIF89a"), "starts with b'GIF89a'"),
    "photo huge": Bad("photo.png", constant(png(60_000, 60_000)), "60000 × 60000 px"),
    "photo bomb": Bad("photo.png", constant(png(15_000, 15_000)), "cannot fit in it"),
    "photo zero": Bad("photo.png", constant(png(0, 5)), "0 × 5 px"),
    "photo aspect": Bad("photo.png", constant(png(16, 20, 0)), "16 × 20 px, but it"),
    "photo aspect by header": Bad(
        "photo.webp", constant(webp(16_383, 16_383)), "16383 × 16383 px, but it"
    ),
    "photo size by header": Bad(
        "photo.webp",
        constant(webp(16_380, 12_285)),
        "16380 × 12285 px, but its camera is for 8 × 6; at most 64 times",
    ),
    "mask size by header": Bad(
        "mask.png", constant(webp(16_380, 12_285)), "a mask of 16380 × 12285 px"
    ),
    "photo checksum": Bad("photo.png", put(50, "B", 77), "cannot be decoded"),
    "jpeg cut": Bad("photo.jpg", lambda d: d[:-9], "no end-of-image marker"),
    "jpeg bomb": Bad("photo.jpg", jpeg_of(8000, 8000), "8000 × 8000 px cannot fit"),
    "jpeg marker": Bad("photo.jpg", put(2, "B", 0), "starts with|no marker"),
    "webp length": Bad(
        "photo.webp", put(4, "I", 2**31), "2147483656 bytes are declared"
    ),
    "tiff bomb": Bad("photo.tiff", tiff_of(8000, 8000), "8000 × 8000 px cannot fit"),
    "tiff offset": Bad("photo.tiff", put(4, "I", 2**32 - 1), "truncated or damaged"),
    "bmp size": Bad("photo.bmp", put(18, "i", 2**30), "declares 1073741824 × 6 px"),
    "mask aspect": Bad("mask.png", constant(png(16, 20, 0)), "a mask of 16 × 20"),
    "mask kind": Bad("mask.png", constant(b"no mask"), "starts with b'no mask'"),
    # checkpoints
    "zip empty": Bad(STEP, constant(b""), "damaged checkpoint: File is not a zip file"),
    "zip other": Bad(STEP, constant(npy(POSES)), "damaged checkpoint"),
    "zip checksum": Bad(
        STEP, lambda d: d[:300] + b"!" + d[301:], r"damaged .*\(byte \d+\): .*CRC"
    ),
    "zip bomb": Bad(
        STEP,
        entries(lambda e: e.update(a=bytes(10**7)), zipfile.ZIP_DEFLATED),
        "compressed, in 1000",
    ),
    "zip lzma": Bad(STEP, entries(lambda _: 0, zipfile.ZIP_LZMA), "compressed"),
    "zip no text": Bad(STEP, entries(lambda e: e.pop(META)), "meta.json is no"),
    "zip deep text": Bad(
        STEP,
        entries(
            lambda e: e.update({META: npy(np.frombuffer(DEEP.encode(), np.uint8))})
        ),
        "meta.json: .*recursion",
    ),
    "zip format": Bad(STEP, meta("format", 99), "format 99; 1 is wanted"),
    "zip step": Bad(STEP, meta("step", 1e999), "meta.json: step inf"),
    "zip capacity": Bad(STEP, meta("capacity", 10**12), "capacity 1000000000000"),
    "zip pairs": Bad(STEP, meta("pair_capacity", "many"), "pair_capacity 'many'"),
    "zip seconds": Bad(STEP, meta("seconds", 1e999), "seconds inf"),
    "zip arrays": Bad(
        STEP, entries(lambda e: e.pop(first_array(e))), "meta.json: arrays"
    ),
    "zip objects": Bad(
        STEP,
        entries(lambda e: e.update({first_array(e): npy(np.asarray([{}]))})),
        r"means.*: the header \(byte 10\).*descr",
    ),
    "zip array size": Bad(
        STEP,
        entries(lambda e: e.update({first_array(e): npy_of(NPY % "9999999999999,")})),
        r"means.*8 bytes follow the header, .* takes 7999",
    ),
    "zip other step": Bad(
        STEP, meta("step", 8), "meta.json says step 8, and its name another"
    ),
    "zip step below 0": Bad(
        STEP,
        values(".step", lambda a: a * 0 - 5),
        r"\.step is -5, and meta.json says 7",
    ),
    "zip steps": Bad(
        STEP, values(".step", lambda a: np.full(9, 7, a.dtype)), r"\.step is \[7, 7"
    ),
    "zip count": Bad(
        STEP, values(".moments.count", lambda a: a + 8), r"count is 8; 0 to 7, the step"
    ),
    "zip nan": Bad(
        STEP,
        values(".gaussians.params.means", spoilt(2, np.nan)),
        r"means: 1 of 4 are not finite numbers, \[2\] the first",
    ),
    "zip infinite square": Bad(
        STEP,
        values(".moments.nu.sh", spoilt(1, np.inf)),
        r"nu\.sh: 1 of 4 are not finite numbers of at least 0, \[1\] the first",
    ),
    "zip square below 0": Bad(
        STEP, values(".moments.nu.quats", spoilt(0, -1)), "nu.quats: 1 of 4 are not fin"
    ),
    "zip statistic": Bad(
        STEP, values(".stats.gradient", spoilt(0, np.nan)), "gradient: 1 of 4 are not"
    ),
    "zip truth": Bad(
        STEP,
        values(".gaussians.active", lambda a: (a * np.uint8(3)).view(bool)),
        "active is no list of what is true or false",
    ),
    # what a run writes
    "config empty": Bad("config.json", constant(b""), "not JSON"),
    "config list": Bad("config.json", constant("[]"), r"the top is \[\], an object"),
    "config deep": Bad("config.json", constant('{"train":' + DEEP), "not JSON"),
    "config format": Bad("config.json", at("format", to=2), "format 2; 1 is wanted"),
    "config without": Bad(
        "config.json", changed(lambda c: c.pop("train")), "'train' is missing"
    ),
    "config type": Bad(
        "config.json", at("every", to="8"), r"every is '8'; int \| None is wanted"
    ),
    "config names": Bad(
        "config.json", at("test_images", to="ab"), "test_images is 'ab'"
    ),
    "config setting": Bad(
        "config.json", at("train", "colour", to=1), r"unknown settings \['colour'\]"
    ),
    "config range": Bad(
        "config.json", at("train", "steps", to=-1), "TrainConfig.steps = -1 is out of"
    ),
    "config half": Bad(
        "config.json", at("train", "mcmc", "every", to=2.5), "every is 2.5; int is wan"
    ),
    "config nan": Bad(
        "config.json",
        at("train", "adaptive", "threshold", to=np.nan),
        "threshold is nan",
    ),
    "config huge": Bad("config.json", at("every", to=10**400), "every is 1000"),
    "config rates": Bad("config.json", at("train", "rates", to=[]), "not the settings"),
    "config cooling": Bad(
        "config.json",
        at("train", "rates", 6, to=-0.5),
        "rates' cooling .* out of range",
    ),
    "evaluation": Bad(
        "eval.json", at("psnr", to="good"), "psnr is 'good'; .*gsjax eval"
    ),
    "evaluation huge": Bad("eval.json", at("psnr", to=10**400), "psnr is 1000"),
    "evaluation views": Bad("eval.json", at("which", to=[]), r"which is \[\]"),
    "cameras missing": Bad(
        "cameras.json", changed(lambda c: c["views"].pop()), "view_01.png"
    ),
    "cameras sheared": Bad(
        "cameras.json", at("views", 0, "viewmat", 0, 0, to=2.0), "00.png: no rigid pose"
    ),
    "cameras huge": Bad(
        "cameras.json", at("views", 1, "K", 0, 0, to=10**400), "too large to convert"
    ),
    "cameras ragged": Bad("cameras.json", at("views", 0, "K", to=[[1]]), "reshape"),
}
