"""Renders of a scene as image files, one or several per camera."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.lens import copies
from gsjax.data.transforms import CameraEntry
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.io import images
from gsjax.planning.plan import plan, trim_scene
from gsjax.raster.exact import exact_config, render_exact
from gsjax.raster.memory_estimate import render_estimate
from gsjax.raster.types import RasterConfig, Render
from gsjax.runs.scene_source import SceneSource
from gsjax.runtime.console import note, progress, say
from gsjax.runtime.devices import replicate
from gsjax.runtime.files import make_folder, reject_existing, write_file
from gsjax.runtime.memory import available, size_text

_MARGIN = 1.5  # spare capacity for views with more pairs than the first
_MAX_LISTED = 10  # with more images, only the first and last are listed


class _Target(NamedTuple):
    """One image of one camera, and its files."""

    kind: str
    png: Path
    npy: Path | None


def render_images(
    source: SceneSource,
    entries: Sequence[CameraEntry],
    folder: Path,
    *,
    kinds: Sequence[str] = ("rgb",),
    npy: bool = False,
    overwrite: bool = False,
) -> None:
    """Render every camera to files with its name, and list them on stdout.

    Args:
      source: the scene.
      entries: cameras and their names.
      folder: output folder; created if missing.
      kinds: of "rgb", "alpha" and "depth"; files of the first have plain names, others
        a suffix.
      npy: also write float32 arrays, linear and unclipped.
      overwrite: replace existing files.

    Raises:
      InputError: if the scene cannot be read; or if an image exists without
        ``overwrite``, would be written twice, or cannot be written.
      CapacityError: if a view needs more memory than can be addressed.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    targets = [_targets(folder, entry.name, kinds, npy) for entry in entries]
    _check_paths(targets, overwrite)
    renders, _ = render_entries(source, entries, kinds)
    make_folder(folder)
    paths = [target.png for of_view in targets for target in of_view]
    list_each = len(paths) <= _MAX_LISTED or "depth" in kinds
    for of_view, view in zip(progress(targets, "views"), renders):
        for target in of_view:
            line = _write(target, np.asarray(getattr(view, target.kind), np.float32))
            if list_each:
                say(line)
    if not list_each:
        say(f"{paths[0]} … {paths[-1].name}, {len(paths)} images")


def prepare_render(
    source: SceneSource, cameras: Sequence[Camera], kinds: Sequence[str]
) -> tuple[Gaussians, RasterConfig]:
    """Load a scene and choose its render settings.

    With a budget, `plan` chooses and its reasons are printed; otherwise Gaussians that
    cannot change a pixel are removed (`trim_scene`).

    Raises:
      InputError: if the scene cannot be read, or as `plan`.
    """
    gaussians, config = source.load(), source.config.replace(outputs=tuple(kinds))
    if source.budget is None:
        return trim_scene(gaussians, config), config
    planned = plan(
        gaussians,
        cameras,
        budget=source.budget,
        config=config,
        background=source.background,
        outputs=kinds,
    )
    for line in planned.lines():
        note(line)
    return planned.gaussians, planned.config


def render_entries(
    source: SceneSource, entries: Sequence[CameraEntry], kinds: Sequence[str]
) -> tuple[Iterator[Render], Gaussians]:
    """Return the renders of cameras, and the Gaussians of the first.

    A scene that moves is shown at the time of each camera, by default 0.

    Raises:
      InputError: as `prepare_render`; if there is a budget for a scene that moves.
    """
    cameras, background = [entry.camera for entry in entries], source.background
    if source.moving is None:
        gaussians, config = prepare_render(source, cameras, kinds)
        return render_cameras(gaussians, cameras, config, background), gaussians
    if source.budget is not None:
        raise InputError(
            "budget: expected None for a scene that moves, since settings are chosen "
            "for one moment; export the moment first (gsjax export --time)"
        )
    scene, config = source.moving(), source.config.replace(outputs=tuple(kinds))
    first = scene.at(entries[0].time or 0.0)

    def at(index: int) -> Gaussians:
        return scene.at(entries[index].time or 0.0)

    return render_cameras(first, cameras, config, background, at), first


def render_cameras(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    config: RasterConfig,
    background: Sequence[float],
    at: Callable[[int], Gaussians] | None = None,
) -> Iterator[Render]:
    """Yield `render_exact` of each camera.

    The pair capacity starts from the first view and only grows, so that few programs
    are compiled.

    Args:
      gaussians, cameras, config, background: the scene and how it is drawn.
      at: returns the Gaussians of a camera by its index, as many slots; by default they
        are the same for all.
    """
    color = jnp.asarray(background, jnp.result_type(float))
    gaussians = replicate(gaussians)
    for index, camera in enumerate(cameras):
        if at is not None:
            gaussians = replicate(at(index))
        if index == 0 and config.pair_capacity is None:
            needed = exact_config(gaussians, camera, config).pair_capacity or 1
            capacity = capacity_bucket(int(_MARGIN * needed))
            config = config.replace(pair_capacity=capacity)
        if index == 0:
            size, bases = (camera.width, camera.height), gaussians.params.sh.shape[1]
            slots = copies(camera.lens) * gaussians.capacity
            need = render_estimate(slots, bases, size, config).total
            free = available()
            of_free = "" if free is None else f" of {size_text(free)} available"
            note(f"memory: about {size_text(need)} per view{of_free}")
        view = render_exact(gaussians, camera, config, color)
        needed = capacity_bucket(int(view.demand.capacity))
        config = config.replace(pair_capacity=max(config.pair_capacity or 1, needed))
        yield view


def _targets(folder: Path, name: str, kinds: Sequence[str], npy: bool) -> list[_Target]:
    stems = [f"{name}.{kind}" if place else name for place, kind in enumerate(kinds)]
    return [
        _Target(kind, folder / f"{stem}.png", folder / f"{stem}.npy" if npy else None)
        for kind, stem in zip(kinds, stems)
    ]


def _check_paths(targets: list[list[_Target]], overwrite: bool) -> None:
    """Raise if two files have the same name, or one exists without ``overwrite``."""
    flat = [target for of_view in targets for target in of_view]
    paths = [path for t in flat for path in (t.png, t.npy) if path is not None]
    names = Counter(str(path).casefold() for path in paths)
    for path in paths:
        if names[str(path).casefold()] > 1:
            raise InputError(
                f"{path}: two images would have this name; rename the frames in the "
                "camera file, or render one kind of image at a time"
            )
    reject_existing(paths, overwrite, "another folder with -o")


def _write(target: _Target, image: np.ndarray) -> str:
    """Write the files of an image and return a line that describes them."""
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
