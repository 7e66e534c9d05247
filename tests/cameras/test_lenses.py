"""Every lens against independent references: float64 tables, OpenCV and pycolmap."""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DATA

from gsjax.cameras import lenses
from gsjax.cameras.lens import angle_ratio
from gsjax.cameras.lenses import Lens
from gsjax.stress.lenses import QUICK

FILES = ("lenses", "lenses_colmap1", "lenses_colmap2", "lenses_colmap3")


class Case(NamedTuple):
    """A lens of the tables.

    Attributes:
      lens: that of gsjax.
      order: index of each of its coefficients among the table's values after the
        intrinsics; −1 for 0.
      focals: number of focal lengths in the table.
    """

    lens: Lens
    order: tuple[int, ...] = ()
    focals: int = 2


_FISHEYE, _OPENCV = lenses.FISHEYE, lenses.OPENCV
CASES = {
    "pinhole": Case(lenses.PINHOLE),
    "ortho": Case(lenses.ORTHOGRAPHIC),
    "opencv": Case(_OPENCV, (0, 1, 2, 3, 4)),
    "opencv_rational": Case(_OPENCV, tuple(range(8))),
    "opencv_thin_prism": Case(_OPENCV, tuple(range(12))),
    "opencv_fisheye": Case(_FISHEYE, (0, 1, 2, 3)),
    "PINHOLE": Case(lenses.PINHOLE),
    "SIMPLE_PINHOLE": Case(lenses.PINHOLE, focals=1),
    "SIMPLE_RADIAL": Case(_OPENCV, (0, -1, -1, -1), 1),
    "RADIAL": Case(_OPENCV, (0, 1, -1, -1), 1),
    "OPENCV": Case(_OPENCV, (0, 1, 2, 3)),
    "FULL_OPENCV": Case(_OPENCV, tuple(range(8))),
    "OPENCV_FISHEYE": Case(_FISHEYE, (0, 1, 2, 3)),
    "RADIAL_FISHEYE": Case(_FISHEYE, (0, 1, -1, -1), 1),
    "SIMPLE_RADIAL_FISHEYE": Case(_FISHEYE, (0, -1, -1, -1), 1),
    "FISHEYE": Case(_FISHEYE, (-1, -1, -1, -1)),
    "SIMPLE_FISHEYE": Case(_FISHEYE, (-1, -1, -1, -1), 1),
    "THIN_PRISM_FISHEYE": Case(lenses.THIN_PRISM_FISHEYE, tuple(range(8))),
    "RAD_TAN_THIN_PRISM_FISHEYE": Case(
        lenses.RAD_TAN_THIN_PRISM_FISHEYE, tuple(range(12))
    ),
    "FOV": Case(lenses.FOV, (0,)),
    "DIVISION": Case(lenses.DIVISION, (0,)),
    "SIMPLE_DIVISION": Case(lenses.DIVISION, (0,), 1),
    "EUCM": Case(lenses.EUCM, (0, 1)),
    "EQUIRECTANGULAR": Case(lenses.EQUIRECTANGULAR),
    "equirectangular": Case(lenses.EQUIRECTANGULAR),
    "ftheta_fwd": Case(lenses.FTHETA),
    "ftheta_bwd": Case(lenses.FTHETA_INVERSE),
}


@cache
def tables() -> dict[str, np.ndarray]:
    found = {}
    for name in FILES:
        path = DATA / "cameras" / f"{name}.npz"
        if not path.exists():
            pytest.skip(f"{path.name} is absent (../shared/data/cameras)")
        with np.load(path, allow_pickle=False) as file:
            found.update(file)
    return found


def read(name: str, index: int):
    """Return the values of a table, and the lens with K and coefficients."""
    start = f"{name}/{index}/"
    table = {k[len(start) :]: v for k, v in tables().items() if k.startswith(start)}
    case, K = CASES[name], np.eye(3)
    if name.lower() == "equirectangular":
        return table, case.lens, lenses.panorama_intrinsics(*table["size"]), None
    if name.startswith("ftheta"):
        K[:2, 2] = table["principal_point"] + 0.5
        key = "angle_to_pixeldist" if name == "ftheta_fwd" else "pixeldist_to_angle"
        values = (table[f"{key}_poly"], table["linear_cde"], table["max_angle"])
        return table, case.lens, K, np.concatenate([np.atleast_1d(v) for v in values])
    values, focals = table["params"], case.focals
    K[0, 0], K[1, 1] = values[0], values[focals - 1]
    K[:2, 2] = values[focals : focals + 2]
    rest = np.append(values[focals + 2 :], 0)
    return table, case.lens, K, rest[list(case.order)] if case.order else None


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def evaluate(lens: Lens, K, c, points):
    """Return pixels, Jacobians [M, 2, 3] and validity of points [M, 3]."""

    def one(p):
        return jnp.stack(lens.project(K, c, tuple(p)))

    at = tuple(points.T)
    valid = jnp.asarray(lens.valid(K, c, at)) & jnp.ones(len(points), bool)
    return jax.vmap(one)(points), jax.vmap(jax.jacfwd(one))(points), valid


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def there_and_back(lens: Lens, K, c, pixels):
    ray = lens.unproject(K, c, tuple(pixels.T))
    return jnp.stack(ray, -1), jnp.stack(lens.project(K, c, ray), -1)


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("name", CASES)
def test_tables(name, index, report):
    table, lens, K, c = read(name, index)
    uv, jacobian, valid = evaluate(lens, K, c, table["points"])
    seen = table["defined"] & table["injective"]
    if lens.depth is lenses.z_depth:
        valid &= table["points"][:, 2] > 0
        seen = seen & table["front"]
    np.testing.assert_array_equal(valid, seen)
    scale = np.maximum(1, np.abs(table["uv"][seen]))
    error = (np.abs(uv - table["uv"])[seen] / scale).max()
    report(f"{name} {index}, relative", error, 1e-9)
    assert error <= 1e-9
    wanted = table["J"][seen]
    size = np.linalg.norm(wanted, axis=(1, 2))
    known = np.isfinite(size)
    off = np.linalg.norm(jacobian[seen] - wanted, axis=(1, 2))
    assert (off[known] <= 1e-9 * size[known]).all()

    single = [None if a is None else np.float32(a) for a in (K, c)]
    image = seen & table["in_image"]
    short, _, _ = evaluate(lens, *single, np.float32(table["points"]))
    error = np.abs(np.float64(short) - table["uv"])[image].max(initial=0)
    report(f"{name} {index}, float32 px", error, 1e-3)
    assert error <= 1e-3

    known = table["ray_valid"]
    ray, again = there_and_back(lens, K, c, table["pixels"])
    np.testing.assert_allclose(again[known], table["pixels"][known], atol=1e-9)
    if name == "ortho":
        found, wanted = np.asarray(ray)[:, :2], table["ray_origin"][:, :2]
    else:
        found = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        wanted = table["ray_dir"]
    np.testing.assert_allclose(found[known], wanted[known], atol=1e-10)


@pytest.mark.parametrize(
    ("lens", "c"), [(lenses.DIVISION, [-1.0]), (lenses.FOV, [2.0])]
)
def test_a_bounded_image_has_finite_derivatives(lens, c):
    """The image of a half space may be smaller than the picture."""
    K, size = np.array([[10.0, 0, 16], [0, 10, 16], [0, 0, 1]]), (32, 32)

    def moved(c, point):
        return sum(lens.linearise(K, c, size, tuple(point)))

    at = jnp.array(c), jnp.array([0.5, -0.3, 1.2])
    value, slopes = jax.value_and_grad(moved, (0, 1))(*at)
    np.testing.assert_allclose(value, at[1].sum(), rtol=1e-12)
    np.testing.assert_allclose(slopes[0], [0.0])
    np.testing.assert_allclose(slopes[1], np.ones(3))


@pytest.mark.parametrize(
    "point", [(0.3, 0.2, 1.0), (0.05, -0.03, 1.0), (0.02, 0.01, 0.5), (0.3, 0.2, -1.0)]
)
def test_the_rule_of_the_angle_is_that_of_automatic_derivatives(point):
    def automatic(point):
        rho = jnp.hypot(point[0], point[1])
        return jnp.arctan2(rho, point[2]) / rho

    def ruled(point):
        return angle_ratio(tuple(point))

    point = jnp.array(point)
    for derivative in (jax.grad, jax.hessian, lambda f: jax.jacfwd(jax.hessian(f))):
        wanted = derivative(automatic)(point)
        error = jnp.abs(derivative(ruled)(point) - wanted).max()
        assert error <= 1e-8 * jnp.abs(wanted).max()
