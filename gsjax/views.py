"""Views of a scene to image files: the work behind `gsjax render`."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax import images
from gsjax.cameras import Camera
from gsjax.console import progress, say
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.io import load
from gsjax.raster.render import render_exact
from gsjax.raster.types import RasterConfig
from gsjax.scene.transforms import load_transforms

_PRESETS = {
    "compat": RasterConfig.compat,
    "accurate": RasterConfig.accurate,
    "fast": RasterConfig.fast,
}


class _Target(NamedTuple):
    """One image of one camera, and the files it goes to."""

    kind: str
    png: Path
    npy: Path | None


def render_views(
    scene: Path,
    cameras: Path,
    folder: Path,
    *,
    preset: str = "compat",
    size: tuple[int, int] | None = None,
    kinds: Sequence[str] = ("rgb",),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    npy: bool = False,
    overwrite: bool = False,
) -> None:
    """Render every camera of a file; one result line for each image.

    Args:
      scene: file of the Gaussians.
      cameras: a `transforms.json`.
      folder: where the images go; created if missing.
      preset: "compat", "accurate" or "fast".
      size: (width, height) to render at; None takes that of the file.
      kinds: of "rgb", "alpha" and "depth"; the first has the plain name.
      background: RGB behind the scene.
      npy: also write float32 arrays, linear and unclipped.
      overwrite: whether images that exist may be replaced.

    Raises:
      InputError: if a file cannot be read or written, is not as it should be, or
        exists and ``overwrite`` is not set.
      CapacityError: if a view wants more memory than can be addressed.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    entries = load_transforms(cameras, size=size)
    targets = [_targets(folder, entry.name, kinds, npy) for entry in entries]
    _refuse_conflicts(targets, overwrite)
    gaussians = load(scene)
    images.make_folder(folder)
    behind = jnp.asarray(background, jnp.result_type(float))
    config = _PRESETS[preset](outputs=tuple(kinds))
    for index in progress(range(len(entries)), "views"):
        camera = entries[index].camera
        config = config.replace(pair_capacity=_capacity(gaussians, camera, config))
        view = render_exact(gaussians, camera, config, behind)
        wanted = capacity_bucket(int(view.demand.capacity))
        config = config.replace(pair_capacity=max(config.pair_capacity or 1, wanted))
        for target in targets[index]:
            _write(target, np.asarray(getattr(view, target.kind), np.float32))


def _capacity(gaussians: Gaussians, camera: Camera, config: RasterConfig) -> int:
    """Room for pairs: never less than for the views before, so as to grow once.

    The first guess is eight tiles a Gaussian and two Gaussians a tile.
    """
    tiles = camera.width * camera.height // config.tile_size**2
    guess = capacity_bucket(8 * gaussians.capacity + 2 * tiles)
    return max(guess, config.pair_capacity or 1)


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
    images.refuse_existing(paths, overwrite)


def _write(target: _Target, image: np.ndarray) -> None:
    line = str(target.png)
    if target.kind == "depth":
        depth = images.depth_picture(image)
        pixels = depth.pixels
        line += f"  depth {depth.near:.6g} (1) to {depth.far:.6g} (65535), 0: nothing"
    else:
        pixels = images.to_8_bit(image)
    images.write_file(target.png, images.encode_png(pixels))
    if target.npy is not None:
        images.write_file(target.npy, images.encode_npy(image))
    say(line)
