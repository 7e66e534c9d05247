"""Conversions for the browser: splats, cameras, viewpoints, exact images."""

import dataclasses

import jax
import numpy as np
import pytest
import training
from conftest import LIGHT, needs_two_devices
from viewing import COUNT, scene

import gsjax
from gsjax.math.rotations import covariance, quaternion_to_matrix
from gsjax.plots.contact_sheets import depth_colors
from gsjax.viewer import cameras, splats
from gsjax.viewer.exact import ExactRenderer, camera_of, picture
from gsjax.viewer.server import copy_to_one_device
from gsjax.viewer.splats import Cut, within

BACKGROUND = (0.1, 0.2, 0.3)


@pytest.mark.parametrize("spread", [1e-4, 1.0, 1e5])
def test_half_precision_represents_a_scene_of_any_size(spread):
    gaussians = scene(spread)
    packed = splats.pack(gaussians, within(gaussians, Cut()))
    scales = np.exp(gaussians.params.log_scales)
    expected = np.asarray(covariance(gaussians.params.quats, scales))
    stored = packed.covariances.astype(np.float16).astype(float) * packed.scale**2
    largest = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(stored / largest, expected / largest, atol=1e-3)
    means = np.asarray(gaussians.params.means)
    np.testing.assert_allclose(packed.centers * packed.scale, means, rtol=1e-5)
    np.testing.assert_allclose(packed.rgbs, [[0.9, 0.5, 0.1]] * COUNT, atol=1e-6)
    opacities = splats.opacities_of(gaussians)
    np.testing.assert_allclose(packed.opacities[:, 0], opacities, rtol=1e-6)


def changed(**leaves) -> gsjax.Gaussians:
    return scene().replace(params=scene().params.replace(**leaves))


def test_huge_gaussians_are_clipped_and_invalid_ones_not_shown():
    """The others keep their precision."""
    params = scene().params
    huge = changed(log_scales=params.log_scales.at[0].set(np.log(1e9)))
    stored = splats.pack(huge, within(huge, Cut())).covariances.astype(np.float16)
    assert np.isfinite(stored).all()
    assert (np.trace(stored[1:], axis1=1, axis2=2) > 0).all()
    broken = changed(
        means=params.means.at[1, 2].set(np.nan),
        log_scales=params.log_scales.at[2].set(np.inf),
        logit_opacities=params.logit_opacities.at[3].set(np.nan).at[4].set(-9.0),
        quats=params.quats.at[5].set(0.0),
    ).replace(active=jax.numpy.arange(COUNT) > 0)
    shown = within(broken, Cut())
    assert list(np.flatnonzero(~shown)) == [0, 1, 2, 3]
    packed = splats.pack(broken, shown)
    assert len(packed.centers) == COUNT - 5  # the fifth is too faint
    assert all(np.isfinite(each).all() for each in packed)
    assert packed.opacities.min() >= splats.MIN_DRAWN_OPACITY


def test_thinning_keeps_the_most_important():
    """Of equally opaque ones the largest."""
    gaussians = scene()
    shown = within(gaussians, Cut(0.4))
    kept = splats.most_important(gaussians, shown, 5)
    assert kept.sum() == 5
    assert not (kept & ~shown).any()
    np.testing.assert_array_equal(splats.most_important(gaussians, shown, COUNT), shown)
    logs = jax.numpy.linspace(-5, 0, COUNT)[:, None] * np.ones(3)
    flat = changed(log_scales=logs, logit_opacities=0 * logs[:, 0])
    kept = splats.most_important(flat, np.ones(COUNT, bool), 9)
    np.testing.assert_array_equal(np.flatnonzero(kept), np.arange(COUNT - 9, COUNT))


@pytest.mark.parametrize("ordered", [False, True])
def test_parts_fall_in_importance(ordered):
    gaussians = scene()
    shown = within(gaussians, Cut(0.1))
    count = shown.sum()
    order = splats.by_importance(gaussians, shown, ordered)
    np.testing.assert_array_equal(np.sort(order), np.flatnonzero(shown))
    if ordered:
        np.testing.assert_array_equal(order, np.flatnonzero(shown))
    for parts, ends in (
        (1, [1]),
        (2, [0.1, 1]),
        (4, 0.1 ** np.array([1, 2 / 3, 1 / 3, 0])),
    ):
        masks = splats.importance_parts(gaussians, shown, parts, ordered)
        so_far = np.cumsum(masks, axis=0)
        assert so_far.max() == 1
        for mask, end in zip(so_far.astype(bool), np.rint(np.multiply(ends, count))):
            np.testing.assert_array_equal(
                mask, splats.most_important(gaussians, shown, int(end), ordered)
            )
        np.testing.assert_array_equal(so_far[-1], shown)
    few = shown & (np.cumsum(shown) <= 3)
    assert [m.sum() for m in splats.importance_parts(gaussians, few, 8)] == [1, 1, 1]
    with pytest.raises(gsjax.InputError, match="parts: expected at least 1, got 0"):
        splats.importance_parts(gaussians, shown, 0)


def test_the_camera_of_a_browser():
    wxyz, position = np.array([0.9, -0.2, 0.3, 0.1]), np.array([1.0, 2, 3])
    camera = camera_of(wxyz, position, 0.8, 40, 30)
    rotation = np.asarray(quaternion_to_matrix(wxyz))
    np.testing.assert_allclose(camera.viewmat[:3, :3], rotation.T, atol=1e-12)
    edge = position + rotation @ (0, -np.tan(0.4), 1)  # the middle of the upper edge
    local = camera.viewmat[:3, :3] @ edge + camera.viewmat[:3, 3]
    pixel = camera.K @ local
    np.testing.assert_allclose(pixel[:2] / pixel[2], (20, 0), atol=1e-9)


def test_viewpoints_see_the_scene():
    for up in cameras.UPS:
        viewpoint = cameras.viewpoint_of_gaussians(scene(), cameras.UPS[up])
        means = np.asarray(scene().params.means)
        np.testing.assert_allclose(viewpoint.target, np.median(means, 0), atol=1.0)
        ahead = viewpoint.position - viewpoint.target
        assert ahead @ cameras.UPS[up] > 0
        if up in ("-y", "+y"):  # the side of the cameras of COLMAP, and of OpenGL
            assert ahead[2] * cameras.UPS[up][1] > 0
    frusta = cameras.frusta_of(training.dataset().views)
    viewpoint = cameras.viewpoint_of_cameras(frusta)
    view = gsjax.look_at(viewpoint.position, viewpoint.target, viewpoint.up)
    points = training.dataset().points @ view[:3, :3].T + view[:3, 3]
    assert (points[:, 2] > 0).all()
    assert (np.abs(points[:, :2] / points[:, 2:]) < 1).all()


def test_photographs_are_as_far_from_the_apex_as_viser_draws_them():
    """Pyramids of one size have one volume, whatever their angles."""
    view = cameras.frusta_of(training.dataset().views)[0]
    wide = view._replace(fov=np.pi / 2, aspect=3.0)
    np.testing.assert_allclose(cameras.photo_distances([wide], 2.0), [2.0])
    for fov, aspect in ((0.3, 1.5), (2.0, 0.5)):
        (depth,) = cameras.photo_distances([view._replace(fov=fov, aspect=aspect)], 2.0)
        np.testing.assert_allclose(depth**3 * np.tan(fov / 2) ** 2 * aspect / 3, 8.0)


@pytest.mark.long
@needs_two_devices
def test_exact_images_are_rendered_on_one_device():
    """Also those of a copy of a training state, which outlives the state."""
    state = jax.tree.map(jax.numpy.copy, scene())
    copy = copy_to_one_device(state)
    assert len(state.active.devices()) > 1
    jax.tree.map(lambda array: array.delete(), state)
    jax.tree.map(np.testing.assert_array_equal, copy, scene())
    first = {jax.local_devices()[0]}
    assert all(array.devices() == first for array in jax.tree.leaves(copy))
    camera = camera_of((1, 0, 0, 0), (0, 0, 0), 0.7, 32, 24)
    renderer = ExactRenderer(gsjax.RasterConfig(**LIGHT), list(BACKGROUND))
    view = renderer(copy, camera)
    camera = jax.device_put(camera, copy.active.sharding)
    expected = gsjax.render_exact(copy, camera, renderer.config, np.array(BACKGROUND))
    assert expected.rgb.devices() == first
    assert np.ptp(expected.rgb) > 0.3
    alpha = np.asarray(expected.alpha)[..., None] * np.ones(3)
    for kind, image in (("rgb", expected.rgb), ("alpha", alpha)):
        pixels, _ = picture(view, kind)
        np.testing.assert_allclose(pixels / 255, image, atol=0.51 / 255)
    colors, *_ = depth_colors(np.asarray(expected.depth))
    pixels, _ = picture(view, "depth")
    # A level of depth more or less is another colour.
    np.testing.assert_allclose(pixels.astype(float), colors, atol=8)


def test_a_camera_that_stands_still_is_drawn_once():
    views = training.dataset().views
    twice = [dataclasses.replace(view, name=f"again-{view.name}") for view in views]
    frusta = cameras.frusta_of([*views, *twice])
    assert [frustum.name for frustum in frusta] == [view.name for view in views]


def test_padding_is_invisible():
    found = scene()
    packed = splats.pack(found, within(found, Cut(0.1)))
    more = splats.padded(packed, len(packed.centers) + 3)
    assert more.opacities[-3:].max() == 0
    for before, after in zip(packed[:-1], more[:-1], strict=True):
        np.testing.assert_array_equal(after[:-3], before)
