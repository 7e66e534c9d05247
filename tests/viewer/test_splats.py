"""Conversions for the browser: splats, cameras, viewpoints, exact images."""

import chex
import jax
import numpy as np
import pytest
import training
from conftest import LIGHT, frustum_points, gaussians_at, needs_two_devices
from viewing import COUNT, scene

import gsjax
from gsjax.math.rotations import covariance, quaternion_to_matrix
from gsjax.plots.contact_sheets import depth_colors
from gsjax.viewer.cameras import (
    UPS,
    frusta_of,
    photo_distances,
    viewpoint_of_cameras,
    viewpoint_of_gaussians,
)
from gsjax.viewer.exact import ExactRenderer, camera_of, picture
from gsjax.viewer.server import copy_to_one_device
from gsjax.viewer.splats import (
    MIN_DRAWN_OPACITY,
    Cut,
    longest_axes,
    most_important,
    opacities_of,
    pack,
    within,
)

BACKGROUND = (0.1, 0.2, 0.3)
CAMERA = ((1, 0, 0, 0), (0, 0, 0), 0.7, 32, 24)


@pytest.mark.parametrize("spread", [1e-4, 1.0, 1e5])
def test_half_precision_represents_a_scene_of_any_size(spread):
    gaussians = scene(spread)
    splats = pack(gaussians, within(gaussians, Cut()))
    scales = np.exp(gaussians.params.log_scales)
    expected = np.asarray(covariance(gaussians.params.quats, scales))
    stored = splats.covariances.astype(np.float16).astype(float) * splats.scale**2
    largest = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(stored / largest, expected / largest, atol=1e-3)
    means = np.asarray(gaussians.params.means)
    np.testing.assert_allclose(splats.centers * splats.scale, means, rtol=1e-5)
    np.testing.assert_allclose(splats.rgbs, [[0.9, 0.5, 0.1]] * COUNT, atol=1e-6)
    np.testing.assert_allclose(
        splats.opacities[:, 0], opacities_of(gaussians), rtol=1e-6
    )


def changed(**leaves) -> gsjax.Gaussians:
    """The scene with leaf[index] set to a value, of each (index, value)."""
    params = scene().params
    for name, edits in leaves.items():
        leaf = np.array(getattr(params, name))
        for index, value in edits.items():
            leaf[index] = value
        params = params.replace(**{name: jax.numpy.asarray(leaf)})
    return scene().replace(params=params)


def test_huge_gaussians_are_clipped_and_the_others_keep_their_precision():
    huge = changed(log_scales={0: np.log(1e9)})
    stored = pack(huge, within(huge, Cut())).covariances.astype(np.float16)
    assert np.isfinite(stored).all()
    assert (np.trace(stored[1:], axis1=1, axis2=2) > 0).all()


def test_invalid_gaussians_are_not_shown():
    broken = changed(
        means={(1, 2): np.nan},
        log_scales={2: np.inf},
        logit_opacities={3: np.nan, 4: -9.0},
        quats={5: 0.0},
    ).replace(active=jax.numpy.arange(COUNT) > 0)
    shown = within(broken, Cut())
    assert list(np.flatnonzero(~shown)) == [0, 1, 2, 3]
    splats = pack(broken, shown)
    assert len(splats.centers) == COUNT - 5  # the fifth is too faint
    assert all(np.isfinite(each).all() for each in splats)
    assert splats.opacities.min() >= MIN_DRAWN_OPACITY


def test_cuts_and_thinning():
    gaussians = scene()
    opacities, longest = opacities_of(gaussians), longest_axes(gaussians)
    half = float(np.median(longest))
    shown = within(gaussians, Cut(0.4, half))
    np.testing.assert_array_equal(shown, (opacities >= 0.4) & (longest <= half))
    kept = most_important(gaussians, shown, 5)
    assert kept.sum() == 5
    assert not (kept & ~shown).any()
    np.testing.assert_array_equal(most_important(gaussians, shown, COUNT), shown)
    # Of equally opaque ones the largest.
    logs = np.linspace(-5, 0, COUNT)
    flat = gaussians_at(frustum_points(np.random.default_rng(0), COUNT),
                        np.exp(logs)[:, None], 0.5)  # fmt: skip
    kept = most_important(flat, np.ones(COUNT, bool), 9)
    np.testing.assert_array_equal(np.flatnonzero(kept), np.arange(COUNT - 9, COUNT))


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
    for up in UPS:
        viewpoint = viewpoint_of_gaussians(scene(), UPS[up])
        means = np.asarray(scene().params.means)
        np.testing.assert_allclose(viewpoint.target, np.median(means, 0), atol=1.0)
        ahead = viewpoint.position - viewpoint.target
        assert ahead @ UPS[up] > 0
        if up in ("-y", "+y"):  # the side of the cameras of COLMAP, and of OpenGL
            assert ahead[2] * UPS[up][1] > 0
    viewpoint = viewpoint_of_cameras(frusta_of(training.dataset().views))
    view = gsjax.look_at(viewpoint.position, viewpoint.target, viewpoint.up)
    points = training.dataset().points @ view[:3, :3].T + view[:3, 3]
    assert (points[:, 2] > 0).all()
    assert (np.abs(points[:, :2] / points[:, 2:]) < 1).all()


def test_photographs_are_as_far_from_the_apex_as_viser_draws_them():
    """Pyramids of one size have one volume, whatever their angles."""
    view = frusta_of(training.dataset().views)[0]
    wide = view._replace(fov=np.pi / 2, aspect=3.0)
    np.testing.assert_allclose(photo_distances([wide], 2.0), [2.0])
    for fov, aspect in ((0.3, 1.5), (2.0, 0.5)):
        (depth,) = photo_distances([view._replace(fov=fov, aspect=aspect)], 2.0)
        np.testing.assert_allclose(depth**3 * np.tan(fov / 2) ** 2 * aspect / 3, 8.0)


@pytest.mark.long
@needs_two_devices
def test_exact_images_are_rendered_on_one_device():
    """Also those of a copy of a training state, which outlives the next step."""
    mesh = jax.sharding.Mesh(np.array(jax.local_devices()), ("devices",))
    everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    step = jax.jit(
        lambda state: jax.tree.map(
            lambda a: a ^ True if a.dtype == bool else -a, state
        ),
        out_shardings=everywhere,
        donate_argnums=0,
    )
    state = step(step(jax.device_put(scene(), everywhere)))
    copy = copy_to_one_device(state)
    after = step(state)
    assert len(after.params.means.devices()) > 1
    assert state.params.means.is_deleted()
    chex.assert_trees_all_equal(copy, scene())
    first = {jax.local_devices()[0]}
    assert all(array.devices() == first for array in jax.tree.leaves(copy))
    camera = camera_of(*CAMERA)
    renderer = ExactRenderer(gsjax.RasterConfig(**LIGHT), list(BACKGROUND))
    view = renderer(copy, camera)
    camera = jax.device_put(camera, copy.active.sharding)
    expected = gsjax.render_exact(copy, camera, renderer.config, np.array(BACKGROUND))
    assert expected.rgb.devices() == first
    assert np.ptp(expected.rgb) > 0.3
    alpha = np.asarray(expected.alpha)[..., None] * np.ones(3)
    for kind, image in (("rgb", expected.rgb), ("alpha", alpha)):
        pixels, what = picture(view, kind)
        assert what == kind
        np.testing.assert_allclose(pixels / 255, image, atol=0.51 / 255)
    colors, near, far = depth_colors(np.asarray(expected.depth))
    pixels, what = picture(view, "depth")
    assert what == f"depth {near:.3g} (red) to {far:.3g} (blue)"
    # A level of depth more or less is another colour.
    np.testing.assert_allclose(pixels.astype(float), colors, atol=8)
