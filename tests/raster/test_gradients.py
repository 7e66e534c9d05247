"""Derivatives: finite differences, forward against reverse, second order, edge cases.

The scene "smooth" has no threshold within reach. The scene "compat" has the constants
of Kerbl et al.; its distance from a threshold is asserted to be larger than the steps
of the finite differences.
"""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPAT, camera_of, cast, gaussians_at, reference
from pictures import assert_close

import gsjax
from gsjax.raster.reference import reference_colors, reference_project

COUNT, WIDTH, HEIGHT, DIRECTIONS = 24, 19, 13, 12
OUTPUTS = ("rgb", "alpha", "depth")
COMPAT = COMPAT.replace(outputs=OUTPUTS)
SMOOTH = COMPAT.replace(
    alpha_min=1e-14, alpha_max=1 - 1e-9, transmittance_min=0.0, stop_rule="after"
)
LEAVES = (
    *("means", "quats", "log_scales", "logit_opacities", "sh"),
    *("viewmat", "K", "background", "probe"),
)


def small_scene():
    """Return Gaussians in view that cover every pixel."""
    rng = np.random.default_rng(0)
    z = rng.permutation(np.linspace(2, 6, COUNT))
    xy = rng.uniform(-0.5, 0.5, (COUNT, 2)) * (WIDTH / 20, HEIGHT / 21)
    scales = np.exp(rng.normal(-1, 0.4, (COUNT, 3)))
    opacities = rng.uniform(0.1, 0.9, COUNT)
    opacities[:2] = 0.999  # above the cap of "compat"
    return gaussians_at(np.column_stack([xy * z[:, None], z]), scales, opacities)


CAMERA = camera_of(WIDTH, HEIGHT, focal=(20.0, 21.0))
RNG = np.random.default_rng(3)
COTANGENTS = {
    name: RNG.normal(size=(HEIGHT, WIDTH, 3)[: 3 if name == "rgb" else 2])
    for name in OUTPUTS
}


def base_point():
    """Return the differentiated values by name."""
    params = small_scene().params
    return {
        **{name: getattr(params, name) for name in LEAVES[:5]},
        "viewmat": CAMERA.viewmat,
        "K": CAMERA.K,
        "background": jnp.asarray([0.3, 0.6, 0.2]),
        "probe": jnp.zeros((COUNT, 2)),
    }


def scene_at(point):
    params = gsjax.GaussianParams(**{name: point[name] for name in LEAVES[:5]})
    active = np.ones(params.means.shape[0], bool)
    batch = point["viewmat"].shape[:-2]
    camera = gsjax.Camera(
        viewmat=point["viewmat"],
        K=point["K"],
        **{n: jnp.broadcast_to(getattr(CAMERA, n), batch) for n in ("near", "far")},
        **{"width": WIDTH, "height": HEIGHT},
    )
    return gsjax.Gaussians(params=params, active=active), camera


def weighted(images):
    return sum(jnp.sum(images[name] * COTANGENTS[name]) for name in OUTPUTS)


def loss(point, config):
    gaussians, camera = scene_at(point)
    out = gsjax.render(
        gaussians, camera, config, point["background"], probe=point["probe"]
    )
    return weighted(out._asdict())


gradient = jax.jit(jax.grad(loss), static_argnames="config")


@partial(jax.jit, static_argnames="config")
def dense_gradient(point, config):
    """Return the gradient of the reference by name."""

    def dense_loss(point):
        images = gsjax.reference_render(*scene_at(point), config, point["background"])
        return weighted(images)

    return jax.grad(dense_loss)(point)


@jax.jit
def slopes_along(point, directions, step):
    """Return slopes of "compat" in forward mode, and by central differences.

    Directions have a leading axis. All is mapped: the renderer is compiled twice only.
    """
    function = partial(loss, config=COMPAT)

    def slope(direction):
        return jax.jvp(function, (point,), (direction,))[1]

    def difference(direction):
        def value(h):
            return function(jax.tree.map(lambda x, d: x + h * d, point, direction))

        ahead, behind = jax.lax.map(value, step * jnp.asarray([1.0, -1.0]))
        return (ahead - behind) / (2 * step)

    return jax.lax.map(slope, directions), jax.lax.map(difference, directions)


def random_directions(point, names, seed=0, count=DIRECTIONS):
    """Return normal directions [count, ...] in ``names``, zero elsewhere."""
    rng = np.random.default_rng(seed)
    directions = {
        name: rng.normal(size=(count, *leaf.shape)) * (name in names)
        for name, leaf in point.items()
    }
    directions["viewmat"][:, 3] = 0
    directions["K"][:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] = 0  # not used
    return directions


def test_reverse_mode_forward_mode_and_differences_agree(report):
    point = base_point()
    images = reference(*scene_at(point), COMPAT, point["background"])
    assert images["margin"].min() > 1e-5  # steps of 1e-8 cross no threshold
    assert images["alpha"].max() > 0.99
    grads = gradient(point, COMPAT)
    for name in LEAVES:
        directions = random_directions(point, {name})
        reverse = directions[name].reshape(DIRECTIONS, -1) @ np.ravel(grads[name])
        forward, wanted = map(np.asarray, slopes_along(point, directions, 1e-8))
        assert_close(report, f"jvp and vjp, {name}", forward, reverse, 1e-10)
        size = np.sqrt(np.mean(wanted**2))
        assert size > 1e-3
        error = np.max(np.abs(reverse - wanted)) / size
        report(f"differences, {name}", error, 1e-5)
        assert error <= 1e-5, name


def assert_same_leaves(name, found, wanted, report, limit=1e-10, but=("probe",)):
    for leaf in set(LEAVES) - set(but):
        assert_close(report, f"{name}, {leaf}", found[leaf], wanted[leaf], limit)


def needle_point():
    point = base_point()
    return point | {"log_scales": point["log_scales"] + np.array([1.5, -2, -2])}


def isotropic_point():
    point = base_point()
    log_scales = jnp.broadcast_to(point["log_scales"][:, :1], (COUNT, 3))
    return point | {"log_scales": log_scales}


def opaque_point():
    """Return two Gaussians of opacity 1 on one pixel, among others."""
    point, rng = base_point(), np.random.default_rng(0)
    point["viewmat"] = jnp.eye(4)
    point["K"] = jnp.asarray([[20.0, 0, 9.5], [0, 21.0, 6.5], [0, 0, 1]])
    z = jnp.linspace(2, 6, COUNT)
    xy = rng.uniform(-0.4, 0.4, (COUNT, 2)) * z[:, None]
    means = jnp.concatenate([xy, z[:, None]], -1)
    opaque = np.array([4, 9])
    point["means"] = means.at[opaque, :2].set(0)
    point["logit_opacities"] = point["logit_opacities"].at[opaque].set(60.0)
    return point


@pytest.mark.parametrize(
    ("make", "config", "dtype", "bar"),
    [
        (base_point, SMOOTH, jnp.float64, 1e-10),
        (base_point, COMPAT, jnp.float64, 1e-10),
        (needle_point, COMPAT, jnp.float64, 1e-10),
        (isotropic_point, SMOOTH, jnp.float64, 1e-10),
        (opaque_point, SMOOTH.replace(alpha_max=1.0), jnp.float64, 1e-10),
        (opaque_point, SMOOTH, jnp.float32, 1e-5),  # in which 1 − 1e-9 is 1
    ],
)
def test_gradient_is_that_of_the_reference(make, config, dtype, bar, report):
    point = make()
    found, wanted = gradient(cast(point, dtype), config), dense_gradient(point, config)
    assert {found[name].dtype for name in LEAVES} == {np.dtype(dtype)}
    name, but = f"{make.__name__}, {dtype.__name__}", ("probe",)
    if make is isotropic_point:  # turning a ball changes nothing
        turns, stretches = np.abs(found["quats"]), np.abs(found["log_scales"])
        assert turns.max() <= 1e-10 * stretches.max()
        but += ("quats",)
    assert_same_leaves(name, found, wanted, report, bar, but)


def test_hessian_vector_product(report):
    point = base_point()

    @jax.jit
    def product(point, direction):
        return jax.jvp(lambda p: jax.grad(loss)(p, SMOOTH), (point,), (direction,))[1]

    for seed, names in enumerate([LEAVES, ("means",), ("K", "probe")]):
        directions = random_directions(point, names, seed, 1)
        direction = {name: jnp.asarray(d[0]) for name, d in directions.items()}
        step = 1e-6
        ahead, behind = (
            gradient({n: x + h * direction[n] for n, x in point.items()}, SMOOTH)
            for h in (step, -step)
        )
        wanted = {name: (ahead[name] - behind[name]) / (2 * step) for name in LEAVES}
        found, but = product(point, direction), ("background",)
        assert_same_leaves(f"Hessian, {names[0]}", found, wanted, report, 1e-4, but)


@pytest.mark.long
@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_second_derivatives_in_all_modes(platform, monkeypatch, report):
    """With α at both limits, against plain differentiation of the reference."""
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    point = base_point()
    directions = random_directions(point, LEAVES[:-1], count=1)
    direction = {name: jnp.asarray(d[0]) for name, d in directions.items()}
    function = partial(loss, config=COMPAT)

    def along(function):
        return lambda point: jax.jvp(function, (point,), (direction,))[1]

    def dot(slopes):
        return sum(jnp.sum(slopes[name] * direction[name]) for name in LEAVES)

    def slope(point):
        return dot(jax.grad(function)(point))

    wanted = along(partial(dense_gradient, config=COMPAT))(point)
    for name, product in {
        "forward over reverse": along(jax.grad(function)),
        "reverse over reverse": jax.grad(slope),
    }.items():
        assert_same_leaves(name, jax.jit(product)(point), wanted, report, 1e-10)
    twice = jax.jit(along(along(function)))(point)
    assert_close(report, "forward over forward", twice, dot(wanted), 1e-10)


def test_every_product_is_in_full_precision():
    """Without a precision, accelerators would compute with fewer bits."""
    point = base_point()

    def curvature(point):
        slope = jax.grad(partial(loss, config=COMPAT))
        return jax.jvp(slope, (point,), (point,))[1]

    program = str(jax.make_jaxpr(curvature)(point))
    products = re.findall(r"dot_general\[.*? precision=(\S+ \S+)", program, re.DOTALL)
    assert len(products) == program.count("dot_general[") > 0
    assert set(products) == {"(Precision.HIGHEST, Precision.HIGHEST)"}


def test_gradients_of_a_batch_are_the_sum(report):
    """Compare a batch and `jax.vmap` with single calls; one camera sees nothing.

    The mapped render has several sizes of arrays, and takes one that fits each camera.
    """
    point = base_point()
    sizes = COMPAT.replace(num_size_buckets=2, pair_capacity=2**18)
    others = point["K"].at[0, 2].add(-2.0).at[1, 1].add(3.0)
    away = point["viewmat"].at[2].multiply(-1)
    cameras = {
        "K": jnp.stack([point["K"], others, others]),
        "viewmat": jnp.stack([point["viewmat"]] * 2 + [away]),
    }
    rest = {name: leaf for name, leaf in point.items() if name not in cameras}

    def one(rest, K, viewmat):
        return loss({**rest, "K": K, "viewmat": viewmat}, sizes)

    def mapped(rest):
        return jax.vmap(partial(one, rest))(cameras["K"], cameras["viewmat"]).sum()

    def batch(rest):
        probe = jnp.stack([rest["probe"]] * 3)
        return loss({**rest, **cameras, "probe": probe}, COMPAT)

    singles = [gradient({**point, "K": K}, COMPAT) for K in cameras["K"][:2]]
    nothing = gradient({**point, "viewmat": away}, COMPAT)
    assert not any(nothing[name].any() for name in (*LEAVES[:5], "probe"))
    behind = COTANGENTS["rgb"].sum((0, 1))
    np.testing.assert_allclose(nothing["background"], behind, rtol=1e-12)
    wanted = jax.tree.map(lambda *slopes: sum(slopes), *singles, nothing)
    for function in (batch, mapped):
        found = jax.jit(jax.grad(function))(rest)
        name = function.__name__
        assert_same_leaves(name, found, wanted, report, 1e-12, ("K", "viewmat"))


def dense_pixels(point, probe, config):
    """Return the loss of each pixel [H W] with ``probe`` added to the means."""
    gaussians, camera = scene_at(point)
    means2d, depth, cov2d, *_ = reference_project(gaussians, camera, config.dilation)
    order = jnp.argsort(depth)
    colors = reference_colors(gaussians, camera)[order]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    offset = pixels - (means2d + probe)[order][:, None]
    inverse = jnp.linalg.inv(cov2d[order])
    power = jnp.einsum("npi,nij,npj->np", offset, inverse, offset)
    alpha = jax.nn.sigmoid(point["logit_opacities"])[order, None]
    alpha = alpha * jnp.exp(-0.5 * power)
    alpha = jnp.where(alpha < config.alpha_max, alpha, config.alpha_max)
    alpha = jnp.where(alpha < config.alpha_min, 0, alpha)
    after = jnp.cumprod(1 - alpha, axis=0)
    before = jnp.concatenate([jnp.ones_like(after[:1]), after[:-1]])
    weight = jnp.where(after > config.transmittance_min, alpha * before, 0)
    total = weight.sum(0)
    rgb = weight.T @ colors + (1 - total)[:, None] * point["background"]
    expected = depth[order] @ weight / total
    flat = {k: v.reshape(HEIGHT * WIDTH, -1) for k, v in COTANGENTS.items()}
    return (
        (rgb * flat["rgb"]).sum(-1)
        + total * flat["alpha"][:, 0]
        + expected * flat["depth"][:, 0]
    )


def test_absolute_gradients_by_brute_force(report):
    """On two devices, which share the rows of tiles."""
    config = COMPAT.replace(absgrad=True, devices=min(2, jax.local_device_count()))
    point = base_point()
    by_pixel = jax.jit(jax.jacrev(lambda probe: dense_pixels(point, probe, COMPAT)))
    per_pixel = by_pixel(point["probe"])
    signed = gradient(point, COMPAT)["probe"]
    grads = gradient(point, config)
    assert_same_leaves("devices", grads, dense_gradient(point, COMPAT), report)
    absolute = grads["probe"]
    assert_close(report, "signed", signed, per_pixel.sum(0), 1e-10)
    assert_close(report, "absolute", absolute, np.abs(per_pixel).sum(0), 1e-10)
    assert (absolute >= np.abs(signed) - 1e-12).all()
    assert (absolute > 1.5 * np.abs(signed)).any()
