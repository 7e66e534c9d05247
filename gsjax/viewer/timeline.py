"""The time of a scene that moves: a slider and a play button, live and in a page.

A page holds what stands still once, and what moves at each of several moments.
"""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gsjax.gaussians import Gaussians
from gsjax.train.motion.scene import MovingScene
from gsjax.viewer import splats

_SECONDS = 4.0  # for time to run from 0 to 1 while it plays
_PAUSE = 0.1  # seconds between two moments while it plays


class Timeline:
    """Slider and play box in the panel of a browser."""

    def __init__(self, gui: Any, show: Callable[[float], None]):
        """Add them to a panel; ``show`` receives each new time."""
        self.slider = gui.add_slider(
            "Time", min=0.0, max=1.0, step=0.01, initial_value=0.0
        )
        self.play = gui.add_checkbox("Play", False, hint="let the time run, repeatedly")
        self.closed = threading.Event()
        self.running: threading.Thread | None = None
        self.slider.on_update(lambda _: show(float(self.slider.value)))
        self.play.on_update(lambda _: self._start())

    def _start(self) -> None:
        if self.play.value and (self.running is None or not self.running.is_alive()):
            self.running = threading.Thread(target=self._run, daemon=True)
            self.running.start()

    def _run(self) -> None:
        before = time.monotonic()
        while self.play.value and not self.closed.wait(_PAUSE):
            now = time.monotonic()
            passed, before = (now - before) / _SECONDS, now
            self.slider.value = round((float(self.slider.value) + passed) % 1.0, 2)

    def close(self) -> None:
        """Stop playing."""
        self.closed.set()


def moving_mask(scene: MovingScene) -> np.ndarray:
    """Return [N] bool: the active Gaussians that are not kept still."""
    active = np.asarray(scene.params.gaussians.active)
    return active & (np.asarray(scene.params.model.buffers["moving"]) > 0)


def page_moments(
    scene: MovingScene, count: int, choose: Callable[[Gaussians], np.ndarray]
) -> tuple[splats.Splats, list[splats.Splats]]:
    """Return what stands still, and what moves at each of ``count`` moments.

    Args:
      scene: with N slots.
      count: of moments, which divide the time from 0 to 1 evenly.
      choose: returns [N] bool, the Gaussians to be shown at a moment.

    Returns:
      The splats that stand still, and those of each moment; moments have equally many,
      the last of which are invisible where fewer are shown.
    """
    moving = moving_mask(scene)
    first = scene.at(0.0)
    still = splats.pack(first, choose(first) & ~moving)
    found = []
    for moment in np.linspace(0, 1, count).tolist():
        now = scene.at(moment)
        found.append(splats.pack(now, choose(now) & moving))
    size = max(len(packed.centers) for packed in found)
    return still, [splats.padded(packed, size) for packed in found]


# Shows one of the moments of a page. As many splats take the place of those before, so
# a page draws and sorts those of one moment only.
CONTROLS = """<div id="gsjax-time" style="position:fixed;left:12px;bottom:58px;
z-index:9;color:#ddd;font:13px sans-serif;background:rgba(0,0,0,.7);padding:5px 9px;
border-radius:4px">
<button id="gsjax-play" style="width:4.5em">Play</button>
<input id="gsjax-slider" type="range" min="0" max="1" step="any" value="0"
style="width:260px;vertical-align:middle" aria-label="Time">
<output id="gsjax-now">0.00</output></div>
<script>
(() => {
  const count = {count}, seconds = {seconds}, kept = window.gsjaxParts.kept;
  const slider = document.getElementById("gsjax-slider");
  const button = document.getElementById("gsjax-play");
  let shown = 0, playing = false, before = 0;
  const show = () => {
    const time = Number(slider.value), index = Math.round(time * (count - 1));
    document.getElementById("gsjax-now").textContent = time.toFixed(2);
    // Before its splats have arrived, a moment cannot be shown.
    if (index === shown || index >= kept.length) return;
    const { name, owner, props: { buffer, scale } } = kept[index];
    window.__viserMutable.messageQueue.push({
      type: "SceneNodeUpdateMessage", name, owner, updates: { buffer, scale }});
    window.__viserMutable.requestRender();
    shown = index;
  };
  const run = (now) => {
    if (!playing) return;
    slider.value = (Number(slider.value) + (now - before) / 1000 / seconds) % 1;
    before = now;
    show();
    requestAnimationFrame(run);
  };
  slider.addEventListener("input", show);
  button.addEventListener("click", () => {
    playing = !playing;
    button.textContent = playing ? "Pause" : "Play";
    before = performance.now();
    if (playing) requestAnimationFrame(run);
  });
  const arrived = setInterval(() => {
    if (kept.length < count) return;
    clearInterval(arrived);
    show();
  }, 100);
})();
</script>"""


def controls(count: int) -> str:
    """Return the slider and the play button of a page with ``count`` moments."""
    text = CONTROLS.replace("{count}", str(count))
    return text.replace("{seconds}", str(_SECONDS))
