"""Datasets as a whole: precedence of formats, positions, and coordinates far from 0."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import (
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
from gsjax.data.colmap import read_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import is_dataset, load_dataset
from gsjax.data.extent import extent_of, scene_extent
from gsjax.data.readers import READERS
from gsjax.data.rebase import far_origin
from gsjax.data.types import Reader
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
    loaded = load_dataset(tmp_path)
    centres = np.stack([view.centre for view in loaded.views])
    apart = np.abs(centres + loaded.origin - at).max()
    assert apart <= 1e-12 * max(1, np.abs(at).max())
    assert scene_extent(centres) == 1.0
    extent = extent_of(loaded)
    assert extent == 1.0 if not points else 0.01 < extent < 1


def test_order_of_formats(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((0, 17)))
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
    made = dataset_of_views(3, at=(1e6, 0, 0))
    seen = []

    def load(path: Path, options):
        seen.append((path, options))
        return replace(made, views=made.views[::-1], format="mine")

    mine = Reader("mine", lambda path: (path / "mine.txt").exists(), load)
    (tmp_path / "mine.txt").touch()
    assert not is_dataset(tmp_path)
    assert is_dataset(tmp_path, (*READERS, mine))
    found = load_dataset(tmp_path, factor=2, readers=(*READERS, mine))
    assert found.format == "mine"
    assert [view.name for view in found.views] == [view.name for view in made.views]
    assert found.origin[0] > 9e5  # checked and translated as any other
    [(path, options)] = seen
    assert (path, options.factor, options.poses_only) == (tmp_path, 2, False)
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
    with pytest.raises(InputError, match=r"w and h are missing, and .*view_00\.png"):
        load_dataset(tmp_path, poses_only=True)


def test_names_are_sorted_and_unique(tmp_path):
    names = ["b.png", "a.png", "B.png", "a/a.png", "a10.png"]
    colmap_dataset(tmp_path, with_names(dataset_of_views(), names))
    found = [view.name for view in load_dataset(tmp_path).views]
    assert found == sorted(names)
    twice = with_names(dataset_of_views(), [*names[:3], "b.png", *names[4:]])
    write_colmap(tmp_path / "sparse/0", twice, overwrite=True)
    rejects(r"'b\.png' is listed more than once", load_dataset, tmp_path)


def test_two_names_of_one_photograph(tmp_path):
    """Else one view would be trained on the photograph of the other."""
    twice = with_names(dataset_of_views(count=2), ("a.jpg", "a.png"))
    write_colmap(tmp_path / "sparse", twice)
    save_photo(tmp_path / "images/a.png")
    rejects(r"a\.jpg and a\.png are one photograph in", load_dataset, tmp_path)
    save_photo(tmp_path / "images/a.jpg")
    assert len(load_dataset(tmp_path).views) == 2


PLACES = [(500_123.4, 5_712_345.6, 118.2), (0, 0, -7e6), (1e7, 1e7, 1e7), (3e3, 0, 0)]


@pytest.mark.parametrize("at", PLACES)
def test_far_datasets_are_translated_and_restored(tmp_path, at):
    made = dataset_of_views(at=np.asarray(at, np.float64), points=500)
    colmap_dataset(tmp_path, made)
    dataset = load_dataset(tmp_path)
    shifted = dataset.origin != 0
    np.testing.assert_array_equal(shifted, np.asarray(at) != 0)
    assert np.abs(dataset.points[:, shifted]).max() < 10
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
    # A camera sees the same, in float32 too.
    view, given = dataset.views[0], made.views[0]
    seen = made.points @ given.viewmat[:3, :3].T + given.viewmat[:3, 3]
    viewmat = view.viewmat.astype(np.float32)
    points = dataset.points.astype(np.float32)
    found = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    np.testing.assert_allclose(found, seen, atol=1e-5)


def test_near_datasets_keep_their_coordinates(tmp_path):
    made = colmap_dataset(tmp_path, dataset_of_views(at=np.asarray([40.0, -30, 3])))
    dataset = load_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.origin, 0)
    np.testing.assert_array_equal(dataset.points, made.points)


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
    points = rng.normal(size=(1000, 3))
    points[::10] *= 1e9
    centres = rng.normal(size=(9, 3))
    assert not far_origin(centres, points).any()
    assert (far_origin(centres + 1e5, points + 1e5) != 0).all()
