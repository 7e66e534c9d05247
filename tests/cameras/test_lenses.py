"""Lenses against independent references: float64 tables, and OpenCV."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DATA

import gsjax
from gsjax.cameras.distortion import Distortion, distort
from gsjax.cameras.lenses import FISHEYE, LENSES, OPENCV, ORTHOGRAPHIC, PINHOLE

TABLES = {
    "pinhole": PINHOLE,
    "ortho": ORTHOGRAPHIC,
    "opencv": OPENCV,
    "opencv_rational": OPENCV,
    "opencv_fisheye": FISHEYE,
}


@pytest.fixture(scope="module")
def tables():
    path = DATA / "cameras" / "lenses.npz"
    if not path.exists():
        pytest.skip(f"{path.name} is absent (../shared/data/cameras)")
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


@pytest.mark.parametrize("index", [0, 2])
@pytest.mark.parametrize("name", TABLES)
def test_tables(tables, name, index, report):
    def table(field):
        return tables[f"{name}/{index}/{field}"]

    lens = TABLES[name]
    fx, fy, cx, cy, *rest = table("params")
    if name == "opencv":
        assert str(table("param_names")) == "fx,fy,cx,cy,k1,k2,p1,p2,k3"
    K = jnp.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    c = jnp.asarray(rest) if rest else None
    points, front = table("points"), table("front")
    seen = front & table("injective") & table("defined")
    if name in ("pinhole", "ortho"):
        seen = front & table("defined")
    point = tuple(jnp.asarray(points[seen].T))
    uv = jnp.stack(lens.project(K, c, point), -1)
    error = np.abs(uv - table("uv")[seen]).max()
    report(f"{name} {index}, px", error, 1e-8)
    assert error <= 1e-8 * max(1, np.abs(table("uv")[seen]).max())

    def one(p):
        return jnp.stack(lens.project(K, c, tuple(p)))

    jacobian = jax.jit(jax.vmap(jax.jacfwd(one)))(jnp.asarray(points[seen]))
    wanted = table("J")[seen]
    size = np.linalg.norm(wanted, axis=(1, 2))
    assert (np.linalg.norm(jacobian - wanted, axis=(1, 2)) <= 1e-9 * size).all()
    if rest:
        valid = np.asarray(lens.valid(K, c, tuple(jnp.asarray(points[front].T))))
        tangent = np.hypot(*points[front, :2].T) / points[front, 2]
        limit = float(table("crit"))
        angle = np.arctan(tangent) if name == "opencv_fisheye" else tangent
        clear = np.abs(angle - limit) > 1e-2 * min(limit, 10)
        np.testing.assert_array_equal(valid[clear], (angle < limit)[clear])
    rays, wanted = table("ray_dir"), table("ray_valid") & (table("ray_dir")[:, 2] > 0.1)
    if name != "ortho":
        found = np.stack(lens.unproject(K, c, tuple(table("pixels")[wanted].T)), -1)
        found /= np.linalg.norm(found, axis=-1, keepdims=True)
        np.testing.assert_allclose(found, rays[wanted], atol=1e-7)


DISTORTIONS = {
    "radial": Distortion("opencv", (-0.12, 0.02, 0.003, -0.002)),
    "rational": Distortion("opencv", (0.3, 0.1, 1e-3, 2e-3, 0.02, 0.35, 0.1, 0.01)),
    "fisheye": Distortion("fisheye", (0.05, -0.01, 0.002, -0.001)),
}


@pytest.mark.parametrize("name", DISTORTIONS)
def test_opencv_agrees(name):
    """The host functions of undistortion are those of OpenCV."""
    distortion = DISTORTIONS[name]
    x, y = np.random.default_rng(0).uniform(-0.8, 0.8, (2, 50))
    c, zero = np.array(distortion.coefficients), np.zeros(3)
    points = np.stack([x, y, np.ones_like(x)], -1)[:, None]
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    wanted, _ = project(points, zero, zero, np.eye(3), c)
    found = np.stack(distort(distortion, x, y), -1)
    np.testing.assert_allclose(found, wanted[:, 0], atol=1e-12)
    u, v = distortion.lens.unproject(np.eye(3), c, tuple(found.T))[:2]
    np.testing.assert_allclose(np.stack([u, v]), np.stack([x, y]), atol=1e-7)


def test_number_of_coefficients_is_checked():
    for name, lens in LENSES.items():
        for count in {0, 3, *lens.counts}:
            values = None if count == 0 else np.zeros(count)
            arguments = {"lens": name, "coefficients": values, "width": 4, "height": 4}
            if count in lens.counts:
                gsjax.make_camera(viewmat=np.eye(4), K=np.eye(3), **arguments)
                continue
            with pytest.raises(gsjax.InputError, match="coefficients"):
                gsjax.make_camera(viewmat=np.eye(4), K=np.eye(3), **arguments)
