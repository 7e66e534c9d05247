"""Datasets as a whole: formats, positions, names, splits; and the format of LLFF."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from captures import (
    PIXELS,
    SIZE,
    colmap_dataset,
    dataset_of_views,
    frames_of,
    llff_dataset,
    nerfstudio_dataset,
    rejects,
    save_photo,
    with_names,
    write_transforms,
)

from gsjax import look_at
from gsjax.cameras.camera import NEAR
from gsjax.data.colmap import read_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import is_dataset, load_dataset
from gsjax.data.extent import extent_of, near_plane, scene_extent
from gsjax.data.llff import read_poses
from gsjax.data.photos import load_photo
from gsjax.data.readers import READERS
from gsjax.data.rebase import far_origin
from gsjax.data.splits import split_views
from gsjax.data.transforms import load_near_transforms
from gsjax.data.types import Reader, ReadOptions
from gsjax.errors import InputError


def transforms(folder, dataset=None, name="transforms.json", **content):
    """A camera list without sizes, with photographs."""
    dataset = dataset_of_views() if dataset is None else dataset
    frames = frames_of(dataset, "images/view_{:02d}.png")
    for frame in frames:
        save_photo(folder / frame["file_path"])
    write_transforms(folder, frames, name, camera_angle_x=0.7, **content)


@pytest.mark.parametrize(("far", "expected"), [(1e29, "is at -1.4"), (1e9, "is 1.7")])
def test_an_outlier_is_named(tmp_path, far, expected):
    dataset = dataset_of_views()
    dataset.views[2].viewmat[:3, 3] += far
    transforms(tmp_path, dataset)
    rejects(rf"of 'images/view_02.png' {expected}", load_dataset, tmp_path)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_cameras_that_are_all_too_far_are_rejected(tmp_path, count):
    transforms(tmp_path, dataset_of_views(count=count, at=(0, 3e20, 0)))
    rejects(r"is at .*3e\+20, .* at most 1e\+15", load_dataset, tmp_path)


def test_cameras_on_a_tripod_and_one_elsewhere_are_read(tmp_path):
    dataset = dataset_of_views()
    for k, view in enumerate(dataset.views[1:]):
        position = np.array([4.0, 5, 6]) + k * 1e-15
        view.viewmat[:3, 3] = -view.viewmat[:3, :3] @ position
    transforms(tmp_path, dataset)
    assert len(load_dataset(tmp_path).views) == 5


@pytest.mark.parametrize("points", [0, 200])
@pytest.mark.parametrize("at", [(0, 0, 0), (1.3, 2.1, 0.7), (1e3, 2e3, 5), (1e6, 0, 5)])
def test_cameras_on_a_tripod_coincide(tmp_path, at, points):
    """Also where rounding is all that is left of their coordinates."""
    dataset, rng = dataset_of_views(points=points, at=at), np.random.default_rng(1)
    turns = [look_at(at, np.add(at, rng.normal(size=3))) for _ in dataset.views]
    views = [replace(v, viewmat=m) for v, m in zip(dataset.views, turns)]
    colmap_dataset(tmp_path, replace(dataset, views=tuple(views)))
    loaded, size = load_dataset(tmp_path), max(1, *at)
    rounded, centres = (
        np.stack([view.centre for view in some]) for some in (views, loaded.views)
    )
    assert np.abs(centres + loaded.origin - at).max() <= 1e-12 * size
    for each in (rounded, centres):
        assert scene_extent(each) == 1.0
        assert near_plane(each) == NEAR
    assert scene_extent(rounded + 1e-6 * size * np.eye(5, 3)) < 1e-5 * size
    extent = extent_of(loaded)
    assert extent == 1.0 if not points else 0.01 < extent < 1


def test_order_of_formats(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((0, 17)))
    (tmp_path / "images").mkdir()
    rejects("expected at least 1 view, got none", load_dataset, tmp_path)
    transforms(tmp_path, name="transforms_train.json")
    assert load_dataset(tmp_path).views[0].split == "train"
    # nerfstudio's list precedes its model, whose poses it aligned.
    (tmp_path / "transforms_train.json").unlink()
    colmap_dataset(tmp_path, place="colmap/sparse/0")
    assert load_dataset(tmp_path).format == "colmap"
    transforms(tmp_path)
    dataset = load_dataset(str(tmp_path))
    assert (dataset.format, dataset.views[0].split) == ("transforms", None)
    colmap_dataset(tmp_path)
    assert load_dataset(tmp_path).format == "colmap"
    assert load_dataset(tmp_path / "transforms.json").format == "transforms"


def test_a_reader_from_outside(tmp_path):
    """Its dataset is checked and translated as any other."""
    made = dataset_of_views(3, at=(1e6, 0, 0))
    seen = []

    def load(*given):
        seen.append(given)
        return replace(made, views=made.views[::-1], format="mine")

    mine = Reader("mine", lambda path: (path / "mine.txt").exists(), load)
    (tmp_path / "mine.txt").touch()
    assert not is_dataset(tmp_path)
    assert is_dataset(tmp_path, (*READERS, mine))
    found = load_dataset(tmp_path, factor=2, readers=(*READERS, mine))
    assert seen == [(tmp_path, ReadOptions(factor=2))]
    assert found.format == "mine"
    assert [view.name for view in found.views] == [view.name for view in made.views]
    assert found.origin[0] > 9e5
    colmap_dataset(tmp_path)
    assert load_dataset(tmp_path, readers=(*READERS, mine)).format == "colmap"
    assert load_dataset(tmp_path, readers=(mine, *READERS)).format == "mine"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("", r"expected sparse/0 of COLMAP.*got IMG_1\.JPG.*gsjax sfm"),
        ("none", r"none: does not exist"),
        ("IMG_1.JPG", r"IMG_1\.JPG: expected the folder of a dataset"),
        ("a" * 5000, "a: File name too long; check the path"),
    ],
)
def test_paths_that_are_no_dataset(tmp_path, name, expected):
    (tmp_path / "IMG_1.JPG").write_bytes(b"")
    rejects(expected, load_dataset, tmp_path / name)


def masked_dataset(folder):
    frames = frames_of(dataset_of_views(5), "images/frame_{}.png")
    frames[0]["mask_path"] = "masks/none.png"
    nerfstudio_dataset(folder, frames=frames)


@pytest.mark.parametrize(
    "make", [colmap_dataset, masked_dataset, lambda folder: llff_dataset(folder, 5)]
)
def test_poses_need_no_photographs(tmp_path, make):
    """They are the same with all, some or none of them, or their folder, present."""
    make(tmp_path)
    images = sorted((tmp_path / "images").iterdir())
    whole = load_dataset(tmp_path, poses_only=True)
    assert len(whole.views) == 5
    for path in (*images[1:3], *images[:1], *images[3:], tmp_path / "images"):
        path.rmdir() if path.is_dir() else path.unlink()
        with pytest.raises(InputError):
            load_dataset(tmp_path, skip_missing=path == tmp_path / "images")
        bare = load_dataset(tmp_path, poses_only=True)
        for view, full in zip(bare.views, whole.views, strict=True):
            assert (view.width, view.height) == (full.width, full.height)
            assert (view.lens, view.mask) == (full.lens, None)
            np.testing.assert_array_equal(view.viewmat, full.viewmat)
            np.testing.assert_array_equal(view.K, full.K)
        np.testing.assert_array_equal(bare.points, whole.points)


def test_without_photographs_a_list_needs_sizes(tmp_path):
    transforms(tmp_path)
    load_dataset(tmp_path, poses_only=True)
    (tmp_path / "images/view_00.png").unlink()
    expected = r"w and h are missing, and .*view_00\.png"
    rejects(expected, load_dataset, tmp_path, poses_only=True)


def colmap_of(folder, names):
    (folder / "images").mkdir(parents=True)
    write_colmap(folder / "sparse/0", with_names(dataset_of_views(), names))


def transforms_of(folder, names):
    frames = frames_of(dataset_of_views())
    frames = [{**frame, "file_path": name} for frame, name in zip(frames, names)]
    write_transforms(folder, frames, **PIXELS)


@pytest.mark.parametrize("write", [colmap_of, transforms_of])
@pytest.mark.parametrize(
    "form", ["/data/{}", "../photos/{}", "C:\\photos\\{}", "a/../../{}"]
)
def test_names_that_leave_the_dataset_are_not_followed(tmp_path, write, form):
    """With ``images`` they are searched within that folder."""
    folder, elsewhere = tmp_path / "data", tmp_path / "photos"
    names = [f"a/{index}.png" for index in range(5)]
    files = [save_photo(elsewhere / name) for name in names]
    write(folder, [form.format(name) for name in names])
    rejects("within the dataset.* pass images=.*--images", load_dataset, folder)
    rejects("5 of 5 photographs are missing", load_dataset, folder, images=folder)
    for images in (str(elsewhere), elsewhere, "../photos"):
        views = load_dataset(folder, images=images).views
        assert [view.name for view in views] == names
        assert [view.image.resolve() for view in views] == files
    poses = load_dataset(folder, poses_only=True).views
    assert [view.image.name for view in poses] == [file.name for file in files]
    elsewhere.rename(folder / "moved")
    [first, *_] = load_dataset(folder, images="moved").views
    assert first.name == ("a/0.png" if write is colmap_of else "moved/a/0.png")
    missing = {"images": elsewhere, "skip_missing": True}
    rejects(f"{elsewhere}: no such folder", load_dataset, folder, **missing)
    for bad in ("..", "/"):
        other = tmp_path / f"of {len(bad)}"
        write(other, [bad, *names[1:]])
        expected = "expected the name of a file within"
        rejects(expected, load_dataset, other, images=folder / "moved")


def test_names_are_sorted_and_unique(tmp_path):
    names = ["b.png", "a.png", "B.png", "a/a.png", "a10.png"]
    colmap_dataset(tmp_path, with_names(dataset_of_views(), names))
    found = [view.name for view in load_dataset(tmp_path).views]
    assert found == sorted(names)
    twice = with_names(dataset_of_views(), [*names[:3], "b.png", *names[4:]])
    write_colmap(tmp_path / "sparse/0", twice, overwrite=True)
    rejects(r"'b\.png' is listed more than once", load_dataset, tmp_path)
    # Two names of one photograph: one view would be trained on that of the other.
    twice = with_names(dataset_of_views(), ["a.jpg", *names[:4]])
    write_colmap(tmp_path / "sparse/0", twice, overwrite=True)
    rejects(r"a\.jpg and a\.png are one photograph in", load_dataset, tmp_path)
    save_photo(tmp_path / "images/a.jpg")
    assert len(load_dataset(tmp_path).views) == 5


@pytest.mark.parametrize("make", [colmap_dataset, nerfstudio_dataset, llff_dataset])
def test_smaller_copies(tmp_path, make):
    """The size stays that of the originals; suffixes may differ."""
    make(tmp_path)
    whole = load_dataset(tmp_path).views
    for factor in (0, -2, 1.5):
        rejects("factor: expected a whole", load_dataset, tmp_path, factor=factor)
    expected = r"images_4: no such folder.*has the folders"
    rejects(expected, load_dataset, tmp_path, factor=4)
    small = np.zeros((6, 8, 3), np.uint8)
    copies = [tmp_path / "images_4" / view.image.name for view in whole]
    copies = [save_photo(path.with_suffix(".tiff"), small) for path in copies]
    for options in ({"factor": 4}, {"images": "images_4"}):
        views = load_dataset(tmp_path, **options).views
        assert [view.image for view in views] == copies
        for view, full in zip(views, whole):
            assert view.name == full.name or make is not colmap_dataset
            assert (view.width, view.height) == (full.width, full.height)
            np.testing.assert_array_equal(view.K, full.K)
            np.testing.assert_allclose(load_photo(view).K[:2], full.K[:2] / 4)
    rejects(r"images_8: no such folder.* factor=4 ", load_dataset, tmp_path, factor=8)
    for name in ("images_16", "images_old", "images_8", "images_1"):
        (tmp_path / name).mkdir()
    (tmp_path / "images").rename(tmp_path / "originals")
    if make is not nerfstudio_dataset:  # which lists their folder
        expected = r"images: no such.* factor=4 \(--factor 4\), as images_4 .*images="
        rejects(expected, load_dataset, tmp_path)


def in_camera(viewmat, points):
    return points @ viewmat[:3, :3].T + viewmat[:3, 3]


@pytest.mark.parametrize(
    "at",
    [
        (500_123.4, 5_712_345.6, 118.2), (0, 0, -7e6), (1e7, 1e7, 1e7), (3e3, 0, 0),
        (40, -30, 3),  # near: not translated
    ],
)  # fmt: skip
def test_far_datasets_are_translated_and_restored(tmp_path, at):
    made = dataset_of_views(at=np.asarray(at, np.float64), points=500)
    colmap_dataset(tmp_path, made)
    dataset = load_dataset(tmp_path)
    shifted = dataset.origin != 0
    far = np.abs(at).max() > 100
    np.testing.assert_array_equal(shifted, (np.asarray(at) != 0) & far)
    assert np.abs(dataset.points[:, shifted]).max(initial=0) < 10
    # Bit for bit, also after writing.
    np.testing.assert_array_equal(dataset.points + dataset.origin, made.points)
    write_colmap(tmp_path / "again", dataset)
    again = read_colmap(tmp_path / "again").points.xyz
    np.testing.assert_array_equal(again, made.points)
    for view, given in zip(dataset.views, made.views):
        centre, atol = view.centre + dataset.origin, 1e-15 * np.abs(at).max()
        np.testing.assert_allclose(centre, given.centre, atol=atol)
        rotations = view.viewmat[:3, :3], given.viewmat[:3, :3]
        np.testing.assert_allclose(*rotations, atol=1e-14)
    # A camera sees the same, in float32 too; also one of a list without points.
    entries, origin = load_near_transforms(
        write_transforms(tmp_path, frames_of(made), **PIXELS)
    )
    place = np.asarray(at)
    assert (np.abs(origin - place)[np.abs(place) > 1e3] < 100).all()
    assert (origin[place == 0] == 0).all()
    seen = in_camera(made.views[0].viewmat, made.points)
    for viewmat, moved in (
        (dataset.views[0].viewmat, dataset.origin),
        (entries[0].camera.viewmat, origin),
    ):
        found = in_camera(np.float32(viewmat), np.float32(made.points - moved))
        atol = max(1e-5, 4e-7 * np.abs(place - moved).max())
        np.testing.assert_allclose(found, seen, atol=atol)


def test_origins_have_few_bits_and_ignore_outliers():
    rng = np.random.default_rng(0)
    none = np.zeros((0, 3))
    for size in (1e-3, 1.0, 40.0):
        centres = rng.normal(size=(9, 3)) * size + (1e6, -3e6, 0)
        origin = far_origin(centres, none)
        assert (origin[:2] != 0).all()
        assert origin[2] == 0
        assert np.abs(origin - np.median(centres, axis=0))[:2].max() < 16 * size
        assert (np.float32(origin) == origin).all() or size < 0.1
    for single in (0.0, 12.0):
        assert not far_origin(np.full((1, 3), single), none).any()
    assert (np.abs(far_origin(np.full((1, 3), 1e7), none) - 1e7) < 100).all()
    points = rng.normal(size=(1000, 3))
    points[::10] *= 1e9
    centres = rng.normal(size=(9, 3))
    assert not far_origin(centres, points).any()
    assert (far_origin(centres + 1e5, points + 1e5) != 0).all()


def test_llff(tmp_path):
    made = llff_dataset(tmp_path)
    # macOS puts a hidden file beside each one that it copies to a foreign disk.
    (tmp_path / "images/._IMG_9.JPG").write_bytes(b"\0\5\x16\7")
    (tmp_path / "images/notes.txt").write_text("not a photograph")
    dataset = load_dataset(tmp_path)
    assert dataset.format == "llff"
    assert [v.name for v in dataset.views] == [f"IMG_{n}.JPG" for n in (6, 7, 8, 9)]
    for view, given in zip(dataset.views, made.views):
        np.testing.assert_allclose(view.viewmat, given.viewmat, atol=1e-14)
        assert np.linalg.det(view.viewmat) > 0.999
        assert (view.width, view.height) == SIZE
        np.testing.assert_array_equal(view.K, [[40, 0, 16], [0, 40, 12], [0, 0, 1]])
    assert dataset.points.shape == (0, 3)
    np.testing.assert_array_equal(dataset.origin, 0)
    assert len(load_dataset(tmp_path / "poses_bounds.npy").views) == 4


def test_a_camera_of_llff_at_the_origin(tmp_path):
    # Down, right, back = −y, x, z: OpenGL's camera at the origin, looking along −z.
    row = [0, 1, 0, 0, 24, -1, 0, 0, 0, 32, 0, 0, 1, 0, 40, 1, 2]
    np.save(tmp_path / "poses_bounds.npy", np.asarray([row], np.float64))
    save_photo(tmp_path / "images" / "a.png")
    [view] = load_dataset(tmp_path).views
    np.testing.assert_allclose(view.viewmat, np.diag([1, -1, -1, 1]), atol=1e-15)


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        (3, 1e35, "finite numbers"),
        (4, 0, ".* got 0, 32"),
        (9, 3.5, ".* got 24, 3.5"),
        (14, -1, ".*focal lengths .* got -1, -1"),
        (14, 1e20, ".*focal lengths .* got 1e[+]20"),
        (0, 9.0, "a rotation"),
    ],
)
def test_bad_values_of_llff(tmp_path, column, value, expected):
    llff_dataset(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    rows = np.load(path)
    rows[2, column] = value
    np.save(path, rows)
    rejects(rf"poses_bounds\.npy: row 2: expected {expected}", load_dataset, tmp_path)


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_forms_of_the_file_of_llff(tmp_path, dtype, order, version):
    table = np.random.default_rng(0).normal(size=(5, 17)).astype("<f4").astype(dtype)
    path = tmp_path / "a.npy"
    with path.open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions that old NumPy does not read
        array = np.asarray(table, order=order)
        np.lib.format.write_array(file, array, version=version)
    found = read_poses(path)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, np.load(path))
    path.write_bytes(path.read_bytes() + b"\0")
    rejects("header", read_poses, path)


NAMES = [f"img_{n:02d}.jpg" for n in range(20)]


def views_of(names, splits=None):
    views = with_names(dataset_of_views(len(names)), names).views
    return [replace(v, split=s) for v, s in zip(views, splits or [None] * len(names))]


SPLIT = views_of(NAMES[:4], ["train", "test", "train", "test"])
FOLDERS = views_of(["a/1.png", "a/2.png", "b/1.png", "1.png"])


@pytest.mark.parametrize(
    ("views", "options", "test"),
    [
        (views_of(NAMES), {}, [3, 10, 16]),
        (views_of(NAMES), {"every": 8}, [0, 8, 16]),
        (views_of(NAMES), {"every": 0}, []),
        (views_of(NAMES[::-1]), {}, [3, 9, 16]),  # in the order of names
        (views_of(NAMES[:1]), {}, []),
        (views_of(NAMES[:2]), {}, [1]),
        (views_of(NAMES[:8]), {}, [4]),  # not at an end
        (SPLIT, {}, [1, 3]),
        (SPLIT, {"every": 3}, [0, 3]),
        (SPLIT, {"every": 0}, []),
        (SPLIT, {"test_names": [NAMES[0]]}, [0]),
        # A dataset without test views, as one without any split.
        (views_of(NAMES, ["train"] * 20), {}, [3, 10, 16]),
        (views_of(NAMES, ["train"] * 19 + [None]), {"every": 5}, [0, 5, 10, 15]),
        (views_of(NAMES), {"test_names": NAMES[5:7]}, [5, 6]),
        (views_of(NAMES), {"test_names": NAMES[5]}, [5]),  # not its letters
        (FOLDERS, {"test_names": ["2.png"]}, [1]),
        (FOLDERS, {"test_names": ["1.png", "b/1.png"]}, [2, 3]),
    ],
)
def test_splits(views, options, test):
    train = [index for index in range(len(views)) if index not in test]
    assert split_views(views, **options) == (train, test)


@pytest.mark.parametrize(
    ("views", "options", "expected"),
    [
        (FOLDERS[:3], {"test_names": ["1.png"]}, r"ambiguous among a/1\.png, b/1\.png"),
        (views_of(NAMES), {"test_names": ["img_5.jpg"]}, r"pass one of .*img_05\.jpg"),
        (views_of(NAMES), {"test_names": ["xyz"]}, r"20 such as img_00\.jpg"),
        (views_of(NAMES), {"every": -1}, "every: expected 0 .* got -1"),
        (views_of(NAMES), {"every": 1}, "all 20 views are test views"),
        (views_of(NAMES), {"every": 2.5}, "every.*2.5"),
        ([], {}, "views: expected at least one"),
    ],
)
def test_bad_splits(views, options, expected):
    rejects(expected, split_views, views, **options)
