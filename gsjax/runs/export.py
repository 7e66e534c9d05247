"""Export of a scene to another file, optionally pruned or with another SH degree."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, num_active, select, with_sh_degree
from gsjax.io.formats import keeps_every_bit, load, render_mode, save
from gsjax.runs.folder import load_settings, load_split
from gsjax.runs.scene_source import is_run, open_scene_source, splat_file
from gsjax.runtime.console import progress
from gsjax.runtime.files import make_folder, reject_existing, write_json
from gsjax.train.config import render_mode_of
from gsjax.train.motion.scene import MovingScene


def export_scene(
    source: Path,
    out: Path,
    *,
    sh_degree: int | None = None,
    min_opacity: float = 0.0,
    time: float = 0.0,
    overwrite: bool = False,
) -> tuple[int, int]:
    """Write the Gaussians of a file or run to ``out``, in their own coordinates.

    Args:
      source: a file of Gaussians, or the folder of a run.
      out: the file; its folder is created if missing.
      sh_degree: SH degree to write: higher bands are dropped, missing ones zero.
      min_opacity: Gaussians below this opacity are left out.
      time: of a scene that moves, from 0 to 1.
      overwrite: replace an existing file.

    Returns:
      The numbers of Gaussians written and read.

    Raises:
      InputError: if a file cannot be read or written, or exists without ``overwrite``,
        or no Gaussian reaches ``min_opacity``.
    """
    reject_existing([out], overwrite)
    path = splat_file(source)
    with jax.enable_x64(True):  # keeps float64 files exact
        whole = _moment(source, time) if time else load(path)
        gaussians, found = _opaque(path, whole, min_opacity)
        if sh_degree is not None:
            gaussians = with_sh_degree(gaussians, sh_degree)
        if not keeps_every_bit(out):  # such formats cannot hold zero quaternions
            rotated = np.any(np.asarray(gaussians.params.quats) != 0, axis=1)
            gaussians = select(gaussians, jnp.asarray(rotated))
        make_folder(out.parent)
        save(out, gaussians, overwrite=True, mode=scene_mode(source))
        return int(num_active(gaussians)), found


def scene_mode(source: Path) -> str | None:
    """Return the render mode of a run or file."""
    if is_run(source):
        return render_mode_of(load_settings(source).config.raster)
    return render_mode(source)  # also a word that is not ours


def open_moving(source: Path) -> MovingScene:
    """Return the scene of a run that moves, in the coordinates of its dataset's files.

    Raises:
      InputError: if it is not such a run, or its file is damaged.
    """
    moving = open_scene_source(source).moving
    if moving is None:
        raise InputError(
            f"{source}: expected the folder of a run that moves, got a still scene; "
            "train one with gsjax train --motion"
        )
    return moving()


def _moment(source: Path, time: float) -> Gaussians:
    """Return the Gaussians of a run that moves at a time."""
    with jax.enable_x64(False):
        return jax.device_get(open_moving(source).at(time))


def export_frames(
    source: Path, out: Path, count: int, *, overwrite: bool = False
) -> list[Path]:
    """Write a scene that moves as numbered PLY files, and a manifest of their times.

    All files hold the same Gaussians in the same order. ``out`` scene.ply becomes
    scene_0000.ply and so on; the manifest is scene.json.

    Args:
      source: the folder of a run.
      out: a .ply file; its folder is created if missing.
      count: number of moments, at least 2, from time 0 to 1.
      overwrite: replace existing files.

    Returns:
      The files, the manifest last.

    Raises:
      InputError: as `export_scene`; if ``out`` is not a .ply, whose order is kept.
    """
    if out.suffix.lower() != ".ply" or out.stem.endswith(".compressed"):
        raise InputError(
            f"{out}: frames are written as .ply, in which the Gaussians keep their "
            "order; pass such a name, and convert the files afterwards"
        )
    files = [out.with_name(f"{out.stem}_{i:04d}.ply") for i in range(count)]
    manifest = out.with_suffix(".json")
    reject_existing([*files, manifest], overwrite)
    scene, mode = open_moving(source), scene_mode(source)
    duration = load_split(load_settings(source)).dataset.duration
    make_folder(out.parent)
    times = np.linspace(0, 1, count).tolist()
    for file, time in zip(progress(files, "frames"), times):
        save(file, scene.at(time), overwrite=True, mode=mode)
    frames = [
        {
            "file": file.name,
            "time": time,
            "seconds": None if duration is None else time * duration,
        }
        for file, time in zip(files, times)
    ]
    number = int(num_active(scene.params.gaussians))
    content = {"gaussians": number, "duration": duration, "frames": frames}
    write_json(manifest, content)
    return [*files, manifest]


def _opaque(
    path: Path, gaussians: Gaussians, min_opacity: float
) -> tuple[Gaussians, int]:
    """Return the Gaussians of at least this opacity, and the number of all."""
    found = int(num_active(gaussians))
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-logits))
    gaussians = select(gaussians, jnp.asarray(opacities >= min_opacity))
    if found and not int(num_active(gaussians)):
        fault = f"none of {found:,} Gaussians has an opacity of {min_opacity:g}"
        most = f"the greatest is {opacities.max():.3g}; lower --min-opacity"
        raise InputError(f"{path}: {fault}; {most}")
    return gaussians, found
