"""A scene as one page, that opens offline."""

import html
from pathlib import Path
from typing import NamedTuple

from gsjax.errors import InputError
from gsjax.gaussians import num_active
from gsjax.runtime import files
from gsjax.viewer.session import Exhibit
from gsjax.viewer.splats import Cut, most_important, pack, within
from gsjax.viewer.stage import (
    add_cameras,
    open_server,
    paint_background,
    set_eye,
    size_of_frusta,
    stop_server,
)

_CAPTION = """<div style="position:fixed;left:12px;bottom:10px;z-index:9;color:#ddd;
font:13px sans-serif;background:rgba(0,0,0,.7);padding:3px 7px;border-radius:4px;
pointer-events:none">{}</div>"""

# viser sorts its splats in a module worker, which it starts from a blob. A page opened
# from a disk has no origin; Chromium then starts none from there, and says nothing.
# From a data URL with the same text it does.
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
      "what is behind shows through. Try another, or gsjax view without --html.";
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
    """What was written: Gaussians drawn, of how many, and bytes."""

    drawn: int
    found: int
    size: int


def write_page(exhibit: Exhibit, path: Path, *, title: str) -> Page:
    """Write what `Exhibit` says, with its cameras, into one HTML file.

    Args:
      exhibit: the scene; cut and thinned out as it says.
      path: of the file, replaced if it exists; its folder is created if missing.
      title: of the page.

    Raises:
      MissingExtraError: without viser.
      InputError: if nothing would be left of the scene, or the file cannot be written.
    """
    gaussians = exhibit.gaussians
    shown = within(gaussians, Cut(exhibit.min_opacity))
    if exhibit.max_gaussians is not None:
        shown = most_important(gaussians, shown, exhibit.max_gaussians)
    splats = pack(gaussians, shown)
    drawn, found = len(splats.centers), int(num_active(gaussians))
    if found and not drawn:
        raise InputError(
            f"{path}: none of {found:,} Gaussians is opaque enough to be drawn; lower "
            "--min-opacity"
        )
    server = open_server("127.0.0.1", 0)
    try:
        set_eye(server, exhibit.eye)
        paint_background(server.scene, exhibit.renderer.background)
        if drawn:
            server.scene.add_gaussian_splats("/splats", **splats._asdict())
        if exhibit.frusta:
            size = size_of_frusta(exhibit.frusta, exhibit.eye.distance)
            add_cameras(server.scene, exhibit.frusta, size)
        text = server.scene.as_html(dark_mode=True)
    finally:
        stop_server(server)
    caption = (
        f"{html.escape(title)} · {drawn:,} of {found:,} Gaussians, each of one colour "
        "from all sides (SH degree 0), drawn by viser; gsjax<br>"
        "Drag to turn, with the right button to shift; the wheel goes nearer."
    )
    head, tail = text.rsplit("</body>", 1)
    head = head.replace("<head>", f"<head>{_WORKERS}", 1)
    head = head.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>")
    data = f"{head}{_CAPTION.format(caption)}</body>{tail}".encode()
    files.make_folder(path.parent)
    files.write_file(path, data)
    return Page(drawn, found, len(data))
