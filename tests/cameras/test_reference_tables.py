"""EWA, unscented transform, rolling shutter and lidar against independent tables."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DATA

import gsjax
from gsjax.cameras import lenses
from gsjax.cameras.camera import with_shutter
from gsjax.cameras.shutter import expose
from gsjax.raster.primitives.ewa import covariance_factor, dilated
from gsjax.raster.primitives.unscented import unscented_image
from gsjax.stress.lenses import QUICK

LENS_OF = {"pinhole": "pinhole", "opencv": "opencv"}


def load(name: str) -> dict[str, np.ndarray]:
    path = DATA / "cameras" / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"{path.name} is absent (../shared/data/cameras)")
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def camera_of(table, lens: str, viewmat) -> gsjax.Camera:
    fx, fy, cx, cy, *rest = table[f"{lens}/params"]
    width, height = (int(side) for side in table["size"])
    return gsjax.make_camera(
        viewmat=viewmat,
        K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        width=width,
        height=height,
        lens=LENS_OF.get(lens, "fisheye"),
        coefficients=rest or None,
    )


def factor_of(covariance_rows):
    m1, m2 = (jnp.stack(row) for row in covariance_rows)
    rows = [[(m1 * m1).sum(0), (m1 * m2).sum(0)], [(m1 * m2).sum(0), (m2 * m2).sum(0)]]
    return np.moveaxis(np.asarray(rows), -1, 0)


@partial(jax.jit, compiler_options=QUICK)
def ewa(camera, means, quats, scales):
    exposure = expose(camera, tuple(means.T))
    rows = covariance_factor(camera, exposure, tuple(quats.T), tuple(scales.T))
    near_image = camera.linearise(exposure.point)
    inside = sum(jnp.abs(a - b) for a, b in zip(near_image, exposure.point)) < 1e-12
    return jnp.stack(camera.project(exposure.point), -1), rows, inside


@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye", "fisheye_k0"])
def test_ewa(lens):
    table = load("ewa")
    camera = camera_of(table, lens, table["viewmat"])
    gaussians = (table["means"], table["quats"], table["scales"])
    uv, rows, inside = ewa(camera, *gaussians)
    found, valid = factor_of(rows), table[f"{lens}/valid"]
    np.testing.assert_allclose(uv[valid], table[f"{lens}/mean2d"][valid], atol=1e-9)
    wanted = table[f"{lens}/cov2d"]
    if lens == "pinhole":
        wanted, inside = table["pinhole/cov2d_clamped"], valid
    sure = valid & np.asarray(inside)
    assert sure.sum() > 150
    size = np.linalg.norm(wanted[sure], axis=(1, 2))
    off = np.linalg.norm(found[sure] - wanted[sure], axis=(1, 2))
    assert (off <= 1e-9 * size).all()
    a, b, c, det, sharp = (np.asarray(n) for n in dilated(*rows, 0.3))
    conic = np.stack([c, -b, a], -1) / det[:, None]
    if lens != "pinhole":  # the table's conic is that of the covariance not limited
        wanted = table[f"{lens}/conic_dilated"][sure]
        np.testing.assert_allclose(conic[sure], wanted, rtol=1e-8, atol=1e-12)
        wanted = table[f"{lens}/compensation"][sure]
        np.testing.assert_allclose(np.sqrt(sharp / det)[sure], wanted, rtol=1e-8)


@partial(jax.jit, static_argnums=1, compiler_options=QUICK)
def unscented(camera, config, means, quats, scales):
    columns = (tuple(a.T) for a in (means, quats, scales))
    shift, rows, good = unscented_image(camera, config, *columns)
    centre = camera.project(expose(camera, tuple(means.T)).point)
    return jnp.stack([c + s for c, s in zip(centre, shift)], -1), rows, good


@pytest.mark.parametrize("alpha", [0.1, 1.0])
@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye"])
def test_unscented(lens, alpha, report):
    table, tag = load("unscented"), f"a{alpha}/{lens}"
    camera = camera_of(table, lens, table["viewmat"])
    config = gsjax.RasterConfig(projection="unscented", unscented=(alpha, 2.0, 0.0))
    gaussians = (table["means"], table["quats"], table["scales"])
    uv, rows, good = unscented(camera, config, *gaussians)
    sure = table[f"{tag}/all_sigma_ok"]
    if lens == "pinhole":  # the table leaves out what is far outside the image
        assert np.asarray(good)[sure].all()
    else:
        np.testing.assert_array_equal(good, sure)
    wanted = table[f"{tag}/mean2d"][sure]
    tight = 1e-9 if alpha == 1 else 1e-7  # the table's own weights of −99 cancel
    np.testing.assert_allclose(uv[sure], wanted, rtol=tight, atol=tight)
    found, wanted = factor_of(rows)[sure], table[f"{tag}/cov2d"][sure]
    size = np.linalg.norm(wanted, axis=(1, 2))
    error = np.linalg.norm(found - wanted, axis=(1, 2)) / size
    report(f"unscented {tag}", error.max(), tight)
    assert (error <= tight).all()
    index = table[f"truth/{lens}/index"]
    truth = table[f"truth/{lens}/gh_cov"]
    off = np.linalg.norm(factor_of(rows)[index] - truth, axis=(1, 2))
    assert (off <= 0.05 * np.linalg.norm(truth, axis=(1, 2))).all()


def test_a_sigma_point_beside_the_camera_does_not_count():
    camera = gsjax.make_camera(
        viewmat=np.eye(4), K=np.diag([40.0, 40, 1]), width=48, height=36
    )
    config = gsjax.RasterConfig(projection="unscented")
    means = np.array([[0.5, 0.1, 1.0], [0.5, 0.1, 1.0]])
    scales = np.array([[0.1, 0.1, 0.1], [0.1, 0.1, 0.57]])  # √3 × 0.57 = 0.99
    quats = np.array([[1.0, 0, 0, 0]] * 2)
    *_, good = unscented(camera, config, means, quats, scales)
    assert good.tolist() == [True, False]


@partial(jax.jit, compiler_options=QUICK)
def exposed(camera, points):
    return jnp.stack(camera.project(expose(camera, tuple(points.T)).point), -1)


@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye"])
@pytest.mark.parametrize(
    "direction", ["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]
)
def test_rolling_shutter(lens, direction, report):
    table = load("rolling_shutter")
    start, end = table["viewmat_start"], table["viewmat_end"]
    camera = camera_of(table, lens, start)
    camera = with_shutter(camera, direction, viewmat_end=end)
    found = np.asarray(exposed(camera, table["points_world"]))
    key = f"{lens}/{direction}/w2c/cont"
    seen = table[f"{key}/valid"]
    error = np.abs(found - table[f"{key}/uv"])[seen].max()
    report(f"{lens} {direction}, px", error, 1e-8)
    assert seen.sum() > 100
    assert error <= 1e-8
    still = exposed(camera.replace(twist=jnp.zeros(6)), table["points_world"])
    shown = np.isfinite(table[f"{lens}/uv_start"]).all(-1) & seen
    wanted = table[f"{lens}/uv_start"][shown]
    np.testing.assert_allclose(np.asarray(still)[shown], wanted, atol=1e-9)


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def of_lidar(lens, K, c, points, places):
    pixels = lens.project(K, c, tuple(points.T))
    ray = lens.unproject(K, c, tuple(places.T))
    return jnp.stack(pixels, -1), jnp.stack(ray, -1), lens.depth(tuple(points.T))


@pytest.mark.parametrize("name", ["waymo", "generic", "synthetic_ccw"])
def test_lidar(name):
    whole = load("lidar")
    table = {k.split("/")[1]: v for k, v in whole.items() if k.startswith(name)}
    elevations, azimuths, offsets = (
        table[f"{key}_rad"]
        for key in ("row_elevations", "column_azimuths", "row_azimuth_offsets")
    )
    lens = lenses.lidar_lens(len(elevations), len(azimuths))
    c = lenses.lidar_coefficients(elevations, azimuths, offsets)
    K = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    # The lidar's x forward, y left, z up are the camera's z, −x, −y.
    swap = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    points, places = table["points"] @ swap.T, table["cont_rowcol"][:, ::-1] + 0.5
    pixels, rays, depth = of_lidar(lens, K, c, points, places)
    pixels = np.asarray(pixels) - 0.5
    inside = np.isfinite(table["row_cont"])
    np.testing.assert_allclose(
        pixels[inside, 1], table["row_cont"][inside], rtol=1e-9, atol=1e-9
    )
    inside &= np.isfinite(table["col_cont"]) & (table["col_cont"] <= len(azimuths) - 1)
    assert inside.sum() > 50
    np.testing.assert_allclose(
        pixels[inside, 0], table["col_cont"][inside], rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(depth, table["range"], rtol=1e-14)
    np.testing.assert_allclose(rays, table["cont_ray"] @ swap.T, atol=1e-9)
    row, column = table["elements"].T
    beams = np.stack([column, row], -1) + 0.5
    _, rays, _ = of_lidar(lens, K, c, points, beams)
    np.testing.assert_allclose(rays, table["element_ray"] @ swap.T, atol=1e-9)
