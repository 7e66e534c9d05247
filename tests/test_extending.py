"""Extensions from outside the package; `docs/extending.md` shows their code.

Each section between two markers is an extension. Gradients are compared with finite
differences; models, strategies and loss terms train.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import training
from conftest import assert_not_empty, camera_of, frustum_points, gaussians_at

import gsjax

# --8<-- [start:lens]
from gsjax.cameras.lenses import Lens, linearise_in_place


def _stereographic(K, c, point):
    """Project by r = 2 tan(θ / 2), then by the radial term 1 + c r²."""
    x, y, z = point
    scale = 2 / (jnp.sqrt(x * x + y * y + z * z) + z)
    a, b = x * scale, y * scale
    radial = 1 + c[0] * (a * a + b * b)
    return K[0, 0] * a * radial + K[0, 2], K[1, 1] * b * radial + K[1, 2]


def _ray(K, c, pixel):
    """Invert the radial term by Newton's method, then the projection."""
    a, b = (pixel[0] - K[0, 2]) / K[0, 0], (pixel[1] - K[1, 2]) / K[1, 1]
    far = jnp.sqrt(a * a + b * b)
    r = far
    for _ in range(8):
        r = r - (r * (1 + c[0] * r * r) - far) / (1 + 3 * c[0] * r * r)
    scale = jnp.where(far > 0, r / jnp.where(far > 0, far, 1), 1)
    a, b = a * scale, b * scale
    return a, b, 1 - (a * a + b * b) / 4


def _range(point):
    return jnp.sqrt(sum(p * p for p in point))


STEREOGRAPHIC = Lens(
    name="stereographic",
    counts=(1,),
    project=_stereographic,
    unproject=_ray,
    valid=lambda _K, _c, point: point[2] > -0.8 * _range(point),
    depth=_range,
    linearise=linearise_in_place,
)
# gsjax.make_camera(..., lens=STEREOGRAPHIC, coefficients=[0.05])
# --8<-- [end:lens]

# --8<-- [start:primitive]
from gsjax.raster.forms import AtPixel, Form, Parts, Plane
from gsjax.raster.primitives.ellipsoid import ELLIPSOID

_EDGE = 8.0  # Q at which a bump ends


def _bump_bounds(active, values, camera, config, alpha_min=None):
    """Bound Q ≤ 8: a small α limit makes the bounds of an ellipsoid wide enough."""
    del alpha_min
    return ELLIPSOID.bounds(active, values, camera, config, jnp.asarray(1e-6))


def _bump_project(inputs, config, order, count):
    out = ELLIPSOID.project(inputs, config, order, count)
    reach = jnp.where(out.footprint.reach > 0, _EDGE, 0)
    return out._replace(footprint=out.footprint._replace(reach=reach))


def _bump_parts(shape):
    """Return y1 and y2, linear in the offset of a pixel from the centre."""
    inv_sx, slope, inv_sy = shape
    return Parts((Plane(0.0, inv_sx, 0.0), Plane(0.0, -inv_sy * slope, inv_sy)))


def _bump_evaluate(values, depth, limits, once):
    """Return the logarithm of (1 − Q / 8)², which ends smoothly at the edge."""
    del depth, limits, once
    y1, y2 = values
    inside = 1 - (y1 * y1 + y2 * y2) / _EDGE
    return AtPixel(2 * jnp.log(jnp.where(inside > 1e-9, inside, 1e-9)))


BUMP = ELLIPSOID._replace(
    name="bump",
    bounds=_bump_bounds,
    project=_bump_project,
    occluders=None,
    form=Form(_bump_parts, _bump_evaluate),
)
# gsjax.RasterConfig(primitive=BUMP)
# --8<-- [end:primitive]

# --8<-- [start:model]
from gsjax.train.models import Model, ModelParams


def _moved(params, view):
    """Move the scene by time · shift and turn it by time · turn about z."""
    motion, gaussians = params.model.shared, params.gaussians
    half = 0.5 * view.time * motion["turn"]
    w, z = jnp.cos(half), jnp.sin(half)
    x, y, height = gaussians.params.means.T
    cos, sin = w * w - z * z, 2 * w * z
    means = jnp.stack([cos * x - sin * y, sin * x + cos * y, height], -1)
    qw, qx, qy, qz = gaussians.params.quats.T
    quats = (w * qw - z * qz, w * qx - z * qy, w * qy + z * qx, w * qz + z * qw)
    moved = gaussians.params.replace(
        means=means + view.time * motion["shift"], quats=jnp.stack(quats, -1)
    )
    return gaussians.replace(params=moved)


RIGID = Model(
    init=lambda _: ModelParams(shared={"turn": jnp.zeros(()), "shift": jnp.zeros(3)}),
    apply=_moved,
    rates={"turn": 0.02, "shift": 0.02},
)
# gsjax.fit(dataset, photos, config, model=RIGID)
# --8<-- [end:model]

# --8<-- [start:strategy]
from gsjax.densify.types import SlotEdit, Strategy


def remove_faint(every: int, limit: float) -> Strategy:
    """Return a strategy that removes Gaussians with an opacity below ``limit``."""

    def plan(key, step, gaussians, stats):
        del key, step
        keep = jax.nn.sigmoid(gaussians.params.logit_opacities) >= limit
        active = gaussians.active & keep
        edit = SlotEdit(
            params=gaussians.params,
            active=active,
            cleared=gaussians.active & ~keep,
            opacities_reset=jnp.asarray(False),
            wanted=jnp.sum(active, dtype=jnp.int32),
        )
        return edit, stats

    return Strategy(
        init=lambda gaussians: jnp.zeros(gaussians.capacity),
        observe=lambda stats, seen: jnp.maximum(stats, seen.radii.max(0)),
        due=lambda step: step % every == 0,
        plan=plan,
    )


# gsjax.fit(dataset, photos, config, strategy=remove_faint(10, 0.01))
# --8<-- [end:strategy]

# --8<-- [start:loss_term]
from gsjax.train.losses import LossTerm


def _transparency(render, batch, params):
    """Return the mean transmittance: the scene becomes opaque."""
    del batch, params
    return jnp.mean(1 - render.alpha)


OPAQUE = LossTerm("opaque", _transparency, weight=0.5, start=2, outputs=("alpha",))
# gsjax.fit(dataset, photos, config, loss_terms=(OPAQUE,))
# --8<-- [end:loss_term]

# --8<-- [start:reader]
from gsjax.data.readers import READERS
from gsjax.data.types import Dataset, Reader, View


def _load_list(path, options):
    """Read lines of: name, focal length, width, height, 12 numbers of the pose."""
    del options
    views = []
    for line in (path / "poses.txt").read_text().splitlines():
        name, *numbers = line.split()
        focal, width, height, *pose = map(float, numbers)
        viewmat = np.vstack([np.reshape(pose, (3, 4)), [0, 0, 0, 1]])
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        size = int(width), int(height)
        views.append(View(name, path / name, viewmat, K, *size))
    return Dataset(path, "list", tuple(views))


LIST = Reader("list", lambda path: (path / "poses.txt").exists(), _load_list)
# gsjax.load_dataset(path, readers=(*READERS, LIST))
# --8<-- [end:reader]

# --8<-- [start:format]
from gsjax.io.common import Format
from gsjax.io.formats import FORMATS


def _load_npz(path):
    with np.load(path, allow_pickle=False) as file:
        return gsjax.make_gaussians(**file)


def _save_npz(path, gaussians, *, overwrite):
    with open(path, "wb" if overwrite else "xb") as file:
        packed = gsjax.compact(gaussians, int(gsjax.num_active(gaussians)))
        np.savez(file, **vars(packed.params))


NPZ = Format("npz", (".npz",), _load_npz, _save_npz)
# gsjax.load(path, formats=(*FORMATS, NPZ))
# --8<-- [end:format]

WEIGHT = np.random.default_rng(3).normal(size=(13, 19, 3))


def scene():
    rng = np.random.default_rng(0)
    points = frustum_points(rng, 12, far=6.0, spread=0.4)
    scales = np.exp(rng.normal(-1, 0.3, (12, 3)))
    return gaussians_at(points, scales, rng.uniform(0.2, 0.9, 12))


def assert_gradient(loss, point):
    """Compare a directional derivative with central differences."""
    value_and_grad, step = jax.jit(jax.value_and_grad(loss)), 1e-6
    rng = np.random.default_rng(1)
    direction = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), point)
    _, grads = value_and_grad(point)
    for leaf in jax.tree.leaves(grads):
        assert np.linalg.norm(leaf) > 0
    products = jax.tree.map(lambda a, b: jnp.sum(a * b), grads, direction)
    found = sum(jax.tree.leaves(products))
    ahead, behind = (
        value_and_grad(jax.tree.map(lambda x, d, h=h: x + h * d, point, direction))[0]
        for h in (step, -step)
    )
    wanted = (ahead - behind) / (2 * step)
    assert abs(found - wanted) <= 1e-5 * abs(wanted)


def test_lens():
    gaussians = scene()
    lens = {"lens": STEREOGRAPHIC, "coefficients": [0.05]}
    camera = camera_of(19, 13, focal=(12.0, 13.0), **lens)
    pixels = np.random.default_rng(2).uniform(0, 13, (2, 40))
    rays = STEREOGRAPHIC.unproject(camera.K, camera.coefficients, pixels)
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-9)

    def loss(point):
        coefficients, (fx, fy, cx, cy), means = point
        K = jnp.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        seen = camera.replace(coefficients=coefficients, K=K)
        moved = gaussians.replace(params=gaussians.params.replace(means=means))
        return jnp.sum(gsjax.render(moved, seen, training.SMOOTH).rgb * WEIGHT)

    assert_not_empty(gsjax.render(gaussians, camera, training.SMOOTH).alpha)
    intrinsics = camera.K[jnp.asarray([0, 1, 0, 1]), jnp.asarray([0, 1, 2, 2])]
    assert_gradient(loss, (camera.coefficients, intrinsics, gaussians.params.means))


def test_primitive():
    gaussians, camera = scene(), camera_of(19, 13, focal=(20.0, 21.0))
    config = training.SMOOTH.replace(primitive=BUMP)
    bumps = gsjax.render(gaussians, camera, config)
    ellipsoids = gsjax.render(gaussians, camera, training.SMOOTH)
    assert not bumps.overflowed
    assert_not_empty(bumps.alpha)
    assert np.abs(bumps.alpha - ellipsoids.alpha).max() > 0.05

    def loss(params):
        image = gsjax.render(gaussians.replace(params=params), camera, config).rgb
        return jnp.sum(image * WEIGHT)

    assert_gradient(loss, gaussians.params)


TRAIN = gsjax.TrainConfig(
    steps=30, sh_degree=0, raster=training.RASTER.replace(pair_capacity=None),
    prune_invisible=False,
)  # fmt: skip


def fit(**seams):
    return gsjax.fit(training.dataset(), training.photos(), TRAIN, **seams)


def test_model():
    """A scene that moves to the side is followed by the model."""
    shift = np.array([0.15, -0.1, 0.05])
    still = training.true_gaussians()
    views, photos = [], []
    for index, view in enumerate(training.dataset().views):
        time = float(index % 2)
        moved = still.params.replace(means=still.params.means + time * shift)
        photos.append(training.photo_of(still.replace(params=moved), view))
        views.append(replace(view, time=time))
    dataset = replace(training.dataset(), views=tuple(views))
    config = TRAIN.replace(rates=TRAIN.rates._replace(means=(1e-5, 1e-5)))
    with jax.enable_x64(False):
        result = gsjax.fit(dataset, photos, config, model=RIGID)
    found = np.asarray(result.state.model.shared["shift"])
    assert np.linalg.norm(found - shift) < 0.6 * np.linalg.norm(shift)


@pytest.mark.usefixtures("float32")
def test_strategy():
    start = training.rough_start(0, 64)
    logits = start.params.logit_opacities.at[:20].set(-9.0)
    start = start.replace(params=start.params.replace(logit_opacities=logits))
    given = {"strategy": remove_faint(every=10, limit=0.01)}
    state = gsjax.init_state(start, TRAIN, training.EXTENT, training.VIEWS, **given)
    result = fit(state=state, **given)
    assert gsjax.num_active(start) == training.POINTS
    assert gsjax.num_active(result.gaussians) == training.POINTS - 20


@pytest.mark.usefixtures("float32")
def test_loss_term():
    camera = training.camera_at(training.dataset().views[0])
    plain, opaque = (
        gsjax.render_exact(fit(loss_terms=terms).gaussians, camera).alpha.mean()
        for terms in ((), (OPAQUE,))
    )
    assert opaque > plain + 0.01


def test_reader(tmp_path):
    lines = []
    for view in training.dataset().views:
        pose = " ".join(map(repr, map(float, view.viewmat[:3].ravel())))
        lines.append(f"{view.name} 30.0 32 24 {pose}")
        (tmp_path / view.name).write_bytes(b"")
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    readers = (*READERS, LIST)
    dataset = gsjax.load_dataset(tmp_path, readers=readers)
    assert dataset.format == "list"
    for view, wanted in zip(dataset.views, training.dataset().views, strict=True):
        np.testing.assert_array_equal(view.viewmat, wanted.viewmat)
    with pytest.raises(gsjax.InputError):
        gsjax.load_dataset(tmp_path)


def test_format(tmp_path):
    formats = (*FORMATS, NPZ)
    gaussians, path = scene(), tmp_path / "scene.npz"
    gsjax.save(path, gaussians, formats=formats)
    found = gsjax.load(path, formats=formats)
    jax.tree.map(np.testing.assert_array_equal, found, gaussians)
    with pytest.raises(gsjax.InputError):
        gsjax.load(path)
