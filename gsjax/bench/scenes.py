"""Scenes of `gsjax bench`, by name or file, each with a camera."""

from pathlib import Path

import numpy as np

from gsjax.cameras.camera import Camera, look_at, make_camera, resize_camera
from gsjax.data.transforms import load_near_transforms, load_transforms
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.runs.folder import load_settings, load_split, run_files, with_refined_cameras
from gsjax.runs.scene_source import is_run, note_moment, open_scene_source
from gsjax.runs.trajectories import view_entries
from gsjax.synthetic.stress_scenes import STRESS_SCENES, StressScene

_SIZE = (400, 300)


def open_bench_scene(
    name: str, *, cameras: Path | None = None, size: tuple[int, int] | None = None
) -> StressScene:
    """Open a built-in scene, a file or a run, with one camera.

    Args:
      name: of `STRESS_SCENES`, unless a file or folder has that name.
      cameras: a transforms.json; its first camera is used.
      size: (width, height) in px.

    Raises:
      InputError: if it cannot be read, or holds no Gaussian or no camera.
    """
    path = Path(name)
    built_in = name in STRESS_SCENES and not path.exists()
    if not (built_in or path.exists()):
        raise InputError(
            f"{name}: expected a run, a .ply, a .spz, or one of "
            f"{', '.join(STRESS_SCENES)}; no such file exists"
        )
    origin = camera = None
    if cameras is not None and built_in:
        camera = load_transforms(cameras, size=size)[0].camera
    elif cameras is not None:
        entries, origin = load_near_transforms(cameras, size=size)
        camera = entries[0].camera
    elif not built_in and is_run(path):
        settings = load_settings(path)
        split = with_refined_cameras(load_split(settings), run_files(path))
        origin = split.dataset.origin
        views = split.views("train")
        camera = view_entries(views, max_size=settings.config.max_size)[0].camera
    if built_in:
        scene = STRESS_SCENES[name]()
    else:
        note_moment(path)
        source = open_scene_source(path, origin=origin)
        gaussians = source.load()
        camera = camera or facing_camera(gaussians, *(size or _SIZE))
        red, green, blue = source.background
        scene = StressScene(path.stem, gaussians, camera, (red, green, blue))
    camera = camera or scene.camera
    if size is not None and size != (camera.width, camera.height):
        camera = resize_camera(camera, *size)
    return scene._replace(camera=camera)


def facing_camera(gaussians: Gaussians, width: int, height: int) -> Camera:
    """Return a camera that looks at the centre of a scene, with most of it in view.

    Raises:
      InputError: if no Gaussian is active and finite.
    """
    means = np.asarray(gaussians.params.means, np.float64)
    means = means[np.asarray(gaussians.active) & np.isfinite(means).all(axis=1)]
    if not len(means):
        raise InputError("scene: expected an active Gaussian of finite mean, got none")
    centre = np.median(means, axis=0)
    radius = np.percentile(np.linalg.norm(means - centre, axis=1), 95)
    eye = centre + np.asarray([0.3, 0.25, 1.0]) * max(float(radius), 1e-6) * 1.85
    focal = 0.875 * max(width, height)
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    viewmat = look_at(eye, centre, (0, 1, 0))
    return make_camera(viewmat=viewmat, K=K, width=width, height=height)
