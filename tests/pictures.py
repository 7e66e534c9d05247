"""Images of the scenes of the catalogue, and comparisons of two of them."""

import jax
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
    pairs = [(getattr(first, n), getattr(second, n)) for n in ("rgb", "alpha", "depth")]
    return max(np.max(np.abs(a - b) / np.maximum(1, np.abs(a))) for a, b in pairs)


def errors_of(out, wanted, band):
    """Return the largest error of each output, and all errors, outside the band.

    Errors of depths above 1 are relative.
    """
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


def assert_close(report, name, found, wanted, bar, least=1e-30):
    """Compare the leaves of two trees in the L2 norm, relative to ``least`` or more."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    for a, b in pairs:
        assert np.isfinite(a).all(), name
        error = np.linalg.norm(a - b) / max(np.linalg.norm(b), least)
        report(f"{name}, {np.shape(b)}", error, bar)
        assert error <= bar, (name, np.shape(b))
