"""Photographs: pixels as stored, undistortion, sizes, masks, and damaged files."""

import contextlib
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import save_photo

from gsjax.cameras.distortion import Distortion, distort
from gsjax.data.decode import warn_of_damage
from gsjax.data.image_header import check_image, image_size
from gsjax.data.photos import load_photo, load_photos, undistorted_view
from gsjax.data.types import View
from gsjax.errors import InputError
from gsjax.sfm.photos import read_upright

RNG = np.random.default_rng(0)
NOISE = RNG.integers(0, 256, (24, 32, 3)).astype(np.uint8)


def png_of(width, height, depth=8, color=2, rows=bytes(1000), clear=None) -> bytes:
    """A PNG of packed rows, each behind a 0; and a transparent grey."""

    def chunk(kind, body):
        sizes = struct.pack(">I", len(body)), struct.pack(">I", zlib.crc32(kind + body))
        return sizes[0] + kind + body + sizes[1]

    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    chunks = [chunk(b"IHDR", head)]
    chunks += [] if clear is None else [chunk(b"tRNS", struct.pack(">H", clear))]
    chunks += [chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def view_of(path: Path, width=32, height=24, K=None, **more) -> View:
    if K is None:
        K = np.asarray([[40.0, 0, 15.5], [0, 42.0, 12.25], [0, 0, 1]])
    return View(path.name, path, np.eye(4), K, width, height, **more)


# --- pixels ---


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".webp", ".jpg"])
def test_rgb_as_stored(tmp_path, suffix):
    smooth = cv2.resize(NOISE[:4, :5], (32, 24), interpolation=cv2.INTER_CUBIC)
    path = save_photo(tmp_path / f"a{suffix}", smooth)
    assert image_size(path) == (32, 24)
    photo = load_photo(view_of(path))
    error = np.abs(photo.pixels.astype(int) - smooth).mean()
    assert error <= (6 if suffix in (".jpg", ".webp") else 0)
    assert photo.alpha is None
    assert photo.valid is None
    assert photo.pixels.flags.c_contiguous
    np.testing.assert_array_equal(photo.K, view_of(path).K)


def test_grey_and_16_bits(tmp_path):
    photo = load_photo(view_of(save_photo(tmp_path / "a.png", NOISE[..., 0])))
    np.testing.assert_array_equal(photo.pixels, np.repeat(NOISE[..., :1], 3, 2))
    deep = np.linspace(0, 65535, 24 * 32 * 3).reshape(24, 32, 3).astype(np.uint16)
    photo = load_photo(view_of(save_photo(tmp_path / "b.png", deep)))
    expected = np.rint(deep / 65535 * 255).astype(np.uint8)
    np.testing.assert_array_equal(photo.pixels, expected)
    assert photo.pixels.dtype == np.uint8


def test_alpha_is_kept(tmp_path):
    rgba = np.dstack([NOISE, NOISE[..., 1]])
    photo = load_photo(view_of(save_photo(tmp_path / "a.png", rgba)))
    np.testing.assert_array_equal(photo.pixels, NOISE)
    np.testing.assert_array_equal(photo.alpha, NOISE[..., 1])


def test_a_partly_transparent_tiff_is_rejected(tmp_path):
    """OpenCV mixes its colours with black; fully transparent pixels do no harm."""
    image = pytest.importorskip("PIL.Image", reason="Pillow is absent")
    alpha = np.where(NOISE[..., 1] > 99, 255, 0)
    rgba = np.dstack([NOISE, alpha]).astype(np.uint8)
    image.fromarray(rgba, "RGBA").save(tmp_path / "a.tiff")
    photo = load_photo(view_of(tmp_path / "a.tiff"))
    np.testing.assert_array_equal(photo.alpha, alpha)
    np.testing.assert_array_equal(photo.pixels[alpha > 0], NOISE[alpha > 0])
    rgba[3, 5, 3] = 128
    image.fromarray(rgba, "RGBA").save(tmp_path / "a.tiff")
    with pytest.raises(InputError, match=r"a\.tiff: a TIFF .* partly transparent"):
        load_photo(view_of(tmp_path / "a.tiff"))


@pytest.mark.parametrize("depth", [2, 8, 16])
def test_a_transparent_grey_of_a_png(tmp_path, depth):
    """The tRNS chunk instead of an alpha channel, which OpenCV ignores."""
    grey, path = NOISE[..., 0] % 4, tmp_path / "a.png"
    one = {2: 1, 8: 1, 16: 257}[depth]
    if depth == 2:
        rows = np.packbits((grey[..., None] >> [1, 0] & 1).reshape(24, -1), axis=1)
    else:
        rows = (grey.astype(int) * one).astype(f">u{depth // 8}")
    lines = b"".join(b"\0" + row.tobytes() for row in rows)
    path.write_bytes(png_of(32, 24, depth, 0, lines, 2 * one))
    photo = load_photo(view_of(path))
    assert photo.alpha is not None
    np.testing.assert_array_equal(photo.alpha, np.where(grey == 2, 0, 255))
    shown = grey * (85 if depth == 2 else 1)
    np.testing.assert_array_equal(photo.pixels, np.repeat(shown[..., None], 3, 2))


def test_a_tiff_of_grey_and_alpha_is_rejected(tmp_path):
    """OpenCV drops one of them, or reads 16 bits as zeros."""
    image = pytest.importorskip("PIL.Image", reason="Pillow is absent")
    both = image.fromarray(np.ascontiguousarray(NOISE[..., :2]), "LA")
    both.save(tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"a\.tif: a TIFF of two samples .* to PNG"):
        load_photo(view_of(tmp_path / "a.tif"))
    both.getchannel(0).save(tmp_path / "b.tif")
    np.testing.assert_array_equal(
        load_photo(view_of(tmp_path / "b.tif")).pixels, np.repeat(NOISE[..., :1], 3, 2)
    )


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("one", [1, 257])
def test_an_opaque_alpha_is_none(tmp_path, suffix, one):
    """One step of 8 bits less in one pixel is not opaque."""
    rgba = np.dstack([NOISE, np.full((24, 32), 255)])
    rgba = (rgba * one).astype(np.uint8 if one == 1 else np.uint16)
    path = save_photo(tmp_path / f"a{suffix}", rgba)
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.shape == (24, 32, 4)
    photo = load_photo(view_of(path))
    assert photo.alpha is None
    np.testing.assert_array_equal(photo.pixels, NOISE)
    rgba[3, 5, 3] -= one
    photo = load_photo(view_of(save_photo(path, rgba)))
    np.testing.assert_array_equal(photo.pixels, NOISE)
    assert photo.alpha is not None
    assert np.argwhere(photo.alpha != 255).tolist() == [[3, 5]]
    assert photo.alpha[3, 5] == 254


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    tiff = b"II*\0" + struct.pack("<IHHHII", 8, 1, 0x112, 3, 1, orientation)
    exif = b"Exif\0\0" + tiff + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def test_orientation_is_ignored(tmp_path):
    path = save_photo(tmp_path / "a.jpg")
    plain = load_photo(view_of(path)).pixels
    path.write_bytes(with_orientation(path.read_bytes(), 6))
    assert cv2.imread(str(path)).shape == (32, 24, 3)  # rotated
    np.testing.assert_array_equal(load_photo(view_of(path)).pixels, plain)
    assert image_size(path) == (32, 24)


def tiff_turned(path: Path, orientation: int) -> None:
    """Give a little-endian TIFF an orientation."""
    data = path.read_bytes()
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    entries = [data[at + 2 + 12 * i :][:12] for i in range(count)]
    entries = [e for e in entries if e[:2] != struct.pack("<H", 0x112)]
    entries.append(struct.pack("<HHII", 0x112, 3, 1, orientation))
    entries.sort(key=lambda e: struct.unpack("<H", e[:2]))
    folder = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    data += bytes(len(data) % 2)
    path.write_bytes(data[:4] + struct.pack("<I", len(data)) + data[8:] + folder)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_orientation_of_a_tiff_is_ignored(tmp_path, orientation, dtype):
    """For photograph and mask: OpenCV always rotates a TIFF."""
    path = save_photo(tmp_path / "a.tiff", NOISE.astype(dtype))
    grey = np.where(NOISE[..., 0] > 99, 255, 0).astype(np.uint8)
    mask = save_photo(tmp_path / "m.tiff", grey)
    plain = load_photo(view_of(path, mask=mask))
    tiff_turned(path, orientation)
    tiff_turned(mask, orientation)
    turned = load_photo(view_of(path, mask=mask))
    np.testing.assert_array_equal(turned.pixels, plain.pixels)
    np.testing.assert_array_equal(turned.valid, plain.valid)
    assert image_size(path) == (32, 24)


def test_a_lens_that_leaves_nothing_is_an_error(tmp_path):
    path = save_photo(tmp_path / "a.png", NOISE)
    lens = Distortion("opencv", (1e20, 0.0, 0.0, 0.0))
    expected = r"a\.png: 0 of 768 pixels are left .* \(opencv, 1e\+20, 0"
    with pytest.raises(InputError, match=expected):
        load_photo(view_of(path, lens=lens))


# --- sizes ---


def test_intrinsics_follow_the_file(tmp_path):
    path = save_photo(tmp_path / "a.png", NOISE)
    K = np.asarray([[160.0, 0, 62], [0, 168.0, 49], [0, 0, 1]])
    photo = load_photo(view_of(path, 128, 97, K))  # images_4: 97 / 4 = 24.25
    expected = K * [[32 / 128], [24 / 97], [1]]
    np.testing.assert_allclose(photo.K, expected, rtol=1e-15)


def dot_image(u, v, width=120, height=90, sigma=2.0):
    """A dot at (u, v), pixel centres at + 0.5."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    column = np.exp(-((y - v) ** 2) / (2 * sigma**2))
    row = np.exp(-((x - u) ** 2) / (2 * sigma**2))
    return np.rint(255 * column[:, None] * row).astype(np.uint8)


def centroid(image, u, v, reach=7):
    """Centroid of the dot near (u, v)."""
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in image.shape[::-1]))
    weight = image * (np.hypot(x - u, y - v) < reach).astype(float)
    return (weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()


def peak(image, u, v, reach=7):
    """Peak of the dot near (u, v), by a parabola through its logarithm.

    A lens maps the peak onto the peak, but not the centroid onto the centroid.
    """
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in image.shape[::-1]))
    near = np.hypot(x - u, y - v) < reach
    near &= image > 0.6 * image[near].max()
    x, y, weight = x[near] - u, y[near] - v, image[near]
    terms = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], -1)
    target = weight * np.log(weight)
    a, b, c, d, e, _ = np.linalg.lstsq(terms * weight[:, None], target)[0]
    return np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e]) + (u, v)


@pytest.mark.parametrize("max_size", [119, 60, 47, 30])
def test_downscaling_moves_nothing(tmp_path, max_size):
    path = save_photo(tmp_path / "a.png", dot_image(71.3, 40.6, sigma=6))
    photo = load_photo(view_of(path, 120, 90), max_size)
    height, width = photo.pixels.shape[:2]
    assert max(width, height) == max_size
    assert abs(width / height - 120 / 90) < 0.05
    sx, sy = width / 120, height / 90
    np.testing.assert_allclose(photo.K, view_of(path).K * [[sx], [sy], [1]], rtol=1e-15)
    found = centroid(photo.pixels[..., 0].astype(float), 71.3 * sx, 40.6 * sy, 99)
    np.testing.assert_allclose(found, (71.3 * sx, 40.6 * sy), atol=0.02)


def test_downscaling_averages(tmp_path):
    path = save_photo(tmp_path / "a.png", NOISE)
    photo = load_photo(view_of(path), 8)
    mean = NOISE.reshape(6, 4, 8, 4, 3).mean((1, 3))
    assert np.abs(photo.pixels - mean).max() <= 0.5 + 1e-6


def test_transparent_colours_do_not_bleed(tmp_path):
    rgba = np.zeros((24, 32, 4), np.uint8)
    rgba[..., 0] = 255  # red and transparent
    rgba[::2] = (0, 200, 0, 255)
    path = save_photo(tmp_path / "a.png", rgba)
    photo = load_photo(view_of(path), 16)
    assert (photo.pixels == (0, 200, 0)).all()
    assert photo.alpha is not None
    assert set(np.unique(photo.alpha)) <= {127, 128}


def test_max_size_is_checked(tmp_path):
    path = save_photo(tmp_path / "a.png", NOISE)
    assert load_photo(view_of(path), 1).pixels.shape == (1, 1, 3)
    assert load_photo(view_of(path), 32).pixels.shape == (24, 32, 3)
    with pytest.raises(InputError, match="max_size: expected at least 1 px, got 0"):
        load_photo(view_of(path), 0)


# --- lenses ---

LENSES = {
    "barrel": Distortion("opencv", (-0.12, 0.02, 0.003, -0.002)),
    "pincushion": Distortion("opencv", (0.15, 0.05, -0.002, 0.004, 0.01)),
    "rational": Distortion("opencv", (0.3, 0.1, 0.001, 0.002, 0.02, 0.35, 0.1, 0.01)),
    "fisheye": Distortion("fisheye", (0.05, -0.02, 0.01, -0.003)),
    "equidistant": Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)),
}
WIDE = np.asarray([[110.0, 0, 118.5], [0, 115.0, 93.25], [0, 0, 1]])
WIDE_SIZE = (240, 180)


def through_lens(lens, x, y):
    """OpenCV's projection of points (x, y, 1), pixel centres at + 0.5."""
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 1, 3)
    zero, coefficients = np.zeros(3), np.asarray(lens.coefficients)
    K = WIDE - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    if lens.model == "fisheye":
        found, _ = cv2.fisheye.projectPoints(points, zero, zero, K, coefficients)
    else:
        found, _ = cv2.projectPoints(points, zero, zero, K, coefficients)
    return found.reshape(-1, 2) + 0.5


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_distortion_equals_that_of_opencv(lens):
    x, y = RNG.uniform(-0.9, 0.9, (2, 500))
    ours = np.stack(distort(lens, x, y), -1) * (110, 115) + (118.5, 93.25)
    np.testing.assert_allclose(ours, through_lens(lens, x, y), atol=1e-9)
    centre = distort(lens, np.zeros(1), np.zeros(1))
    np.testing.assert_array_equal(centre, np.zeros((2, 1)))


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistorted_points_are_where_a_pinhole_projects_them(tmp_path, lens, report):
    expected = np.stack(np.meshgrid([25.3, 80, 119, 171.7, 215], [20, 61.4, 155.2]), -1)
    expected = expected.reshape(-1, 2)
    x, y = ((expected - WIDE[:2, 2]) / np.diag(WIDE)[:2]).T
    seen = through_lens(lens, x, y)
    inside = (seen > 8).all(1) & (seen < np.asarray(WIDE_SIZE) - 8).all(1)
    assert inside.sum() >= 9
    image = np.zeros(WIDE_SIZE[::-1], np.uint8)
    for u, v in seen[inside]:
        image = np.maximum(image, dot_image(u, v, *WIDE_SIZE))
    path = save_photo(tmp_path / "a.png", image)
    photo = load_photo(view_of(path, *WIDE_SIZE, WIDE, lens=lens))
    np.testing.assert_array_equal(photo.K, WIDE)
    found = [peak(photo.pixels[..., 0].astype(float), *p) for p in expected[inside]]
    error = np.hypot(*(np.asarray(found) - expected[inside]).T).max()
    moved = np.hypot(*(seen - expected)[inside].T).max()
    assert moved > 3
    report("undistorted points, px", error, 0.1)
    assert error <= 0.1


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_valid_pixels_are_those_that_the_lens_saw(tmp_path, lens):
    path = save_photo(tmp_path / "a.png", np.full(WIDE_SIZE[::-1], 200, np.uint8))
    photo = load_photo(view_of(path, *WIDE_SIZE, WIDE, lens=lens))
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in WIDE_SIZE))
    xn, yn = (x - WIDE[0, 2]) / 110, (y - WIDE[1, 2]) / 115
    seen = through_lens(lens, xn.ravel(), yn.ravel())
    margin = np.minimum(seen - 0.5, np.asarray(WIDE_SIZE) - 0.5 - seen).min(1)
    margin = margin.reshape(x.shape)
    valid = np.ones(x.shape, bool) if photo.valid is None else photo.valid
    assert valid[margin > 0.05].all()
    assert not valid[margin < -0.05].any()
    assert (photo.pixels[valid] == 200).all()
    assert valid.mean() > 0.5


def test_past_the_fold_nothing_is_valid(tmp_path):
    # r(1 − 0.5 r²) decreases from r = 0.816 on: the wider field would appear again,
    # mirrored.
    lens = Distortion("opencv", (-0.5, 0.0, 0.0, 0.0))
    path = save_photo(tmp_path / "a.png", np.full(WIDE_SIZE[::-1], 200, np.uint8))
    photo = load_photo(view_of(path, *WIDE_SIZE, WIDE, lens=lens))
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in WIDE_SIZE))
    radius = np.hypot((x - WIDE[0, 2]) / 110, (y - WIDE[1, 2]) / 115)
    assert photo.valid is not None
    fold = np.sqrt(2 / 3)
    assert photo.valid[radius < fold - 1e-3].all()
    assert not photo.valid[radius > fold + 1e-3].any()


def test_lens_of_a_smaller_copy(tmp_path):
    lens = LENSES["barrel"]
    path = save_photo(tmp_path / "a.png", np.full((90, 120), 200, np.uint8))
    half = load_photo(view_of(path, *WIDE_SIZE, WIDE, lens=lens))
    np.testing.assert_allclose(half.K, WIDE * [[0.5], [0.5], [1]])
    K, small = WIDE * [[0.5], [0.5], [1]], view_of(path, 120, 90, lens=lens)
    same = load_photo(View(small.name, path, np.eye(4), K, 120, 90, lens))
    np.testing.assert_array_equal(half.pixels, same.pixels)


def test_undistorted_view(tmp_path):
    path = save_photo(tmp_path / "a.png", np.full(WIDE_SIZE[::-1], 200, np.uint8))
    view = view_of(path, *WIDE_SIZE, WIDE, lens=LENSES["fisheye"])
    photo = load_photo(view, 60)
    ideal = undistorted_view(view, photo)
    assert (ideal.width, ideal.height, ideal.lens) == (60, 45, None)
    np.testing.assert_array_equal(ideal.K, photo.K)


@pytest.mark.parametrize(
    "lens", [Distortion("fisheye", (0.1,)), Distortion("mirror", (0.0,) * 4)]
)
def test_unknown_lenses(tmp_path, lens):
    path = save_photo(tmp_path / "a.png", NOISE)
    with pytest.raises(InputError, match=r"lens: expected .* with \d"):
        load_photo(view_of(path, lens=lens))


# --- masks ---


def test_masks(tmp_path):
    path = save_photo(tmp_path / "a.png", NOISE)
    mask = np.full((24, 32), 255, np.uint8)
    mask[3, 7] = 0
    mask[10:, 20:] = 0
    mask[0, 0] = 1  # not 0, so not left out
    view = view_of(path, mask=save_photo(tmp_path / "m.png", mask))
    photo = load_photo(view)
    np.testing.assert_array_equal(photo.valid, mask > 0)
    np.testing.assert_array_equal(photo.pixels, NOISE)
    # A pixel is valid if all that contribute to it are.
    small = load_photo(view, 8).valid
    np.testing.assert_array_equal(small, (mask > 0).reshape(6, 4, 8, 4).all((1, 3)))
    # Masks of another size: nearest.
    twice = save_photo(tmp_path / "m2.png", np.kron(mask, np.ones((2, 2), np.uint8)))
    photo = load_photo(view_of(path, mask=twice))
    np.testing.assert_array_equal(photo.valid, mask > 0)
    # A 1 of 16 bits is not black either.
    deep = save_photo(tmp_path / "m16.png", (mask > 0).astype(np.uint16))
    np.testing.assert_array_equal(load_photo(view_of(path, mask=deep)).valid, mask > 0)
    white = save_photo(tmp_path / "m3.png", np.full((24, 32), 255, np.uint8))
    assert load_photo(view_of(path, mask=white)).valid is None


def test_mask_through_a_lens(tmp_path):
    lens = LENSES["pincushion"]
    image = np.full(WIDE_SIZE[::-1], 200, np.uint8)
    image[60:80, 150:170] = 0
    path = save_photo(tmp_path / "a.png", image)
    photo = load_photo(view_of(path, *WIDE_SIZE, WIDE, lens=lens, mask=path))
    assert photo.valid is not None
    assert (photo.pixels[photo.valid] == 200).all()  # nothing of the hole leaks
    dark = (photo.pixels[..., 0] == 0).sum()
    hidden = (~photo.valid & (photo.pixels[..., 0] < 200)).sum()
    assert dark > 200
    assert hidden < 2 * dark


# --- many ---


def test_many_in_order(tmp_path):
    views = []
    for index in range(12):
        pixels = np.full((24, 32, 3), 20 * index, np.uint8)
        views.append(view_of(save_photo(tmp_path / f"{index}.png", pixels)))
    calls = []
    photos = load_photos(views, 16, progress=lambda done, of: calls.append((done, of)))
    assert [int(photo.pixels[0, 0, 0]) for photo in photos] == [*range(0, 240, 20)]
    assert calls == [(n, 12) for n in range(1, 13)]
    views[7].image.unlink()
    with pytest.raises(InputError, match=r"7\.png: cannot be read: No such file"):
        load_photos(views)
    assert load_photos([]) == []


# --- rejected files ---


def test_thumbnail_does_not_hide_truncation(tmp_path):
    # An EXIF thumbnail is a JPEG of its own, with an end marker of its own.
    path = save_photo(tmp_path / "a.jpg", NOISE)
    data = path.read_bytes()
    inner = b"\xff\xe1" + struct.pack(">H", len(data) + 2) + data
    path.write_bytes(data[:2] + inner + data[2:])
    assert load_photo(view_of(path)).pixels.shape == (24, 32, 3)
    path.write_bytes(data[:2] + inner + data[2:-9])
    with pytest.raises(InputError, match="no end-of-image marker"):
        load_photo(view_of(path))


def test_damaged_bytes_do_not_crash(tmp_path):
    rng = np.random.default_rng(1)
    for suffix in (".png", ".jpg", ".webp", ".tiff", ".bmp"):
        good = save_photo(tmp_path / f"a{suffix}", NOISE).read_bytes()
        for _ in range(60):
            data = bytearray(good)
            for at in rng.integers(0, min(len(data), 300), 3):
                data[at] = rng.integers(256)
            with contextlib.suppress(InputError):
                assert min(check_image(tmp_path, bytes(data))) >= 1


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((24, 32), "its camera, 24 × 32, .*it was rotated"),
        ((64, 24), "64 × 24, got 32 × 24"),
    ],
)
def test_other_aspect_ratios(tmp_path, size, expected):
    path = save_photo(tmp_path / "a.png", NOISE)
    with pytest.raises(
        InputError, match=rf"a\.png: expected the aspect ratio of .*{expected}"
    ):
        load_photo(view_of(path, *size))


def test_float_images(tmp_path):
    path = tmp_path / "a.tiff"
    done, data = cv2.imencode(".tiff", np.zeros((24, 32, 3), np.float32))
    assert done
    path.write_bytes(data.tobytes())
    with pytest.raises(InputError, match=r"a\.tiff: expected samples .* got float32"):
        load_photo(view_of(path))


# --- damaged, and read anyway ---


def with_hole(path: Path, *encoding: int) -> Path:
    """Write a photograph with some bytes of its pixels lost and intact headers."""
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    done, data = cv2.imencode(path.suffix, pixels, encoding)
    assert done
    whole = data.tobytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(40) + whole[middle + 40 :])
    return path


@pytest.mark.parametrize(
    ("name", "expected"),
    [("a.jpg", "Corrupt JPEG data"), ("a.tiff", "LZWDecode")],
)
def test_holes_give_a_warning(tmp_path, capfd, name, expected):
    path = with_hole(tmp_path / name)
    good = [save_photo(tmp_path / f"{index}.png") for index in range(40)]
    told = rf"damaged .*: \S*{name}: {expected}[^;]*; copy or export them again"
    view = view_of(path, 64, 48)
    with pytest.warns(UserWarning, match=told):
        assert load_photo(view).pixels.shape == (48, 64, 3)
    with pytest.warns(UserWarning, match=told):
        read_upright(path)
    with pytest.warns(UserWarning, match=told) as warned:
        photos = load_photos([view_of(p) for p in good] + [view])
    assert [photo.pixels.shape[0] for photo in photos] == [24] * 40 + [48]
    assert len(warned) == 1
    with pytest.warns(
        UserWarning, match=f"{name}: {expected}[^;]*; \\S*m_{name}: [^;]*; copy"
    ):
        load_photo(view_of(path, 64, 48, mask=with_hole(tmp_path / f"m_{name}")))
    assert capfd.readouterr().err == ""


def test_other_lines_on_stderr_are_kept(tmp_path, capfd):
    view = view_of(save_photo(tmp_path / "a.png"))
    with warn_of_damage([view.image]):
        os.write(2, b"of XLA\nlibpng warning: iCCP: known incorrect sRGB profile\n")
        with warn_of_damage([view.image]):
            load_photo(view)
            os.write(2, b"within\n")
    assert sorted(capfd.readouterr().err.splitlines()) == ["of XLA", "within"]
    with pytest.raises(InputError), warn_of_damage([view.image]):
        raise InputError("any")
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
