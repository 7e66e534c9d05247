"""Images and camera files that commands write."""

import numpy as np
import pytest

import gsjax
from gsjax.data.transforms import CameraEntry, load_transforms, transforms_json
from gsjax.io import images


def test_depth_pictures_of_no_depth_and_of_a_plane():
    nothing = images.depth_picture(np.zeros((2, 3), np.float32))
    assert not nothing.pixels.any()
    flat = images.depth_picture(np.full((2, 3), 2.0, np.float32))
    assert (flat.pixels == 1).all()
    assert (flat.near, flat.far) == (2, 2)


def test_camera_files_round_trip(tmp_path):
    viewmat = gsjax.look_at((1, 2, 3), (0.5, 0, 0))
    cameras = [
        gsjax.make_camera(
            viewmat=viewmat,
            K=[[50, 0, 7], [0, 60, 9], [0, 0, 1]],
            width=20 + index,
            height=10,
            lens=lens,
        )
        for index, lens in enumerate(("pinhole", "orthographic"))
    ]
    path = tmp_path / "cameras.json"
    entries = [CameraEntry(f"c{i}", camera) for i, camera in enumerate(cameras)]
    path.write_text(transforms_json(entries))
    back = load_transforms(path)
    assert [entry.name for entry in back] == ["c0", "c1"]
    for entry, camera in zip(back, cameras):
        assert (entry.camera.width, entry.camera.lens) == (camera.width, camera.lens)
        np.testing.assert_array_equal(entry.camera.K, camera.K)
        np.testing.assert_allclose(entry.camera.viewmat, camera.viewmat, atol=1e-6)
    with pytest.raises(gsjax.InputError, match="expected a single camera"):
        transforms_json([CameraEntry("b", gsjax.stack_cameras([cameras[0]] * 2))])
