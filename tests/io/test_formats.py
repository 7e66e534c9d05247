"""The registry of file formats, and the arguments of `load` and `save`."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest
from captures import rejects

import gsjax
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


@pytest.mark.parametrize("name", ["a.npy", "a.MEANS"])
def test_a_format_from_outside(tmp_path, name):
    formats, path = (*FORMATS, MEANS), tmp_path / name
    gsjax.save(path, gsjax.grow(scene(), 9), formats=formats)
    found = gsjax.load(path, formats=formats)
    np.testing.assert_array_equal(found.params.means, scene().params.means)
    gsjax.save(path, scene(5), formats=formats, overwrite=True)
    assert gsjax.load(path, formats=formats).capacity == 5
    rejects(r"a suffix of \.ply, \.spz, got '\.n|M", gsjax.load, path)


def test_the_last_format_of_a_suffix_is_used(tmp_path):
    formats, path = (*FORMATS, WRITE_ONLY), tmp_path / "a.ply"
    gsjax.save(path, scene(), formats=formats)
    assert np.load(path).shape == (2, 3)
    rejects(r"expected a suffix of \.spz, got", gsjax.load, path, formats=formats)


def refusals(folder: Path):
    """(call, message) of what is refused before anything is read or written."""
    (folder / "folder.ply").mkdir()
    os.mkfifo(folder / "pipe.ply")
    one = scene()
    return [
        (lambda: gsjax.load(folder / "a.obj"), r"a\.obj: .*\.ply, \.spz, got '\.obj'"),
        (lambda: gsjax.load(folder / "a.splat"), r"a\.splat: .* of \.ply, \.spz, got"),
        (lambda: gsjax.load(folder / "none.ply"), r"none\.ply: cannot be read: No su"),
        (lambda: gsjax.load(folder / "folder.ply"), r"folder\.ply: not a regular file"),
        (lambda: gsjax.load(folder / "pipe.ply"), r"pipe\.ply: not a regular file"),
        (lambda: gsjax.load(one), r"path: expected .*, got Gaussians; call load\(path"),
        (lambda: gsjax.save(one, folder / "a.ply"), r"path: .*save\(path, gaussians\)"),
        (lambda: gsjax.save(folder / "a.ply", [one]), r"got list; .*gsjax.concatenate"),
        (lambda: gsjax.save(folder / "a.obj", one), r"of \.ply, \.splat, \.spz, got"),
        (lambda: gsjax.save(folder / "none/a.ply", one), r"none.* is missing; create"),
        (
            lambda: gsjax.save(folder / "folder.ply", one, overwrite=True),
            r"folder\.ply: expected a file, got a folder",
        ),
    ]


def test_refusals(tmp_path):
    for call, message in refusals(tmp_path):
        rejects(message, call)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["folder.ply", "pipe.ply"]


def test_loaded_scenes_are_on_all_devices(tmp_path):
    for suffix in (".ply", ".spz"):
        gsjax.save(tmp_path / f"a{suffix}", scene())
        for leaf in jax.tree.leaves(gsjax.load(tmp_path / f"a{suffix}")):
            assert len(leaf.devices()) == jax.local_device_count()
