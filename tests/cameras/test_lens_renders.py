"""Images through every kind of lens and shutter, against dense renders and laws."""

import jax
import jax.numpy as jnp
import lens_oracle
import numpy as np
import pytest
from conftest import COMPAT, gaussians_at

import gsjax
from gsjax.cameras import lenses
from gsjax.cameras.camera import with_shutter

COUNT = 40
# No limit of a pixel is within reach but that of α.
OPEN = COMPAT.replace(
    alpha_min=1e-6, transmittance_min=0.0, stop_rule="after", outputs=("rgb",)
)
UNSCENTED = OPEN.replace(projection="unscented")
OPENCV = (
    -0.12,
    0.03,
    0.004,
    -0.006,
    0.01,
    0.02,
    -0.01,
    0.003,
    0.002,
    -1e-3,
    3e-3,
    1e-3,
)
FISHEYE = (0.06, -0.02, 0.004, -0.001)
POSE = gsjax.look_at((0.2, -0.1, 0.05), (1.0, 0.3, 0.4))
TWIST = np.array([0.02, -0.05, 0.03, 0.04, 0.1, -0.03])


def around(seed=0):
    """Return splats in all directions, some of them large, none at the camera."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(COUNT, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = rng.uniform(1, 4, (COUNT, 1))
    scales = distance * np.exp(rng.uniform(-4, -1.5, (COUNT, 3)))
    means = distance * direction + (0.2, -0.1, 0.05)
    opacities = rng.uniform(0.2, 0.95, COUNT)
    return gaussians_at(means, scales, opacities, viewmat=np.eye(4), degree=0)


def intrinsics(focal, width=48, height=36):
    return np.array(
        [[focal, 0, width * 0.52], [0, 1.1 * focal, height * 0.47], [0, 0, 1]]
    )


def camera_of(lens, focal=30.0, viewmat=POSE, shutter="global", twist=None):
    size = {"width": 48, "height": 36}
    K = intrinsics(focal)
    if lens == "equirectangular":
        K = lenses.panorama_intrinsics(48, 36)
    c = {"opencv": OPENCV, "fisheye": FISHEYE}.get(lens)
    camera = gsjax.make_camera(viewmat=viewmat, K=K, **size, lens=lens, coefficients=c)
    return with_shutter(camera, shutter, twist=twist)


ORACLES = {
    "opencv": lambda K: lens_oracle.opencv(K, np.array(OPENCV), (48, 36)),
    "fisheye": lambda K: lens_oracle.fisheye(K, FISHEYE, (48, 36)),
    "equirectangular": lambda _: lens_oracle.equirectangular(48, 36),
}


@pytest.mark.parametrize(
    ("lens", "focal"), [("opencv", 30.0), ("fisheye", 12.0), ("equirectangular", 1.0)]
)
def test_images_are_those_of_the_oracle(lens, focal, report):
    gaussians, camera = around(), camera_of(lens, focal)
    wanted = lens_oracle.render(
        gaussians, camera, ORACLES[lens](np.asarray(camera.K)), OPEN
    )
    found = gsjax.render(gaussians, camera, OPEN).check()
    assert np.std(wanted) > 0.05
    error = np.abs(found.rgb - wanted)
    report(lens, error.max(), 1e-6)
    assert error.max() <= 1e-6
    if lens == "equirectangular":
        culled = gsjax.render(
            gaussians, camera, OPEN.replace(occlusion=True, transmittance_min=1e-7)
        )
        np.testing.assert_allclose(culled.rgb, found.rgb, atol=1e-5)


def turned(columns, width=48):
    """Return the pose turned so that the image moves by whole columns."""
    angle = 2 * np.pi * columns / width
    turn = np.eye(4)
    turn[0, [0, 2]], turn[2, [0, 2]] = (
        (np.cos(angle), np.sin(angle)),
        (-np.sin(angle), np.cos(angle)),
    )
    return turn @ POSE


@pytest.mark.parametrize("config", [OPEN, UNSCENTED], ids=lambda c: c.projection)
def test_a_panorama_rolls(config):
    first = gsjax.render(around(), camera_of("equirectangular"), config).rgb
    for columns in (1, 17, 40):
        camera = camera_of("equirectangular", viewmat=turned(columns))
        image = gsjax.render(around(), camera, config).check().rgb
        np.testing.assert_allclose(image, np.roll(first, columns, 1), atol=1e-9)


@jax.jit
def still_images(gaussians, camera, poses):
    return jax.lax.map(
        lambda pose: gsjax.render(gaussians, camera.replace(viewmat=pose), OPEN).rgb,
        poses,
    )


@pytest.mark.parametrize("shutter", ["top_to_bottom", "right_to_left"])
def test_a_rolling_shutter_is_assembled_from_its_rows(shutter, report):
    """Small splats: within a splat the shutter is linear, from row to row it is not."""
    gaussians = around()
    small = gaussians.params.log_scales - 1.5
    gaussians = gaussians.replace(params=gaussians.params.replace(log_scales=small))
    camera = camera_of("opencv", shutter=shutter, twist=TWIST)
    image = gsjax.render(gaussians, camera, OPEN).check().rgb
    rows = shutter == "top_to_bottom"
    times = (np.arange(36 if rows else 48) + 0.5) / (36 if rows else 48)
    times = times if rows else 1 - times
    # As many for rows as for columns, for one program.
    padded = np.pad(times, (0, 48 - len(times)))
    poses = jnp.stack([pose_at(camera.viewmat, t) for t in (0, *padded)])
    still = camera_of("opencv")
    first, *others = still_images(gaussians, still, poses)[: len(times) + 1]
    lines = [image[i] if rows else image[:, i] for i, image in enumerate(others)]
    wanted = np.stack(lines, 0 if rows else 1)
    error, moved = np.abs(image - wanted).max(), np.abs(first - wanted).max()
    report(f"{shutter}, of a motion of {moved:.2f}", error, 0.02)
    assert moved > 0.2
    assert error < 0.02


def pose_at(viewmat, t):
    from scipy.spatial.transform import Rotation

    pose = np.array(viewmat)
    pose[:3, :3] = Rotation.from_rotvec(t * TWIST[:3]).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += t * TWIST[3:]
    return jnp.asarray(pose)


NAMES = ("K", "viewmat", "coefficients", "twist")
# Entries that make intrinsics and a pose.
MASKS = {
    "K": np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]]),
    "viewmat": np.array([[1.0], [1], [1], [0]]),
}


def test_gradients_are_finite_differences(report):
    """By K, pose and Gaussians, in 32 directions, with splats across the seam."""
    config = UNSCENTED.replace(alpha_min=1e-14, alpha_max=1 - 1e-9)
    gaussians, camera = around(), camera_of("equirectangular")
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(36, 48, 3))
    inputs = {name: getattr(camera, name) for name in NAMES}
    inputs["params"] = gaussians.params

    def loss(inputs):
        changed = {name: inputs[name] for name in NAMES}
        some = gaussians.replace(params=inputs["params"])
        image = gsjax.render(some, camera.replace(**changed), config)
        return jnp.sum(image.rgb * weights)

    def random(which):
        direction = jax.tree.map(jnp.zeros_like, inputs)
        direction[which] = jax.tree.map(
            lambda a: rng.normal(size=a.shape) * MASKS.get(which, 1), inputs[which]
        )
        return direction

    def along(direction, scale):
        return jax.tree.map(lambda a, d: a + scale * d, inputs, direction)

    def dot(a, b):
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b))
        return sum(float(jnp.vdot(x, y)) for x, y in pairs)

    both = jax.jit(jax.value_and_grad(loss))  # one program
    (_, gradients), step = both(inputs), 1e-6
    present = [name for name in inputs if inputs[name] is not None]
    for number in range(32):
        which = present[number % len(present)]
        direction = random(which)
        near, far = (
            both(along(direction, h))[0] - both(along(direction, -h))[0]
            for h in (step, 2 * step)
        )
        wanted = (8 * near - far) / (12 * step)
        size = (dot(gradients[which], gradients[which])) ** 0.5
        size *= dot(direction, direction) ** 0.5
        error = abs(dot(gradients, direction) - wanted) / size
        report(which, error, 1e-5)
        assert error <= 1e-5, which
    direction = {which: random(which)[which] for which in inputs}
    product = jax.jit(lambda x, d: jax.jvp(jax.value_and_grad(loss), (x,), (d,))[1])
    tangent, found = product(inputs, direction)
    assert abs(tangent - dot(gradients, direction)) <= 1e-10 * abs(tangent)
    ends = [both(along(direction, h))[1] for h in (1e-6, -1e-6)]
    wanted = jax.tree.map(lambda a, b: (a - b) / 2e-6, *ends)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b)
