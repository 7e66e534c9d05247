"""Pictures of renders and scenes, in notebooks and files.

Renders, scenes and cameras display themselves as the last line of a cell; the methods
are attached here, because drawing depends on everything below. Drawing is done on the
host: nothing is compiled, and nothing is drawn of a traced value.

Axis legend: B batch, H W picture, N Gaussians.
"""

import tempfile
from collections.abc import Callable, Iterable, Sequence
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError, MissingExtraError
from gsjax.gaussians import Gaussians, has_values
from gsjax.io.movies import write_movie
from gsjax.plots import previews
from gsjax.plots.contact_sheets import (
    Cell,
    SheetRow,
    cell_grid,
    comparison,
    depth_cell,
    display_pixels,
)
from gsjax.plots.figures import Series, curves
from gsjax.raster.exact import render_exact
from gsjax.raster.types import RasterConfig, Render
from gsjax.runtime.settings import as_int
from gsjax.train.loop import Progress
from gsjax.train.models import IDENTITY, Model, scene_of
from gsjax.train.state import TrainState
from gsjax.viewer.pictures import MIME_TYPES, MIN_SIZE, Movie, Picture

_MAX_WIDTH = 1200  # px


def picture(
    *values,
    captions: Sequence[str] | None = None,
    columns: int | None = None,
    zoom: int = 1,
) -> Picture:
    """Return one picture of several, arranged in a grid.

    A single picture without a caption keeps its pixels. A grid is at most 1200 px wide.

    Args:
      *values: pictures [H, W] or [H, W, 3], uint8, or floats in [0, 1] (clipped);
        batches of them [B, H, W] or [B, H, W, 3], or lists; a `Render`, for each of its
        images; or `Gaussians`, for a sketch. Pixels that are not finite are magenta.
      captions: one below each picture.
      columns: number of pictures side by side; default as many as fit.
      zoom: integer magnification of the pixels.

    Raises:
      InputError: if a value is not a picture, there is none, the number of captions
        differs, or the zoom is below 1.
    """
    if as_int("zoom", zoom) < 1:
        raise InputError(f"zoom: expected an integer of at least 1, got {zoom}")
    cells = [cell for value in values for cell in _cells(value)]
    if captions is not None:
        if len(captions) != len(cells):
            expected = f"expected {len(cells)}, one for each picture"
            got = f"got {len(captions)}; pass None for none"
            raise InputError(f"captions: {expected}, {got}")
        cells = [cell._replace(caption=text) for cell, text in zip(cells, captions)]
    if zoom > 1:
        cells = [
            c._replace(pixels=c.pixels.repeat(zoom, 0).repeat(zoom, 1)) for c in cells
        ]
    if len(cells) == 1 and not cells[0].caption:
        return Picture(cells[0].pixels)
    return Picture(cell_grid(cells, columns, _MAX_WIDTH))


def show(*values, **options) -> None:
    """Display the `picture` of the same arguments."""
    _display(picture(*values, **options))


def save_png(path: str | PathLike[str], *values, **options) -> None:
    """Write the `picture` of the same arguments to a PNG file.

    ``gsjax.save_png("a.png", gsjax.render(gaussians, camera))``
    """
    picture(*values, **options).save(path)


def movie(
    frames: Iterable[Any],
    fps: float = 24.0,
    *,
    kind: str = "webp",
    width: int | None = None,
) -> Movie:
    """Return a movie embedded in the notebook.

    Args:
      frames: pictures of one size, as `picture` takes them.
      fps: frames per second.
      kind: "webp", which every browser shows; "gif", which every program shows; or,
        smaller for many frames and with a control bar, "webm" (VP9) or "mp4" (H.264,
        needs gsjax[movies]).
      width: at which it is shown, px; None for its own, or enlarged if it is small.

    Raises:
      InputError: as `picture` and `gsjax.io.movies.write_movie`, or if the kind is
        unknown.
      MissingExtraError: as `gsjax.io.movies.write_movie`.
    """
    if kind not in MIME_TYPES:
        raise InputError(f"kind: expected one of {', '.join(MIME_TYPES)}, got {kind!r}")
    shape = (0, 0, 3)

    def pictures():
        nonlocal shape
        for frame in frames:
            pixels = picture(frame).pixels
            shape = pixels.shape
            yield pixels

    with tempfile.TemporaryDirectory(prefix="gsjax-") as folder:
        path = Path(folder) / f"movie.{kind}"
        count = write_movie(path, pictures(), fps=fps)
        data = path.read_bytes()
    zoom = width / shape[1] if width else max(1, MIN_SIZE // max(shape))
    return Movie(data, kind, count, (round(zoom * shape[1]), round(zoom * shape[0])))


def save_movie(
    path: str | PathLike[str],
    frames: Iterable[Any],
    fps: float = 24.0,
    *,
    overwrite: bool = False,
) -> int:
    """Write a movie and return the number of its frames.

    ``gsjax.save_movie("a.mp4", (gsjax.render(gaussians, c) for c in cameras))``

    Args:
      path: .mp4 (H.264, needs gsjax[movies]), .webm (VP9), .webp or .gif, or a name
        without suffix for a folder of PNGs.
      frames: pictures of one size, as `picture` takes them, read one by one.
      fps: frames per second.
      overwrite: replace an existing movie.

    Raises:
      InputError: as `picture` and `gsjax.io.movies.write_movie`.
      MissingExtraError: as `gsjax.io.movies.write_movie`.
    """
    pictures = (picture(frame).pixels for frame in frames)
    return write_movie(Path(path), pictures, fps=fps, overwrite=overwrite)


def live(
    camera: Camera,
    photo: np.ndarray | None = None,
    *,
    every: int = 25,
    config: RasterConfig | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    model: Model = IDENTITY,
) -> Callable[[TrainState, Progress], None]:
    """Return a hook that updates a preview of a training in one place.

    ``fit(…, hooks=Hooks(state=live(camera, photo)))`` shows the render above the PSNR
    of the views of each step. The first drawing compiles its own program.

    Args:
      camera: a single camera.
      photo: [H, W, 3] photograph of the same view, shown with the error.
      every: steps between two drawings; the first step is drawn too.
      config: render settings.
      background: RGB behind the scene.
      model: scene model of the training, such as `gsjax.train.state.model_of` returns.

    Returns:
      The hook for `gsjax.Hooks.state`.

    Raises:
      InputError: if ``every`` is below 1.
    """
    if as_int("every", every) < 1:
        raise InputError(f"every: expected at least 1 step, got {every}")
    fixed = config or RasterConfig(num_size_buckets=1)
    fixed = fixed.replace(outputs=("rgb", "depth"), absgrad=False)
    behind = jnp.asarray(background, jnp.result_type(float))
    steps: list[tuple[int, float]] = []
    handle = None

    def draw(state: TrainState, progress: Progress) -> None:
        nonlocal handle
        metrics = progress.metrics
        step = int(metrics.step)
        steps.append((step, float(metrics.psnr)))
        if step % every and len(steps) > 1:
            return
        # One program for any number of Gaussians.
        scene = scene_of(model, state.params)
        config = fixed.replace(visible_capacity=scene.capacity)
        view = render_exact(scene, camera, config, behind)
        preview = _preview(view, photo, f"step {step}")
        title = f"PSNR, dB; {int(metrics.gaussians):,} Gaussians"
        size = (max(preview.shape[1], 400), 300)
        plot = curves(_lines(steps), title=title, size=size)
        drawn = Picture(cell_grid([Cell(preview), Cell(plot)], columns=1))
        if handle is None:
            handle = _display(drawn, display_id=True)
        else:
            handle.update(drawn)

    return draw


def _lines(steps: Sequence[tuple[int, float]]) -> list[Series]:
    """Return the PSNR of each step, and its mean over a tenth of the steps so far."""
    at, psnr = np.transpose(steps)
    width = max(1, len(at) // 10)
    mean = np.convolve(psnr, np.ones(width) / width, mode="valid")
    middle = at[width // 2 :][: len(mean)]
    pale = Series("views of the steps", at, psnr, faint=True)
    return [pale, Series(f"mean of {width}", middle, mean)]


def _preview(view: Render, photo: np.ndarray | None, name: str) -> np.ndarray:
    """Draw render and depth [H, W, 3]; with a photograph, that and the error too."""
    rgb, depth = np.asarray(view.rgb), np.asarray(view.depth)
    if photo is not None:
        width = min(max(photo.shape[1], 120), 240)
        rgb = np.clip(rgb, 0, 1)
        row = SheetRow("photograph", photo, rgb, depth, rendered=f"{name},")
        return comparison([row], width=width)
    cells = [Cell(display_pixels(rgb), name), depth_cell(depth)]
    return cell_grid(cells, max_width=_MAX_WIDTH)


def _display(value, **options):
    """Call IPython's display, which prints outside notebooks."""
    try:
        from IPython.display import display
    except ImportError as error:
        raise MissingExtraError("IPython is missing: pip install ipython") from error
    return display(value, **options)


def _cells(value) -> list[Cell]:
    if isinstance(value, Picture):
        return [Cell(value.pixels)]
    if isinstance(value, Render):
        return previews.render_cells(value)
    if isinstance(value, Gaussians):
        return previews.gaussian_cells(value)
    if isinstance(value, (list, tuple)) and any(
        isinstance(one, (Picture, Render, Gaussians)) or getattr(one, "ndim", 0) > 1
        for one in value
    ):
        return [cell for one in value for cell in _cells(one)]
    array = np.asarray(value)
    if array.dtype.kind not in "buif":
        got = f"{type(value).__name__}; pass the image itself"
        raise InputError(f"picture: expected arrays, a Render or Gaussians, got {got}")
    if array.ndim == 4 or (array.ndim == 3 and array.shape[-1] != 3):
        return [Cell(display_pixels(one)) for one in array]
    return [Cell(display_pixels(array))]


def _concrete(value) -> bool:
    """Return True if the leaves of a pytree are arrays whose values can be read now."""
    leaves = jax.tree.leaves(value)
    return bool(leaves) and all(
        isinstance(leaf, np.ndarray) or has_values(leaf) for leaf in leaves
    )


def _png(value) -> tuple[bytes, dict[str, int]] | None:
    """Return the PNG of a `Render` or `Gaussians`; None lets Jupyter print it."""
    if not _concrete(value):
        return None
    try:
        return picture(value)._repr_png_()
    except (InputError, MissingExtraError):
        return None


def _html(camera: Camera) -> str | None:
    """Describe a `Camera` in HTML; None lets Jupyter print it."""
    if not _concrete(camera):
        return None
    count = camera.viewmat.shape[0] if camera.batched else 1
    facts = [f"{camera.width} × {camera.height} px, {camera.lens.name}"]
    first = jax.tree.map(lambda a: np.asarray(a)[0] if camera.batched else a, camera)
    viewmat, K = np.asarray(first.viewmat), np.asarray(first.K)
    if camera.lens.name == "pinhole":
        focal, centre = np.diag(K)[:2], K[:2, 2]
        rest = np.array([camera.width, camera.height]) - centre
        angles = np.degrees(np.arctan(rest / focal) + np.arctan(centre / focal))
        facts.append(f"{angles[0]:.1f}° × {angles[1]:.1f}°")
    place = ", ".join(f"{x:.3g}" for x in -viewmat[:3, :3].T @ viewmat[:3, 3] + 0.0)
    ahead = ", ".join(f"{x + 0:.2f}" for x in viewmat[2, :3])
    facts += [f"at ({place})", f"looking along ({ahead})"]
    name = f"{count} cameras, the first" if camera.batched else "Camera"
    return f"<div><b>{name}</b>: {escape('; '.join(facts))}</div>"


setattr(Render, "_repr_png_", _png)  # noqa: B010
setattr(Gaussians, "_repr_png_", _png)  # noqa: B010
setattr(Camera, "_repr_html_", _html)  # noqa: B010
