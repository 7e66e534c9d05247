"""What the tests of the viewer share: a scene, and patience."""

import time

import jax
import numpy as np
from conftest import frustum_points, gaussians_at

COUNT = 64


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def scene(spread=1.0, degree=1):
    """Gaussians of all sizes and opacities, orange, as large as ``spread``."""
    rng = np.random.default_rng(0)
    points = spread * frustum_points(rng, COUNT)
    scales = spread * np.exp(rng.normal(-2.0, 0.7, (COUNT, 3)))
    found = gaussians_at(points, scales, rng.uniform(0.02, 0.99, COUNT), degree=degree,
                         viewmat=np.eye(4))  # fmt: skip
    sh = np.zeros_like(found.params.sh)
    sh[:, 0] = (np.array([0.9, 0.5, 0.1]) - 0.5) / 0.28209479177387814
    return found.replace(params=found.params.replace(sh=jax.numpy.asarray(sh)))
