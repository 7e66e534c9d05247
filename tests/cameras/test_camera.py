"""Bad arguments of cameras raise an `InputError` that names them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of

import gsjax
from gsjax import InputError
from gsjax.cameras.camera import with_shutter

EYE, K = np.eye(4), np.array([[50.0, 0, 8], [0, 50, 8], [0, 0, 1]])


def put(matrix, place, value):
    matrix = matrix.copy()
    matrix[place] = value
    return matrix


def lens(name, *coefficients):
    """Return arguments of a lens; a list is its coefficients as they are."""
    values = [c for c in coefficients if not isinstance(c, list)]
    values = values or next(iter(coefficients), None)
    return {"lens": name, "coefficients": values}


TWIST = np.array([0.02, -0.05, 0.03, 0.04, 0.1, -0.03])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"shutter": "sideways", "twist": TWIST}, "shutter: .*top_to_bottom"),
        ({"shutter": 3, "twist": TWIST}, "shutter"),
        ({"shutter": "global", "twist": TWIST}, "neither .*global"),
        ({"shutter": "top_to_bottom"}, "expected one of twist and viewmat_end"),
        ({"twist": TWIST, "viewmat_end": EYE}, "expected one of"),
        ({"twist": TWIST[:5]}, "twist: expected shape"),
        ({"twist": TWIST * np.nan}, "twist: expected finite"),
        ({"viewmat_end": np.eye(3)}, "viewmat_end: expected shape"),
        ({"viewmat_end": 2 * EYE}, "viewmat"),
    ],
)
def test_shutters_are_checked(changes, named):
    camera = gsjax.make_camera(viewmat=EYE, K=K, width=16, height=16)
    with pytest.raises(InputError, match=named):
        with_shutter(camera, **{"shutter": "top_to_bottom"} | changes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"width": 0}, "image size"),
        ({"height": -3}, "image size"),
        ({"width": 8.5}, "image size"),
        ({"width": np.nan}, "image size"),
        ({"height": None}, "image size"),
        ({"lens": 3}, "lens"),
        ({"lens": "unknown"}, "lens"),
        ({"coefficients": [1.0]}, "coefficients: expected 0 for the pinhole lens"),
        (lens("opencv"), "coefficients: expected 4 or 5 or 8 or 12"),
        (lens("opencv", 0.1, 0.2, 0.3), "opencv lens, got 3"),
        (lens("opencv", [[0.1] * 4] * 3), r"coefficients: expected shape \[M\]"),
        (lens("fisheye", 0.1, np.nan, 0, 0), "finite .*fisheye.*calibrate"),
        (lens("division", np.inf), "coefficients: expected finite"),
        (lens("equirectangular", 1.0), "coefficients: expected 0"),
        (lens("eucm", 1.1, 0.6), "alpha .*order"),
        (lens("eucm", 0.6, -1.0), "beta above 0"),
        (lens("fov", 45.0), "fov.*radians"),
        (lens("ftheta", *[0.0] * 10), "slope .*largest angle"),
        (lens("ftheta_inverse", 0, 1, *[0.0] * 7, -1), "largest angle above 0"),
        ({"viewmat": 1j * EYE}, "viewmat"),
        ({"K": K + 0j}, "K"),
        ({"viewmat": np.eye(3)}, "viewmat"),
        ({"viewmat": np.zeros((2, 3, 4, 4))}, "viewmat"),
        ({"viewmat": np.zeros((0, 4, 4))}, "viewmat.* at least one"),
        ({"viewmat": put(EYE, (3, 0), 1)}, "viewmat.* transpose"),
        ({"viewmat": put(EYE, (0, 3), np.nan)}, "viewmat"),
        ({"viewmat": put(EYE, (0, 0), np.inf)}, "viewmat"),
        ({"viewmat": 2 * EYE}, "viewmat"),
        ({"viewmat": np.diag([2, 2, 2, 1.0])}, r"viewmat.*\[2. 2. 2.\]"),
        ({"viewmat": put(EYE, (0, 1), 0.1)}, "viewmat.* rotation"),
        ({"viewmat": np.diag([1, -1, 1, 1.0])}, "viewmat.* mirror"),
        ({"viewmat": np.stack([EYE, np.diag([-1.0, -1, -1, 1])])}, "viewmat.* mirror"),
        ({"K": np.eye(4)}, "K"),
        ({"K": K.T}, "K: .*last row.*transpose"),
        ({"K": 2 * K}, "K: .*last row.*divide"),
        ({"K": put(K, (0, 1), 0.1)}, "K: .*skew"),
        ({"K": put(K, (1, 0), -0.1)}, "K: .*skew"),
        ({"K": np.zeros((2, 3, 3))}, "K"),
        ({"K": put(K, (0, 2), np.nan)}, "K"),
        ({"K": put(K, (0, 0), 0.0)}, "K: .*focal"),
        ({"K": put(K, (1, 1), -50.0)}, "K: .*focal"),
        ({"K": put(K, (0, 0), 1e16)}, "K: .*focal"),
        ({"K": put(K, (0, 2), -1e16)}, "K: .*principal"),
        ({"near": 0.0}, "near"),
        ({"near": np.nan}, "near"),
        ({"near": [0.1, 0.2]}, "near"),
        ({"near": 5.0, "far": 4.0}, "far"),
        ({"far": np.nan}, "far"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_cameras_are_checked(changes, named):
    with pytest.raises(InputError, match=named):
        gsjax.make_camera(
            **{"viewmat": EYE, "K": K, "width": 16, "height": 16} | changes
        )


def test_rounded_and_traced_cameras_are_accepted():
    """Rounding is no skew; values of tracers are not checked."""
    near = K * (1 + 1e-7) + 1e-7  # as a product with an inverse leaves them
    camera = gsjax.make_camera(viewmat=EYE, K=near, width=16, height=16)
    np.testing.assert_allclose(camera.K, K, atol=1e-5)

    @jax.jit
    def focal(viewmat, K):
        return gsjax.make_camera(viewmat=viewmat, K=K, width=16, height=16).K[0, 0]

    assert focal(jnp.diag(jnp.array([1, -1, 1, 1.0])), jnp.asarray(K.T)) == 50


def test_look_at_normalises_and_rejects_missing_directions():
    wanted = gsjax.look_at((1, 2, 3), (0, 0, 0), (0, 1, 1))
    for length in (1e-30, 1e30):
        found = gsjax.look_at((1, 2, 3), (0, 0, 0), (0, length, length))
        np.testing.assert_allclose(found, wanted, atol=1e-12)
    for bad in ({"target": (1, 2, 3)}, {"up": (0, 0, 0)}, {"target": (np.nan, 0, 0)}):
        with pytest.raises(InputError, match="direction"):
            gsjax.look_at(**{"eye": (1, 2, 3), "target": (0, 0, 0), **bad})


def test_sizes_and_batches_are_checked():
    camera = camera_of()
    for size in ((0, 8), (8, -1), (8.5, 8)):
        with pytest.raises(InputError, match="image size"):
            gsjax.resize_camera(camera, *size)
    assert type(gsjax.resize_camera(camera, 8.0, 4).width) is int
    for cameras in ([], [camera_of(8, 8), camera_of(8, 9)]):
        with pytest.raises(InputError, match="cameras"):
            gsjax.stack_cameras(cameras)
