"""Pictures in a notebook: `show`, `movie`, and `live` for watching a training.

Renders, scenes and cameras display themselves where they are the last line of a cell.
Their methods for that are put in place here and not where the classes are: what draws
lies above them. Everything is drawn on the host from arrays that are there; of a value
under tracing nothing is drawn, and nothing is compiled for a display.

Axis legend: B batch, H W picture, N Gaussians.
"""

import base64
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError, MissingExtraError
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.io.movies import write_movie
from gsjax.plots import previews
from gsjax.plots.contact_sheets import SheetRow, comparison
from gsjax.plots.curves import Series, curves
from gsjax.plots.previews import Cell
from gsjax.raster.render import render_exact
from gsjax.raster.types import RasterConfig, Render
from gsjax.train.loop import Progress
from gsjax.train.state import TrainState

_LEAST, _MOST = 240, 1200  # px: shown enlarged below, made smaller above
_MIME = {"webp": "image/webp", "gif": "image/gif", "webm": "video/webm"}


@dataclass(frozen=True, eq=False)
class Picture:
    """``pixels`` [H, W, 3] uint8 that a notebook shows; a small one enlarged."""

    pixels: np.ndarray

    @property
    def png(self) -> bytes:
        """The file."""
        return images.encode_png(self.pixels)

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        height, width = self.pixels.shape[:2]
        zoom = max(1, _LEAST // max(height, width))
        return self.png, {"width": zoom * width, "height": zoom * height}

    def __repr__(self) -> str:
        height, width = self.pixels.shape[:2]
        return f"Picture({width} × {height} px)"


@dataclass(frozen=True)
class Movie:
    """A movie in a file of its ``kind``, which a notebook plays, over and over.

    Attributes:
      data: the file.
      kind: "webp", "gif" or "webm".
      frames: how many there are.
      size: (width, height) in px at which it is shown.
    """

    data: bytes
    kind: str
    frames: int
    size: tuple[int, int]

    def _repr_html_(self) -> str:
        source = base64.b64encode(self.data).decode()
        width, height = self.size
        shape = f'width="{width}" height="{height}"'
        url = f'src="data:{_MIME[self.kind]};base64,{source}"'
        if self.kind == "webm":
            switches = "autoplay loop muted playsinline controls"
            return f"<video {shape} {switches} {url}></video>"
        return f"<img {shape} {url}>"

    def __repr__(self) -> str:
        kilobytes = len(self.data) / 1000
        return f"Movie({self.frames} frames, {self.kind}, {kilobytes:.0f} kB)"


def picture(
    *values,
    captions: Sequence[str] | None = None,
    columns: int | None = None,
    zoom: int = 1,
) -> Picture:
    """One picture of several, beside and below each other.

    A single picture without a caption is that picture, pixel by pixel. A sheet is at
    most 1200 px wide.

    Args:
      *values: pictures [H, W] or [H, W, 3], uint8, or floats in [0, 1] (clipped);
        batches of them [B, H, W] or [B, H, W, 3]; a `Render`, each of its images; or
        `Gaussians`, of which a sketch is drawn. What is not finite is magenta.
      captions: below each; as many as there are pictures.
      columns: how many side by side; default as many as there is room for.
      zoom: a pixel becomes so many by so many.

    Raises:
      InputError: on another shape, no picture, another number of captions, or a zoom
        below 1.
    """
    if zoom < 1:
        raise InputError(f"zoom is {zoom}; a whole number from 1 is wanted")
    cells = [cell for value in values for cell in _cells(value)]
    if captions is not None:
        if len(captions) != len(cells):
            raise InputError(
                f"{len(captions)} captions for {len(cells)} pictures; one for each "
                "is wanted"
            )
        cells = [cell._replace(caption=text) for cell, text in zip(cells, captions)]
    if not cells:
        raise InputError("no pictures; one is wanted at least")
    if zoom > 1:
        cells = [c._replace(pixels=previews.enlarged(c.pixels, zoom)) for c in cells]
    if len(cells) == 1 and not cells[0].caption:
        return Picture(cells[0].pixels)
    return Picture(previews.sheet(cells, columns, _MOST))


def show(
    *values,
    captions: Sequence[str] | None = None,
    columns: int | None = None,
    zoom: int = 1,
) -> None:
    """Display `picture` of the same arguments, now."""
    _display(picture(*values, captions=captions, columns=columns, zoom=zoom))


def movie(
    frames: Iterable[Any],
    fps: float = 24.0,
    *,
    kind: str = "webp",
    width: int | None = None,
) -> Movie:
    """Frames as a movie within the notebook, which needs no file beside it.

    Args:
      frames: pictures of one size, as `picture` takes them.
      fps: frames per second.
      kind: "webp", which every browser shows; "gif" for what knows nothing else; or
        "webm" (VP9), the smallest of many frames, with a bar to move along.
      width: at which it is shown, px; None as it is, a small one enlarged.

    Raises:
      InputError: as `picture`, on another kind, or as `gsjax.io.movies.write_movie`.
    """
    if kind not in _MIME:
        raise InputError(f"no movie of kind {kind!r}; known: {', '.join(_MIME)}")
    size = (0, 0)

    def pictures():
        nonlocal size
        for frame in frames:
            pixels = picture(frame).pixels
            size = pixels.shape[1], pixels.shape[0]
            yield pixels

    with tempfile.TemporaryDirectory(prefix="gsjax-") as folder:
        path = Path(folder) / f"movie.{kind}"
        count = write_movie(path, pictures(), fps=fps)
        data = path.read_bytes()
    zoom = width / size[0] if width else max(1, _LEAST // max(size))
    return Movie(data, kind, count, (round(zoom * size[0]), round(zoom * size[1])))


def live(
    camera: Camera,
    photo: np.ndarray | None = None,
    *,
    every: int = 25,
    config: RasterConfig | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Callable[[TrainState, Progress], None]:
    """A hook that draws a preview of a training, again and again in one place.

    ``fit(…, hooks=Hooks(state=live(camera, photo)))``. Below the preview is the PSNR of
    the views that the steps saw. The first drawing compiles a program of its own.

    Args:
      camera: a single one.
      photo: [H, W, 3] what it should see, to be shown beside, with the error.
      every: steps between two drawings; the first step is drawn too.
      config: how to render.
      background: RGB behind the scene.

    Returns:
      The hook for `gsjax.Hooks.state`.

    Raises:
      InputError: if ``every`` is below 1.
    """
    if every < 1:
        raise InputError(f"every is {every}; a number of steps from 1 is wanted")
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
        # One program, however many Gaussians there are by now.
        config = fixed.replace(visible_capacity=state.gaussians.capacity)
        view = render_exact(state.gaussians, camera, config, behind)
        preview = _preview(view, photo, f"step {step}")
        title = f"PSNR, dB; {int(metrics.gaussians):,} Gaussians"
        size = (max(preview.shape[1], 400), 300)
        plot = curves(_lines(steps), title=title, size=size)
        drawn = Picture(previews.stacked([preview, plot]))
        if handle is None:
            handle = _display(drawn, display_id=True)
        else:
            handle.update(drawn)

    return draw


def _lines(steps: Sequence[tuple[int, float]]) -> list[Series]:
    """PSNR by step, pale, and its mean over a tenth of the steps so far."""
    at, psnr = np.transpose(steps)
    width = max(1, len(at) // 10)
    mean = np.convolve(psnr, np.ones(width) / width, mode="valid")
    middle = at[width // 2 :][: len(mean)]
    pale = Series("views of the steps", at, psnr, faint=True)
    return [pale, Series(f"mean of {width}", middle, mean)]


def _preview(view: Render, photo: np.ndarray | None, name: str) -> np.ndarray:
    """[H, W, 3]: render and depth; with a photograph, that and the error too."""
    rgb, depth = np.asarray(view.rgb), np.asarray(view.depth)
    if photo is not None:
        width = min(max(photo.shape[1], 120), 240)
        rgb = np.clip(rgb, 0, 1)
        row = SheetRow("photograph", photo, rgb, depth, rendered=f"{name},")
        return comparison([row], width=width)
    found = previews.of_depth(depth)
    return previews.sheet([Cell(previews.visible(rgb), name), found], None, _MOST)


def _display(value, **options):
    """IPython's display, which elsewhere prints."""
    try:
        from IPython.display import display
    except ImportError as error:
        raise MissingExtraError(
            "IPython, which notebooks run on, is missing; install it: "
            "pip install ipython"
        ) from error
    return display(value, **options)


# --- what displays itself ---


def _cells(value) -> list[Cell]:
    if isinstance(value, Picture):
        return [Cell(value.pixels)]
    if isinstance(value, Render):
        return previews.of_render(value)
    if isinstance(value, Gaussians):
        return previews.of_gaussians(value)
    array = np.asarray(value)
    if array.ndim == 4 or (array.ndim == 3 and array.shape[-1] != 3):
        return [Cell(previews.visible(one)) for one in array]
    return [Cell(previews.visible(array))]


def _concrete(value) -> bool:
    """Whether the leaves of a pytree, if any, are arrays with values, now."""
    leaves = jax.tree.leaves(value)
    return bool(leaves) and all(
        isinstance(leaf, np.ndarray)
        or (
            isinstance(leaf, jax.Array)
            and not isinstance(leaf, Tracer)
            and not leaf.is_deleted()  # given away to a step
        )
        for leaf in leaves
    )


def _png(value) -> tuple[bytes, dict[str, int]] | None:
    """What Jupyter asks of a `Render` or of `Gaussians`; None where it is to print."""
    if not _concrete(value):
        return None
    try:
        return picture(value)._repr_png_()
    except (InputError, MissingExtraError):
        return None


def _html(camera: Camera) -> str | None:
    """What Jupyter asks of a `Camera`."""
    if not _concrete(camera):
        return None
    count = camera.viewmat.shape[0] if camera.batched else 1
    told = [f"{camera.width} × {camera.height} px, {camera.model.name}"]
    first = jax.tree.map(lambda a: np.asarray(a)[0] if camera.batched else a, camera)
    viewmat, K = np.asarray(first.viewmat), np.asarray(first.K)
    if camera.model.name == "pinhole":
        angles = [
            np.degrees(
                np.arctan((side - K[i, 2]) / K[i, i]) + np.arctan(K[i, 2] / K[i, i])
            )
            for i, side in enumerate((camera.width, camera.height))
        ]
        told.append(f"{angles[0]:.1f}° × {angles[1]:.1f}°")
    place = ", ".join(f"{x:.3g}" for x in -viewmat[:3, :3].T @ viewmat[:3, 3] + 0.0)
    ahead = ", ".join(f"{x + 0:.2f}" for x in viewmat[2, :3])
    told += [f"at ({place})", f"looking along ({ahead})"]
    name = f"{count} cameras, the first" if camera.batched else "Camera"
    return f"<div><b>{name}</b>: {escape('; '.join(told))}</div>"


setattr(Render, "_repr_png_", _png)  # noqa: B010
setattr(Gaussians, "_repr_png_", _png)  # noqa: B010
setattr(Camera, "_repr_html_", _html)  # noqa: B010
