"""SPZ and `.splat` files, compared with independent decoders of their layouts.

`THEIRS` is the Gaussians of `given` as another program (@playcanvas/splat-transform
2.7.1) writes them, in version 3 of SPZ.
"""

import gzip
import math
import struct
from base64 import b64decode
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest
import zstandard
from captures import rejects, warned
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.cli.main import main
from gsjax.io.common import to_bytes
from gsjax.io.spz import write_spz

pytestmark = pytest.mark.usefixtures("float32")

THEIRS = b64decode(
    "TkdTUAMAAAADAAAAAwwAAAAYAAAkAAD+/wDA+QDQ/wCI/wAAAAAAAAAIAOFFkoeXkICXdmN4Y3BgSKCwCIC"
    "AgGmlnRZKeEupdVWy5LioMOhAQHhYULCQgJDwwKDwUNBw4CCAgDBwgIBQIMBgwKDwQEBQ0IBAYLAwkGjYmK"
    "jIQGjgkHBgYEBwUHAw4MBgsNCgQEAwMJBAQDCAwDBgcHBwUOAwkJBgsNAgYJB4MGCQqKCAUNBA4CCwwNCQQ"
    "CCgwIBQwEBgQKAwcKCwIIDggIAwUJBw0A=="
)
C0 = 0.28209479177387814
NAMES = ("means", "log_scales", "logit_opacities", "sh")


def given(degree: int = 3, **changes) -> gsjax.Gaussians:
    """Three Gaussians that SPZ represents almost exactly."""
    rng = np.random.default_rng(7)
    fields = {
        "means": [[1.5, -2.25, 0.125], [-100.0, 3.0, 7.5], [0, 0, -0.5]],
        "quats": [[0.5, 0.5, -0.5, 0.5], [0.1, -0.2, 0.3, -0.9], [-0.8, 0.1, 0.2, 0.5]],
        "log_scales": [[-3, -4, -5.5], [0, 1, -9.5], [-2, -2, -2]],
        "logit_opacities": [2.0, -1.0, 0.3],
        "sh": np.round(rng.uniform(-0.8, 0.8, (3, 16, 3)) * 16) / 16,
    }
    fields["sh"] = fields["sh"][:, : (degree + 1) ** 2]
    return gsjax.make_gaussians(**fields | changes)


def rotations(gaussians: gsjax.Gaussians) -> np.ndarray:
    """[N, 3, 3]"""
    w, *xyz = np.asarray(gaussians.params.quats).T
    return matrices(*xyz, w)


def matrices(x, y, z, w) -> np.ndarray:
    return Rotation.from_quat(np.stack([x, y, z, w], -1)).as_matrix()


def opacities(logits) -> np.ndarray:
    return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def assert_alike(found: gsjax.Gaussians, expected: gsjax.Gaussians, sh: float) -> None:
    """Equal to half a step of SPZ in each number, ``sh`` for harmonics; found here."""
    assert len(found.active.devices()) == jax.local_device_count()
    for name in NAMES:
        values = [np.asarray(getattr(one.params, name)) for one in (found, expected)]
        if name == "logit_opacities":
            values = map(opacities, values)
        bound = {"means": 2.0**-13, "log_scales": 1 / 32, "sh": sh}.get(name, 0.5 / 255)
        np.testing.assert_allclose(*values, rtol=0, atol=bound + 1e-6)
    np.testing.assert_allclose(rotations(found), rotations(expected), atol=6e-3)


def xyzw_of(bits: int) -> list[float]:
    """The quaternion in four bytes, after Niantic's README."""
    largest, xyzw = bits >> 30, [0.0] * 4
    for axis in (3, 2, 1, 0):
        if axis != largest:
            size = (bits & 511) / 511 / math.sqrt(2)
            xyzw[axis] = -size if bits & 512 else size
            bits >>= 10
    xyzw[largest] = math.sqrt(1 - sum(v * v for v in xyzw))
    return xyzw


def content(path: Path) -> bytes:
    """The bytes of version 3, of a file of version 3 or 4."""
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        return gzip.decompress(data)
    magic, version, *fields, blocks, table = struct.unpack_from("<4sIIBBBBI", data)
    assert (magic, version, table, data[20:32]) == (b"NGSP", 4, 32, bytes(12))
    raw, at = struct.pack("<4sIIBBBB", magic, 3, *fields, 0), table + 16 * blocks
    for compressed, size in struct.iter_unpack("<QQ", data[table:at]):
        inflate = zstandard.ZstdDecompressor().decompress
        raw += inflate(data[at : at + compressed], max_output_size=size)
        at += compressed
    assert at == len(data)
    return raw


def by_the_book(raw: bytes) -> dict[str, np.ndarray]:
    """The Gaussians of version 3, decoded after Niantic's README."""
    header = struct.unpack_from("<4sIIBBBB", raw)
    magic, version, count, degree, fraction, *rest = header
    assert (magic, version, *rest) == (b"NGSP", 3, 0, 0)
    widths = 9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)
    starts = np.cumsum([16, *(count * width for width in widths)])
    assert len(raw) == starts[-1]
    means, alphas, colors, scales, quats, sh = (
        np.frombuffer(raw[a:b], np.uint8).reshape(count, width)
        for (a, b), width in zip(pairwise(starts), widths)
    )
    triples = (bytes(triple) for triple in means.reshape(-1, 3))
    integers = [int.from_bytes(triple, "little", signed=True) for triple in triples]
    return {
        "means": np.reshape(integers, (count, 3)) / 2**fraction,
        "opacities": alphas[:, 0] / 255,
        "colors": 0.5 + C0 * (colors / 255 - 0.5) / 0.15,
        "log_scales": scales / 16 - 10,
        "xyzw": np.array(
            [xyzw_of(int.from_bytes(q.tobytes(), "little")) for q in quats]
        ),
        "sh": (sh - 128.0) / 128,
    }


@pytest.mark.parametrize(("degree", "version"), [(0, 4), (1, 3), (2, 4), (3, 3)])
def test_written_files_follow_the_specification(tmp_path, degree, version):
    """With y and z turned, and without inactive slots."""
    scene = gsjax.concatenate(given(degree), given(degree))
    scene = gsjax.select(scene, np.arange(6) > 2)
    write_spz(tmp_path / "a.spz", scene, version=version)
    raw = content(tmp_path / "a.spz")
    found, params = by_the_book(raw), given(degree).params
    # 24 bits hold 100 to 2⁻¹⁶.
    assert raw[13] == 16
    turn = np.diag([1, -1, -1])
    np.testing.assert_array_equal(found["means"], params.means @ turn)
    shares = opacities(params.logit_opacities)
    np.testing.assert_allclose(found["opacities"], shares, atol=0.5 / 255)
    expected = 0.5 + C0 * params.sh[:, 0]
    np.testing.assert_allclose(found["colors"], expected, atol=0.51 / 255 * 1.9)
    np.testing.assert_array_equal(found["log_scales"], params.log_scales)
    turned = turn @ rotations(given()) @ turn
    np.testing.assert_allclose(matrices(*found["xyzw"].T), turned, atol=6e-3)
    signs = {1: [-1, -1, 1], 2: [-1, 1, 1, -1, 1], 3: [-1, 1, -1, -1, 1, -1, 1]}
    sign = [s for band in range(1, degree + 1) for s in signs[band]]
    expected = np.asarray(params.sh[:, 1:]) * np.reshape(sign, (-1, 1))
    # The values have no more than the 5 bits that are kept.
    np.testing.assert_array_equal(found["sh"], expected.reshape(3, -1))


def test_means_are_as_precise_as_their_range_allows(tmp_path):
    for largest, step in ((0.5, 2**-20), (7.9, 2**-20), (8.1, 2**-19), (1e6, 2**-3)):
        means = np.asarray([[largest, 0, 0], [1 / 3, -1 / 3, 0.1], [0, 0, 0]])
        scene = given(0, means=means, log_scales=np.full((3, 3), 5.0))
        gsjax.save(tmp_path / "a.spz", scene, overwrite=True)
        found = np.asarray(gsjax.load(tmp_path / "a.spz").params.means)
        error = np.abs(found[1] - np.asarray(scene.params.means)[1]).max()
        assert step / 10 < error <= step / 2


@pytest.mark.filterwarnings("ignore:.*most programs reject")
@pytest.mark.parametrize("degree", range(5))
def test_a_file_that_is_read_is_written_to_the_same_bytes(tmp_path, degree):
    """Nothing is rounded twice, and files are deterministic."""
    rng = np.random.default_rng(degree)
    count = 200
    scene = gsjax.make_gaussians(
        means=rng.normal(size=(count, 3)) * 10,
        quats=rng.normal(size=(count, 4)),
        log_scales=rng.uniform(-9.9, 5, (count, 3)),
        logit_opacities=rng.normal(size=count) * 8,
        sh=rng.uniform(-0.99, 0.99, (count, (degree + 1) ** 2, 3)),
    )
    gsjax.save(tmp_path / "a.spz", scene)
    once = gsjax.load(tmp_path / "a.spz")
    write_spz(tmp_path / "b.spz", once, version=3)
    gsjax.save(tmp_path / "c.spz", gsjax.load(tmp_path / "b.spz"))
    assert_alike(once, scene, 1 / 32)
    assert content(tmp_path / "b.spz") == content(tmp_path / "a.spz")
    assert (tmp_path / "c.spz").read_bytes() == (tmp_path / "a.spz").read_bytes()


def save_raw(path: Path, raw: bytes) -> Path:
    path.write_bytes(gzip.compress(raw))
    return path


def as_version_2(raw: bytes) -> bytes:
    """The same file with quaternions in three bytes each."""
    quats = by_the_book(raw)["xyzw"]
    count, start = len(quats), 16 + 16 * len(quats)
    packed = to_bytes(127.5 + 127.5 * quats[:, :3] * np.sign(quats[:, 3:]))
    body = raw[8:start] + packed.tobytes() + raw[start + 4 * count :]
    return b"NGSP" + struct.pack("<I", 2) + body


def test_files_of_another_program_are_read(tmp_path):
    """Also of version 2."""
    found = gsjax.load(save_raw(tmp_path / "a.SPZ", THEIRS))
    # Its harmonics above degree 1 are rounded to 4 bits.
    assert_alike(found, given(), 1 / 16)
    older = gsjax.load(save_raw(tmp_path / "b.spz", as_version_2(THEIRS)))
    for name in NAMES:
        values = getattr(older.params, name), getattr(found.params, name)
        np.testing.assert_array_equal(*values)
    np.testing.assert_allclose(rotations(older), rotations(given()), atol=0.03)


@pytest.mark.parametrize(
    ("flags", "tail", "message"),
    [
        (0, b"more", "bytes after the last Gaussian"),
        (2, struct.pack("<II", 0x12340001, 4) + b"more", "of type 0x12340001 are ign"),
        (1, b"", r"render it with RasterConfig\(antialias=True, dilation=0.1"),
    ],
)
def test_flags_and_trailing_bytes_are_warned_about(tmp_path, flags, tail, message):
    raw = THEIRS[:14] + bytes([flags]) + THEIRS[15:] + tail
    found = warned(message, gsjax.load, save_raw(tmp_path / "a.spz", raw))
    assert_alike(found, given(), 1 / 16)
    write_spz(tmp_path / "b.spz", given(0), mode="mip" if flags == 1 else None)
    assert content(tmp_path / "b.spz")[14] == (flags == 1)


FEW = np.asarray([[1.0, 0, 0], [0, 0, 0], [1, 2, 3]])
WHITE = np.zeros((3, 1, 3))
WHITE[2, 0, 1] = 2.0
CLIPPED = [
    (".spz", {"log_scales": np.full((3, 3), -11.0), "means": 0 * FEW}, "3 of 3 .*log"),
    (".spz", {"sh": np.full((3, 1, 3), 4.0)}, "3 of 3 Gaussians have colours"),
    (".spz", {"sh": np.ones((3, 4, 3)) * [[[0]], [[1.5]], [[-1]]]}, "1 of 3 .*harmoni"),
    (".spz", {"means": 9e4 * FEW}, "2 of 3 Gaussians have means"),
    (".spz", {"sh": np.zeros((3, 25, 3))}, "degree 4; cut it to 3 .*--sh-degree"),
    (".splat", {"sh": WHITE}, r"1 of 3 colours are out of \[0, 1\]"),
    (".splat", {"means": 5e6 * FEW + [[0.3], [0], [0]]}, "1 of 3 Gaussians have means"),
]


@pytest.mark.parametrize(("suffix", "changes", "message"), CLIPPED)
def test_lost_precision_is_warned_about(tmp_path, suffix, changes, message):
    with jax.enable_x64(True), pytest.warns(UserWarning, match=message) as caught:
        gsjax.save(tmp_path / f"a{suffix}", given(0, **changes))
    assert len(caught) == 1
    if changes.get("sh") is WHITE:
        raw = (tmp_path / "a.splat").read_bytes()
        assert {raw[32 * k + 25] for k in range(3)} == {128, 255}


def test_values_are_clipped_to_the_nearest(tmp_path):
    sh = np.zeros((3, 4, 3))
    sh[0, :] = (9.0, -9.0, 0.5)
    fields = {"log_scales": [[9, -19, 0], [0, 0, 0], [1, 1, 1]], "sh": sh}
    scene = given(1, logit_opacities=[-np.inf, np.inf, -9.0], **fields)
    warned("beyond", gsjax.save, tmp_path / "a.spz", scene)
    found = gsjax.load(tmp_path / "a.spz").params
    np.testing.assert_array_equal(found.log_scales[0], [255 / 16 - 10, -10, 0])
    np.testing.assert_allclose(found.sh[0, 0], [10 / 3, -10 / 3, 0.5], atol=0.014)
    for basis in (1, 2, 3):
        np.testing.assert_allclose(found.sh[0, basis], [1, -1, 0.5], atol=1 / 128)
    shares = opacities(found.logit_opacities)
    np.testing.assert_allclose(shares, [0, 1, 0], atol=0.5 / 255)
    assert np.isfinite(found.logit_opacities).all()


def test_gaussians_that_are_never_drawn_are_left_out(tmp_path):
    quats = np.asarray([[1, 0, 0, 0], [0, 0, 0, 0], [0, 1e-20, 0, 0]])
    empty = gsjax.select(given(0), np.zeros(3, bool))
    for suffix in (".spz", ".splat"):
        with pytest.warns(UserWarning, match="1 of 3 quaternions are zero"):
            gsjax.save(tmp_path / f"a{suffix}", given(0, quats=quats))
        gsjax.save(tmp_path / f"empty{suffix}", empty)
    assert gsjax.load(tmp_path / "a.spz").capacity == 2
    assert len((tmp_path / "a.splat").read_bytes()) == 64
    assert int(gsjax.num_active(gsjax.load(tmp_path / "empty.spz"))) == 0
    assert (tmp_path / "empty.splat").read_bytes() == b""


BOTH, NOT_FINITE = (".spz", ".splat"), "1 of 3 Gaussians are NaN or infinite"
INFINITE = np.asarray([0, np.inf, 0])[:, None]
REFUSED = [
    (BOTH, {"means": INFINITE * np.ones(3)}, NOT_FINITE),
    (BOTH, {"quats": 1 + INFINITE * np.ones(4)}, NOT_FINITE),
    (BOTH, {"log_scales": INFINITE * np.ones(3)}, NOT_FINITE),
    (BOTH, {"sh": INFINITE[:, None] * np.ones((1, 3))}, NOT_FINITE),
    (BOTH, {"logit_opacities": [0, np.nan, 0]}, NOT_FINITE),
    (BOTH, {"quats": np.zeros((3, 4))}, "quaternions of all 3 Gaussians are zero"),
    ([".splat"], {"means": 1e39 * FEW}, "2 of 3 means exceed float32"),
    ([".spz"], {"means": 1e7 * FEW}, "expected means up to 8,388,607"),
]


@pytest.mark.parametrize(("suffixes", "changes", "message"), REFUSED)
def test_scenes_that_a_format_cannot_store(tmp_path, suffixes, changes, message):
    with jax.enable_x64(True):
        scene = given(0, **changes)
        for suffix in suffixes:
            rejects(message, gsjax.save, tmp_path / f"a{suffix}", scene)
    assert list(tmp_path.iterdir()) == []


def test_splat_files_follow_the_layout(tmp_path):
    """32 bytes each, the largest first, which is the last one here."""
    with pytest.warns(UserWarning, match="degree 1 to 3 are left out") as caught:
        gsjax.save(tmp_path / "a.splat", given())
    assert len(caught) == 1
    found = np.fromfile(tmp_path / "a.splat", "3<f4, 3<f4, 4u1, 4u1")[::-1]
    means, scales, rgba, quats = (found[name] for name in found.dtype.names)
    params = given().params
    np.testing.assert_array_equal(means, params.means)
    np.testing.assert_allclose(scales, np.exp(params.log_scales), rtol=1e-6)
    colors, shares = 0.5 + C0 * params.sh[:, 0], opacities(params.logit_opacities)
    expected = np.column_stack([colors, shares])
    np.testing.assert_allclose(rgba / 255, expected, atol=0.5 / 255)
    w, *xyz = (quats.T - 128.0) / 128
    np.testing.assert_allclose(matrices(*xyz, w), rotations(given()), atol=0.03)


def test_export_selects_the_format_by_suffix(tmp_path, capsys):
    quats = np.asarray([[1, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0]])
    gsjax.save(tmp_path / "a.ply", given(quats=quats))
    out = tmp_path / "new" / "b.spz"
    assert main(["export", str(tmp_path / "a.ply"), str(out)]) == 0
    assert "2 of 3 Gaussians" in capsys.readouterr().out
    assert gsjax.load(out).capacity == 2
    args = ["export", str(out), str(tmp_path / "c.splat")]
    assert main(args) == 0
    assert "degree 1 to 3 are left out" in capsys.readouterr().err
    assert main([*args, "--overwrite", "--sh-degree", "0"]) == 0
    assert capsys.readouterr().err == ""
