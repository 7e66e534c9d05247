"""Choice of the order in which pixels blend: the narrowest that keeps the budget."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.planning.accuracy import margin_for
from gsjax.planning.types import Reason
from gsjax.raster.exact import render_exact
from gsjax.raster.types import RasterConfig

_SHARE = 0.5  # share of the budget for the order
_WIDEST = 4  # beyond, exact sorting is hardly slower on a CPU


def choose_order(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    budget: float | None,
) -> tuple[RasterConfig, Reason]:
    """Return ``config`` with the window that the budget needs, and the reason.

    The order of centres and the exact order are kept as they are. A window is compared
    with the exact order on the views; if its error is more than half of the budget, it
    is widened, or else sorts exactly. Without a budget nothing is measured.

    Args:
      gaussians: N slots, concrete.
      views: single cameras.
      config: its order is the first that is tried.
      background: [3] colour behind the views.
      budget: largest error of a channel, or None.
    """
    if config.order == "center":
        why = "center: one order for all pixels; it pops when the camera turns"
        return config, Reason("order", why)
    if config.order == "pixel":
        return config, Reason("order", "pixel: sorted exactly")
    if budget is None:
        return config, Reason("order", f"a window of {config.order_window}, as given")
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    light = config.replace(num_size_buckets=1, outputs=("rgb",), visible_capacity=None)

    def draw(**changes) -> list[np.ndarray]:
        mine = light.replace(**changes)
        return [
            np.asarray(render_exact(gaussians, view, mine, behind).rgb)
            for view in views
        ]

    margin, exact = margin_for(len(views)), draw(order="pixel")
    window, error = config.order_window, float("inf")
    while window <= max(_WIDEST, config.order_window):
        pictures = zip(draw(order_window=window), exact)
        error = margin * max(float(np.abs(a - b).max()) for a, b in pictures)
        if error <= _SHARE * budget:
            why = f"a window of {window}: measured on {len(views)} cameras"
            reason = Reason("order", why, error, "estimate")
            return config.replace(order_window=window), reason
        window *= 2
    why = f"pixel: a window of {window // 2} errs by {255 * error:.3g}/255"
    return config.replace(order="pixel"), Reason("order", why)
