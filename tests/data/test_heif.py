"""HEIC and AVIF: size, turns and pixels, against Pillow."""

import io
import sys

import cv2
import numpy as np
import pytest
from conftest import DATA
from PIL import Image, ImageOps

from gsjax import InputError
from gsjax.data.decode import decode
from gsjax.data.image_header import image_size
from gsjax.errors import MissingExtraError

HEIC = DATA / "captures" / "heic"
SAMPLES = ("iphone8plus_orientation6", "libheif_example", "sony_exif_gray_64px")


def corners() -> np.ndarray:
    """Return [48, 64, 3] with red, green, blue and white corners."""
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:24, :32], pixels[:24, 32:] = (255, 0, 0), (0, 255, 0)
    pixels[24:, :32], pixels[24:, 32:] = (0, 0, 255), 255
    return pixels


def avif(orientation: int) -> bytes:
    turn, stream = Image.Exif(), io.BytesIO()
    turn[274] = orientation
    image = Image.fromarray(corners())
    image.save(stream, "AVIF", exif=turn.tobytes(), quality=95)
    return stream.getvalue()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_avif_is_upright(tmp_path, orientation):
    path, data = tmp_path / "a.avif", avif(orientation)
    path.write_bytes(data)
    wanted = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(data))))
    assert image_size(path) == wanted.shape[1::-1]
    for flags in (cv2.IMREAD_COLOR, cv2.IMREAD_UNCHANGED):
        np.testing.assert_array_equal(decode(path, flags)[..., ::-1], wanted)


@pytest.mark.parametrize("name", SAMPLES)
def test_heic_is_upright_once(name):
    """EXIF also has the turn, which the decoder has applied."""
    pytest.importorskip("pillow_heif", reason="needs gsjax[heic]")
    if not HEIC.is_dir():
        pytest.skip("the captures are absent")
    path = HEIC / f"{name}.heic"
    pixels = decode(path, cv2.IMREAD_COLOR)
    assert image_size(path) == pixels.shape[1::-1]
    grey = decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    assert grey.shape == pixels.shape[:2]
    small = HEIC / f"{name}_upright_small.jpg"
    if small.exists():
        wanted = cv2.imread(str(small))
        size = wanted.shape[1::-1]
        found = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.99


def test_a_missing_decoder_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    path = tmp_path / "a.heic"
    path.write_bytes(avif(1).replace(b"avif", b"heic"))
    with pytest.raises(MissingExtraError, match=r"pip install .gsjax\[heic\]"):
        decode(path, cv2.IMREAD_COLOR)


@pytest.mark.parametrize("kind", ["avif", "heic"])
def test_every_prefix_is_rejected(tmp_path, kind):
    """Or decodes to the whole picture."""
    if kind == "heic":
        pytest.importorskip(
            "pillow_heif", reason="needs gsjax[heic]"
        ).register_heif_opener()
    stream = io.BytesIO()
    Image.fromarray(corners()).save(stream, "HEIF" if kind == "heic" else "AVIF")
    data, path = stream.getvalue(), tmp_path / f"a.{kind}"
    path.write_bytes(data)
    assert decode(path, cv2.IMREAD_COLOR).shape == (48, 64, 3)
    for end in range(1, len(data), 7):
        path.write_bytes(data[:end])
        with pytest.raises(InputError):
            decode(path, cv2.IMREAD_COLOR)


@pytest.mark.parametrize("form", ["JPEG", "TIFF"])
def test_colours_of_inks_are_rejected(tmp_path, form):
    path = tmp_path / "a"
    Image.new("CMYK", (8, 8)).save(path, form)
    with pytest.raises(InputError, match=r"CMYK.*sRGB"):
        decode(path, cv2.IMREAD_COLOR)
