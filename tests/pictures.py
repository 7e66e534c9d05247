"""Images of the scenes of the catalogue, and comparisons of two of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ALL, BACKGROUND, DATA, WHOLE, assert_not_empty, cast, render

import gsjax

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


def order_data() -> dict[str, np.ndarray]:
    """Return the references of the order of a pixel, or skip."""
    path = DATA / "methods" / "order.npz"
    if not path.exists():
        pytest.skip(f"{path.name} is absent (../shared/data/methods)")
    return dict(np.load(path, allow_pickle=False))


def order_scene(data, frames: int) -> tuple[gsjax.Gaussians, list[gsjax.Camera]]:
    """Return the scene of `order_data`, and its first cameras."""
    logits = np.log(data["opacities"]) - np.log1p(-data["opacities"])
    gaussians = gsjax.make_gaussians(
        means=data["means"],
        quats=data["quats"],
        log_scales=np.log(data["scales"]),
        logit_opacities=logits,
        sh=np.zeros((len(logits), 1, 3)),
    )
    views = np.tile(np.eye(4), (frames, 1, 1))
    views[:, :3, :3], views[:, :3, 3] = (
        data[name][:frames] for name in ("R_frames", "t_frames")
    )
    size = {name: int(data[name]) for name in ("width", "height")}
    given = {"K": data["K"], "near": 1e-3, **size}
    return gaussians, [gsjax.make_camera(viewmat=view, **given) for view in views]
