"""One host device for each core: XLA's CPU backend hardly uses a second core inside
the compositor's loop, so the tiles are spread over several devices instead.
"""

import os

import jax


def use_all_cores(count: int | None = None) -> int:
    """Let JAX show ``count`` CPU devices (default: the cores this process may use).

    Call it before the first computation: ``import gsjax; gsjax.use_all_cores()``. On
    a GPU or TPU it changes nothing that matters. `RasterConfig.devices` then
    defaults to all of them; images do not depend on it.

    Returns:
      The number of local devices.

    Raises:
      RuntimeError: if JAX has started already with another number of devices.
    """
    if count is None:
        available = getattr(os, "sched_getaffinity", None)
        count = len(available(0)) if available else (os.cpu_count() or 1)
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError as error:
        if jax.default_backend() != "cpu" or jax.local_device_count() == count:
            return jax.local_device_count()
        raise RuntimeError(
            "use_all_cores came after JAX had started; call it before the first "
            "computation, right after import gsjax"
        ) from error
    return jax.local_device_count()
