"""When slots are edited."""

import jax


def is_due(step: jax.Array, start: int, stop: int, every: int) -> jax.Array:
    """[] bool: whether ``step`` is a multiple of ``every`` in (start, stop]."""
    inside = (step > start) & (step <= stop)
    return inside & (step % every == 0)
