"""Covariances and spherical harmonics against an independent float64 reference."""

import numpy as np
import pytest
from conftest import oracle_data

from gsjax.math.rotations import covariance
from gsjax.math.sh import eval_sh

VALUE = 1e-9


@pytest.fixture(scope="module")
def data():
    return oracle_data("projection_oracle")


def relative(found, wanted):
    """Return the largest error of a row (a vector, a matrix) relative to its norm."""
    found, wanted = (np.asarray(a).reshape(len(a), -1) for a in (found, wanted))
    assert np.isfinite(found).all()
    size = np.linalg.norm(wanted, axis=-1)
    assert (size > 0).mean() > 0.99
    return np.max(np.linalg.norm(found - wanted, axis=-1) / np.maximum(size, 1e-30))


def test_covariances_agree(data, report):
    quats, scales = (data[f"in_{n}"].astype(np.float64) for n in ("quats", "scales"))
    error = relative(covariance(quats, scales), data["f64_covars"])
    report("covariances", error, VALUE)
    assert error <= VALUE


@pytest.mark.parametrize("degree", range(5))
def test_spherical_harmonics_agree(data, degree, report):
    wanted = data[f"sh_deg{degree}_f64"]
    coefficients = data["in_sh_coeffs"][:, : (degree + 1) ** 2]
    directions = data["in_sh_dirs"]  # of any length
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    error = relative(eval_sh(coefficients, directions), wanted)
    report(f"SH degree {degree}", error, VALUE)
    assert error <= VALUE
