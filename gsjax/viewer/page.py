"""A scene as one HTML page that opens offline."""

import html
from pathlib import Path
from typing import NamedTuple

from gsjax.errors import InputError
from gsjax.gaussians import num_active
from gsjax.runtime import files
from gsjax.viewer.cameras import add_cameras, frustum_size, set_viewpoint
from gsjax.viewer.session import ViewerContent
from gsjax.viewer.splats import Cut, most_important, pack, within
from gsjax.viewer.viser_server import (
    add_mesh,
    open_server,
    set_background,
    stop_server,
)

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
    """

    drawn: int
    found: int
    size: int
    triangles: int = 0


def write_page(content: ViewerContent, path: Path, *, title: str) -> Page:
    """Write a scene, or its mesh, and its cameras into one HTML file.

    Args:
      content: the scene, reduced by its ``min_opacity`` and ``max_gaussians``; or its
        mesh, if there is one.
      path: of the file, replaced if it exists; its folder is created if missing.
      title: of the page.

    Raises:
      MissingExtraError: if viser is absent.
      InputError: if no Gaussian would be drawn, or the file cannot be written.
    """
    gaussians, mesh = content.gaussians, content.mesh
    shown = within(gaussians, Cut(content.min_opacity))
    splats = pack(gaussians, most_important(gaussians, shown, content.max_gaussians))
    drawn, found = len(splats.centers), int(num_active(gaussians))
    if found and not drawn and mesh is None:
        what = f"none of {found:,} Gaussians is opaque enough to be drawn"
        raise InputError(f"{path}: {what}; lower --min-opacity")
    server = open_server("127.0.0.1", 0)
    try:
        set_viewpoint(server, content.viewpoint)
        set_background(server.scene, content.renderer.background)
        if mesh is not None:
            add_mesh(server.scene, mesh)
        elif drawn:
            server.scene.add_gaussian_splats("/splats", **splats._asdict())
        if content.frusta:
            size = frustum_size(content.frusta, content.viewpoint.distance)
            add_cameras(server.scene, content.frusta, size)
        text = server.scene.as_html(dark_mode=True)
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
    head = head.replace("<head>", f"<head>{_WORKERS}", 1)
    head = head.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>")
    data = f"{head}{_CAPTION.format(caption)}</body>{tail}".encode()
    files.make_folder(path.parent)
    files.write_file(path, data)
    if mesh is not None:
        return Page(0, found, len(data), len(mesh.faces))
    return Page(drawn, found, len(data))
