"""The panel of one browser: cuts, counts, cameras, and pictures by our own renderer.

Each browser has its own; what it shows is shared. viser calls from its threads.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsjax.cameras.camera import NEAR
from gsjax.gaussians import Gaussians, select
from gsjax.runtime.console import note, one_line
from gsjax.viewer.exact import KINDS, ExactRenderer, camera_of, picture
from gsjax.viewer.splats import (
    LEAST_OPACITY,
    Cut,
    longest_axes,
    most_important,
    opacities_of,
    pack,
    within,
)
from gsjax.viewer.stage import (
    Eye,
    Frustum,
    add_cameras,
    paint_background,
    photo_distances,
    size_of_frusta,
    wxyz_of,
)

_HEIGHTS = ("270", "360", "540", "720", "1080")
_REST = 0.3  # seconds without motion after which "follow" renders
_NOWHERE = "–"


@dataclass
class Exhibit:
    """What all browsers are shown; replaced bit by bit as it changes.

    Attributes:
      gaussians: the scene.
      renderer: for exact pictures.
      eye: where one looks from at first.
      frusta: cameras of the dataset.
      status: a line about training, or "".
      max_gaussians: never more than that in the browser, the most important ones.
      min_opacity: where the slider stands at first.
    """

    gaussians: Gaussians
    renderer: ExactRenderer
    eye: Eye
    frusta: list[Frustum] = field(default_factory=list)
    status: str = ""
    max_gaussians: int | None = None
    min_opacity: float = 0.0


class Latest:
    """``work``, called so that of calls that pile up only the last is carried out."""

    def __init__(self, work: Callable[[], None]):
        self.work = work
        self.count = 0
        self.busy = threading.Lock()

    def __call__(self) -> None:
        """Do the work, unless a later call waits already."""
        self.count += 1
        mine = self.count
        with self.busy:
            if mine == self.count:
                self.work()


class Session:
    """One browser and its panel."""

    def __init__(self, client: Any, exhibit: Exhibit):
        self.client, self.exhibit = client, exhibit
        self.splats: Any = None
        # With what is shown of it: another thread takes both, of one time.
        self.scene_shown: tuple[Gaussians, np.ndarray] | None = None
        self.closed = False
        self.covered = False  # by an exact picture, over the view
        self.cameras: list[Any] = []
        self.places = np.zeros((0, 4))  # of cameras, and how far photographs are drawn
        self.stood_at = _NOWHERE  # the camera that the view is in
        self.result: Any = None
        self.photo: Any = None
        self.rest: threading.Timer | None = None
        self.refresh = Latest(self._draw)
        self.render = Latest(self._render)
        self.look_around = Latest(self._show_what_is_not_in_the_way)
        self._add_controls()
        self.show_cameras()
        client.camera.on_update(lambda _: self._moved())
        self.refresh()

    # --- the panel ---

    def _add_controls(self) -> None:
        gui, begin = self.client.gui, self.exhibit.min_opacity
        self.counts = gui.add_markdown("")
        self.opacity = gui.add_slider(
            "Opacity from", min=0.0, max=max(0.99, begin), step=0.01,
            initial_value=begin, hint="hide those of less",
        )  # fmt: skip
        self.scale = gui.add_slider(
            "Scale up to, %", min=0.0, max=100.0, step=0.5, initial_value=100.0,
            hint="by the longest axis: of all Gaussians, the smallest so many percent",
        )  # fmt: skip
        for slider in (self.opacity, self.scale):
            slider.on_update(lambda _: self._cut())
        with gui.add_folder("Exact picture"):
            self.kind = gui.add_dropdown("Shows", KINDS)
            self.height = gui.add_dropdown("Height, px", _HEIGHTS, initial_value="540")
            self.place = gui.add_dropdown("Where", ("over the view", "in the panel"))
            self.follow = gui.add_checkbox(
                "Follow", False, hint="render again whenever the camera rests"
            )
            self.button = gui.add_button("Render", hint="by gsjax, as seen from here")
            self.told = gui.add_markdown("")
            self.pictures = gui.add_folder("Picture", expand_by_default=True)
            self.pictures.visible = False
        self.button.on_click(lambda _: self.render())
        for choice in (self.kind, self.height, self.place):
            choice.on_update(lambda _: self._again())
        self.follow.on_update(lambda _: self._again())
        self.album = gui.add_folder("Cameras")
        self.go_to: Any = None

    def _again(self) -> None:
        """Render anew if an exact picture is to be seen."""
        if self.covered or self.pictures.visible or self.follow.value:
            self.render()

    def show_cameras(self) -> None:
        """Draw the exhibit's cameras, in place of those that were."""
        frusta, eye = self.exhibit.frusta, self.exhibit.eye
        self.album.visible = bool(frusta)
        if not frusta or self.closed:
            return
        if self.go_to is None:
            with self.album:
                self.drawn = self.client.gui.add_checkbox("Show", True)
                names = (_NOWHERE, *(frustum.name for frustum in frusta))
                self.go_to = self.client.gui.add_dropdown("Go to", names)
            self.drawn.on_update(lambda _: self.look_around())
            self.go_to.on_update(lambda _: self._go_to_chosen())
        size = size_of_frusta(frusta, eye.distance)
        self.places = np.column_stack(
            [[frustum.centre for frustum in frusta], photo_distances(frusta, size)]
        )
        self.cameras = add_cameras(self.client.scene, frusta, size)
        for handle, frustum in zip(self.cameras[1:], frusta):
            handle.on_click(lambda _, chosen=frustum: self._go(chosen))
        self.look_around()

    def _show_what_is_not_in_the_way(self) -> None:
        """The cameras that are wanted: none over an exact picture, and none that the
        view stands in, whose photograph would hide what is seen from there.
        """
        if not self.cameras or self.closed:
            return
        away = np.linalg.norm(self.client.camera.position - self.places[:, :3], axis=1)
        hides = away <= self.places[:, 3]
        self.cameras[0].visible = self.drawn.value and not self.covered
        for handle, hidden in zip(self.cameras[1:], hides.tolist()):
            handle.visible = not hidden
        frusta = self.exhibit.frusta
        near = [frusta[i].name for i in np.argsort(away)[: hides.sum()]]
        if self.stood_at not in near:  # said, and free to be chosen again
            self.stood_at = near[0] if near else _NOWHERE
            self.go_to.value = self.stood_at

    def _go_to_chosen(self) -> None:
        names = [frustum.name for frustum in self.exhibit.frusta]
        if self.go_to.value in names and self.go_to.value != self.stood_at:
            self._go(self.exhibit.frusta[names.index(self.go_to.value)])

    def _go(self, frustum: Frustum) -> None:
        """Stand where a photograph was taken, and put it into the panel."""
        camera = self.client.camera
        with self.client.atomic():
            camera.position = frustum.centre
            camera.wxyz = wxyz_of(frustum.viewmat[:3, :3].T)
            camera.fov = frustum.fov
        self.stood_at = self.go_to.value = frustum.name
        self.look_around()
        if frustum.photo is None:
            return
        if self.photo is None:
            with self.album:
                self.photo = self.client.gui.add_image(frustum.photo, format="jpeg")
        self.photo.image = frustum.photo
        self.photo.label = frustum.name

    # --- the splats ---

    def _cut(self) -> None:
        self.refresh()
        self._again()

    def _draw(self) -> None:
        if self.closed:
            return
        exhibit, gaussians = self.exhibit, self.exhibit.gaussians
        longest = longest_axes(gaussians)[np.asarray(gaussians.active)]
        longest = longest[np.isfinite(longest)]
        limit = float("inf")
        if self.scale.value < 100 and len(longest):
            limit = float(np.percentile(longest, self.scale.value))
        shown = within(gaussians, Cut(self.opacity.value, limit))
        self.scene_shown = gaussians, shown
        sent = shown
        if exhibit.max_gaussians is not None:
            sent = most_important(gaussians, shown, exhibit.max_gaussians)
        splats = pack(gaussians, sent)
        if len(splats.centers):
            self.splats = self.client.scene.add_gaussian_splats(
                "/splats", **splats._asdict(), visible=not self.covered
            )
        elif self.splats is not None:
            self.splats.remove()
            self.splats = None
        found = np.count_nonzero(np.asarray(gaussians.active))
        faint = np.count_nonzero(opacities_of(gaussians)[shown] < LEAST_OPACITY)
        lines = [f"**{len(splats.centers):,}** of {found:,} Gaussians"]
        if faint:
            told = f"{faint:,} of opacity below {LEAST_OPACITY} in exact pictures only"
            lines.append(told)
        if limit < float("inf"):
            lines.append(f"scales up to {limit:.3g}")
        if exhibit.status:
            lines.append(exhibit.status)
        self.counts.content = "<br/>".join(lines)
        if self.follow.value:
            self.render()

    # --- exact pictures ---

    def _render(self) -> None:
        """The picture for where the camera is now; what goes wrong is told there."""
        if self.scene_shown is None or self.closed:
            return
        gaussians, shown = self.scene_shown
        self.told.content = "rendering; the first of a size compiles for some seconds"
        camera, height = self.client.camera, int(self.height.value)
        width = max(1, round(height * camera.aspect))
        begun, seen_from = time.perf_counter(), camera.update_timestamp
        try:
            view = self.exhibit.renderer(
                select(gaussians, shown),  # pyright: ignore
                camera_of(
                    camera.wxyz,
                    camera.position,
                    camera.fov,
                    width,
                    height,
                    near=min(NEAR, self.exhibit.eye.near),
                ),
            )
        except Exception as error:  # of XLA too, as where memory is short
            self.told.content = f"not rendered: {one_line(error)}"
            note(f"warning: {one_line(error)}")
            return
        if self.closed:
            return
        pixels, what = picture(view, self.kind.value)
        seconds = time.perf_counter() - begun
        self.told.content = f"{what}, {width} × {height} px, {seconds:.2f} s"
        if camera.update_timestamp == seen_from:
            self._put(pixels)
        else:
            self._moved()

    def _put(self, pixels: np.ndarray) -> None:
        """Show a picture where it is wanted, and nowhere else."""
        over = self.place.value == "over the view"
        self.pictures.visible = not over
        if not over:
            self._uncover()
            if self.result is None:
                with self.pictures:
                    self.result = self.client.gui.add_image(pixels, format="png")
            self.result.image = pixels
            return
        with self.client.atomic():
            self.covered = True
            self.client.scene.set_background_image(pixels, format="png")
            if self.splats is not None:
                self.splats.visible = False
        self.look_around()

    def _uncover(self) -> None:
        """The browser's own splats again."""
        if not self.covered:
            return
        with self.client.atomic():
            self.covered = False
            background = self.exhibit.renderer.background
            paint_background(self.client.scene, background)
            if self.splats is not None:
                self.splats.visible = True
        self.look_around()

    def _moved(self) -> None:
        """A picture is only right for where it was taken from."""
        self._uncover()
        self.look_around()
        if self.rest is not None:
            self.rest.cancel()
        if self.follow.value:
            self.rest = threading.Timer(_REST, self.render)
            self.rest.daemon = True
            self.rest.start()

    def close(self) -> None:
        """Nothing more is drawn."""
        self.closed = True
        if self.rest is not None:
            self.rest.cancel()
