"""A scene as one HTML page that opens offline."""

import html
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.errors import InputError, MissingExtraError
from gsjax.gaussians import Gaussians, num_active
from gsjax.runtime import files
from gsjax.viewer import page_parts
from gsjax.viewer.cameras import add_cameras, frustum_size, set_viewpoint
from gsjax.viewer.session import ViewerContent
from gsjax.viewer.splats import (
    MANY,
    MIN_DRAWN_OPACITY,
    Cut,
    Splats,
    importance_parts,
    most_important,
    pack,
    within,
)
from gsjax.viewer.timeline import controls, page_moments
from gsjax.viewer.viser_server import (
    add_mesh,
    open_server,
    set_background,
    stop_server,
)

MOMENTS = 25  # at which a page shows a scene that moves
_CAPTION = """<div style="position:fixed;left:12px;bottom:10px;z-index:9;color:#ddd;
font:13px sans-serif;background:rgba(0,0,0,.7);padding:3px 7px;border-radius:4px;
pointer-events:none">{}</div>"""

# viser sorts its splats in a module worker that it starts from a blob. A page opened
# from a disk has no origin, and Chromium then silently starts no worker from a blob; it
# does from a data URL of the same text.
_WORKERS = """<script>
(() => {
  const texts = new Map(), toURL = URL.createObjectURL.bind(URL);
  const NativeBlob = window.Blob, NativeWorker = window.Worker;
  const complain = () => {
    if (document.getElementById("unsorted")) return;
    const line = document.createElement("div");
    line.id = "unsorted";
    line.style = "position:fixed;left:12px;top:10px;z-index:9;color:#f66;" +
      "font:13px sans-serif";
    line.textContent = "This browser does not sort the splats of a page from a disk: " +
      "hidden splats show through. Try another, or gsjax view without --html.";
    document.body.append(line);
  };
  window.Blob = class extends NativeBlob {
    constructor(parts, options) {
      super(parts, options);
      if (parts?.every((part) => typeof part === "string")) this.text_ = parts.join("");
    }
  };
  URL.createObjectURL = (object) => {
    const url = toURL(object);
    if (object.text_ !== undefined) texts.set(url, object.text_);
    return url;
  };
  window.Worker = class extends NativeWorker {
    constructor(url, options) {
      const text = window.origin === "null" ? texts.get(String(url)) : undefined;
      const data = "data:text/javascript;charset=utf-8,";
      super(text === undefined ? url : data + encodeURIComponent(text), options);
      const fromDisk = window.origin === "null" && /^(blob|data):/.test(String(url));
      if (fromDisk) this.addEventListener("error", complain);
    }
  };
})();
</script>"""


class Page(NamedTuple):
    """Counts of a page.

    Attributes:
      drawn, found: Gaussians drawn, and of the scene.
      size: bytes.
      triangles: of the mesh, which is drawn in place of the Gaussians; 0 without one.
      moments: at which a scene that moves is shown; 0 if it stands still.
    """

    drawn: int
    found: int
    size: int
    triangles: int = 0
    moments: int = 0


def write_page(
    content: ViewerContent, path: Path, *, title: str, parts: int | None = 1
) -> Page:
    """Write a scene, or its mesh, and its cameras into one HTML file.

    Args:
      content: the scene, reduced by its ``min_opacity`` and ``max_gaussians``; or its
        mesh, if there is one.
      path: of the file, replaced if it exists; its folder is created if missing.
      title: of the page.
      parts: number of parts in which the Gaussians appear while the page loads, the
        most important first, as `importance_parts` divides them. None chooses two for
        `MANY` Gaussians and more, where viser supports it.

    Raises:
      MissingExtraError: if viser is absent, or too old for several parts.
      InputError: if no Gaussian would be drawn, or the file cannot be written.
    """
    gaussians, mesh = content.gaussians, content.mesh
    shown = _shown(content, gaussians)
    drawn, found = int(shown.sum()), int(num_active(gaussians))
    if found and not drawn and mesh is None:
        what = f"none of {found:,} Gaussians is opaque enough to be drawn"
        raise InputError(f"{path}: {what}; lower --min-opacity")
    count = _number_of_parts(parts, 0 if mesh is not None else drawn)
    masks = importance_parts(gaussians, shown, count, content.ordered)
    moments = 0
    server = open_server("127.0.0.1", 0)
    try:
        if content.moving is not None and mesh is None:
            moments = MOMENTS
            text, scripts = _recorded_moments(server, content, moments)
        else:
            text, scripts = _recorded(server, content, masks)
    finally:
        stop_server(server)
    what = (
        f"{drawn:,} of {found:,} Gaussians in view-independent colours (SH degree 0)"
        if mesh is None
        else f"mesh of {len(mesh.faces):,} triangles"
    )
    caption = (
        f"{html.escape(title)} · {what}, drawn by viser; gsjax<br>"
        "Drag to rotate, drag with the right button to pan, scroll to zoom."
    )
    head, tail = text.rsplit("</body>", 1)
    head = head.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>")
    before, after = _WORKERS, "".join(scripts)
    if moments:
        after = controls(moments) + after
    if scripts:
        first = f"{int(masks[0].sum()):,} are shown, the others load."
        if moments:
            first = f"The first of {moments} moments is shown, the others load."
        before, after = before + page_parts.HEAD, page_parts.START + after
        caption += page_parts.STATUS.format(first)
    head = head.replace("<head>", f"<head>{before}", 1)
    data = f"{head}{_CAPTION.format(caption)}{after}</body>{tail}".encode()
    files.make_folder(path.parent)
    files.write_file(path, data)
    if mesh is not None:
        return Page(0, found, len(data), len(mesh.faces))
    return Page(drawn, found, len(data), moments=moments)


def _recorded_moments(
    server: Any, content: ViewerContent, count: int
) -> tuple[str, list[str]]:
    """Return the page with the first moment of a scene, and a script with the others.

    Raises:
      MissingExtraError: if the installed viser cannot load a page in parts.
    """
    assert content.moving is not None
    if not page_parts.parts_are_possible():
        what = "the installed viser cannot show a scene that moves in a page"
        raise MissingExtraError(f"{what}; pip install -U viser, or gsjax view --time")
    still, found = page_moments(content.moving, count, partial(_shown, content))
    scene = server.scene
    set_viewpoint(server, content.viewpoint)
    set_background(scene, content.renderer.background)

    def add(packed: Splats) -> None:
        if len(packed.centers):
            scene.add_gaussian_splats(page_parts.KEPT, **packed._asdict())

    def add_moments() -> None:
        for packed in found:
            add(packed)
        if content.frusta:
            size = frustum_size(content.frusta, content.viewpoint.distance)
            add_cameras(scene, content.frusta, size)

    if len(still.centers):
        scene.add_gaussian_splats("/splats", **still._asdict())
    add(found[0])
    text = scene.as_html(dark_mode=True)
    return text, page_parts.record(server, [(add_moments, "")])


def _shown(content: ViewerContent, gaussians: Gaussians) -> np.ndarray:
    """Return [N] bool: the Gaussians that a page draws."""
    shown = within(gaussians, Cut(max(content.min_opacity, MIN_DRAWN_OPACITY)))
    return most_important(gaussians, shown, content.max_gaussians, content.ordered)


def _number_of_parts(parts: int | None, drawn: int) -> int:
    """Return the number of parts of a page; see `write_page`."""
    possible = page_parts.parts_are_possible()
    if parts is None:
        return 2 if possible and drawn >= MANY else 1
    if parts > 1 and not possible:
        what = "the installed viser cannot load a page in parts"
        raise MissingExtraError(f"{what}; pip install -U viser, or ask for one part")
    return parts if drawn else 1


def _recorded(
    server: Any, content: ViewerContent, masks: list[np.ndarray]
) -> tuple[str, list[str]]:
    """Return the page of viser with the first part, and scripts with the others.

    The cameras, with their photographs, are in the last part.
    """
    scene = server.scene
    set_viewpoint(server, content.viewpoint)
    set_background(scene, content.renderer.background)

    def add(index: int) -> None:
        if content.mesh is not None:
            add_mesh(scene, content.mesh)
        elif masks:
            packed = pack(content.gaussians, masks[index])
            name = f"/splats-{index + 1}" if index else "/splats"
            scene.add_gaussian_splats(name, **packed._asdict())
        if content.frusta and index + 1 >= len(masks):
            size = frustum_size(content.frusta, content.viewpoint.distance)
            add_cameras(scene, content.frusta, size)

    add(0)
    text = scene.as_html(dark_mode=True)
    if len(masks) < 2:
        return text, []
    steps, so_far = [], int(masks[0].sum())
    for index in range(1, len(masks)):
        so_far += int(masks[index].sum())
        last = index + 1 == len(masks)
        status = "" if last else f"{so_far:,} are shown, the others load."
        steps.append((partial(add, index), status))
    return text, page_parts.record(server, steps)
