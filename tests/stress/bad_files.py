"""Bad files of every format: the change of a good file, and the expected error."""

import gzip
import io
import json
import struct
from collections import namedtuple
from collections.abc import Callable
from zipfile import ZIP_DEFLATED, ZIP_LZMA

import numpy as np
import zstandard
from glb_files import edited, primitive, put_together, taken_apart, with_array
from good_files import COLMAP_TEXT, META, POSES, STEP, entries, npy

# A change of the bytes of a good file, and a regular expression of the error.
Bad = namedtuple("Bad", "file change expected")


def swap(old: bytes | str, new: bytes | str):
    """Replace the first occurrence."""
    old, new = (x.encode() if isinstance(x, str) else x for x in (old, new))

    def change(data: bytes) -> bytes:
        assert old in data, old
        return data.replace(old, new, 1)

    return change


def put(at: int, form: str, *values):
    """Overwrite numbers at a byte."""
    raw = struct.pack("<" + form, *values)
    return lambda data: data[:at] + raw + data[at + len(raw) :]


def unpacked(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Change the content of a gzip file."""
    return lambda data: gzip.compress(change(gzip.decompress(data)))


def insert(at: int, more: bytes):
    """Insert bytes."""
    return lambda data: data[:at] + more + data[at:]


def chained(*changes: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Apply changes one after another."""

    def change(data: bytes) -> bytes:
        for one in changes:
            data = one(data)
        return data

    return change


def extended(record: bytes) -> Callable[[bytes], bytes]:
    """Add an extension record to SPZ of version 4."""
    place = put(14, "BBI", 2, 5, 32 + len(record))
    return chained(place, insert(32, record))


def first_frame(content: bytes, **options) -> Callable[[bytes], bytes]:
    """Replace the means of SPZ of version 4 of degree 0; its table stays true."""
    frame = zstandard.ZstdCompressor(**options).compress(content)

    def change(data: bytes) -> bytes:
        rest = data[112 + struct.unpack_from("<Q", data, 32)[0] :]
        return data[:32] + struct.pack("<Q", len(frame)) + data[40:112] + frame + rest

    return change


def just(data: bytes | str):
    return lambda _: data.encode() if isinstance(data, str) else data


def changed(edit: Callable):
    """Change a JSON value in place."""

    def change(data: bytes) -> bytes:
        value = json.loads(data)
        edit(value)
        return json.dumps(value).encode()

    return change


def at(*keys, to):
    """Set the JSON value at a path of keys."""

    def edit(value):
        for key in keys[:-1]:
            value = value[key]
        value[keys[-1]] = to

    return changed(edit)


def in_meta(*keys, to):
    """Set a value in the meta.json of a SOG."""
    change = at(*keys, to=to)
    return entries(
        lambda found: found.update({"meta.json": change(found["meta.json"])})
    )


def in_entry(name: str, change: Callable[[bytes], bytes]):
    """Change a file of a SOG."""
    return entries(lambda found: found.update({name: change(found[name])}))


def frame(key, to):
    return at("frames", 1, key, to=to)


def npy_of(header: str) -> bytes:
    """Return a .npy file of 8 bytes with a given header."""
    head = struct.pack("<H", len(header)) + header.encode()
    return b"\x93NUMPY\1\0" + head + bytes(8)


def text(data: bytes) -> bytes:
    """Return the entry of a checkpoint that holds this text."""
    return npy(np.frombuffer(data, np.uint8))


def meta(key, to):
    """Set a value in the checkpoint's JSON."""

    def edit(found):
        value = json.loads(found[META].split(b"\n", 1)[1])
        found[META] = text(json.dumps({**value, key: to}).encode())

    return entries(edit)


def entry(name: str, data: bytes):
    """Replace an entry of the checkpoint."""
    return entries(lambda found: found.update({name: data}))


def values(name: str, edit: Callable):
    """Change an array of the checkpoint, with valid checksums."""

    def change(found):
        array = np.load(io.BytesIO(found[name + ".npy"]))
        found[name + ".npy"] = npy(edit(array))

    return entries(change)


def spoilt(name: str, index: int, value):
    """Set a value of an array of the checkpoint."""

    def edit(array):
        array[index] = value
        return array

    return values(name, edit)


# Images that hold little but their size.


def png(width: int, height: int, color=2) -> bytes:
    head = struct.pack(">I4sIIBB", 13, b"IHDR", width, height, 8, color) + bytes(7)
    return b"\x89PNG\r\n\x1a\n" + head + struct.pack(">I4sI", 0, b"IEND", 0)


def webp(width: int, height: int) -> bytes:
    bits = struct.pack("<BI", 0x2F, (width - 1) | (height - 1) << 14) + bytes(9)
    chunk = b"VP8L" + struct.pack("<I", len(bits)) + bits
    return b"RIFF" + struct.pack("<I", len(chunk) + 4) + b"WEBP" + chunk


def jpeg(width: int, height: int) -> bytes:
    size = struct.pack(">HBHH", 17, 8, height, width)
    return b"\xff\xd8\xff\xc0" + size + bytes(10) + b"\xff\xda\xff\xd9"


def tiff(width: int, height: int) -> bytes:
    tags = struct.pack("<HHIIHHII", 256, 4, 1, width, 257, 4, 1, height)
    return b"II*\0\x08\0\0\0\x02\0" + tags


NAN = struct.pack("<f", np.nan)
DEEP = b"[" * 9_000  # deeper than Python parses
KEYS = "{" + "".join(f'"k{i}":1,' for i in range(50_000)) + '"frames":[]}'
CLOUD = "ply\nformat ascii 1.0\nelement vertex 0\n"
CLOUD += "".join(f"property float {n}\n" for n in [*"xyz", "red", "green", "blue"])
CLOUD += "end_header\n"
NPY = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s), }\n"
CAMERAS, IMAGES, POINTS = (
    f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")
)
LEAVING = "expected the name of a file within the dataset's folder, .*; copy"
MEANS, SQUARES = ".gaussians.params.means.npy", ".moments[0].nu.gaussians."
TRUTH = np.full(4, 3, np.uint8).view(bool)  # neither false nor true
ROWS: dict[str, dict[str, tuple]] = {}
ROWS["scene.ply"] = {
    "empty": (just(b""), "byte 0: expected a PLY file.*got b''"),
    "magic": (just(png(4, 4)), "byte 0: .*got .*PNG"),
    "endless header": (just(b"ply\n" + b"comment\n" * 300_000), "no line 'end_header'"),
    "count": (swap("vertex 4", "vertex 4000000000"), r"byte \d+.*272000000000.*272;"),
    "negative count": (swap("vertex 4", "vertex -4"), r"header line 3 \(byte 36\)"),
    "type": (swap("float x", "half x"), "line 4 .byte 53.*'property half x'"),
    "list": (swap("float nx", "list uchar int nx"), r"list properties \['nx'\]"),
    "property": (swap("opacity", "opaque"), "lacks .* opacity"),
    "not finite": (lambda d: d[:-4] + NAN, r"in 1 of 4 Gaussians .*quats: 1.*\[3\]"),
    "of points": (just(CLOUD), "this is a point cloud"),
}
ROWS["ascii.ply"] = {
    "word": (swap("\n-", "\none "), r"vertex \d.*(got 18|one)"),
    "underscore": (lambda d: d[:-2] + b"1_0\n", r"vertex 3 \(byte \d+\): .*got .1_0"),
    "digits": (
        lambda d: d[:-2] + "\uff11\n".encode(),
        "vertex 3 .*expected 17 numbers",
    ),
    "row endless": (lambda d: d[:-2] + b"1 " * 500_000, "vertex 3 .*got a line of"),
}
ROWS["older.spz"] = {
    "empty": (just(b""), "expected an SPZ header.*got b''"),
    "of something": (just(png(4, 4)), "not an SPZ file, or damaged .*gzip"),
    "magic": (unpacked(swap("NGSP", "PSGN")), "expected an SPZ header.*got b'PSGN"),
    "not packed": (gzip.decompress, "version 4, got 3"),
    "version": (unpacked(put(4, "I", 9)), "version 2 to 3, got 9"),
    "degree": (unpacked(put(12, "B", 7)), "degree 0 to 4, got 7"),
    "fraction": (unpacked(put(13, "B", 99)), "fraction 0 to 24, got 99"),
    "count": (unpacked(put(8, "I", 4_000_000_000)), "bytes cannot hold"),
    "count, a little": (unpacked(put(8, "I", 5)), "expected 20 bytes of quats, got 0"),
    "cut within": (unpacked(lambda d: d[:-5]), "bytes of quats, got"),
    "checksum": (lambda d: d[:-8] + bytes(4) + d[-4:], "damaged .*CRC"),
    "long": (unpacked(lambda d: d + bytes(2**21)), "at most 262,144 bytes after"),
    "extension": (
        unpacked(chained(put(14, "B", 2), lambda d: d + bytes(7))),
        "extension records, got one that is truncated after 7 bytes",
    ),
}
AXES = struct.pack("<III", 0xADBE0003, 4, 3)
ROWS["scene.spz"] = {
    "empty": (just(b""), "expected an SPZ header of 16 bytes.*got b''"),
    "magic": (swap("NGSP", "PSGN"), "not an SPZ file, or damaged"),
    "version": (put(4, "I", 5), "version 4, got 5"),
    "degree": (put(12, "B", 5), "degree 0 to 4, got 5"),
    "count": (put(8, "I", 2**32 - 1), "4,294,967,295 Gaussians, which .* cannot hold"),
    "count, a little": (put(8, "I", 5), "expected 45 bytes of means, got 36 in the"),
    "blocks": (put(15, "B", 6), "expected a table of 5 blocks .*, got 6 at byte 32"),
    "table before": (put(16, "I", 0), "got 5 at byte 0;"),
    "table after": (put(16, "I", 2**31), "got 5 at byte 2,147,483,648"),
    "size": (put(40, "Q", 2**40), "36 bytes of means, got 1,099,511,627,776 in the"),
    "packed": (put(32, "Q", 2**40), "expected a file of 1,099,511,6"),
    "long": (lambda d: d + b"x", "expected a file of .* after its table of contents"),
    "frame": (put(112, "I", 0), "the block of means is damaged"),
    "bomb": (first_frame(bytes(10**8)), "36 bytes of means, got 100,000,000"),
    "bomb of unknown size": (
        first_frame(bytes(10**8), write_content_size=False),
        "the block of means is damaged",
    ),
    "frame, short": (
        first_frame(bytes(35), write_content_size=False),
        "36 bytes of means, got 35",
    ),
    "two frames": (
        chained(first_frame(bytes(36)), put(32, "Q", 45), insert(112, b"x" * 27)),
        "damaged",
    ),
    "extension": (extended(AXES[:-1]), "got one that is truncated after 11 bytes"),
    "axes": (extended(AXES), r"axes of 4 \(rub\), 6 \(rdf\) .*, got 03000000"),
    "axes empty": (extended(AXES[:4] + bytes(4)), "axes of .*, got no number"),
}
ROWS["scene.splat"] = {
    "empty": (just(b""), "rows of 32 bytes, got 0 bytes"),
    "long": (lambda d: d + b"x", "rows of 32 bytes, got 129 bytes"),
    "mean": (put(32 + 4, "f", np.nan), "1 of 4 rows .* row 1 with a mean that is"),
    "scale": (put(12, "f", -1e-9), "row 0 with a scale that is negative"),
    "scale infinite": (put(16, "f", np.inf), "row 0 with a scale that is negative or"),
    "quaternion": (put(124, "4B", *[128] * 4), "row 3 with a quaternion that is zero"),
}
ROWS["scene.compressed.ply"] = {
    "text": (swap("binary_little_endian", "ascii"), "expected a binary body"),
    "chunks": (swap("chunk 1", "chunk 2"), "expected 1 chunks for 4 Gaussians, got 2"),
    "count": (swap("vertex 4", "vertex 4000000000"), "expected 15,625,000 chunks"),
    "both": (
        chained(swap("vertex 4", "vertex 1024000"), swap("chunk 1", "chunk 4000")),
        "truncated: expected 16672000 bytes",
    ),
    "type": (swap("uint packed_scale", "int packed_scale"), "vertex packed_scale"),
    "no bounds": (swap("min_x", "least_x"), "lacks the properties chunk min_x"),
    "no element": (swap("chunk 1", "lump 1"), "lacks .*chunk min_x, chunk min_y"),
    "list": (swap("float min_x", "list uchar int q"), "without lists"),
    "harmonics": (
        swap("end_header", "element sh 4\nproperty uchar f_rest_0\nend_header"),
        r"4 rows of \[0, 9, 24, 45\] harmonics, got 4 of 1;",
    ),
    "not finite": (
        lambda d: d[: -64 - 72] + NAN + d[-64 - 68 :],
        "row [0-3] with a mean that is not finite",
    ),
}
ROWS["scene.ksplat"] = {
    "empty": (just(b""), "expected 4,096 bytes of the header, got 0"),
    "version": (put(1, "B", 2), "version 0.1 and .*, got version 0.2 and level 1"),
    "level": (put(20, "H", 3), "got version 0.1 and level 3"),
    "sections": (put(4, "2I", 2**31, 2**31), "of 2,147,483,648"),
    "no section": (put(8, "I", 0), "got 0 sections of 1"),
    "count": (put(16, "I", 5), "sections of 5 Gaussians, at least 1, got 4"),
    "incomplete": (put(4096, "I", 3), "all 4 Gaussians, got 3: .* incomplete"),
    "both counts": (put(4096, "2I", 2**30, 2**30), "in section 0 .* bytes, got"),
    "buckets": (put(4096 + 32, "I", 2), "expected in section 0 4 buckets"),
    "bucket": (put(5120, "I", 5), "buckets that hold 4 Gaussians, got 8"),
    "block": (put(4096 + 16, "f", np.nan), "finite size, got .* size nan"),
    "degree": (put(4096 + 40, "H", 3), "SH degree 0 to 2, got 3"),
    "storage": (put(4096 + 28, "I", 2**31), "bytes, got 2,147,483,648"),
    "center": (put(5120 + 8, "f", np.inf), "with a mean that is not finite"),
}
SECRET = "../../../etc/passwd"
ROWS["scene.sog"] = {
    "empty": (just(b""), "not a SOG, or truncated: File is not a zip"),
    "of something": (just(png(4, 4)), "not a SOG"),
    "without": (
        entries(lambda e: e.pop("meta.json")),
        "meta.json is missing, got .'me",
    ),
    "texture missing": (entries(lambda e: e.pop("sh0.webp")), "sh0.webp is missing"),
    "compression": (entries(lambda _: 0, ZIP_LZMA), "expected a stored or deflated"),
    "checksum": (swap("generator", "Generator"), "meta.json: damaged .*CRC"),
    "bomb": (
        entries(lambda e: e.update({"meta.json": b" " * 10**7}), ZIP_DEFLATED),
        "meta.json: expected at most 1,048,576 bytes, got 10,000,000",
    ),
    "texture bomb": (
        entries(lambda e: e.update({"quats.webp": bytes(10**7)}), ZIP_DEFLATED),
        r"quats.webp: expected at most [\d,]+ bytes, got 10,000,000",
    ),
    "large": (in_entry("sh0.webp", just(webp(16_383, 16_383))), "up to .* 16383 ×"),
    "small": (in_meta("count", to=17), "expected 17 texels or more, got 4 × 4"),
    "count": (in_meta("count", to=2**28), "declares 268,435,456 Gaussians, which"),
    "count negative": (in_meta("count", to=-1), "count: .* from 0 to .*, got -1"),
    "count fraction": (in_meta("count", to=4.5), "count: .*a whole number .*, got 4.5"),
    "lossy": (
        in_entry("scales.webp", just(b"RIFF\x20\0\0\0WEBPVP8 " + bytes(24))),
        "scales.webp: expected a lossless WebP",
    ),
    "no image": (in_entry("quats.webp", just(b"no")), "a WebP image, got 2 bytes"),
    "texture cut": (in_entry("quats.webp", lambda d: d[:-4]), "the file is truncated"),
    "pixels": (
        in_entry("quats.webp", lambda d: d[:25] + bytes(len(d) - 25)),
        "decoded",
    ),
    "no header": (
        in_entry("quats.webp", just(b"RIFF\x14\0\0\0WEBPEXIF" + bytes(12))),
        "expected a lossless WebP, got another",
    ),
    "path up": (
        in_meta("quats", "files", 0, to=SECRET),
        "name of a file beside .*passw",
    ),
    "path absolute": (in_meta("means", "files", 1, to="/etc/passwd"), "beside meta"),
    "path of Windows": (in_meta("sh0", "files", 0, to="..\\a"), "beside meta.json"),
    "path with 0": (in_meta("sh0", "files", 0, to="a\0b"), "beside meta.json"),
    "path unpaired": (in_meta("sh0", "files", 0, to="\ud800"), "beside meta.json"),
    "path empty": (in_meta("sh0", "files", 0, to=""), "beside meta.json"),
    "path itself": (
        in_meta("sh0", "files", 0, to="meta.json"),
        "expected a WebP image",
    ),
    "files": (in_meta("means", "files", to=["a"]), "means.files: expected 2 names"),
    "files of numbers": (
        in_meta("sh0", "files", to=[1]),
        "sh0.files: expected 1 names",
    ),
    "bounds": (in_meta("means", "mins", to=[0, 0]), "means.mins: expected 3 finite"),
    "bounds nan": (in_meta("means", "maxs", 2, to=np.nan), "means.maxs: .*3 finite"),
    "bounds far": (
        in_meta("means", "maxs", 2, to=200),
        "expected means within float32",
    ),
    "codebook nan": (in_meta("scales", "codebook", 9, to=np.nan), "1 to 256 finite"),
    "codebook huge": (in_meta("sh0", "codebook", 9, to=1e39), "1 to 256 finite numb"),
    "codebook long": (in_meta("sh0", "codebook", to=[0] * 257), "1 to 256 finite"),
    "codebook text": (in_meta("sh0", "codebook", 0, to="0"), "1 to 256 finite num"),
    "codebook short": (
        in_meta("scales", "codebook", to=[0]),
        "scales: expected indices",
    ),
    "bands": (in_meta("shN", "bands", to=4), "shN.bands: .* from 1 to 3, got 4"),
    "bands other": (
        in_meta("shN", "bands", to=2),
        "a palette 512 texels wide, got 192",
    ),
    "entries": (in_meta("shN", "count", to=2**16 + 1), "shN.count: .* got 65537"),
    "entries more": (in_meta("shN", "count", to=65), "2 rows for 65 entries, got 1"),
    "label": (
        in_meta("shN", "files", 1, to="quats.webp"),
        "shN_labels|quats.webp: expected indices below the 1 entries",
    ),
}
ROWS["sog/meta.json"] = {
    "empty": (just(b""), "not JSON"),
    "list": (just(b"[2]"), "expected an object with 'version'|got .2"),
    "deep": (just(DEEP), "not JSON"),
    "encoding": (just(b"\xff\xfe\xff"), "not JSON"),
    "huge": (just(b" " * 2**21), "expected at most 1,048,576 bytes, got 2,097,152"),
    "version": (at("version", to=3), "expected version 2, or none .*, got 3"),
    "version true": (at("version", to=True), "expected version 2, .*, got True"),
    "count": (at("count", to=2**28), "which [\\d,]+ bytes cannot hold"),
    "object": (at("means", to=[]), "means.*: expected an object with"),
    "texture missing": (at("sh0", "files", 0, to="none.webp"), "none.webp: cannot be"),
    "path up": (at("quats", "files", 0, to=SECRET), "beside meta.json, got .*passwd"),
}
ROWS["sog/quats.webp"] = {
    "empty": (just(b""), "expected a WebP image, got 0 bytes"),
    "kind": (just(png(4, 4) + bytes(9)), "expected a WebP image, got .*PNG"),
    "large": (just(webp(16_383, 16_383)), "texture of up to .* got 16383 × 16383"),
}


def as_glb(text: bytes) -> Callable[[bytes], bytes]:
    """Replace the JSON of a glTF file by these bytes."""

    def change(data: bytes) -> bytes:
        body = taken_apart(data)[1]
        padded = text + b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 28 + len(padded) + len(body))
        head += struct.pack("<I4s", len(padded), b"JSON") + padded
        return head + struct.pack("<I4s", len(body), b"BIN\0") + body

    return change


def in_glb(*keys, to):
    """Set a value in the JSON of a glTF file."""

    def edit(value):
        for key in keys[:-1]:
            value = value[key]
        value[keys[-1]] = to

    return edited(edit)


def in_primitive(edit: Callable[[dict], object]):
    return edited(lambda data: edit(primitive(data)))


SPLATS = "KHR_gaussian_splatting"


def in_settings(key: str, to):
    return in_primitive(lambda one: one["extensions"][SPLATS].update({key: to}))


def without(name: str):
    return in_primitive(lambda one: one["attributes"].pop(f"{SPLATS}:{name}"))


def spoilt_array(name: str, value: float, width: int = 3):
    """Set a number of an attribute of four Gaussians."""
    array = np.full((4, width), 0.5, np.float32)
    array[2, width - 1] = value
    return lambda data: with_array(data, name, array)


MAT = [1.0, *[0.0] * 4, 1.0, *[0.0] * 4, 1.0, *[0.0] * 4, 1.0]
LONE = {"bufferView": 0, "byteOffset": 0, "componentType": 5126, "type": "VEC3"}
ROWS["scene.glb"] = {
    "empty": (just(b""), "byte 0: expected a binary glTF file.*got b''"),
    "of something": (just(png(4, 4)), "byte 0: .*PNG"),
    "version": (put(4, "I", 1), "glTF of version 2, got 1"),
    "length": (put(8, "I", 99), "expected 99 bytes as its header declares, got"),
    "long": (lambda d: d + bytes(4), "bytes as its header declares"),
    "chunk": (put(16, "4s", b"TEXT"), "byte 12: expected a chunk b'JSON', got b'TEXT'"),
    "chunk long": (put(12, "I", 2**31), "byte 12: expected a chunk of 2,147,483,648"),
    "text": (as_glb(b"{,}"), "its JSON is damaged"),
    "deep": (as_glb(DEEP), "its JSON is damaged"),
    "list": (as_glb(b"[]"), "expected an object as JSON, got"),
    "nothing": (as_glb(b"{}"), "expected a mesh with KHR_gaussian_splatting in the"),
    "required": (
        in_glb("extensionsRequired", to=["KHR_draco_mesh_compression", SPLATS]),
        "no required extensions but .*, got .'KHR_draco_mesh_compression'",
    ),
    "required by a word": (in_glb("extensionsRequired", to="KHR"), "got 'KHR'"),
    "scene": (in_glb("scene", to=1), "scenes: expected an index below 1, .*, got 1"),
    "scene no list": (in_glb("scenes", 0, "nodes", to=0), "expected a list, got 0"),
    "node": (in_glb("scenes", 0, "nodes", to=[7]), "nodes: expected an index below 1"),
    "cycle": (
        in_glb("nodes", 0, "children", to=[0]),
        "expected nodes that form a tree",
    ),
    "twice": (
        in_glb("scenes", 0, "nodes", to=[0, 0]),
        "expected nodes that form a tree",
    ),
    "mesh": (in_glb("nodes", 0, "mesh", to=-1), "meshes: expected an index below 1"),
    "translation": (in_glb("nodes", 0, "translation", to=[0, 0]), "3 finite numbers"),
    "rotation": (in_glb("nodes", 0, "rotation", to=[0] * 4), "that is not zero"),
    "scale": (in_glb("nodes", 0, "scale", to=[1, 1, 0]), "with scales that are not 0"),
    "scale of a word": (in_glb("nodes", 0, "scale", to=1), "3 finite numbers, got 1"),
    "scale nan": (in_glb("nodes", 0, "scale", to=[1, 1, np.nan]), "3 finite numbers"),
    "matrix": (in_glb("nodes", 0, "matrix", to=MAT[:-1] + [2]), "last row of 0, 0, 0"),
    "matrix huge": (in_glb("nodes", 0, "matrix", to=[10**400] * 16), "16 finite num"),
    "mode": (
        in_primitive(lambda one: one.pop("mode")),
        "mode: expected 0, points, got 4",
    ),
    "kernel": (in_settings("kernel", "cube"), "kernel: expected 'ellipse', got 'cube'"),
    "colours": (
        in_settings("colorSpace", "acescg"),
        "colorSpace: expected srgb_rec709",
    ),
    "no colours": (in_settings("colorSpace", None), "colorSpace: .*, got None"),
    "attribute": (without("ROTATION"), "expected the attributes .*ROTATION, got"),
    "compressed": (
        chained(
            without("SCALE"),
            in_settings("extensions", {"KHR_gaussian_splatting_compression_x": {}}),
        ),
        "SCALE, got .*",
    ),
    "degree": (
        without("SH_DEGREE_1_COEF_2"),
        "whole SH degrees, .*, got '3 attributes",
    ),
    "degree 4": (
        in_primitive(
            lambda one: one["attributes"].update({f"{SPLATS}:SH_DEGREE_4_COEF_0": 0})
        ),
        "whole SH degrees, of up to 3",
    ),
    "accessor": (
        in_primitive(lambda one: one["attributes"].update(POSITION=99)),
        "accessors: expected an index below 9",
    ),
    "sparse": (
        in_glb("accessors", 2, "sparse", to={}),
        "a bufferView without 'sparse'",
    ),
    "zeros": (
        edited(lambda data: data["accessors"][2].pop("bufferView")),
        "a bufferView without 'sparse'",
    ),
    "type": (
        in_glb("accessors", 3, "type", to="VEC4"),
        "SCALE.: expected VEC3 of float",
    ),
    "kind": (
        in_glb("accessors", 3, "componentType", to=5125),
        "expected VEC3 of float",
    ),
    "normalised": (in_glb("accessors", 0, "normalized", to=True), "VEC3 of float, got"),
    "count": (in_glb("accessors", 0, "count", to=10**9), "one Gaussian for each byte"),
    "count, a little": (
        in_glb("accessors", 3, "count", to=5),
        "got '5 elements every 12",
    ),
    "count 0": (in_glb("accessors", 0, "count", to=0), "at least 1, got 0"),
    "counts": (in_glb("accessors", 3, "count", to=3), "attributes of equal length"),
    "instances": (
        edited(lambda data: data.update(nodes=[{"mesh": 0}] * 1001, scenes=None)),
        "at most 1,000 primitives with .*, got 'more'",
    ),
    "offset": (in_glb("accessors", 0, "byteOffset", to=2**31), "12 bytes within"),
    "view": (in_glb("bufferViews", 0, "byteLength", to=47), "12 bytes within"),
    "stride": (in_glb("bufferViews", 0, "byteStride", to=4), "12 bytes within"),
    "buffer": (in_glb("bufferViews", 0, "buffer", to=1), "buffers: expected an index"),
    "buffer long": (in_glb("buffers", 0, "byteLength", to=10**6), "12 bytes within"),
    "uri": (in_glb("buffers", 0, "uri", to="file:///etc/passwd"), "without a URI"),
    "meshopt": (
        in_glb("bufferViews", 0, "extensions", to={"EXT_meshopt_compression": {}}),
        "expected no extension, got .'EXT_meshopt",
    ),
    "no body": (
        lambda data: put_together(taken_apart(data)[0], b""),
        "elements of 12 bytes within 0 bytes",
    ),
    "mean nan": (spoilt_array("POSITION", np.nan), "POSITION: .*1 of 4 .*the first 2"),
    "scale below 0": (spoilt_array("SCALE", -1), "at least 0, .*1 of 4 .*logarithms"),
    "opacity": (spoilt_array("OPACITY", 1.5, 1), "opacities from 0 to 1"),
}
ROWS["cloud.ply"] = {
    "without y": (swap("float y", "float why"), "expected scalar properties x, y, z"),
    "not finite": (swap("0 0.5", "0 inf"), r"in 1 of 2 points.*\[0\]"),
}
ROWS[CAMERAS] = {
    "model": (put(12, "i", 99), r"camera 0 \(byte 8\): unknown camera model 99"),
    "model unsupported": (put(12, "i", 10), "THIN_PRISM_FISHEYE"),
    "size": (put(16, "Q", 0), r"\(byte 8\): .* got 0 × 24"),
    "focal": (put(32, "d", -1), r"\(byte 8\): .*focal lengths.* got -1"),
    "twice": (put(64, "I", 1), r"\(byte 64\): the id 1 is that of"),
    "text": (just(COLMAP_TEXT["cameras"]), "byte 0: the count"),
}
ROWS[IMAGES] = {
    "quaternion": (put(12, "4d", 0, 0, 0, 0), r"\(byte 8\): the quaternion of 'view"),
    "pose": (put(12, "d", np.nan), r"\(byte 8\): .*pose.* got \[nan"),
    "name endless": (swap("view_00.png\0", "v" * 2000), r"byte 72\) has no end within"),
    "name no text": (swap("view_00", b"view\xff0"), "is not UTF-8"),
    "name empty": (swap("view_00.png", ""), "name of .* is empty"),
    "observations": (put(84, "Q", 2**60), r"byte 92: .* 1152\d+ 2D points of image 0"),
}
ROWS[POINTS] = {
    "not finite": (put(16, "d", np.inf), r"1 of 4 points .*point \[1\]"),
    "twice": (put(8 + 51, "Q", 1), r"have the id of another point.*\[1\]"),
    "track": (put(51, "Q", 2**61), "byte 8: expected 1844.* for point 0"),
}
ROWS["text/cameras.txt"] = {
    "few": (swap(" 40 42 15.5 12.25", ""), "line 3: .* parameters of PINHOLE, got 0"),
    "word": (swap("15.5", "here"), "line 3: .*'here'"),
    "underscore": (swap("42", "4_2"), "line 3: .*4_2"),
    "digits": (swap("42", "\uff14\uff12"), "line 3: .* could not convert"),
    "number": (swap("32 24", "32 2.4"), "the height, got '2.4'"),
    "camera endless": (just("1 PINHOLE " + "5 " * 500_000), "line 1: .* at most 16384"),
}
ROWS["text/images.txt"] = {
    "binary": (just(b"\x89\xff\0"), "line 0: not UTF-8"),
    "pose": (swap("3 1 v", "nan 1 v"), "line 3: .*pose.*nan"),
    "observations": (swap("1.5 2 1", "1 2"), "line 4: .* got 2 values"),
    "no 2D": (swap("1.5 2 1", "7 1 0 0 0 0 0 1 1 a b"), "got 11 values, the last 'b'"),
    "image endless": (just("# a\n" + "1 " * 500_000), "line 2: .* at most 16384"),
    "comment endless": (just("#" * 500_000), "line 1: .* at most 16384"),
}
ROWS["text/points3D.txt"] = {
    "colour": (swap("255", "256"), "line 3: .*colour.* got .256"),
    "point": (swap("0.5 1", "0.5 1_"), "line 3: .*1_"),
    "digits": (swap("0.5 1", "0.\uff15 1"), "line 3: .* could not convert"),
    "point id": (swap("\n1 ", "\n1.0 "), "line 3: .* the point id, got '1.0'"),
    "id": (swap("\n1 ", "\n18446744073709551616 "), "line 3: .* the point id, got"),
    "track of nan": (swap(" 0 2 1\n", " nan 2 1\n"), "line 3: .* the track, got 'nan'"),
    "point control": (swap("0.5 1", "0.5\x1c1"), "after line 0: .*other characters"),
    "track endless": (just("2 0 0 0 0 0 0 0" + " 1 2" * 500_000), ".* at most 1048576"),
}
ROWS["transforms.json"] = {
    "empty": (just(b""), "not JSON: .*char 0"),
    "deep": (just(DEEP), "not JSON"),
    "of braces": (just('{"frames":[' + "{}," * 50_000 + "{}]}"), "50003 objects"),
    "of keys": (just(KEYS), "50001 keys"),
    "of numbers": (just('{"frames":[' + "1.5," * 50_000 + "1]}"), "50000 values"),
    "encoding": (just(b"\xff\xfe\xff"), "not JSON"),
    "list": (just("[1]"), r"expected an object at the top, got \[1\]"),
    "lens endless": (frame("camera_model", "A" * 500_000), "A' is not supported"),
    "path up": (frame("file_path", "../../etc/passwd"), rf"\[1\]: {LEAVING}"),
    "path absolute": (frame("file_path", "/etc/passwd"), rf"\[1\]: {LEAVING}"),
    "path of Windows": (frame("file_path", "..\\a.png"), rf"\[1\]: {LEAVING}"),
    "path with 0": (frame("file_path", "a\0.png"), rf"\[1\]: {LEAVING}"),
    "path long": (frame("file_path", "a" * 5000), r"\[1\]: .* at most 1024 .* of 5000"),
    "path part": (frame("file_path", "a/" + "b" * 300), r"\[1\]: .* of 301 and 300"),
    "path unpaired": (frame("file_path", "\ud800.png"), rf"\[1\]: {LEAVING}"),
    "mask up": (frame("mask_path", "../mask.png"), rf"\[1\]: {LEAVING}"),
    "points up": (at("ply_file_path", to="/etc/passwd"), LEAVING),
}
ROWS["poses_bounds.npy"] = {
    "magic": (just(b"PK\3\4 zip"), r"expected a \.npy file"),
    "objects": (just(npy(np.asarray([{}]))), "header.*byte 10.*descr"),
    "size": (just(npy_of(NPY % "999999999999, 17")), "135999999999864 bytes .* got 8"),
    "negative": (just(npy_of(NPY % "-1, 17")), "header .*shape"),
    "deep": (just(npy_of("(" * 60_000)), "header"),
    "columns": (just(npy(POSES[:, :15])), r"\[2, 15\]"),
    "whole numbers": (just(npy(POSES.astype(int))), "int64"),
    "not finite": (put(128 + 17 * 8, "d", np.nan), "row 1"),
    "rows": (just(npy(POSES[:1])), "expected 1 photographs .* got 2"),
    "mirrored": (put(128 + 8, "d", -1), "row 0: .*reflection"),
}
ROWS["photo.png"] = {
    "empty": (just(b""), "the file is empty"),
    "kind": (just(b"GIF89a"), "starts with b'GIF89a'"),
    "huge": (just(png(60_000, 60_000)), "60000 × 60000 px"),
    "bomb": (just(png(15_000, 15_000)), "cannot fit in it"),
    "zero": (just(png(0, 5)), "0 × 5 px"),
    "aspect": (just(png(16, 20, 0)), "aspect ratio .* got 16 × 20 px"),
    "checksum": (put(50, "B", 77), "cannot be decoded"),
}
ROWS["photo.webp"] = {
    "aspect": (just(webp(16_383, 16_383)), "aspect ratio .* got 16383 × 16383 px"),
    "size": (just(webp(16_380, 12_285)), "at most 64 times .* got 16380 × 12285 px"),
    "webp length": (put(4, "I", 2**31), "2147483656 bytes are declared"),
}
ROWS["mask.png"] = {
    "size": (just(webp(16_380, 12_285)), "expected a mask .* got 16380 × 12285 px"),
    "aspect": (just(png(16, 20, 0)), "expected a mask .* got 16 × 20"),
    "kind": (just(b"no mask"), "starts with b'no mask'"),
}
ROWS["photo.jpg"] = {
    "cut": (lambda d: d[:-9], "no end-of-image marker"),
    "bomb": (just(jpeg(8000, 8000)), "8000 × 8000 px cannot fit"),
    "marker": (put(2, "B", 0), "starts with|no marker"),
}
ROWS["photo.tiff"] = {
    "bomb": (just(tiff(8000, 8000)), "8000 × 8000 px cannot fit"),
    "offset": (put(4, "I", 2**32 - 1), "truncated or damaged"),
}
ROWS["photo.bmp"] = {"size": (put(18, "i", 2**30), "1073741824 × 6 px")}
ROWS[STEP] = {
    "other": (just(npy(POSES)), "damaged checkpoint: File is not a zip file"),
    "checksum": (lambda d: d[:300] + b"!" + d[301:], r"damaged .*\(byte \d+\): .*CRC"),
    "bomb": (entries(lambda e: e.update(a=bytes(10**7)), ZIP_DEFLATED), "of 1000"),
    "lzma": (entries(lambda _: 0, ZIP_LZMA), "compressed"),
    "no text": (entries(lambda e: e.pop(META)), "meta.json is missing"),
    "deep": (entry(META, text(DEEP)), "meta.json: .*recursion"),
    "format": (meta("format", 99), "format 99"),
    "step": (meta("step", 1e999), "meta.json: step inf"),
    "capacity": (meta("capacity", 10**12), "capacity 1000000000000"),
    "pairs": (meta("pair_capacity", "many"), "pair_capacity 'many'"),
    "seconds": (meta("seconds", 1e999), "seconds inf"),
    "arrays": (entries(lambda e: e.pop(MEANS)), "meta.json: arrays"),
    "objects": (entry(MEANS, npy(np.asarray([{}]))), "means.*header.*byte 10.*descr"),
    "size": (entry(MEANS, npy_of(NPY % "9999999999999,")), "79999999999992 .* got 8"),
    "other step": (meta("step", 8), "meta.json says step 8"),
    "step below 0": (values(".step", lambda a: a * 0 - 5), r"\.step is -5.*says 7"),
    "steps": (values(".step", lambda a: np.full(9, 7, a.dtype)), r"\.step is \[7, 7"),
    "count": (values(".moments[0].count", lambda a: a + 8), "count .* got 8"),
    "nan": (spoilt(".gaussians.params.means", 2, np.nan), r"means: 1 of 4 .*\[2\]"),
    "square inf": (spoilt(SQUARES + "sh", 1, np.inf), r"nu.*sh: 1 of 4 .*\[1\]"),
    "square below 0": (spoilt(SQUARES + "quats", 0, -1), "nu.*quats: 1 of 4 "),
    "statistic": (spoilt(".stats.gradient", 0, np.nan), "gradient: 1 of 4 are not"),
    "truth": (values(".gaussians.active", lambda _: TRUTH), "active.*booleans"),
}
ROWS["config.json"] = {
    "list": (just("[]"), r"expected an object at the top, got \[\]"),
    "deep": (just(b'{"train":' + DEEP), "not JSON"),
    "format": (at("format", to=2), "format.* 2"),
    "without": (changed(lambda c: c.pop("train")), "'train' is missing"),
    "type": (at("every", to="8"), "every: .* got '8'"),
    "names": (at("test_images", to="ab"), "test_images: .* got 'ab'"),
    "setting": (at("train", "colour", to=1), r"unknown settings \['colour'\]"),
    "range": (at("train", "steps", to=-1), "TrainConfig.steps: expected"),
    "half": (at("train", "mcmc", "every", to=2.5), "every: expected int, got 2.5"),
    "nan": (at("train", "adaptive", "threshold", to=np.nan), "threshold: .* got nan"),
    "huge": (at("every", to=10**400), "every: .* got 1000"),
    "rates": (at("train", "rates", to=[]), "not the settings"),
    "cooling": (at("train", "rates", 6, to=-0.5), "rates' cooling: expected"),
}
ROWS["eval.json"] = {
    "evaluation": (at("psnr", to="good"), "psnr is 'good'; .*gsjax eval"),
    "evaluation huge": (at("psnr", to=10**400), "psnr is 1000"),
    "evaluation views": (at("which", to=[]), r"which is \[\]"),
}
ROWS["cameras.json"] = {
    "missing": (changed(lambda c: c["views"].pop()), "view_01.png"),
    "sheared": (at("views", 0, "viewmat", 0, 0, to=2.0), "00.png: .*rigid"),
    "huge": (at("views", 1, "K", 0, 0, to=10**400), "too large to convert"),
    "ragged": (at("views", 0, "K", to=[[1]]), "reshape"),
}
BAD = {
    f"{file}: {name}": Bad(file, *row)
    for file, rows in ROWS.items()
    for name, row in rows.items()
}
