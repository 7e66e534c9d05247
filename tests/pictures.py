"""Pictures of the catalogue's scenes, and how two of them are compared."""

import jax.numpy as jnp
import numpy as np
from conftest import ALL, BACKGROUND, WHOLE, assert_not_empty, cast, render

KINDS = ("random", "wall", "equal_depths")


def images(gaussians, camera, config=WHOLE, dtype=jnp.float32):
    given = cast((gaussians, camera, BACKGROUND), dtype)
    out = render(given[0], given[1], config, given[2])
    assert not out.overflowed
    assert_not_empty(out.alpha)
    assert np.std(out.rgb) > 1e-3
    return out


def assert_same(first, second, names=ALL):
    for name in names:
        a, b = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
        np.testing.assert_array_equal(a, b, err_msg=name)


def largest_difference(first, second):
    return max(
        np.max(
            np.abs(getattr(first, name) - getattr(second, name))
            / np.maximum(1, np.abs(getattr(first, name)))
        )
        for name in ("rgb", "alpha", "depth")
    )


def errors_of(out, wanted, band):
    """Largest error of each output outside the band, depths relative to 1 or more."""
    clear = np.asarray(wanted["margin"]) > band
    assert clear.mean() > 0.97
    errors = {}
    for name in ALL:
        found, target = np.asarray(getattr(out, name)), np.asarray(wanted[name])
        assert np.isfinite(found).all(), name
        error = np.abs(found - target)
        if "depth" in name:
            error = error / np.maximum(1, np.abs(target))
        errors[name] = error.reshape(*clear.shape, -1).max(-1)[clear]
    return {name: error.max() for name, error in errors.items()}, errors
