"""Views of a scene to image files, one or several for each camera."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.data.transforms import CameraEntry
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.io import images
from gsjax.planning.plan import plan, trimmed
from gsjax.raster.render import exact_config, render_estimate, render_exact
from gsjax.raster.types import RasterConfig, Render
from gsjax.runs.scene_source import SceneSource
from gsjax.runtime.console import note, progress, say
from gsjax.runtime.devices import replicate
from gsjax.runtime.files import make_folder, refuse_existing, write_file
from gsjax.runtime.memory import available, size_text

_MARGIN = 1.5  # room for views that show more than the first
_LISTED = 10  # images that are named each; of more, the first and the last


class _Target(NamedTuple):
    """One image of one camera, and the files it goes to."""

    kind: str
    png: Path
    npy: Path | None


def write_views(
    subject: SceneSource,
    entries: Sequence[CameraEntry],
    folder: Path,
    *,
    kinds: Sequence[str] = ("rgb",),
    npy: bool = False,
    overwrite: bool = False,
) -> None:
    """Render every camera to files of its name.

    The results are a line for each image, or for many without depth, which has its
    range there, one for all.

    Args:
      subject: what to render.
      entries: the cameras.
      folder: where the images go; created if missing.
      kinds: of "rgb", "alpha" and "depth"; the first has the plain name.
      npy: also write float32 arrays, linear and unclipped.
      overwrite: whether images that exist may be replaced.

    Raises:
      InputError: if the scene cannot be read, or an image exists and ``overwrite`` is
        not set, or cannot be written.
      CapacityError: if a view wants more memory than can be addressed.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    targets = [_targets(folder, entry.name, kinds, npy) for entry in entries]
    _refuse_conflicts(targets, overwrite)
    cameras = [entry.camera for entry in entries]
    gaussians, config = prepared(subject, cameras, kinds)
    make_folder(folder)
    views = rendered(gaussians, cameras, config, subject.background)
    pictures = [target.png for of_view in targets for target in of_view]
    each = len(pictures) <= _LISTED or "depth" in kinds
    for of_view, view in zip(progress(targets, "views"), views):
        for target in of_view:
            line = _write(target, np.asarray(getattr(view, target.kind), np.float32))
            if each:
                say(line)
    if not each:
        say(f"{pictures[0]} … {pictures[-1].name}, {len(pictures)} images")


def prepared(
    subject: SceneSource, cameras: Sequence[Camera], kinds: Sequence[str]
) -> tuple[Gaussians, RasterConfig]:
    """The scene and how to render it: with a budget as `plan` says, and why; else
    without what changes nothing (`trimmed`).

    Raises:
      InputError: if the scene cannot be read, or as `plan`.
    """
    gaussians, config = subject.load(), subject.config.replace(outputs=tuple(kinds))
    if subject.budget is None:
        return trimmed(gaussians, config), config
    made = plan(
        gaussians,
        cameras,
        budget=subject.budget,
        config=config,
        background=subject.background,
        outputs=kinds,
    )
    for line in made.lines():
        note(line)
    return made.gaussians, made.config


def rendered(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    config: RasterConfig,
    background: Sequence[float],
) -> Iterator[Render]:
    """`render_exact` of each camera in turn.

    The capacity fits the first view, and grows with the others: it never shrinks, so
    that few programs are compiled.
    """
    behind = jnp.asarray(background, jnp.result_type(float))
    gaussians = replicate(gaussians)
    for index, camera in enumerate(cameras):
        if index == 0 and config.pair_capacity is None:
            fitted = exact_config(gaussians, camera, config).pair_capacity or 1
            roomy = capacity_bucket(int(_MARGIN * fitted))
            config = config.replace(pair_capacity=roomy)
        if index == 0:
            _tell_memory(gaussians, camera, config)
        view = render_exact(gaussians, camera, config, behind)
        wanted = capacity_bucket(int(view.demand.capacity))
        config = config.replace(pair_capacity=max(config.pair_capacity or 1, wanted))
        yield view


def _tell_memory(gaussians: Gaussians, camera: Camera, config: RasterConfig) -> None:
    bases, size = gaussians.params.sh.shape[1], (camera.width, camera.height)
    estimate = render_estimate(gaussians.capacity, bases, size, config)
    free = available()
    told = "" if free is None else f"; {size_text(free)} is free"
    note(f"memory: about {size_text(estimate.total)} a view{told}")


def _targets(folder: Path, name: str, kinds: Sequence[str], npy: bool) -> list[_Target]:
    out = []
    for place, kind in enumerate(kinds):
        stem = f"{name}.{kind}" if place else name
        array = folder / f"{stem}.npy" if npy else None
        out.append(_Target(kind, folder / f"{stem}.png", array))
    return out


def _refuse_conflicts(targets: list[list[_Target]], overwrite: bool) -> None:
    """Raise unless every file has a name of its own that may be written."""
    flat = [target for of_view in targets for target in of_view]
    paths = [path for t in flat for path in (t.png, t.npy) if path is not None]
    seen: set[str] = set()
    for path in paths:
        if str(path).casefold() in seen:
            raise InputError(
                f"{path}: two images would have this name; rename the frames in the "
                "camera file, or ask for one kind of image at a time"
            )
        seen.add(str(path).casefold())
    refuse_existing(paths, overwrite, "another folder with -o")


def _write(target: _Target, image: np.ndarray) -> str:
    """Write the files of an image; returns what is said of it."""
    line = str(target.png)
    if target.kind == "depth":
        depth = images.depth_picture(image)
        pixels = depth.pixels
        line += f"  depth {depth.near:.6g} (1) to {depth.far:.6g} (65535), 0: nothing"
    else:
        pixels = images.to_8_bit(image)
    write_file(target.png, images.encode_png(pixels))
    if target.npy is not None:
        write_file(target.npy, images.encode_npy(image))
    return line
