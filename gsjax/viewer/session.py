"""The panel of one browser: cuts, counts, cameras, and images rendered by gsjax.

Each browser has its own session; the content is shared. viser calls from its threads.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsjax.cameras.camera import NEAR
from gsjax.gaussians import Gaussians, select
from gsjax.mesh.surface import Mesh
from gsjax.runtime.console import note, one_line
from gsjax.train.motion.scene import MovingScene
from gsjax.viewer import cameras, splats
from gsjax.viewer.exact import KINDS, ExactRenderer, camera_of, picture
from gsjax.viewer.timeline import Timeline
from gsjax.viewer.viser_server import add_mesh, set_background

_HEIGHTS = ("270", "360", "540", "720", "1080")
_REST = 0.3  # seconds without motion after which "follow" renders
_COLLECTED = 0.05  # seconds after which viser has sent a message
_NOWHERE = "–"
_SCENES = ("mesh", "splats", "splats and mesh")


@dataclass
class ViewerContent:
    """Content that all browsers show; attributes are replaced as they change.

    Attributes:
      gaussians, renderer: the scene, and what renders exact images of it.
      viewpoint, frusta: initial camera, and cameras of the dataset.
      status: a line about training, or "".
      max_gaussians: largest number in the browser; the most important ones are kept.
      min_opacity: initial value of the slider.
      ordered: the scene lists its Gaussians by importance, the most important first;
        otherwise `gsjax.viewer.splats.by_importance` estimates it.
      mesh: a mesh of the scene, shown in place of the splats at first; or None.
      moving: the scene at all times, if it moves; ``gaussians`` are those at time 0.
    """

    gaussians: Gaussians
    renderer: ExactRenderer
    viewpoint: cameras.Viewpoint
    frusta: list[cameras.Frustum] = field(default_factory=list)
    status: str = ""
    max_gaussians: int | None = None
    min_opacity: float = 0.0
    ordered: bool = False
    mesh: Mesh | None = None
    moving: MovingScene | None = None


class Latest:
    """A function without arguments; of calls that pile up only the last runs."""

    def __init__(self, work: Callable[[], None]):
        self.work = work
        self.count = 0
        self.busy = threading.Lock()

    def __call__(self) -> None:
        """Do the work, unless a later call is waiting."""
        self.count += 1
        mine = self.count
        with self.busy:
            if mine == self.count:
                self.work()


class Session:
    """One browser and its panel."""

    def __init__(self, client: Any, content: ViewerContent):
        self.client, self.content = client, content
        self.splats: Any = None
        self.mesh: Any = None
        self.choice: Any = None  # of splats or mesh
        self.timeline: Timeline | None = None
        self.moment = 0.0
        # The scene and its mask in one tuple: another thread reads both.
        self.scene_shown: tuple[Gaussians, np.ndarray] | None = None
        self.closed = False
        self.covered = False  # an exact image lies over the view
        self.cameras: list[Any] = []
        # Positions of the cameras, and the distances of their photographs.
        self.places = np.zeros((0, 4))
        self.camera_name = _NOWHERE  # of the camera that the view is in
        self.result: Any = None
        self.photo: Any = None
        self.rest: threading.Timer | None = None
        self.refresh = Latest(self._draw)
        self.render = Latest(self._render)
        self.update_cameras = Latest(self._update_cameras)
        self._add_controls()
        if content.mesh is not None:
            self.mesh = add_mesh(client.scene, content.mesh)
        self.show_cameras()
        client.camera.on_update(lambda _: self._moved())
        self.refresh()

    def _add_controls(self) -> None:
        gui, begin = self.client.gui, self.content.min_opacity
        self.counts = gui.add_markdown("")
        if self.content.mesh is not None:
            self.choice = gui.add_dropdown("Scene", _SCENES, initial_value=_SCENES[0])
            self.choice.on_update(lambda _: self._choose())
        if self.content.moving is not None:
            self.timeline = Timeline(gui, self._show_time)
        self.opacity = gui.add_slider(
            "Opacity from", min=0.0, max=max(0.99, begin), step=0.01,
            initial_value=begin, hint="hide Gaussians of lower opacity",
        )  # fmt: skip
        self.scale = gui.add_slider(
            "Scale up to, %", min=0.0, max=100.0, step=0.5, initial_value=100.0,
            hint="show this percentage of Gaussians, the smallest by longest axis",
        )  # fmt: skip
        for slider in (self.opacity, self.scale):
            slider.on_update(lambda _: (self.refresh(), self._again()))
        with gui.add_folder("Exact image"):
            self.kind = gui.add_dropdown("Shows", KINDS)
            self.height = gui.add_dropdown("Height, px", _HEIGHTS, initial_value="540")
            self.place = gui.add_dropdown("Where", ("over the view", "in the panel"))
            hint = "render again when the camera rests"
            self.follow = gui.add_checkbox("Follow", False, hint=hint)
            self.button = gui.add_button("Render", hint="render this view with gsjax")
            self.message = gui.add_markdown("")
            self.pictures = gui.add_folder("Image", expand_by_default=True)
            self.pictures.visible = False
        self.button.on_click(lambda _: self.render())
        for choice in (self.kind, self.height, self.place, self.follow):
            choice.on_update(lambda _: self._again())
        self.camera_folder = gui.add_folder("Cameras")
        self.go_to: Any = None

    def _show_time(self, moment: float) -> None:
        """Show the scene at another time."""
        self.moment = moment
        self.refresh()
        self._again()

    def _gaussians(self) -> Gaussians:
        """Return the scene at the time of this browser."""
        moving = self.content.moving
        return self.content.gaussians if moving is None else moving.at(self.moment)

    def _shows(self, what: str) -> bool:
        """Return whether "splats" or "mesh" are visible."""
        chosen = what == "splats" if self.choice is None else what in self.choice.value
        return chosen and not self.covered

    def _choose(self) -> None:
        """Show splats, mesh or both, as chosen; neither under an exact image."""
        for handle, what in ((self.splats, "splats"), (self.mesh, "mesh")):
            if handle is not None:
                handle.visible = self._shows(what)

    def _again(self) -> None:
        """Render again if an exact image is visible."""
        if self.covered or self.pictures.visible or self.follow.value:
            self.render()

    def show_cameras(self) -> None:
        """Draw the cameras of the content, in place of earlier ones."""
        frusta = self.content.frusta
        self.camera_folder.visible = bool(frusta)
        if not frusta or self.closed:
            return
        if self.go_to is None:
            with self.camera_folder:
                self.drawn = self.client.gui.add_checkbox("Show", True)
                names = (_NOWHERE, *(frustum.name for frustum in frusta))
                self.go_to = self.client.gui.add_dropdown("Go to", names)
            self.drawn.on_update(lambda _: self.update_cameras())
            self.go_to.on_update(lambda _: self._go_to_chosen())
        size = cameras.frustum_size(frusta, self.content.viewpoint.distance)
        distances = cameras.photo_distances(frusta, size)
        self.places = np.column_stack([[f.centre for f in frusta], distances])
        self.cameras = cameras.add_cameras(self.client.scene, frusta, size)
        for handle, frustum in zip(self.cameras[1:], frusta):
            handle.on_click(lambda _, chosen=frustum: self._go(chosen))
        self.update_cameras()

    def _update_cameras(self) -> None:
        """Show the cameras, not over an exact image, and none that the view is in."""
        if not self.cameras or self.closed:
            return
        away = np.linalg.norm(self.client.camera.position - self.places[:, :3], axis=1)
        hides = away <= self.places[:, 3]
        self.cameras[0].visible = self.drawn.value and not self.covered
        for handle, hidden in zip(self.cameras[1:], hides.tolist()):
            handle.visible = not hidden
        frusta = self.content.frusta
        near = [frusta[i].name for i in np.argsort(away)[: hides.sum()]]
        if self.camera_name not in near:  # shown, and free to be chosen again
            self.camera_name = near[0] if near else _NOWHERE
            self.go_to.value = self.camera_name

    def _go_to_chosen(self) -> None:
        names = [frustum.name for frustum in self.content.frusta]
        if self.go_to.value in names and self.go_to.value != self.camera_name:
            self._go(self.content.frusta[names.index(self.go_to.value)])

    def _go(self, frustum: cameras.Frustum) -> None:
        """Move to where a photograph was taken, and show it in the panel."""
        camera = self.client.camera
        with self.client.atomic():
            camera.position = frustum.centre
            camera.wxyz = cameras.wxyz_of(frustum.viewmat[:3, :3].T)
            camera.fov = frustum.fov
        self.camera_name = self.go_to.value = frustum.name
        self.update_cameras()
        if frustum.photo is None:
            return
        if self.photo is None:
            with self.camera_folder:
                self.photo = self.client.gui.add_image(frustum.photo, format="jpeg")
        self.photo.image = frustum.photo
        self.photo.label = frustum.name

    def _draw(self) -> None:
        if self.closed:
            return
        content, gaussians = self.content, self._gaussians()
        longest = splats.longest_axes(gaussians)[np.asarray(gaussians.active)]
        longest = longest[np.isfinite(longest)]
        limit = float("inf")
        if self.scale.value < 100 and len(longest):
            limit = float(np.percentile(longest, self.scale.value))
        shown = splats.within(gaussians, splats.Cut(self.opacity.value, limit))
        self.scene_shown = gaussians, shown
        drawn = shown & (splats.opacities_of(gaussians) >= splats.MIN_DRAWN_OPACITY)
        ordered, most = content.ordered, content.max_gaussians
        sent = splats.most_important(gaussians, drawn, most, ordered)
        if self.splats is None and np.count_nonzero(sent) >= splats.MANY:
            first = splats.importance_parts(gaussians, sent, 2, ordered)[0]
            self._send(gaussians, first)
            # viser collects messages for 1/60 s, and drops a node replaced meanwhile.
            time.sleep(_COLLECTED)
        self._send(gaussians, sent)
        found = np.count_nonzero(np.asarray(gaussians.active))
        least, faint = splats.MIN_DRAWN_OPACITY, np.count_nonzero(shown & ~drawn)
        lines = [
            f"**{np.count_nonzero(sent):,}** of {found:,} Gaussians",
            f"{faint:,} of opacity below {least} in exact images only" if faint else "",
            f"scales up to {limit:.3g}" if limit < float("inf") else "",
            content.status,
        ]
        self.counts.content = "<br/>".join(filter(None, lines))
        if self.follow.value:
            self.render()

    def _send(self, gaussians: Gaussians, mask: np.ndarray) -> None:
        """Replace the splats of the browser by those of a mask [N]."""
        packed = splats.pack(gaussians, mask)
        if self.closed:
            return
        if len(packed.centers):
            self.splats = self.client.scene.add_gaussian_splats(
                "/splats", **packed._asdict(), visible=self._shows("splats")
            )
        elif self.splats is not None:
            self.splats.remove()
            self.splats = None

    def _render(self) -> None:
        """Render for the present camera, and show the image or the error."""
        if self.scene_shown is None or self.closed:
            return
        gaussians, shown = self.scene_shown
        self.message.content = "rendering; a new image size takes seconds to compile"
        camera, height = self.client.camera, int(self.height.value)
        width = max(1, round(height * camera.aspect))
        begun, seen_from = time.perf_counter(), camera.update_timestamp
        near, place = min(NEAR, self.content.viewpoint.near), camera.position
        try:
            taken = camera_of(camera.wxyz, place, camera.fov, width, height, near=near)
            some = select(gaussians, shown)  # pyright: ignore
            view = self.content.renderer(some, taken)
        except Exception as error:  # also of XLA, when memory is short
            self.message.content = f"not rendered: {one_line(error)}"
            note(f"warning: {one_line(error)}")
            return
        if self.closed:
            return
        pixels, what = picture(view, self.kind.value)
        seconds = time.perf_counter() - begun
        self.message.content = f"{what}, {width} × {height} px, {seconds:.2f} s"
        if camera.update_timestamp == seen_from:
            self._put(pixels)
        else:
            self._moved()

    def _put(self, pixels: np.ndarray) -> None:
        """Show an image at the chosen place only."""
        over = self.place.value == "over the view"
        self.pictures.visible = not over
        if not over:
            self._uncover()
            if self.result is None:
                with self.pictures:
                    self.result = self.client.gui.add_image(pixels, format="png")
            self.result.image = pixels
            return
        self._cover(pixels)

    def _uncover(self) -> None:
        """Show the splats of the browser again."""
        if self.covered:
            self._cover(None)

    def _cover(self, pixels: np.ndarray | None) -> None:
        """Show an image instead of splats and cameras, or these again."""
        scene = self.client.scene
        with self.client.atomic():
            self.covered = pixels is not None
            if pixels is None:
                set_background(scene, self.content.renderer.background)
            else:
                scene.set_background_image(pixels, format="png")
            self._choose()
        self.update_cameras()

    def _moved(self) -> None:
        """Remove the image, which is right for its own camera only."""
        self._uncover()
        self.update_cameras()
        if self.rest is not None:
            self.rest.cancel()
        if self.follow.value:
            self.rest = threading.Timer(_REST, self.render)
            self.rest.daemon = True
            self.rest.start()

    def close(self) -> None:
        """Stop drawing."""
        self.closed = True
        if self.timeline is not None:
            self.timeline.close()
        if self.rest is not None:
            self.rest.cancel()
