"""Axes, extension records and versions of SPZ files."""

import gzip
import struct
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from captures import rejects
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.io.spz import read_spz, write_spz
from gsjax.math.sh import eval_sh

pytestmark = [
    pytest.mark.usefixtures("float32"),
    pytest.mark.filterwarnings("ignore:.*most programs reject"),
]
RUB, RDF = 4, 6
FLIP = np.asarray([1.0, -1, -1])


def scene(degree: int = 1, count: int = 5) -> gsjax.Gaussians:
    rng = np.random.default_rng(degree)
    return gsjax.make_gaussians(
        means=rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        log_scales=rng.uniform(-3, 0, (count, 3)),
        logit_opacities=rng.normal(size=count),
        sh=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)),
    )


def axes_record(number: int) -> bytes:
    return struct.pack("<III", 0xADBE0003, 4, number)


CAMERA_RECORD = struct.pack("<II3f", 0xADBE0002, 12, -0.5, 1, 2)


def extended(data: bytes, *records: bytes) -> bytes:
    """The file with extension records."""
    more = b"".join(records)
    if data[:4] != b"NGSP":
        raw = gzip.decompress(data)
        return gzip.compress(raw[:14] + b"\2\0" + raw[16:] + more)
    head = data[:14] + b"\2" + data[15:16] + struct.pack("<I", 32 + len(more))
    return head + data[20:32] + more + data[32:]


def arrays(gaussians: gsjax.Gaussians) -> dict[str, np.ndarray]:
    return {name: np.asarray(array) for name, array in vars(gaussians.params).items()}


def rotations(found) -> np.ndarray:
    w, *xyz = found["quats"].T
    return Rotation.from_quat(np.stack([*xyz, w], -1)).as_matrix()


@pytest.mark.parametrize("degree", [0, 2, 4])
def test_frames_differ_by_half_a_turn_about_x(tmp_path, degree):
    """Of covariances, and of the colours seen from any direction."""
    path = tmp_path / "a.spz"
    gsjax.save(path, scene(degree))
    found, turned = arrays(read_spz(path)), arrays(read_spz(path, frame="rdf"))
    for name in ("log_scales", "logit_opacities"):
        np.testing.assert_array_equal(found[name], turned[name])
    np.testing.assert_array_equal(found["means"] * FLIP, turned["means"])
    flip = np.diag(FLIP)
    found_r, turned_r = rotations(found), rotations(turned)
    np.testing.assert_allclose(flip @ found_r @ flip, turned_r, atol=1e-6)
    rays = np.random.default_rng(0).normal(size=(5, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = eval_sh(jnp.asarray(found["sh"]), jnp.asarray(rays))
    seen_turned = eval_sh(jnp.asarray(turned["sh"]), jnp.asarray(rays * FLIP))
    np.testing.assert_allclose(seen, seen_turned, atol=1e-5)


@pytest.mark.parametrize("version", [3, 4])
def test_axes_that_a_file_records_take_precedence(tmp_path, version):
    path, other = tmp_path / "a.spz", tmp_path / "b.spz"
    write_spz(path, scene(), version=version)
    for number, axes in ((RDF, "rdf"), (RUB, "rub")):
        record = axes_record(number)
        other.write_bytes(extended(path.read_bytes(), CAMERA_RECORD, record))
        expected = arrays(read_spz(path, frame=axes))
        for frame in ("rub", "rdf"):
            for name, array in arrays(read_spz(other, frame=frame)).items():
                np.testing.assert_array_equal(array, expected[name])


def test_empty_scenes(tmp_path):
    """Version 4 has no blocks then, and degree 0 no block of harmonics."""
    path, nothing = tmp_path / "a.spz", np.zeros(5, bool)
    for version in (3, 4):
        for keep in (nothing, ~nothing):
            some = gsjax.select(scene(0), keep)
            write_spz(path, some, version=version, overwrite=True)
            assert int(gsjax.num_active(gsjax.load(path))) == keep.sum()
            blocks = path.read_bytes()[15] if version == 4 else None
            assert blocks in (None, 5 * bool(keep.any()))


@pytest.mark.parametrize("bits", [(6, 5), (8, 8), (1, 7)])
def test_harmonics_keep_the_given_bits(tmp_path, bits):
    given = np.asarray(scene(2, 200).params.sh)[:, 1:]
    gsjax.save(tmp_path / "a.spz", scene(2, 200), harmonic_bits=bits)
    found = np.asarray(gsjax.load(tmp_path / "a.spz").params.sh)[:, 1:]
    for some, kept in ((slice(0, 3), bits[0]), (slice(3, None), bits[1])):
        error = np.abs(found - given)[:, some].max()
        assert 0.8 < error * 2**kept <= 1.01


REFUSED: list[tuple[Callable, str]] = [
    (lambda path: read_spz(path, frame="luf"), r"frame: expected .*'rub', 'rdf'.*luf"),
    (lambda path: write_spz(path, scene(), version=2), r"version: .*\(3, 4\), got 2;"),
    (lambda path: write_spz(path, scene(), harmonic_bits=(0, 8)), "expected 1 to 8"),
    (lambda path: write_spz(path, scene(), version=5), r"version: .*\(3, 4\), got 5;"),
]


@pytest.mark.parametrize("row", range(len(REFUSED)))
def test_unknown_options(tmp_path, row):
    call, message = REFUSED[row]
    rejects(message, call, tmp_path / "a.spz")
    assert list(tmp_path.iterdir()) == []
