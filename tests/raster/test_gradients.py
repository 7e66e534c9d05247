"""Derivatives: finite differences, forward against reverse, second order, edge cases.

The scene "smooth" has no threshold within reach: cut 1e-14, no stop. The scene
"compat" has the field's constants; its smallest distance from a threshold is asserted
to be larger than what the finite differences step over.
"""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    COMPAT,
    assert_not_empty,
    camera_of,
    cast,
    gaussians_at,
    reference,
)

import gsjax
from gsjax.raster.compositing.alpha import (
    _gaussian,
    _limited,
    alphas,
    pixel_centres,
)
from gsjax.raster.compositing.blending import (
    channel_sums,
    running_product,
    transmittance,
)
from gsjax.raster.reference import reference_colors, reference_project

COUNT, WIDTH, HEIGHT, DIRECTIONS = 24, 19, 13, 32
OUTPUTS = ("rgb", "alpha", "depth")
COMPAT = COMPAT.replace(outputs=OUTPUTS)
SMOOTH = COMPAT.replace(
    alpha_min=1e-14, alpha_max=1 - 1e-9, transmittance_min=0.0, stop_rule="after"
)
CONFIGS = {"smooth": SMOOTH, "compat": COMPAT}
LEAVES = (
    *("means", "quats", "log_scales", "logit_opacities", "sh"),
    *("viewmat", "K", "background", "probe"),
)


def small_scene(seed=0, count=COUNT):
    """Gaussians in view, wide enough that every pixel is covered."""
    rng = np.random.default_rng(seed)
    z = rng.permutation(np.linspace(2, 6, count))
    xy = rng.uniform(-0.5, 0.5, (count, 2)) * (WIDTH / 20, HEIGHT / 21)
    scales = np.exp(rng.normal(-1, 0.4, (count, 3)))
    opacities = rng.uniform(0.1, 0.9, count)
    opacities[:2] = 0.999  # above the cap of "compat"
    return gaussians_at(np.column_stack([xy * z[:, None], z]), scales, opacities)


CAMERA = camera_of(WIDTH, HEIGHT, focal=(20.0, 21.0))
RNG = np.random.default_rng(3)
COTANGENTS = {
    "rgb": RNG.normal(size=(HEIGHT, WIDTH, 3)),
    "alpha": RNG.normal(size=(HEIGHT, WIDTH)),
    "depth": RNG.normal(size=(HEIGHT, WIDTH)),
}


def base_point(seed=0):
    """All that is differentiated, by name."""
    params = small_scene(seed).params
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
    camera = gsjax.Camera(
        viewmat=point["viewmat"],
        K=point["K"],
        near=jnp.broadcast_to(CAMERA.near, point["viewmat"].shape[:-2]),
        far=jnp.broadcast_to(CAMERA.far, point["viewmat"].shape[:-2]),
        width=WIDTH,
        height=HEIGHT,
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
    """That of the reference, by name."""

    def dense_loss(point):
        images = gsjax.reference_render(*scene_at(point), config, point["background"])
        return weighted(images)

    return jax.grad(dense_loss)(point)


@partial(jax.jit, static_argnames="config")
def central_slopes(point, directions, step, config):
    """(L(x + h d) − L(x − h d)) / 2h for a leading axis of directions."""

    def difference(direction):
        def value(h):
            moved = jax.tree.map(lambda x, d: x + h * d, point, direction)
            return loss(moved, config)

        # Mapped, so that the renderer is compiled once.
        ahead, behind = jax.lax.map(value, step * jnp.asarray([1.0, -1.0]))
        return (ahead - behind) / (2 * step)

    return jax.lax.map(difference, directions)


@partial(jax.jit, static_argnames="config")
def forward_slopes(point, directions, config):
    """Directional derivatives in forward mode."""
    return jax.lax.map(
        lambda d: jax.jvp(partial(loss, config=config), (point,), (d,))[1], directions
    )


def random_directions(point, names, seed=0, count=DIRECTIONS):
    """Normal directions [count, ...] in ``names``, zero elsewhere."""
    rng = np.random.default_rng(seed)
    directions = {
        name: rng.normal(size=(count, *leaf.shape)) * (name in names)
        for name, leaf in point.items()
    }
    directions["viewmat"][:, 3] = 0
    directions["K"][:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] = 0  # not used
    return directions


def slopes_of(grads, directions):
    return sum(
        d.reshape(len(d), -1) @ np.asarray(grads[name]).ravel()
        for name, d in directions.items()
    )


@pytest.mark.parametrize("name", LEAVES)
@pytest.mark.parametrize("kind", CONFIGS)
def test_finite_differences(kind, name, report):
    config, point = CONFIGS[kind], base_point()
    step = 1e-6 if kind == "smooth" else 1e-8
    if kind == "compat":
        images = reference(*scene_at(point), config, point["background"])
        assert images["margin"].min() > 1e-5  # steps of 1e-8 cross no threshold
        assert images["alpha"].max() > 0.99
    directions = random_directions(point, {name})
    found = slopes_of(gradient(point, config), directions)
    wanted = np.asarray(central_slopes(point, directions, step, config))
    size = np.sqrt(np.mean(wanted**2))
    assert size > 1e-3
    error = np.max(np.abs(found - wanted)) / size
    report(f"differences, {kind}, {name}", error, 1e-5)
    assert error <= 1e-5


@pytest.mark.parametrize("kind", CONFIGS)
def test_forward_and_reverse_agree(kind, report):
    config, point = CONFIGS[kind], base_point()
    grads = gradient(point, config)
    for name in LEAVES:
        directions = random_directions(point, {name}, seed=1)
        forward = np.asarray(forward_slopes(point, directions, config))
        reverse = slopes_of(grads, directions)
        error = np.linalg.norm(forward - reverse) / np.linalg.norm(reverse)
        report(f"jvp and vjp, {kind}, {name}", error, 1e-10)
        assert error <= 1e-10, name


def test_hessian_vector_product(report):
    point = base_point()

    @jax.jit
    def product(point, direction):
        return jax.jvp(lambda p: jax.grad(loss)(p, SMOOTH), (point,), (direction,))[1]

    for seed, names in enumerate([LEAVES, ("means",), ("quats",), ("K", "probe")]):
        direction = jax.tree.map(
            lambda d: jnp.asarray(d[0]), random_directions(point, names, seed, 1)
        )
        found, step = product(point, direction), 1e-6
        ahead, behind = (
            gradient(
                jax.tree.map(lambda x, d, h=h: x + h * d, point, direction), SMOOTH
            )
            for h in (step, -step)
        )
        for name in set(LEAVES) - {"background"}:
            wanted = (ahead[name] - behind[name]) / (2 * step)
            assert np.linalg.norm(wanted) > 1e-3
            error = np.linalg.norm(found[name] - wanted) / np.linalg.norm(wanted)
            report(f"Hessian, {names[0]} onto {name}", error, 1e-4)
            assert error <= 1e-4, (names, name)


@pytest.mark.parametrize("kind", [*CONFIGS, "two sizes of compositing"])
def test_gradient_is_that_of_the_reference(kind, report):
    config, point = CONFIGS.get(kind, COMPAT), base_point()
    wanted = dense_gradient(point, config)
    if kind not in CONFIGS:  # with room for enough steps that there is a smaller one
        config = config.replace(num_size_buckets=4, pair_capacity=2**18)
    found = gradient(point, config)
    for name in set(LEAVES) - {"probe"}:
        error = np.linalg.norm(found[name] - wanted[name])
        error /= np.linalg.norm(wanted[name])
        report(f"reference, {kind}, {name}", error, 1e-10)
        assert error <= 1e-10, name


def test_features(report):
    """Values are linear in the features, so their gradient is exact to rounding."""
    point = base_point()
    gaussians, camera = scene_at(point)
    rng = np.random.default_rng(0)
    features, direction = rng.normal(size=(2, COUNT, 2))
    cotangent = rng.normal(size=(HEIGHT, WIDTH, 2))

    @jax.jit
    def value_and_grad(features):
        return jax.value_and_grad(
            lambda f: jnp.sum(
                gsjax.render(gaussians, camera, COMPAT, features=f).rgb * cotangent
            )
        )(features)

    slope = np.sum(value_and_grad(jnp.asarray(features))[1] * direction)
    ahead, behind = (
        value_and_grad(jnp.asarray(features + h * direction))[0] for h in (0.5, -0.5)
    )
    assert abs(slope) > 1e-3
    error = abs(slope - (ahead - behind)) / abs(slope)
    report("features", error, 1e-10)
    assert error <= 1e-10


@pytest.mark.parametrize("names", [("sh",), ("means", "viewmat"), ("background",)])
def test_gradients_by_some_are_those_by_all(names, report):
    """What is not differentiated by is left out, and changes nothing."""
    point = base_point()
    some = {name: point[name] for name in names}
    by_some = jax.jit(jax.grad(lambda some: loss({**point, **some}, COMPAT)))(some)
    for name, wanted in gradient(point, COMPAT).items():
        if name in names:
            error = np.linalg.norm(by_some[name] - wanted) / np.linalg.norm(wanted)
            report(name, error, 1e-12)
            assert error <= 1e-12, name


def test_what_no_derivative_is_taken_by_is_left_out():
    """By colours the program has none of the products that α's derivative takes, which
    that by opacities has."""
    point = base_point()

    def products(names):
        some = {name: point[name] for name in names}
        slope = jax.grad(lambda some: loss({**point, **some}, COMPAT))
        return str(jax.make_jaxpr(slope)(some)).count("dot_general")

    assert 0 < products(["sh"]) < products(["logit_opacities"]) < products(LEAVES)


def test_every_product_is_in_full_precision():
    """Of the image, its gradient and a Hessian–vector product: accelerators would take
    fewer bits where nothing is said."""
    point = base_point()
    some = {name: point[name] for name in LEAVES}

    def value(some):
        return loss({**point, **some}, COMPAT)

    def curvature(some):
        return jax.jvp(jax.grad(value), (some,), (some,))[1]

    for of in (value, jax.grad(value), curvature):
        program = str(jax.make_jaxpr(of)(some))
        products = re.findall(
            r"dot_general\[.*? precision=(\S+ \S+)", program, re.DOTALL
        )
        assert len(products) == program.count("dot_general[") > 0
        assert set(products) == {"(Precision.HIGHEST, Precision.HIGHEST)"}


def test_gradients_of_a_batch_are_the_sum(report):
    """One call with two cameras, and `jax.vmap` over them, against two calls."""
    point = base_point()
    others = point["K"].at[0, 2].add(-2.0).at[1, 1].add(3.0)
    cameras = {
        "K": jnp.stack([point["K"], others]),
        "viewmat": jnp.stack([point["viewmat"]] * 2),
    }
    rest = {name: leaf for name, leaf in point.items() if name not in cameras}
    rest_batch = {**rest, "probe": jnp.stack([point["probe"]] * 2)}

    def one(rest, K, viewmat):
        return loss({**rest, "K": K, "viewmat": viewmat}, COMPAT)

    def mapped(rest):
        return jax.vmap(partial(one, rest))(cameras["K"], cameras["viewmat"]).sum()

    ways = {
        "batch": jax.jit(jax.grad(lambda rest: loss({**rest, **cameras}, COMPAT))),
        "vmap": jax.jit(jax.grad(mapped)),
    }
    singles = [gradient({**point, "K": K}, COMPAT) for K in cameras["K"]]
    for way, function in ways.items():
        found = function(rest_batch if way == "batch" else rest)
        for name in rest:
            a, b = found[name], singles[0][name] + singles[1][name]
            if name == "probe" and way == "batch":
                b = jnp.stack([single[name] for single in singles])
            error = np.linalg.norm(a - b) / np.linalg.norm(b)
            report(f"{way}, {name}", error, 1e-12)
            assert error <= 1e-12, (way, name)


def slopes_both_ways(function, point, direction, order):
    """Of a scalar function: derivatives of the order along the direction, forward, and
    gradients of one order less of it, reverse; flat."""

    def along(function):
        return lambda point: jax.jvp(function, (point,), (direction,))[1]

    def dot(tree):
        products = jax.tree.map(lambda a, b: jnp.sum(a * b), tree, direction)
        return sum(jax.tree.leaves(products))

    forward, reverse = along(function), jax.grad(function)
    for _ in range(order - 1):
        forward = along(forward)
        reverse = jax.grad(lambda point, f=reverse: dot(f(point)))
    return [jnp.ravel(a) for a in (forward(point), *jax.tree.leaves(reverse(point)))]


def assert_same_slopes(name, found, wanted, report, limit=1e-12):
    for ours, plain in zip(found, wanted, strict=True):
        error = np.linalg.norm(ours - plain) / np.linalg.norm(plain)
        report(name, error, limit)
        assert error <= limit, name


@pytest.mark.parametrize("order", [1, 2])
def test_rule_of_transmittance_is_plain_differentiation(order, report):
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0, 0.99, (3, 9, 5)) * (rng.uniform(size=(3, 9, 5)) > 0.3)
    alpha[0, :4, 0] = 0.99
    direction, weights = rng.normal(size=alpha.shape), rng.normal(size=alpha.shape)

    def slopes(product):
        def total(alpha):
            whole, before = product(alpha)
            return jnp.sum(before**2 * weights) + jnp.sum(whole**2 * weights[:, 0])

        return slopes_both_ways(total, alpha, direction, order)

    name = f"transmittance, order {order}"
    found, wanted = slopes(transmittance), slopes(running_product)
    assert_same_slopes(name, found, wanted, report)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("tile", [8, 16])
def test_rule_of_alpha_is_plain_differentiation(tile, order, report):
    """Of round splats and needles, near and far; at the cap, and cut somewhere."""
    rng = np.random.default_rng(order)
    shape, count = (2, 300), 600
    angle, long = rng.uniform(0, np.pi, count), 10 ** rng.uniform(0, 3, count)
    short = rng.uniform(0.6, 4, count)
    along = np.stack([np.cos(angle), np.sin(angle)])
    place = rng.uniform(0, tile, (2, count)) + along * long * rng.normal(0, 1, count)
    across = np.stack([-along[1], along[0]])
    (a, b), (_, c) = np.einsum("s,is,js->ijs", long**2, along, along) + np.einsum(
        "s,is,js->ijs", short**2, across, across
    )
    opacity = rng.uniform(0.1, 1, count)
    values = (1 / np.sqrt(a), b / a, np.sqrt(a / (a * c - b * b)), opacity, *place)
    splats = tuple(jnp.asarray(value.reshape(shape)) for value in values)
    direction = tuple(v * rng.normal(size=shape) for v in splats)
    pixels = pixel_centres(tile, np.float64)
    config = COMPAT.replace(tile_size=tile, alpha_max=0.8)
    weights = rng.normal(size=(*shape, tile * tile))

    def slopes(function):
        return slopes_both_ways(
            lambda splats: jnp.sum(weights * function(splats, pixels, config) ** 2),
            splats,
            direction,
            order,
        )

    def plain_alphas(splats, pixels, config):
        return _limited(_gaussian(splats, pixels), config, None)

    alpha = np.asarray(alphas(splats, pixels, config))
    assert 0.05 < np.mean(alpha == 0) < 0.95
    assert np.sum(alpha == config.alpha_max) > 5
    name, limit = f"alpha, tile {tile}, order {order}", 1e-11
    assert_same_slopes(name, slopes(alphas), slopes(plain_alphas), report, limit)


@pytest.mark.parametrize("order", [1, 2])
def test_rule_of_sums_is_plain_differentiation(order, report):
    rng = np.random.default_rng(0)
    point = (rng.normal(size=(3, 9, 7)), rng.normal(size=(3, 9, 4)))
    direction = tuple(rng.normal(size=a.shape) for a in point)
    weights = rng.normal(size=(3, 4, 7))

    def slopes(sums):
        def total(point):
            return jnp.sum(weights * sums(*point) ** 2)

        return slopes_both_ways(total, point, direction, order)

    found = slopes(channel_sums)
    wanted = slopes(lambda w, c: jnp.einsum("gkp,gkc->gcp", w, c))
    assert_same_slopes(f"sums, order {order}", found, wanted, report)


def test_probe_is_the_gradient_of_the_means_on_screen(report):
    """Shifting the principal point shifts every mean (none is at the clamp)."""
    grads = gradient(base_point(), SMOOTH)
    wanted = grads["K"][:2, 2]
    error = np.linalg.norm(grads["probe"].sum(0) - wanted) / np.linalg.norm(wanted)
    report("probe and principal point", error, 1e-10)
    assert error <= 1e-10


def dense_pixels(point, probe, config):
    """Loss of each pixel [H W] with ``probe`` added to the means; rules "before"."""
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
    point = base_point()
    zeros = jnp.zeros((COUNT, 2))
    per_pixel = jax.jit(jax.jacrev(lambda probe: dense_pixels(point, probe, COMPAT)))(
        zeros
    )

    signed = gradient(point, COMPAT)["probe"]
    absolute = gradient({**point, "probe": zeros}, COMPAT.replace(absgrad=True))
    absolute = absolute["probe"]
    for what, found, wanted in (
        ("signed", signed, per_pixel.sum(0)),
        ("absolute", absolute, np.abs(per_pixel).sum(0)),
    ):
        error = np.linalg.norm(found - wanted) / np.linalg.norm(wanted)
        report(f"probe, {what}", error, 1e-10)
        assert error <= 1e-10, what
    assert (absolute >= np.abs(signed) - 1e-12).all()
    assert (absolute > 1.5 * np.abs(signed)).any()


def test_isotropic_covariances(report):
    point = base_point()
    point["log_scales"] = jnp.broadcast_to(point["log_scales"][:, :1], (COUNT, 3))
    grads = gradient(point, SMOOTH)
    directions = random_directions(point, {"log_scales", "means"})
    wanted = np.asarray(central_slopes(point, directions, 1e-6, SMOOTH))
    error = np.max(np.abs(slopes_of(grads, directions) - wanted))
    error /= np.sqrt(np.mean(wanted**2))
    report("isotropic", error, 1e-5)
    assert error <= 1e-5
    # Turning a ball changes nothing.
    assert np.abs(grads["quats"]).max() <= 1e-10 * np.abs(grads["log_scales"]).max()


def test_zero_quaternion_is_culled():
    point = base_point()
    point["quats"] = point["quats"].at[5].set(0)
    grads = gradient(point, SMOOTH)
    for name in LEAVES:
        assert np.isfinite(grads[name]).all(), name
        if name in (*LEAVES[:5], "probe"):
            assert (grads[name][5] == 0).all(), name
            assert (grads[name][6] != 0).any(), name


@pytest.mark.parametrize(
    ("dtype", "cap"),
    [(jnp.float64, 1.0), (jnp.float32, 1.0), (jnp.float32, 1 - 1e-9)],
)
def test_alpha_of_exactly_one(dtype, cap, report):
    """Two Gaussians of opacity 1 centred on one pixel, with others around them.

    A cap that float32 has as 1 is one of 1 there.
    """
    config = SMOOTH.replace(alpha_max=cap)
    point = base_point()
    point["viewmat"] = jnp.eye(4)
    point["K"] = jnp.asarray([[20.0, 0, 9.5], [0, 21.0, 6.5], [0, 0, 1]])
    rng = np.random.default_rng(0)
    z = jnp.linspace(2, 6, COUNT)
    xy = rng.uniform(-0.4, 0.4, (COUNT, 2)) * z[:, None]
    means = jnp.concatenate([xy, z[:, None]], -1)
    opaque = np.array([4, 9])
    point["means"] = means.at[opaque, :2].set(0)
    point["logit_opacities"] = point["logit_opacities"].at[opaque].set(60.0)
    images = reference(*scene_at(point), config)
    assert images["alpha"][6, 9] > 1 - 1e-15
    assert_not_empty(images["alpha"])
    wanted = dense_gradient(point, config)
    found = gradient(cast(point, dtype), config)
    bar = 1e-10 if dtype == jnp.float64 else 1e-5
    for name in set(LEAVES) - {"probe"}:
        assert np.isfinite(found[name]).all(), name
        largest = np.abs(wanted[name]).max()
        error = np.abs(found[name] - wanted[name]).max() / largest
        report(f"alpha 1, {dtype.__name__}, {name}", error, bar)
        assert error <= bar, name


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_gradients_follow_the_dtype(dtype):
    point = cast(base_point(), dtype)
    grads = gradient(point, COMPAT)
    for name in LEAVES:
        assert grads[name].dtype == dtype, name
        assert np.isfinite(grads[name]).all(), name


def test_float32_against_float64(report):
    """Not an acceptance bar: how far the default precision is from the truth."""
    wanted = gradient(base_point(), COMPAT)
    found = gradient(cast(base_point(), jnp.float32), COMPAT)
    for name in LEAVES:
        error = np.linalg.norm(found[name] - wanted[name])
        error /= np.linalg.norm(wanted[name])
        report(f"float32 gradient, {name}", error, 1e-4)
        assert error <= 1e-4, name
