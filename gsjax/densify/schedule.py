"""When slots are edited, and what that may come to."""

import jax


def is_due(step: jax.Array, start: int, stop: int, every: int) -> jax.Array:
    """[] bool: whether ``step`` is a multiple of ``every`` in (start, stop]."""
    inside = (step > start) & (step <= stop)
    return inside & (step % every == 0)


def edits_between(since: int, until: int, start: int, stop: int, every: int) -> int:
    """How many of the steps in (since, until] edit."""
    return max(0, min(until, stop) // every - max(since, start) // every)


def grown(count: int, edits: int, growth: float, most: int) -> int:
    """``count`` after so many edits by a factor of ``growth``, each by one at least
    if that is above 1, and up to ``most``."""
    if growth > 1 and count:
        while edits > 0 and count < most:
            count, edits = min(max(count + 1, int(growth * count)), most), edits - 1
    return count
