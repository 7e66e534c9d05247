"""Surfels and the images of geometry: references, a dense oracle, laws, poison.

The references are 400 surfels of five kinds (Huang et al. 2024) and 300 ellipsoids
(RaDe-GS), all float64. Fused and chunked compositing run on a CPU, parallel compositing
as on a GPU.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPAT, DATA, camera_of, gaussians_at, pose

import gsjax
from gsjax.init.surfels import flattened
from gsjax.raster.forms import unmarked, values_at
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.ellipsoid_depth import RAY_FORM
from gsjax.raster.surfel_reference import dense_geometry
from gsjax.raster.types import Inputs

GEOMETRY = ("rgb", "alpha", "depth", "normals", "distortion")
LIMITS = {
    "thr": {"alpha_min": 1 / 255, "alpha_max": 0.99, "transmittance_min": 1e-4},
    "free": {
        **{"alpha_min": 1e-300, "alpha_max": 1.0, "transmittance_min": 0.0},
        "stop_rule": "after",
    },
}
KINDS = {
    "surfel": {"primitive": "surfel"},
    "surfel_area": {"primitive": "surfel_area", "antialias": True},
    "ellipsoid": {"ray_depth": True},
}


def load(name):
    path = DATA / "methods" / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"{path.name}: the references are not here")
    return np.load(path)


@pytest.fixture(scope="module")
def data():
    return load("surfels")


def within(report, name, error, bar):
    report(name, error, bar)
    assert error <= bar, name


def scene_of(data):
    """Return the scene of the references; a third scale that must not matter."""
    scales, opacities = data["scales"], np.minimum(data["opacities"], 1 - 1e-12)
    flat = np.full((len(scales), 1), 1e-3)
    return gsjax.make_gaussians(
        means=data["means"],
        quats=data["quats"],
        log_scales=np.log(np.concatenate([scales[:, :2], flat], 1)),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh=np.zeros((len(scales), 1, 3)),
    )


def camera_in(data, near):
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = data["R_cw"], data["t_cw"]
    return gsjax.make_camera(
        viewmat=viewmat,
        K=data["K"],
        width=int(data["width"]),
        height=int(data["height"]),
        near=near,
    )


def config_of(mode, outputs, **changes):
    return COMPAT.replace(
        **{**LIMITS[mode], "outputs": outputs, "pair_capacity": 2**16, **changes}
    )


@pytest.mark.parametrize("mode", ["thr", "free"])
def test_images_are_those_of_the_reference(data, mode, report):
    near = float(data["near"])
    config = config_of(mode, (*GEOMETRY, "median_depth"), primitive="surfel")
    colors = jnp.asarray(data["colours"], float)
    view = gsjax.render(scene_of(data), camera_in(data, near), config, features=colors)
    assert not view.overflowed
    scale = near * 100 / (100 - near)
    found = {
        "image": view.rgb,
        "alpha": view.alpha,
        "normal": view.normals,
        "depth_sel": view.depth * view.alpha,
        "dist_quad": view.distortion * scale**2,
    }
    clear = data["thr_robust"] if mode == "thr" else np.ones(view.alpha.shape, bool)
    for name, image in found.items():
        error = np.abs(np.asarray(image) - data[f"{mode}_{name}"])[clear]
        within(report, f"{mode} {name}", error.max(), 1e-9)
    median, wanted = np.asarray(view.median_depth), data[f"{mode}_median_sel"]
    clear = clear & (median > 0) & data["thr_robust_depth"]
    assert clear.mean() > 0.8
    within(
        report, f"{mode} median", np.abs(median - wanted)[clear].max(), 1e-6
    )  # float32


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_gradients_are_those_of_the_reference(data, platform, monkeypatch, report):
    if platform == "gpu":
        monkeypatch.setattr("gsjax.raster.tile_render.platform_name", lambda: "gpu")
    wanted, mode, near = load("surfels_grad"), "thr", float(data["near"])
    config = config_of(mode, GEOMETRY, primitive="surfel")
    gaussians, camera = scene_of(data), camera_in(data, near)
    scale = near * 100 / (100 - near)

    def losses(params, colors):
        view = gsjax.render(
            gaussians.replace(params=params), camera, config, features=colors
        )
        images = {
            **{"image": view.rgb, "alpha": view.alpha, "normal": view.normals},
            "depth": view.depth * view.alpha,
        }
        total = sum(jnp.sum(wanted[f"cot_{k}"] * image) for k, image in images.items())
        return total, jnp.sum(wanted["cot_distortion"] * view.distortion) * scale**2

    colors = jnp.asarray(data["colours"], float)
    both = jax.jit(jax.jacrev(losses, argnums=(0, 1)))(gaussians.params, colors)
    opacity = data["opacities"].astype(float)
    for name, (by_params, by_colors) in zip(("L_sel", "dquad"), both):
        found = {
            "means": by_params.means,
            "quats": by_params.quats,
            "scales": by_params.log_scales[:, :2] / data["scales"][:, :2],
            "opacities": by_params.logit_opacities / (opacity * (1 - opacity)),
            "colours": by_colors,
        }
        assert not by_params.log_scales[:, 2].any()
        for leaf, value in found.items():
            key = f"{mode}_grad_{name}_{leaf}"
            if key not in wanted:
                continue
            # α = 1 has no logit.
            right, there = wanted[key], opacity < 1
            error = np.abs(np.asarray(value) - right)[there]
            within(report, f"{name} {leaf}", error.max() / np.abs(right).max(), 1e-7)


def test_depth_and_normals_of_ellipsoids(report):
    """z* and RaDe-GS's normals, and their gradients, at single pairs."""
    data = load("depth3d")
    scales, count = data["scales"], len(data["means"])
    gaussians = gsjax.make_gaussians(
        means=data["means"],
        quats=data["quats"],
        log_scales=np.log(scales),
        logit_opacities=np.zeros(count),
        sh=np.zeros((count, 1, 3)),
    )
    camera = camera_in(data, 1e-3)
    outputs = "depth", "normals"
    config = COMPAT.replace(outputs=outputs, ray_depth=True, dilation=0)
    owner, pixel = data["pair_gaussian"], data["pair_pixel"] + 0.5

    @jax.jit
    def geometry(params):
        inputs = Inputs(gaussians.replace(params=params), camera)
        order = jnp.arange(count), jnp.int32(count)
        out = ELLIPSOID.project(inputs, config, *order)
        *shape, _ = (number[owner] for number in out.splat.shape)
        parts = RAY_FORM.parts(tuple(shape))
        offset = pixel[:, 0] - out.splat.u[owner], pixel[:, 1] - out.splat.v[owner]
        values = values_at(parts, *offset)
        at = RAY_FORM.evaluate(values, parts.depth, parts.limits, unmarked)
        return at.depth, out.channels.normals.T

    (depth, normals), pull = jax.vjp(geometry, gaussians.params)
    within(report, "z*", np.max(np.abs(depth / data["z_star"] - 1)), 1e-9)
    within(report, "normal", np.max(np.abs(normals - data["normal_rade"])), 1e-9)
    cotangents = (
        jnp.asarray(data["cot_z"], float),
        jnp.asarray(data["cot_normal"], float),
    )
    (by_depth,) = pull((cotangents[0], jnp.zeros_like(normals)))
    (by_normals,) = pull((jnp.zeros_like(depth), cotangents[1]))
    for name, slopes in (("z_star", by_depth), ("normal_rade", by_normals)):
        leaves = {"means": slopes.means, "quats": slopes.quats}
        leaves["scales"] = slopes.log_scales / scales
        for leaf, value in leaves.items():
            right = data[f"grad_{name}_{leaf}"]
            size = np.linalg.norm(right, axis=-1)
            error = np.linalg.norm(np.asarray(value) - right, axis=-1)
            worst = np.max(error / (size + 1e-6 * size.max()))
            within(report, f"{name} by {leaf}", worst, 1e-7)


COUNT, WIDTH, HEIGHT = 60, 37, 26
# Not rounded to float32: its rotation is one to 1e-16.
CAMERA = camera_of(WIDTH, HEIGHT).replace(viewmat=jnp.asarray(pose()))
CLEAR = {"alpha_min": 1e-6, "transmittance_min": 0.0, "stop_rule": "after"}


def some_scene(seed=0):
    """Return flat Gaussians of all sizes; some cross the near plane."""
    rng = np.random.default_rng(seed)
    z = np.linspace(0.3, 6, COUNT)
    xy = rng.uniform(-0.5, 0.5, (COUNT, 2)) * z[:, None]
    scales = np.exp(rng.normal(-1.5, 0.8, (COUNT, 3)))
    return gaussians_at(np.column_stack([xy, z]), scales, rng.uniform(0.2, 0.95, COUNT))


def near_scene():
    """Return flat Gaussians, close and beside the image; many cross the near plane."""
    rng = np.random.default_rng(5)
    z = rng.uniform(0.02, 1.5, COUNT)
    xy = rng.uniform(-1.5, 1.5, (COUNT, 2)) * z[:, None]
    scales = np.exp(rng.normal(-0.5, 0.7, (COUNT, 3)))
    return gaussians_at(np.column_stack([xy, z]), scales, rng.uniform(0.02, 0.3, COUNT))


SCENE = flattened(some_scene())
CLOSE = flattened(near_scene()), CAMERA.replace(near=jnp.asarray(0.01))


def config_for(kind, **changes):
    outputs = (*GEOMETRY, "median_depth")
    return COMPAT.replace(**{**CLEAR, **KINDS[kind], "outputs": outputs, **changes})


@pytest.mark.parametrize(
    ("kind", "platform"), [*((kind, "cpu") for kind in KINDS), ("surfel", "gpu")]
)
def test_images_are_those_of_the_oracle(kind, platform, monkeypatch, report):
    if platform == "gpu":
        monkeypatch.setattr("gsjax.raster.tile_render.platform_name", lambda: "gpu")
    config = config_for(kind, num_size_buckets=1 if platform == "cpu" else 2)

    scenes = [(SCENE, CAMERA)] + [CLOSE] * (platform == "cpu")
    for which, (scene, camera) in enumerate(scenes):
        view = gsjax.render(scene, camera, config)
        assert not view.overflowed
        wanted = jax.jit(partial(dense_geometry, scene, camera, config))()
        clear = np.asarray(wanted["margin"]) > 1e-9
        assert clear.mean() > 0.95
        assert np.mean(np.asarray(view.alpha) > 0.1) > 0.5
        for name in config.outputs:
            error = np.abs(np.asarray(getattr(view, name) - wanted[name]))[clear]
            size = max(1, np.abs(wanted[name]).max())
            bar = 1e-9 if which == 0 else 1e-8
            within(report, f"{kind} {name}", error.max() / size, bar)


def test_derivatives_agree(report):
    """Forward, reverse and finite differences, and one pass with features."""
    kind = "surfel_area"
    outputs = (*GEOMETRY, "features")
    config = config_for(kind, outputs=outputs)
    rng = np.random.default_rng(1)
    features = jnp.asarray(rng.normal(size=(COUNT, 2)))
    shapes = {"rgb": 3, "normals": 3, "features": 2}
    weights = {
        name: rng.normal(size=(HEIGHT, WIDTH, shapes.get(name, 1))).squeeze()
        for name in outputs
    }

    @jax.jit
    def value(params, viewmat, features):
        gaussians = SCENE.replace(params=params)
        camera = CAMERA.replace(viewmat=viewmat)
        view = gsjax.render(gaussians, camera, config, features=features)
        return sum(jnp.sum(getattr(view, k) * w) for k, w in weights.items())

    point = SCENE.params, CAMERA.viewmat, features
    way = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), point)
    way = (way[0], way[1].at[3].set(0), way[2])
    slope = jax.jvp(value, point, way)[1]
    gradient = jax.grad(value, argnums=(0, 1, 2))(*point)
    pairs = jax.tree.map(lambda a, b: jnp.sum(a * b), gradient, way)
    reverse = sum(jax.tree.leaves(pairs))
    within(report, f"{kind} jvp, vjp", abs(reverse / slope - 1), 1e-10)
    step = 1e-6

    def along(length):
        return value(*jax.tree.map(lambda a, b: a + length * b, point, way))

    low, high = along(-step), along(step)
    difference = (high - low) / (2 * step)
    within(report, f"{kind} differences", abs(difference / slope - 1), 1e-5)


def test_sizes_order_and_dead_slots_do_not_matter():
    config = config_for("surfel")
    first = gsjax.render(SCENE, CAMERA, config)
    order = np.random.default_rng(2).permutation(COUNT)
    turned = jax.tree.map(lambda a: a[order], SCENE)
    dead = jax.tree.map(lambda a: jnp.concatenate([a, a[:9]]), turned)
    nothing = jnp.where(jnp.arange(COUNT + 9) < COUNT, dead.params.means.T, jnp.nan).T
    active = jnp.arange(COUNT + 9) < COUNT
    dead = dead.replace(params=dead.params.replace(means=nothing), active=active)
    others = [(dead, config.replace(pair_capacity=2**14, occlusion=True))]
    others += [(SCENE, config.replace(tile_size=16, pair_capacity=2**15))]
    for gaussians, changed in others:
        second = gsjax.render(gaussians, CAMERA, changed)
        for name in config.outputs:
            a, b = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
            if changed.tile_size == config.tile_size:
                np.testing.assert_array_equal(a, b, err_msg=name)
            np.testing.assert_allclose(a, b, atol=1e-12, err_msg=name)


def test_a_surfel_that_faces_the_camera_is_a_flat_ellipsoid():
    camera = camera_of(WIDTH, HEIGHT, viewmat=np.eye(4))
    gaussians = gsjax.make_gaussians(
        means=[[0.3, -0.2, 3.0]],
        quats=[[np.cos(0.3), 0, 0, np.sin(0.3)]],
        log_scales=[[-1.0, -2.0, -20.0]],
        logit_opacities=[1.0],
        sh=np.ones((1, 1, 3)),
    )
    config = COMPAT.replace(antialias=True, outputs=("rgb", "depth"))
    flat = gsjax.render(gaussians, camera, config)
    surfel = gsjax.render(gaussians, camera, config.replace(primitive="surfel_area"))
    assert np.asarray(flat.rgb).max() > 0.5
    for name in config.outputs:
        found, wanted = getattr(surfel, name), getattr(flat, name)
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_surfels_from_their_edge_and_behind_the_camera_show_nothing():
    camera = camera_of(WIDTH, HEIGHT, viewmat=np.eye(4))
    half = np.sqrt(0.5)
    edge = [half, 0, half, 0]  # the normal along x, across the ray
    gaussians = gsjax.make_gaussians(
        means=[[0, 0, 3.0], [0, 0, -3.0], [0, 0, 0.005]],
        quats=[edge, [1, 0, 0, 0], [1, 0, 0, 0]],
        log_scales=np.zeros((3, 3)),
        logit_opacities=[3.0] * 3,
        sh=np.ones((3, 1, 3)),
    )
    config = config_for("surfel", outputs=GEOMETRY)

    @jax.jit
    def total(params):
        view = gsjax.render(gaussians.replace(params=params), camera, config)
        return sum(jnp.sum(getattr(view, name)) for name in config.outputs)

    value, slopes = jax.value_and_grad(total)(gaussians.params)
    assert value == 0
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(slopes))


def test_orthographic_cameras_are_refused():
    camera = camera_of(WIDTH, HEIGHT, lens="orthographic")
    with pytest.raises(gsjax.InputError, match="orthographic"):
        gsjax.render(SCENE, camera, config_for("surfel"))


def test_features_need_an_argument():
    with pytest.raises(gsjax.InputError, match="features"):
        gsjax.render(SCENE, CAMERA, COMPAT.replace(outputs=("features",)))


def test_unknown_primitives_are_refused():
    with pytest.raises(gsjax.InputError, match=r"primitive.*surfel_area"):
        gsjax.RasterConfig(primitive="surfle")
    with pytest.raises(gsjax.InputError, match="projection"):
        gsjax.RasterConfig(primitive="surfel", projection="unscented")
