"""A training in the browser, while it goes on.

What is shown is a copy, made between two steps, at most for a fiftieth of the time;
so a run comes to the same bits with and without.
"""

import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from gsjax.data.types import Dataset, Photo
from gsjax.gaussians import Gaussians
from gsjax.runtime.console import note
from gsjax.train.config import TrainConfig
from gsjax.train.loop import Progress
from gsjax.train.state import TrainState
from gsjax.viewer.opening import exhibit_of_training
from gsjax.viewer.stage import require_viser
from gsjax.viewer.window import Window

_INTERVAL = 2.0  # seconds between two copies, at least
_SHARE = 0.02  # of the time, at most


class LiveViewer:
    """Watches one run.

    Args:
      host, port: where to serve.

    Raises:
      MissingExtraError: without viser.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080):
        require_viser()
        self.host, self.port = host, port
        self.window: Window | None = None
        self.due = 0.0

    def begin(
        self, scene: Dataset, photos: Sequence[Photo], config: TrainConfig
    ) -> Callable[[TrainState, Progress], None]:
        """The hook for `gsjax.Hooks.state`; serving begins at its first."""

        def after_step(state: TrainState, progress: Progress) -> None:
            step = int(progress.metrics.step)
            last, now = step == config.steps, time.monotonic()
            window = self.window
            if window is not None and not last and not self.wants(window, now):
                return
            gaussians = copy_on_one_device(state.gaussians)
            jax.block_until_ready(gaussians)
            if window is None:
                exhibit = exhibit_of_training(gaussians, scene, photos, config)
                self.window = window = Window(exhibit, host=self.host, port=self.port)
                note(f"viewer: {window.url}")
            window.show(gaussians, f"step {step:,} of {config.steps:,}")
            took = time.monotonic() - now
            self.due = now + max(_INTERVAL, took / _SHARE)

        return after_step

    def wants(self, window: Window, now: float) -> bool:
        """Whether it is time for the next copy, and the last one has been shown."""
        return now >= self.due and not window.busy

    def stay(self) -> None:
        """Until nobody looks any more, or Ctrl-C."""
        window = self.window
        if window is None or not window.watched:
            return
        note(f"viewer: {window.url} stays until its last page is closed, or Ctrl-C")
        try:
            while window.watched:
                window.left.wait(1.0)
                window.left.clear()
        except KeyboardInterrupt:
            pass

    def close(self) -> None:
        """Stop serving."""
        if self.window is not None:
            self.window.close()


def copy_on_one_device(gaussians: Gaussians) -> Gaussians:
    """A copy on the first device, whose memory the next step does not take over.

    The step leaves its state on all devices, and all would render it. `jax.device_put`
    (jax 0.10.2) copies nothing to a device that has it already.
    """
    there = jax.device_put(gaussians, jax.local_devices()[0])
    return jax.tree.map(jnp.copy, there)
