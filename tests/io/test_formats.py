"""The registry of file formats, arguments of `load` and `save`, and camera files."""

import os
from pathlib import Path

import numpy as np
from captures import rejects
from conftest import camera_of

import gsjax
from gsjax.data.transforms import CameraEntry, load_transforms, transforms_json
from gsjax.io.common import Format
from gsjax.io.formats import FORMATS


def scene(count: int = 2) -> gsjax.Gaussians:
    return gsjax.make_gaussians(
        means=np.arange(3.0 * count).reshape(count, 3),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), -1.0),
        logit_opacities=np.zeros(count),
        sh=np.zeros((count, 1, 3)),
    )


def load_means(path: Path) -> gsjax.Gaussians:
    means = np.load(path)
    one = vars(scene(len(means)).params)
    return gsjax.make_gaussians(**one | {"means": means})


def save_means(path: Path, gaussians: gsjax.Gaussians, *, overwrite: bool) -> None:
    with path.open("wb" if overwrite else "xb") as file:
        np.save(file, np.asarray(gaussians.params.means)[np.asarray(gaussians.active)])


MEANS = Format("means", (".npy", ".means"), load_means, save_means)
WRITE_ONLY = Format("ply", (".ply",), None, save_means)


def test_formats_from_outside(tmp_path):
    """The last format of a suffix is used."""
    formats, path = (*FORMATS, MEANS, WRITE_ONLY), tmp_path / "a.MEANS"
    gsjax.save(path, scene(5), formats=formats)
    gsjax.save(path, gsjax.grow(scene(), 9), formats=formats, overwrite=True)
    found = gsjax.load(path, formats=formats)
    np.testing.assert_array_equal(found.params.means, scene().params.means)
    rejects(r"a suffix of .*\.ply, .*\.spz, .*got '\.M", gsjax.load, path)
    ply = tmp_path / "a.ply"
    gsjax.save(ply, scene(), formats=formats)
    assert np.load(ply).shape == (2, 3)
    expected = r"expected a suffix of .*\.means, \.npy, (?!\.ply).*\.spz, .*got"
    rejects(expected, gsjax.load, ply, formats=formats)


def refusals(folder: Path):
    """(call, message) of what is refused before anything is read or written."""
    (folder / "folder.ply").mkdir()
    os.mkfifo(folder / "pipe.ply")
    one, there = scene(), [folder / f"there{s}" for s in (".ply", ".spz", ".splat")]
    for path in there:
        path.touch()
    return [
        (lambda: gsjax.load(folder / "a.obj"), r"a\.obj: .*\.spz, .*got '\.obj'"),
        (lambda: gsjax.load(folder / "none.ply"), r"none\.ply: cannot be read: No su"),
        (lambda: gsjax.load(folder / "folder.ply"), r"folder\.ply: not a regular file"),
        (lambda: gsjax.load(folder / "pipe.ply"), r"pipe\.ply: not a regular file"),
        (lambda: gsjax.load(one), r"path: expected .*, got Gaussians; call load\(path"),
        (lambda: gsjax.save(one, folder / "a.ply"), r"path: .*save\(path, gaussians\)"),
        (lambda: gsjax.save(folder / "a.ply", [one]), r"got list; .*gsjax.concatenate"),
        (lambda: gsjax.save(folder / "a.obj", one), r"of .*\.splat, \.spz, .*got"),
        (lambda: gsjax.save(folder / "none/a.ply", one), r"none.* is missing; create"),
        (lambda: gsjax.save(there[0], one), r"there\.ply: exists.*overwrite=True"),
        (lambda: gsjax.save(there[1], one), r"there\.spz: exists.*overwrite=True"),
        (lambda: gsjax.save(there[2], one), r"there\.splat: exists.*overwrite=True"),
        (
            lambda: gsjax.save(folder / "folder.ply", one, overwrite=True),
            r"folder\.ply: expected a file, got a folder",
        ),
    ]


def test_refusals(tmp_path):
    rows = refusals(tmp_path)
    before = {path: path.stat() for path in tmp_path.iterdir()}
    for call, message in rows:
        rejects(message, call)
    assert {path: path.stat() for path in tmp_path.iterdir()} == before


def test_camera_files_round_trip(tmp_path):
    cameras = [camera_of(20, lens="pinhole"), camera_of(21, lens="orthographic")]
    path = tmp_path / "cameras.json"
    entries = [CameraEntry(f"c{i}", camera) for i, camera in enumerate(cameras)]
    path.write_text(transforms_json(entries))
    back = load_transforms(path)
    assert [entry.name for entry in back] == ["c0", "c1"]
    for entry, camera in zip(back, cameras):
        assert (entry.camera.width, entry.camera.lens) == (camera.width, camera.lens)
        np.testing.assert_array_equal(entry.camera.K, camera.K)
        np.testing.assert_allclose(entry.camera.viewmat, camera.viewmat, atol=1e-6)
    both = [CameraEntry("b", gsjax.stack_cameras([cameras[0]] * 2))]
    rejects("expected a single camera", transforms_json, both)
