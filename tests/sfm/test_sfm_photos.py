"""Photographs for structure from motion: orientation, EXIF, transparency, names."""

import os

import cv2
import numpy as np
import pytest
from captures import exif_turn, png_chunk, save_photo
from corner_room import HEIGHT, WIDTH, corner_view, read, write_blank, write_photo

from gsjax import InputError
from gsjax.sfm.engine import count_rows
from gsjax.sfm.mapping import exif_camera, extract_features
from gsjax.sfm.photos import (
    WorkFolder,
    dataset_name,
    find_photos,
    prepare_photos,
)

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is absent")

RED = (255, 0, 0)  # a colour that the room does not have


@pytest.fixture
def work(tmp_path) -> WorkFolder:
    work = WorkFolder(tmp_path / "work")
    for folder in (work.folder, work.photos, work.masks):
        folder.mkdir()
    return work


def test_photos_are_upright_small_and_have_the_focal_length_of_exif(work, tmp_path):
    """The focal length is COLMAP's initial value; without EXIF there is none."""
    paths = [tmp_path / f"{i}.jpg" for i in range(3)]
    write_photo(paths[0], corner_view(0), 6, 32)
    write_blank(paths[1], seed=1)
    write_photo(paths[2], corner_view(1), 1, 32)
    assert exif_camera(paths[0])[0].startswith("Maker-Model")
    assert exif_camera(paths[1]) == ("", None)
    made = prepare_photos(paths, None, work, max_size=160)
    records = [photo.record for photo in made]
    for photo, path, i in zip(made[::2], paths[::2], (0, 1)):
        assert (photo.record.width, photo.record.height) == (160, 120)
        pixels = read(work.photos / photo.record.file)
        shape = {"dsize": (160, 120), "interpolation": cv2.INTER_AREA}
        wanted = cv2.resize(corner_view(i), **shape)
        assert np.corrcoef(wanted.ravel(), pixels.ravel())[0, 1] > 0.95
        assert photo.name == path.name
        assert photo.record.focal == pytest.approx(32 / 35 * 160, rel=0.05)
    assert records[0].camera == records[2].camera
    extract_features(work.database, work.photos, None, records, print)
    with pycolmap.Database.open(work.database) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        cameras = [database.read_camera(image.camera_id) for image in images]
    assert [image.name for image in images] == [record.file for record in records]
    assert [c.has_prior_focal_length for c in cameras] == [True, False, True]
    assert cameras[0].camera_id == cameras[2].camera_id
    assert cameras[0].focal_length == pytest.approx(records[0].focal)
    assert count_rows(work.database, "keypoints") == 3
    assert count_rows(tmp_path / "none.db", "keypoints") == 0


PHONE = (b"Apple", b"iPhone 12")  # its sensor is in COLMAP's table


@pytest.mark.parametrize(
    ("focal_35mm", "focal_mm", "known"),
    [
        (0, (42, 10), True),
        (0, (0, 0), False),
        (0, (5, 0), False),
        (0, (1, 10**5), False),
        (65535, (42, 10), False),
        (1, (42, 10), False),
    ],
)
def test_implausible_focal_lengths_are_ignored(tmp_path, focal_35mm, focal_mm, known):
    """COLMAP would otherwise register no photograph, or not terminate."""
    lens = {"focal_mm": focal_mm, "camera": PHONE}
    write_photo(tmp_path / "a.jpg", corner_view(), 1, focal_35mm, **lens)
    camera, focal = exif_camera(tmp_path / "a.jpg")
    assert camera.startswith("Apple-iPhone 12")
    assert (focal is not None) == known
    if focal is not None:
        assert WIDTH / 2 < focal < 2 * WIDTH


def transparent(pixels: np.ndarray, left: int, top=0, size=HEIGHT, hidden=RED):
    """Return RGBA in which a square has another colour and is transparent."""
    rgba = np.dstack([pixels, np.full(pixels.shape[:2], 255, np.uint8)])
    rgba[top : top + size, left : left + size] = (*hidden, 127)
    return rgba


@pytest.mark.parametrize("orientation", range(1, 9))
def test_transparency_is_oriented_as_the_colours(work, tmp_path, orientation):
    path = tmp_path / "a.png"
    data = save_photo(path, transparent(corner_view(), 20, 30, 90)).read_bytes()
    turn = png_chunk(b"eXIf", exif_turn(orientation))
    path.write_bytes(data[:33] + turn + data[33:])
    (made,) = prepare_photos([path], None, work, 0)
    pixels = read(work.photos / made.record.file)
    if int(cv2.__version__.split(".")[0]) >= 5:  # older versions rotate no PNG
        assert (pixels.shape[0] > pixels.shape[1]) == (orientation > 4)
    red = (pixels == RED).all(-1)
    assert red.sum() == 90 * 90
    grown = cv2.dilate(red.astype(np.uint8), np.ones((5, 5))) > 0
    np.testing.assert_array_equal(read(work.mask(made.record.file)) == 0, grown)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".webp"])
def test_no_pixel_mixes_with_transparent_colours(work, tmp_path, suffix):
    """Pixels outside the mask do not depend on hidden colours, even if scaled down."""
    seen = []
    for hidden in (RED, (0, 0, 255)):
        rgba = transparent(corner_view(), 21, 33, 90, hidden)
        encoding = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
        path = tmp_path / f"photo{suffix}"
        cv2.imwrite(str(path), rgba[..., [2, 1, 0, 3]], encoding)
        (made,) = prepare_photos([path], None, work, 150)
        assert made.mask
        mask = read(work.mask(made.record.file))
        assert 0.05 < (mask == 0).mean() < 0.2
        pixels = read(work.photos / made.record.file)
        seen.append(np.where(mask[..., None] > 0, pixels, 0))
    np.testing.assert_array_equal(*seen)


def test_masks_and_transparency_are_combined(work, tmp_path):
    masks = tmp_path / "drawn"
    masks.mkdir()
    plain = corner_view()
    opaque = np.dstack([plain, np.full(plain.shape[:2], 128, np.uint8)])
    paths = [
        save_photo(tmp_path / "both.png", transparent(plain, 0, 0, 50)),
        save_photo(tmp_path / "alpha.png", transparent(plain, 0, 0, 50)),
        save_photo(tmp_path / "opaque.png", opaque),
        save_photo(tmp_path / "deep.png", opaque.astype(np.uint16) * 257),
    ]
    drawn = np.full((HEIGHT, WIDTH), 255, np.uint8)
    drawn[:, -60:] = 0
    cv2.imwrite(str(masks / "both.png"), (drawn > 0).astype(np.uint16))
    made = prepare_photos(paths, masks, work, 0)
    assert [photo.mask for photo in made] == [True, True, False, False]
    both, alpha, *others = (read(work.mask(photo.record.file)) for photo in made)
    np.testing.assert_array_equal(both, np.minimum(alpha, drawn))
    assert (alpha == 0).sum() == 52 * 52
    assert all((mask == 255).all() for mask in others)  # COLMAP expects one of each


def test_photos_are_in_natural_order_and_named_in_utf_8(tmp_path):
    names = [f"frame{i}.jpg" for i in range(8, 13)]
    for name in sorted(names):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in find_photos(tmp_path)] == names
    (tmp_path / os.fsdecode(b"caf\xe9.png")).write_bytes(b"")
    with pytest.raises(InputError, match=r"caf\\udce9.png.*UTF-8"):
        find_photos(tmp_path)


def test_photos_of_folders_are_found_and_named_by_their_place(tmp_path):
    names = ["2.jpg", "10.jpg", "left/1.heic", "left/deep/1.cr.tif", "right/1.AVIF"]
    others = ["masks/2.png", ".trash/3.jpg", "old/images/2.jpg", "mine/2.png"]
    for name in names + others:
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "old" / "sfm.json").write_bytes(b"")
    found = find_photos(tmp_path, [tmp_path / "mine"])
    assert [p.relative_to(tmp_path).as_posix() for p in found] == names
    assert [dataset_name(path, tmp_path) for path in found] == [
        *names[:2],
        "left/1.jpg",
        "left/deep/1.cr.png",
        "right/1.jpg",
    ]
