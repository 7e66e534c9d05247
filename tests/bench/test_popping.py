"""Popping, against the references' figures, and single places against pictures."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPAT, render, scene_of
from pictures import order_data, order_scene

import gsjax
from gsjax.bench.popping import popping, same_rays, turned
from gsjax.bench.report import popping_picture, popping_table
from gsjax.raster.sampling import sample


def test_figures_of_the_references():
    """`pop_exact`: the order of centres, and the floor that EWA has by itself."""
    data = order_data()
    gaussians, cameras = order_scene(data, 2)
    config = COMPAT.replace(
        alpha_min=1e-300, alpha_max=1.0, transmittance_min=0.0, stop_rule="after"
    )
    colors = jnp.asarray(data["colours"])
    for order, name in (("center", "centre"), ("pixel", "tstar")):
        found = popping(
            gaussians, cameras, config.replace(order=order), features=colors
        )
        assert found[0] == pytest.approx(data[f"pop_exact_{name}"][0], abs=1e-9)


def test_places_are_pixels_of_the_picture():
    gaussians, camera = scene_of("random")
    points = np.random.default_rng(0).integers(0, (45, 29), (70, 2))
    for order in ("center", "window", "pixel"):
        config = COMPAT.replace(order=order)
        rgb = np.asarray(render(gaussians, camera, config).rgb)
        found = sample(gaussians, camera, points + 0.5, config)
        np.testing.assert_allclose(found, rgb[points[:, 1], points[:, 0]], atol=1e-12)
        assert found.std() > 0.05


def test_a_turn_shows_the_same_rays():
    _, camera = scene_of("random")
    first, *_, last = turned(camera, 4, 2.0, axis=(0.3, 1.0, 0.1))
    points = np.random.default_rng(0).uniform(0, 29, (50, 2))
    places = same_rays(first, last, points)
    assert np.abs(places - points).max() > 2
    # The camera's matrix is rounded to float32.
    np.testing.assert_allclose(same_rays(last, first, places), points, atol=1e-5)
    # A point of space on a ray of one is at these places in both pictures.
    world = [np.linalg.inv(np.asarray(c.viewmat)) for c in (first, last)]
    np.testing.assert_allclose(world[0][:3, 3], world[1][:3, 3], atol=1e-5)
    K = np.asarray(camera.K)
    rays = np.column_stack([points, np.ones(50)]) @ np.linalg.inv(K).T * 3.0
    space = rays @ world[1][:3, :3].T + world[1][:3, 3]
    seen = (space - world[0][:3, 3]) @ world[0][:3, :3] @ K.T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], places, atol=1e-5)


def test_rows_reach_table_and_plot():
    rows = [
        {"order": "center", "forward ms": 3.0, "popping": 0.2, "of center": 1.0,
         "misordered": None},
        {"order": "window 64", "forward ms": None, "popping": 0.1, "of center": 0.5,
         "misordered": 1234},
    ]  # fmt: skip
    text = popping_table(rows)
    assert "1,234" in text
    assert text.count("0.500") == 1
    picture = popping_picture(rows, "$x")
    assert picture.shape == (480, 720, 3)


def test_other_cameras_are_refused():
    gaussians, camera = scene_of("random")
    moved = camera.replace(viewmat=camera.viewmat.at[0, 3].add(0.1))
    with pytest.raises(gsjax.InputError, match="at one place"):
        popping(gaussians, [camera, moved], COMPAT)
    fisheye = gsjax.make_camera(
        viewmat=camera.viewmat, K=camera.K, width=45, height=29, lens="fisheye",
        coefficients=(0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip
    with pytest.raises(gsjax.InputError, match="pinhole"):
        popping(gaussians, [camera, fisheye], COMPAT)
