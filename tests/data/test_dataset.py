"""Datasets as a whole: what is taken for what, far scenes, and splits."""

import json
from dataclasses import replace

import numpy as np
import pytest
from captures import save_photo, scene_of_views, to_opengl

from gsjax import look_at
from gsjax.data.colmap import read_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import load_dataset
from gsjax.data.extent import extent_of, scene_extent
from gsjax.data.rebase import far_origin
from gsjax.data.splits import split_views
from gsjax.data.types import View
from gsjax.errors import InputError


def colmap(folder, **more):
    scene = scene_of_views(**more)
    write_colmap(folder / "sparse/0", scene)
    for view in scene.views:
        save_photo(folder / "images" / view.name)
    return scene


def transforms(folder, scene=None, name="transforms.json"):
    scene = scene_of_views() if scene is None else scene
    frames = []
    for view in scene.views:
        path = save_photo(folder / "images" / view.name)
        matrix = to_opengl(view.viewmat).tolist()
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": matrix})
    (folder / name).write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))


# --- poses that cannot be ---


@pytest.mark.parametrize(("far", "told"), [(1e29, "at -1.4"), (1e9, "1.7")])
def test_a_camera_at_the_end_of_the_world_is_named(tmp_path, far, told):
    scene = scene_of_views()
    view = scene.views[2]
    viewmat = view.viewmat.copy()
    viewmat[:3, 3] += far
    views = [*scene.views[:2], replace(view, viewmat=viewmat), *scene.views[3:]]
    transforms(tmp_path, replace(scene, views=tuple(views)))
    with pytest.raises(InputError, match=rf"of 'images/{view.name}' stands {told}"):
        load_dataset(tmp_path)


def test_cameras_on_a_tripod_and_one_elsewhere_are_read(tmp_path):
    """Of which all but one stand in one place, but for rounding."""
    scene = scene_of_views()
    first, *others = scene.views
    views = [first]
    for k, view in enumerate(others):
        viewmat = view.viewmat.copy()
        viewmat[:3, 3] = -viewmat[:3, :3] @ (np.array([4.0, 5, 6]) + k * 1e-15)
        views.append(replace(view, viewmat=viewmat))
    transforms(tmp_path, replace(scene, views=tuple(views)))
    assert len(load_dataset(tmp_path).views) == len(views) > 2


@pytest.mark.parametrize("points", [0, 200])
@pytest.mark.parametrize(
    "at", [(0, 0, 0), (1.3, 2.1, 0.7), (1e3, 2e3, 5), (1e6, 2e6, 5)]
)
def test_cameras_on_a_tripod_are_in_one_place(tmp_path, at, points):
    """Also where rounding is all that is left of their coordinates."""
    scene, rng = scene_of_views(points=points, at=at), np.random.default_rng(1)
    turns = [look_at(at, np.add(at, rng.normal(size=3))) for _ in scene.views]
    views = [replace(v, viewmat=m) for v, m in zip(scene.views, turns)]
    scene = replace(scene, views=tuple(views))
    write_colmap(tmp_path / "sparse/0", scene)
    for view in scene.views:
        save_photo(tmp_path / "images" / view.name)
    loaded = load_dataset(tmp_path)
    centres = np.stack([view.centre for view in loaded.views])
    apart = np.abs(centres + loaded.origin - at).max()
    assert apart <= 1e-12 * max(1, np.abs(at).max())
    assert scene_extent(centres) == 1.0
    extent = extent_of(loaded)
    assert extent == 1.0 if not points else 0.01 < extent < 1


@pytest.mark.parametrize("count", [1, 2, 5])
def test_cameras_all_too_far_are_refused(tmp_path, count):
    transforms(tmp_path, scene_of_views(count=count, at=(0, 3e20, 0)))
    with pytest.raises(InputError, match=r"stands at .*3e\+20, .* at most 1e\+15"):
        load_dataset(tmp_path)


def test_names_that_the_system_does_not_take(tmp_path):
    transforms(tmp_path)
    with pytest.raises(InputError, match="a: File name too long; check the path"):
        load_dataset(tmp_path / ("a" * 5000))
    with pytest.raises(InputError, match="File name too long"):
        load_dataset(tmp_path, images="a" * 5000)


# --- what is taken for what ---


def test_order_of_formats(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((0, 17)))
    transforms(tmp_path, name="transforms_train.json")
    assert load_dataset(tmp_path).views[0].split == "train"
    transforms(tmp_path)
    scene = load_dataset(str(tmp_path))
    assert (scene.format, scene.views[0].split) == ("transforms", None)
    colmap(tmp_path)
    assert load_dataset(tmp_path).format == "colmap"
    assert load_dataset(tmp_path / "transforms.json").format == "transforms"


def test_the_list_of_nerfstudio_goes_before_its_model(tmp_path):
    """Which is of the photographs before it straightened the scene."""
    scene = scene_of_views()
    write_colmap(tmp_path / "colmap/sparse/0", scene)
    for view in scene.views:
        save_photo(tmp_path / "images" / view.name)
    assert load_dataset(tmp_path).format == "colmap"
    transforms(tmp_path)
    assert load_dataset(tmp_path).format == "transforms"


def test_nothing_known(tmp_path):
    (tmp_path / "IMG_1.JPG").write_bytes(b"")
    with pytest.raises(
        InputError, match=r"IMG_1\.JPG\).*sparse/0 of COLMAP.*gsjax sfm"
    ):
        load_dataset(tmp_path)
    with pytest.raises(InputError, match=r"none: does not exist"):
        load_dataset(tmp_path / "none")
    with pytest.raises(InputError, match=r"IMG_1\.JPG: pass the folder"):
        load_dataset(tmp_path / "IMG_1.JPG")


def test_one_view(tmp_path):
    colmap(tmp_path, count=1, points=0)
    scene = load_dataset(tmp_path)
    assert len(scene.views) == 1
    assert scene.points.shape == (0, 3)


def as_llff(folder):
    scene = scene_of_views()
    rows = []
    for view in scene.views:
        right, down, forward = view.viewmat[:3, :3]
        size = np.asarray([24, 32, 40.0])
        matrix = np.stack([down, right, -forward, view.centre, size], -1)
        rows.append([*matrix.ravel(), 1, 9])
        save_photo(folder / "images" / view.name)
    np.save(folder / "poses_bounds.npy", np.asarray(rows))


def as_transforms(folder):
    transforms(folder)
    path = folder / "transforms.json"
    told = json.loads(path.read_text())
    told["frames"][0]["mask_path"] = "masks/none.png"
    path.write_text(json.dumps({**told, "w": 32, "h": 24}))


@pytest.mark.parametrize("make", [colmap, as_transforms, as_llff])
def test_poses_want_no_photographs(tmp_path, make):
    """They are the same with all, some or none of them, or their folder, there."""
    make(tmp_path)
    images = sorted((tmp_path / "images").iterdir())
    whole = load_dataset(tmp_path, poses_only=True)
    assert len(whole.views) == 5
    for path in (*images[1:3], *images[:1], *images[3:], tmp_path / "images"):
        path.rmdir() if path.is_dir() else path.unlink()
        with pytest.raises(InputError):
            load_dataset(tmp_path, skip_missing=path == tmp_path / "images")
        bare = load_dataset(tmp_path, poses_only=True)
        for view, wanted in zip(bare.views, whole.views, strict=True):
            assert (view.width, view.height, view.lens, view.mask) == (
                *(wanted.width, wanted.height, wanted.lens),
                None,
            )
            np.testing.assert_array_equal(view.viewmat, wanted.viewmat)
            np.testing.assert_array_equal(view.K, wanted.K)
        np.testing.assert_array_equal(bare.points, whole.points)


def test_without_photographs_a_size_is_wanted(tmp_path):
    transforms(tmp_path)
    load_dataset(tmp_path, poses_only=True)
    (tmp_path / "images/view_00.png").unlink()
    with pytest.raises(InputError, match=r"w and h are missing, and .*view_00\.png"):
        load_dataset(tmp_path, poses_only=True)


def test_names_are_sorted_and_unique(tmp_path):
    made = scene_of_views()
    names = ["b.png", "a.png", "B.png", "a/a.png", "a10.png"]
    views = [View(**{**v.__dict__, "name": n}) for v, n in zip(made.views, names)]
    scene = made.__class__(made.source, "made", tuple(views))
    write_colmap(tmp_path / "sparse", scene)
    for name in names:
        save_photo(tmp_path / "images" / name)
    found = [view.name for view in load_dataset(tmp_path).views]
    assert found == sorted(names)
    views[3] = View(**{**views[3].__dict__, "name": "b.png"})
    scene = made.__class__(made.source, "made", tuple(views))
    write_colmap(tmp_path / "sparse", scene, overwrite=True)
    with pytest.raises(InputError, match=r"'b\.png' is listed more than once"):
        load_dataset(tmp_path)


def test_two_names_of_one_photograph(tmp_path):
    """Else the one view would be trained on the other's photograph."""
    made = scene_of_views(count=2)
    views = [replace(v, name=n) for v, n in zip(made.views, ("a.jpg", "a.png"))]
    write_colmap(tmp_path / "sparse", replace(made, views=tuple(views)))
    save_photo(tmp_path / "images/a.png")
    with pytest.raises(InputError, match=r"a\.jpg and a\.png are one photograph in"):
        load_dataset(tmp_path)
    save_photo(tmp_path / "images/a.jpg")
    assert len(load_dataset(tmp_path).views) == 2


# --- far scenes ---

PLACES = [(500_123.4, 5_712_345.6, 118.2), (0, 0, -7e6), (1e7, 1e7, 1e7), (3e3, 0, 0)]


@pytest.mark.parametrize("at", PLACES)
def test_far_scenes_come_near_and_back(tmp_path, at):
    made = colmap(tmp_path, at=np.asarray(at, np.float64), points=500)
    scene = load_dataset(tmp_path)
    shifted = scene.origin != 0
    np.testing.assert_array_equal(shifted, np.asarray(at) != 0)
    assert np.abs(scene.points[:, shifted]).max() < 10
    # Bit for bit, also as they stand in the file.
    np.testing.assert_array_equal(scene.points + scene.origin, made.points)
    there = read_colmap(tmp_path / "sparse/0").points.xyz
    np.testing.assert_array_equal(scene.points + scene.origin, there)
    for view, wanted in zip(scene.views, made.views):
        scale = np.abs(at).max()
        np.testing.assert_allclose(
            view.centre + scene.origin, wanted.centre, atol=1e-15 * scale
        )
        rotations = view.viewmat[:3, :3], wanted.viewmat[:3, :3]
        np.testing.assert_allclose(*rotations, atol=1e-14)
    # What a camera sees is the same, in float32 too.
    view, wanted = scene.views[0], made.views[0]
    seen = made.points @ wanted.viewmat[:3, :3].T + wanted.viewmat[:3, 3]
    viewmat = view.viewmat.astype(np.float32)
    points = scene.points.astype(np.float32)
    found = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    np.testing.assert_allclose(found, seen, atol=1e-5)


def test_written_again_a_far_scene_is_the_same(tmp_path):
    made = colmap(tmp_path, at=np.asarray(PLACES[0]))
    write_colmap(tmp_path / "again", load_dataset(tmp_path))
    again = read_colmap(tmp_path / "again")
    np.testing.assert_array_equal(again.points.xyz, made.points)


def test_near_scenes_stay(tmp_path):
    made = colmap(tmp_path, at=np.asarray([40.0, -30, 3]))
    scene = load_dataset(tmp_path)
    np.testing.assert_array_equal(scene.origin, 0)
    np.testing.assert_array_equal(scene.points, made.points)


def test_origins_are_round():
    rng = np.random.default_rng(0)
    for size in (1e-3, 1.0, 40.0):
        centres = rng.normal(size=(9, 3)) * size + (1e6, -3e6, 0)
        origin = far_origin(centres, np.zeros((0, 3)))
        assert (origin[:2] != 0).all()
        assert origin[2] == 0
        assert np.abs(origin - np.median(centres, axis=0))[:2].max() < 16 * size
        assert (np.float32(origin) == origin).all() or size < 0.1
    np.testing.assert_array_equal(far_origin(np.zeros((1, 3)), np.zeros((0, 3))), 0)
    np.testing.assert_array_equal(
        far_origin(np.full((1, 3), 12.0), np.zeros((0, 3))), 0
    )


def test_far_outliers_do_not_matter():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(1000, 3))
    points[::10] *= 1e9
    centres = rng.normal(size=(9, 3))
    np.testing.assert_array_equal(far_origin(centres, points), 0)
    assert (far_origin(centres + 1e5, points + 1e5) != 0).all()


# --- splits ---


def views_of(names, splits=None):
    made = scene_of_views(len(names))
    splits = splits or [None] * len(names)
    return [
        View(**{**view.__dict__, "name": name, "split": split})
        for view, name, split in zip(made.views, names, splits)
    ]


NAMES = [f"img_{n:02d}.jpg" for n in range(20)]


def test_every_eighth():
    train, test = split_views(views_of(NAMES))
    assert test == [0, 8, 16]
    assert train == [n for n in range(20) if n % 8]
    assert split_views(views_of(NAMES), 0) == ([*range(20)], [])
    # By the order of names, whatever that of the views is.
    train, test = split_views(views_of(NAMES[::-1]))
    assert test == [3, 11, 19]
    assert split_views(views_of(NAMES[:1])) == ([0], [])
    assert split_views(views_of(NAMES[:2])) == ([1], [0])


def test_the_split_of_the_dataset_is_the_default():
    """Names that are given go before it, and so does a distance."""
    views = views_of(NAMES[:4], ["train", "test", "train", "test"])
    assert split_views(views) == ([0, 2], [1, 3])
    assert split_views(views, every=3) == ([1, 2], [0, 3])
    assert split_views(views, every=0) == ([0, 1, 2, 3], [])
    assert split_views(views, test_names=[NAMES[0]]) == ([1, 2, 3], [0])


@pytest.mark.parametrize("split", ["train", None])
def test_a_dataset_without_test_views_has_some_held_out(split):
    """As where it names no split at all."""
    views = views_of(NAMES, ["train"] * 19 + [split])
    assert split_views(views)[1] == [0, 8, 16]
    assert split_views(views, every=5)[1] == [0, 5, 10, 15]


def test_a_training_list_alone(tmp_path):
    transforms(tmp_path, name="transforms_train.json")
    views = load_dataset(tmp_path).views
    assert split_views(views) == ([1, 2, 3, 4], [0])


def test_names_win():
    assert split_views(views_of(NAMES), test_names=NAMES[5:7])[1] == [5, 6]
    views = views_of(["a/1.png", "a/2.png", "b/1.png", "1.png"])
    assert split_views(views, test_names=["2.png"])[1] == [1]
    assert split_views(views, test_names=["1.png", "b/1.png"])[1] == [2, 3]
    with pytest.raises(InputError, match=r"'1\.png' may be any of a/1\.png, b/1\.png"):
        split_views(views[:3], test_names=["1.png"])


def test_unknown_names():
    with pytest.raises(
        InputError, match=r"called 'img_5.jpg'; near it are .*img_05\.jpg"
    ):
        split_views(views_of(NAMES), test_names=["img_5.jpg"])
    with pytest.raises(
        InputError, match=r"called 'xyz'; names are like \['img_00\.jpg'"
    ):
        split_views(views_of(NAMES), test_names=["xyz"])


def test_bad_splits():
    with pytest.raises(InputError, match=r"every -1"):
        split_views(views_of(NAMES), every=-1)
    with pytest.raises(InputError, match=r"all 20 views are test views"):
        split_views(views_of(NAMES), every=1)
    with pytest.raises(InputError, match=r"every = 2\.5: a whole number is wanted"):
        split_views(views_of(NAMES), every=2.5)  # pyright: ignore
    with pytest.raises(InputError, match="no views to split"):
        split_views([])


def test_one_name_is_not_its_letters():
    assert split_views(views_of(NAMES), test_names=NAMES[5])[1] == [5]
