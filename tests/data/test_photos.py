"""Photographs: pixels as stored, undistortion, sizes, masks, and damaged files."""

import contextlib
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import exif_turn, png_chunk, rejects, save_photo, warned

from gsjax.cameras.distortion import Distortion, distort
from gsjax.data.decode import warn_of_damage
from gsjax.data.image_header import check_image, image_size
from gsjax.data.photos import load_photo, load_photos, loaded_view, undistort_photo
from gsjax.data.types import Photo, View
from gsjax.errors import InputError
from gsjax.sfm.photos import read_upright

RNG = np.random.default_rng(0)
NOISE = RNG.integers(0, 256, (24, 32, 3)).astype(np.uint8)
GREY = np.repeat(NOISE[..., :1], 3, 2)
K = np.asarray([[40.0, 0, 15.5], [0, 42.0, 12.25], [0, 0, 1]])


def view_of(path: Path, size=(32, 24), K=K, **more) -> View:
    return View(path.name, path, np.eye(4), K, *size, **more)


def load(folder: Path, pixels, name="a.png", max_size=None, **more) -> Photo:
    """Write pixels and load them as a photograph."""
    view = view_of(save_photo(folder / name, pixels), **more)
    return load_photo(view, max_size, undistort=True)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".webp", ".jpg"])
def test_rgb_as_stored(tmp_path, suffix):
    smooth = cv2.resize(NOISE[:4, :5], (32, 24), interpolation=cv2.INTER_CUBIC)
    photo = load(tmp_path, smooth, f"a{suffix}")
    error = np.abs(photo.pixels.astype(int) - smooth).mean()
    assert error <= (6 if suffix in (".jpg", ".webp") else 0)
    assert (photo.alpha, photo.valid) == (None, None)
    assert photo.pixels.flags.c_contiguous
    np.testing.assert_array_equal(photo.K, K)
    assert image_size(tmp_path / f"a{suffix}") == (32, 24)


def test_grey_and_16_bits(tmp_path):
    np.testing.assert_array_equal(load(tmp_path, NOISE[..., 0]).pixels, GREY)
    deep = np.linspace(0, 65535, 24 * 32 * 3).reshape(24, 32, 3).astype(np.uint16)
    pixels = load(tmp_path, deep).pixels
    np.testing.assert_array_equal(pixels, np.rint(deep / 65535 * 255))
    assert pixels.dtype == np.uint8


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_is_kept_unless_opaque(tmp_path, suffix, dtype):
    """One step of 8 bits less in one pixel is not opaque."""
    alpha = np.full((24, 32), 255)
    for step in (0, 1):
        alpha[3, 5] -= step
        rgba = np.dstack([NOISE, alpha]) * (np.iinfo(dtype).max // 255)
        photo = load(tmp_path, rgba.astype(dtype), f"a{suffix}")
        np.testing.assert_array_equal(photo.pixels, NOISE)
        np.testing.assert_array_equal(photo.alpha, alpha if step else None)


@pytest.mark.parametrize("depth", [2, 8, 16])
def test_a_transparent_grey_of_a_png(tmp_path, depth):
    """The tRNS chunk instead of an alpha channel, which OpenCV ignores."""
    grey, one = NOISE[..., 0] % 4, {2: 1, 8: 1, 16: 257}[depth]
    if depth == 2:
        rows = np.packbits((grey[..., None] >> [1, 0] & 1).reshape(24, -1), axis=1)
    else:
        rows = (grey.astype(int) * one).astype(f">u{depth // 8}")
    lines = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    head = struct.pack(">IIBBBBB", 32, 24, depth, 0, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"tRNS", struct.pack(">H", 2 * one))]
    chunks += [(b"IDAT", lines), (b"IEND", b"")]
    path = tmp_path / "a.png"
    data = b"".join(png_chunk(*each) for each in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    photo = load_photo(view_of(path))
    np.testing.assert_array_equal(photo.alpha, np.where(grey == 2, 0, 255))
    shown = grey * (85 if depth == 2 else 1)
    np.testing.assert_array_equal(photo.pixels, np.repeat(shown[..., None], 3, 2))


def test_tiffs_that_opencv_misreads_are_rejected(tmp_path):
    """It mixes partly transparent colours with black, and drops a second sample."""
    image = pytest.importorskip("PIL.Image", reason="Pillow is absent")
    path = tmp_path / "a.tiff"
    alpha = np.where(NOISE[..., 1] > 99, 255, 0)
    rgba = np.dstack([NOISE, alpha]).astype(np.uint8)
    image.fromarray(rgba, "RGBA").save(path)
    photo = load_photo(view_of(path))
    np.testing.assert_array_equal(photo.alpha, alpha)
    np.testing.assert_array_equal(photo.pixels[alpha > 0], NOISE[alpha > 0])
    rgba[3, 5, 3] = 128
    image.fromarray(rgba, "RGBA").save(path)
    rejects(r"a\.tiff: a TIFF .* partly transparent", load_photo, view_of(path))
    both = image.fromarray(np.ascontiguousarray(NOISE[..., :2]), "LA")
    both.save(path)
    rejects(r"a\.tiff: a TIFF of two samples .* to PNG", load_photo, view_of(path))
    both.getchannel(0).save(path)
    np.testing.assert_array_equal(load_photo(view_of(path)).pixels, GREY)


def test_orientation_and_thumbnail_of_exif_are_ignored(tmp_path):
    path = save_photo(tmp_path / "a.jpg")
    plain, data = load_photo(view_of(path)).pixels, path.read_bytes()

    def with_exif(exif, end=None):
        head = b"\xff\xe1" + struct.pack(">H", len(exif) + 2)
        path.write_bytes(data[:2] + head + exif + data[2:end])

    with_exif(b"Exif\0\0" + exif_turn(6))
    assert cv2.imread(str(path)).shape == (32, 24, 3)  # rotated
    np.testing.assert_array_equal(load_photo(view_of(path)).pixels, plain)
    assert image_size(path) == (32, 24)
    # A thumbnail is a JPEG with an end marker of its own.
    with_exif(data)
    assert load_photo(view_of(path)).pixels.shape == (24, 32, 3)
    with_exif(data, -9)
    rejects("no end-of-image marker", load_photo, view_of(path))


def turn_tiff(path: Path, orientation: int) -> None:
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
    turn_tiff(path, orientation)
    turn_tiff(mask, orientation)
    turned = load_photo(view_of(path, mask=mask))
    np.testing.assert_array_equal(turned.pixels, plain.pixels)
    np.testing.assert_array_equal(turned.valid, plain.valid)
    assert image_size(path) == (32, 24)


def pixel_centres(shape):
    return np.meshgrid(*(np.arange(n) + 0.5 for n in shape[::-1]))


@pytest.mark.parametrize("max_size", [119, 60, 47, 30])
def test_downscaling_moves_nothing(tmp_path, max_size):
    """A ramp along each axis keeps its values; K of `images_4` follows the file."""
    x, y = pixel_centres((90, 120))
    ramps = np.rint(np.stack([2 * x, 2 * y, 0 * x], -1)).astype(np.uint8)
    photo = load(tmp_path, ramps, size=(120, 90), max_size=max_size)
    height, width = photo.pixels.shape[:2]
    assert max(width, height) == max_size
    assert abs(width / height - 120 / 90) < 0.05
    scale = np.asarray([width / 120, height / 90])
    np.testing.assert_allclose(photo.K[:2], K[:2] * scale[:, None], rtol=1e-15)
    expected = np.stack(pixel_centres((height, width)), -1) * 2 / scale
    error = photo.pixels[..., :2] - expected
    assert np.abs(error.mean((0, 1))).max() < 0.06
    assert np.abs(error).max() < 2
    photo = load(tmp_path, NOISE, size=(128, 97))  # 97 / 4 = 24.25
    np.testing.assert_allclose(photo.K, K * [[32 / 128], [24 / 97], [1]], rtol=1e-15)


def test_downscaling_averages(tmp_path):
    photo = load(tmp_path, NOISE, max_size=8)
    mean = NOISE.reshape(6, 4, 8, 4, 3).mean((1, 3))
    assert np.abs(photo.pixels - mean).max() <= 0.5 + 1e-6
    assert load(tmp_path, NOISE, max_size=1).pixels.shape == (1, 1, 3)
    assert load(tmp_path, NOISE, max_size=32).pixels.shape == (24, 32, 3)
    rgba = np.zeros((24, 32, 4), np.uint8)
    rgba[..., 0] = 255  # red and transparent, which must not show
    rgba[::2] = (0, 200, 0, 255)
    photo = load(tmp_path, rgba, max_size=16)
    assert (photo.pixels == (0, 200, 0)).all()
    assert photo.alpha is not None
    assert set(np.unique(photo.alpha)) <= {127, 128}


LENSES = {
    "barrel": Distortion("opencv", (-0.12, 0.02, 0.003, -0.002)),
    "pincushion": Distortion("opencv", (0.15, 0.05, -0.002, 0.004, 0.01)),
    "rational": Distortion("opencv", (0.3, 0.1, 0.001, 0.002, 0.02, 0.35, 0.1, 0.01)),
    "fisheye": Distortion("fisheye", (0.05, -0.02, 0.01, -0.003)),
    "equidistant": Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)),
}
WIDE = {
    "K": np.asarray([[110.0, 0, 118.5], [0, 115.0, 93.25], [0, 0, 1]]),
    "size": (240, 180),
}
WHITE = np.full((180, 240), 200, np.uint8)


def through_lens(lens, x, y):
    """OpenCV's projection of points (x, y, 1), pixel centres at + 0.5."""
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 1, 3)
    zero, coefficients = np.zeros(3), np.asarray(lens.coefficients)
    shifted = WIDE["K"] - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    module = cv2.fisheye if lens.model == "fisheye" else cv2
    found, _ = module.projectPoints(points, zero, zero, shifted, coefficients)
    return found.reshape(-1, 2) + 0.5


def pattern(places):
    """Waves of 24 px with a slope of up to 26 levels per px."""
    waves = np.rint(128 + 100 * np.sin(2 * np.pi / 24 * places)).astype(np.uint8)
    return np.concatenate([waves, waves[..., :1]], -1)


def normalised(x, y):
    return (x - 118.5) / 110, (y - 93.25) / 115


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistortion_inverts_the_projection_of_opencv(tmp_path, lens, report):
    x, y = RNG.uniform(-0.9, 0.9, (2, 500))
    ours = np.stack(distort(lens, x, y), -1) * (110, 115) + (118.5, 93.25)
    np.testing.assert_allclose(ours, through_lens(lens, x, y), atol=1e-9)
    centre = distort(lens, np.zeros(1), np.zeros(1))
    np.testing.assert_array_equal(centre, np.zeros((2, 1)))
    # A pattern is where a pinhole projects it.
    x, y = pixel_centres(WHITE.shape)
    seen = through_lens(lens, *normalised(x.ravel(), y.ravel())).reshape(*x.shape, 2)
    photo = load(tmp_path, pattern(np.stack([x, y], -1)), **WIDE, lens=lens)
    np.testing.assert_array_equal(photo.K, WIDE["K"])
    margin = np.minimum(seen - 0.5, np.asarray(WIDE["size"]) - 0.5 - seen).min(-1)
    error = np.abs(photo.pixels.astype(float) - pattern(seen))[margin > 1].max()
    assert np.abs(seen - np.stack([x, y], -1))[margin > 1].max() > 3
    report("undistorted pattern, levels", error, 3)
    assert error <= 3  # 0.1 px of its slope
    # Valid pixels are those that the lens saw.
    photo = load(tmp_path, WHITE, **WIDE, lens=lens)
    valid = np.ones(x.shape, bool) if photo.valid is None else photo.valid
    assert valid[margin > 0.05].all()
    assert not valid[margin < -0.05].any()
    assert (photo.pixels[valid] == 200).all()
    assert valid.mean() > 0.5


def test_pixels_beyond_the_fold_are_invalid(tmp_path):
    # r(1 − 0.5 r²) decreases from r = 0.816 on: the wider field would appear again,
    # mirrored.
    lens = Distortion("opencv", (-0.5, 0.0, 0.0, 0.0))
    photo = load(tmp_path, WHITE, **WIDE, lens=lens)
    radius = np.hypot(*normalised(*pixel_centres(WHITE.shape)))
    assert photo.valid is not None
    fold = np.sqrt(2 / 3)
    assert photo.valid[radius < fold - 1e-3].all()
    assert not photo.valid[radius > fold + 1e-3].any()


def test_undistortion_of_smaller_copies(tmp_path):
    lens, K = LENSES["barrel"], WIDE["K"] * [[0.5], [0.5], [1]]
    half = load(tmp_path, WHITE[::2, ::2], **WIDE, lens=lens)
    np.testing.assert_allclose(half.K, K)
    same = load(tmp_path, WHITE[::2, ::2], size=(120, 90), K=K, lens=lens)
    np.testing.assert_array_equal(half.pixels, same.pixels)
    np.testing.assert_array_equal(half.valid, same.valid)
    view = view_of(tmp_path / "a.png", **WIDE, lens=lens)
    photo = load_photo(view, 60, undistort=True)
    ideal = loaded_view(view, photo)
    assert (ideal.width, ideal.height, ideal.lens) == (60, 45, None)
    np.testing.assert_array_equal(ideal.K, photo.K)


def test_lenses_are_kept(tmp_path):
    """Pixels stay as they are; those outside a fisheye's circle are invalid."""
    path = save_photo(tmp_path / "a.png", NOISE)
    photo = load_photo(view_of(path, lens=LENSES["barrel"]), 16)
    same = load_photo(view_of(path), 16)
    np.testing.assert_array_equal(photo.pixels, same.pixels)
    assert (photo.lens, photo.valid) == (LENSES["barrel"], None)
    undistorted = undistort_photo("a", load_photo(view_of(path, lens=photo.lens)))
    wanted = load_photo(view_of(path, lens=photo.lens), undistort=True)
    np.testing.assert_array_equal(undistorted.pixels, wanted.pixels)
    np.testing.assert_array_equal(undistorted.valid, wanted.valid)
    # θ (1 − 0.1 θ²) grows up to θ = 1.826, to 1.217.
    narrow = Distortion("fisheye", (-0.1, 0.0, 0.0, 0.0))
    K = np.array([[14.0, 0, 16], [0, 14, 12], [0, 0, 1]])
    photo = load_photo(view_of(path, K=K, lens=narrow))
    x, y = pixel_centres((24, 32))
    assert photo.valid is not None
    np.testing.assert_array_equal(photo.valid, np.hypot(x - 16, y - 12) < 1.217 * 14)
    folded = Distortion("fisheye", (-1.0, 0.0, 0.0, 0.0))
    folds = r"a\.png: the lens \(fisheye, -1, .* folds within the image: .* estimate"
    rejects(folds, load_photo, view_of(path, K=K, lens=folded))


def test_masks(tmp_path):
    path = save_photo(tmp_path / "a.png", NOISE)
    mask = np.full((24, 32), 255, np.uint8)
    mask[3, 7] = 0
    mask[10:, 20:] = 0
    mask[0, 0] = 1  # not 0, so not excluded
    view = view_of(path, mask=save_photo(tmp_path / "m.png", mask))
    photo = load_photo(view)
    np.testing.assert_array_equal(photo.valid, mask > 0)
    np.testing.assert_array_equal(photo.pixels, NOISE)
    # A pixel is valid if all that contribute to it are.
    small = load_photo(view, 8).valid
    np.testing.assert_array_equal(small, (mask > 0).reshape(6, 4, 8, 4).all((1, 3)))
    # Masks of another size: nearest. A 1 of 16 bits is not black either.
    others = [np.kron(mask, np.ones((2, 2), np.uint8)), (mask > 0).astype(np.uint16)]
    for other in others:
        photo = load_photo(view_of(path, mask=save_photo(tmp_path / "m.png", other)))
        np.testing.assert_array_equal(photo.valid, mask > 0)
    white = save_photo(tmp_path / "m.png", np.full((24, 32), 255, np.uint8))
    assert load_photo(view_of(path, mask=white)).valid is None


def test_mask_through_a_lens(tmp_path):
    image = WHITE.copy()
    image[60:80, 150:170] = 0
    path = save_photo(tmp_path / "a.png", image)
    view = view_of(path, **WIDE, lens=LENSES["pincushion"], mask=path)
    photo = load_photo(view, undistort=True)
    assert photo.valid is not None
    assert (photo.pixels[photo.valid] == 200).all()  # nothing of the hole leaks
    dark = (photo.pixels[..., 0] == 0).sum()
    hidden = (~photo.valid & (photo.pixels[..., 0] < 200)).sum()
    assert dark > 200
    assert hidden < 2 * dark


def test_many_photographs_keep_their_order(tmp_path):
    """With cameras in common and of their own, on several threads."""
    lenses = [Distortion("opencv", (k, 0.0, 0.0, 0.0)) for k in (0.1, 0.2, 0.3)]
    views = []
    for index in range(12):
        pixels = np.full((24, 32, 3), 20 * index, np.uint8)
        path = save_photo(tmp_path / f"{index}.png", pixels)
        views.append(view_of(path, lens=lenses[index % 3]))
    calls = []
    photos = load_photos(
        views, 16, lambda done, of: calls.append((done, of)), undistort=True
    )
    assert [int(photo.pixels[6, 8, 0]) for photo in photos] == [*range(0, 240, 20)]
    for index, view in enumerate(views):
        alone = load_photo(view, 16, undistort=True)
        np.testing.assert_array_equal(photos[index].pixels, alone.pixels)
        np.testing.assert_array_equal(photos[index].valid, alone.valid)
    assert calls == [(n, 12) for n in range(1, 13)]
    views[7].image.unlink()
    rejects(r"7\.png: cannot be read: No such file", load_photos, views)
    assert load_photos([]) == []


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"size": (24, 32)}, "its camera, 24 × 32, .*was rotated"),
        ({"size": (64, 24)}, "its camera, 64 × 24, got 32 × 24 px"),
        ({"pixels": np.float32(NOISE), "name": "a.tiff"}, "samples .* got float32"),
        ({"max_size": 0}, "max_size: expected at least 1 px, got 0"),
        ({"lens": Distortion("fisheye", (0.1,))}, "'fisheye' with 1"),
        ({"lens": Distortion("mirror", (0.0,))}, "'mirror' with 1"),
        (
            {"lens": Distortion("opencv", (1e20, 0.0, 0.0, 0.0))},
            r"a\.png: 0 of 768 pixels are left .* \(opencv, 1e\+20, 0",
        ),
    ],
)
def test_rejected_photographs(tmp_path, more, expected):
    rejects(expected, load, tmp_path, **({"pixels": NOISE} | more))


def test_damaged_bytes_raise_nothing_else(tmp_path):
    rng = np.random.default_rng(1)
    for suffix in (".png", ".jpg", ".webp", ".tiff", ".bmp"):
        good = save_photo(tmp_path / f"a{suffix}", NOISE).read_bytes()
        for _ in range(60):
            data = bytearray(good)
            for at in rng.integers(0, min(len(data), 300), 3):
                data[at] = rng.integers(256)
            with contextlib.suppress(InputError):
                assert min(check_image(tmp_path, bytes(data))) >= 1


def with_hole(path: Path) -> Path:
    """Write a photograph with some bytes of its pixels lost and intact headers."""
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    whole = save_photo(path, pixels[..., ::-1]).read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(40) + whole[middle + 40 :])
    return path


@pytest.mark.parametrize(
    ("name", "damage"), [("a.jpg", "Corrupt JPEG data"), ("a.tiff", "LZWDecode")]
)
def test_repaired_photographs_give_a_warning(tmp_path, capfd, name, damage):
    path = with_hole(tmp_path / name)
    good = [save_photo(tmp_path / f"{index}.png") for index in range(40)]
    expected = rf"damaged .*: \S*{name}: {damage}[^;]*; copy or export them again"
    view = view_of(path, (64, 48))
    assert warned(expected, load_photo, view).pixels.shape == (48, 64, 3)
    warned(expected, read_upright, path)
    with pytest.warns(UserWarning, match=expected) as caught:
        photos = load_photos([view_of(p) for p in good] + [view])
    assert [photo.pixels.shape[0] for photo in photos] == [24] * 40 + [48]
    assert len(caught) == 1
    both = f"{name}: {damage}[^;]*; \\S*m_{name}: [^;]*; copy"
    mask = with_hole(tmp_path / f"m_{name}")
    warned(both, load_photo, view_of(path, (64, 48), mask=mask))
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
