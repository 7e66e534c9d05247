"""A training in the browser, while it runs.

The browser is shown copies that are made between two steps, for at most a fiftieth of
the time, so a run yields the same bits with and without a viewer.
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
from gsjax.viewer.opening import training_content
from gsjax.viewer.server import ViewerServer
from gsjax.viewer.viser_server import require_viser

_INTERVAL = 2.0  # least seconds between two copies
_SHARE = 0.02  # of the time, at most


class LiveViewer:
    """Shows one run.

    Args:
      host, port: address to serve.

    Raises:
      MissingExtraError: if viser is absent.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080):
        require_viser()
        self.host, self.port = host, port
        self.server: ViewerServer | None = None
        self.due = 0.0

    def begin(
        self, dataset: Dataset, photos: Sequence[Photo], config: TrainConfig
    ) -> Callable[[TrainState, Progress], None]:
        """Return the hook for `gsjax.Hooks.state`; its first call starts the server."""

        def after_step(state: TrainState, progress: Progress) -> None:
            step = int(progress.metrics.step)
            last, now = step == config.steps, time.monotonic()
            server = self.server
            early = server is not None and (now < self.due or server.busy)
            if early and not last:
                return
            gaussians = copy_to_one_device(state.gaussians)
            jax.block_until_ready(gaussians)
            if server is None:
                content = training_content(gaussians, dataset, photos, config)
                server = ViewerServer(content, host=self.host, port=self.port)
                self.server = server
                note(f"viewer: {server.url}")
            server.show(gaussians, f"step {step:,} of {config.steps:,}")
            took = time.monotonic() - now
            self.due = now + max(_INTERVAL, took / _SHARE)

        return after_step

    def wait_for_browsers(self) -> None:
        """Block until no browser is connected, or Ctrl-C."""
        server = self.server
        if server is None or not server.has_browsers:
            return
        note(f"viewer: {server.url} stays until its last page is closed, or Ctrl-C")
        try:
            while server.has_browsers:
                server.left.wait(1.0)
                server.left.clear()
        except KeyboardInterrupt:
            pass

    def close(self) -> None:
        """Stop serving."""
        if self.server is not None:
            self.server.close()


def copy_to_one_device(gaussians: Gaussians) -> Gaussians:
    """Copy to memory of the first device, which the next step does not reuse.

    A step leaves its state on all devices, and each would render it. `jax.device_put`
    alone copies nothing to a device that holds the array already.
    """
    local = jax.device_put(gaussians, jax.local_devices()[0])
    return jax.tree.map(jnp.copy, local)
