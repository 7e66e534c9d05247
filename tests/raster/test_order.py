"""Order of each pixel's own: against a dense sort, finite differences and references.

A window must do what a plain simulation of it does, and count what comes too late.
"""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    AS_USERS,
    COMPAT,
    HEIGHT,
    SCENES,
    WIDTH,
    camera_of,
    cast,
    gaussians_at,
    on_cpu,
    reference,
    render,
    scene_of,
)
from pictures import order_data, order_scene
from test_fused import RANKS, task_of, tiles_of

import gsjax
from gsjax import RasterConfig
from gsjax.raster.compositing import fused_window, fused_window_vjp, ordered
from gsjax.raster.compositing.fused_sorted import SORTED
from gsjax.raster.compositing.fused_window_vjp import WINDOWED
from gsjax.raster.compositing.ordered import ORDERED
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.surfel import SURFEL
from gsjax.raster.reference import reference_ray_depths
from gsjax.raster.surfel_reference import dense_geometry

ROOM = {"pair_capacity": 1 << 15}  # huge scenes cover each tile
PIXEL = COMPAT.replace(order="pixel", **ROOM)
WIDE = COMPAT.replace(order="window", order_window=32, **ROOM)
# The covariance of the dense oracle has no more digits there.
BAR = {"needles_1000": 1e-6, "needles_10000": 1e-6}


def test_references(report):
    data = order_data()
    gaussians, (camera,) = order_scene(data, 1)
    limits = {"alpha_min": 1e-300, "alpha_max": 1.0, "transmittance_min": 0.0}
    config = PIXEL.replace(stop_rule="after", outputs=("rgb", "alpha"), **limits)
    assert (np.abs(data["image_tstar"] - data["image_centre"]) > 1 / 255).any()
    for order, name in (("pixel", "image_tstar"), ("center", "image_centre")):
        view = render(
            gaussians, camera, config.replace(order=order), features=data["colours"]
        )
        assert not view.overflowed
        image = np.concatenate([view.rgb, view.alpha[..., None]], -1)
        error = np.abs(image - data[name]).max()
        report(f"order {order}", error, 1e-9)
        assert error <= 1e-9


# Opaque ones need another program.
@pytest.mark.parametrize("kind", [kind for kind in SCENES if kind != "saturated"])
def test_dense_sort(kind, report):
    gaussians, camera = scene_of(kind)
    dense = reference(gaussians, camera, PIXEL)
    sure = np.asarray(dense["margin"]) > 1e-9
    assert sure.mean() > 0.9
    for config in (PIXEL, *((WIDE,) if kind in ("random", "wall", "tiny") else ())):
        view = render(gaussians, camera, config)
        assert not view.overflowed
        if config is PIXEL:
            assert view.misordered == 0
        elif view.misordered > 0:
            continue
        for name in ("rgb", "alpha", "depth", "median_depth"):
            wanted, found = np.asarray(dense[name]), np.asarray(getattr(view, name))
            bar = BAR.get(kind, 1e-10) * max(1, np.abs(wanted).max())
            error = np.abs(found - wanted)[sure].max()
            report(f"{kind}, {config.order}, {name}", error, bar)
            assert error <= bar, (config.order, name)


def first_of(waiting, key):
    """Take the nearest out of ``waiting``, of equal ones the first."""
    place = min(waiting, key=lambda i: (key[i], i))
    waiting.remove(place)
    return place


def simulated(alpha, keys, window, config):
    """Run lists [N, P] through a window: the order [N, P], and how many come late."""
    orders, late = [], 0
    for column, key in zip(alpha.T, keys.T):
        waiting, order = [], []

        for i in np.flatnonzero(column):
            waiting.append(i)
            if len(waiting) > window:
                order.append(first_of(waiting, key))
        while waiting:
            order.append(first_of(waiting, key))
        passed, deepest = 1.0, -np.inf
        for i in order:
            behind = passed * (1 - column[i])
            tested = behind if config.stop_rule == "before" else passed
            if tested <= config.transmittance_min:
                break
            late += key[i] < deepest
            deepest, passed = max(deepest, key[i]), behind
        rest = [i for i in range(len(column)) if i not in set(order)]
        orders.append([*order, *rest])
    return np.array(orders).T, late


def ordered_tiles(dtype, config):
    """Lists of `test_fused` with depths that vary over the image."""
    rng, tiles = np.random.default_rng(3), tiles_of(dtype)
    primitive, outputs = config.primitive, config.outputs
    steps = [jnp.asarray(a, dtype) for a in rng.normal(0, 0.03, (5, RANKS))]
    splat, channels = tiles.splat, tiles.channels
    if primitive is SURFEL:
        *shape, opacity = splat.shape
        numbers = (*shape, *steps[:2], channels.depth, 0.01 / channels.depth)
        splat = splat._replace(shape=(*numbers, opacity))
    else:
        splat = splat._replace(key=(*steps, channels.depth))
        if config.blends_ray_depth:
            *shape, opacity = splat.shape
            numbers = *shape, *steps[:2], *steps[1:], channels.depth
            splat = splat._replace(shape=(*numbers, opacity))
    if "normals" in outputs:
        normals = jnp.asarray(rng.normal(size=(3, RANKS)), dtype)
        channels = channels._replace(normals=normals)
    return tiles._replace(splat=splat, channels=channels)


WINDOW = COMPAT.replace(order="window", outputs=("rgb", "depth", "median_depth"))
RULES = {
    "before": {"transmittance_min": 0.05},
    "after": {"stop_rule": "after", "alpha_max": 1.0, "transmittance_min": 0.1},
}


@pytest.mark.parametrize("window", [1, 2, 5])
@pytest.mark.parametrize("rule", RULES)
def test_window_is_what_a_simulation_does(window, rule):
    config = WINDOW.replace(
        **RULES[rule], order_window=window, primitive=ELLIPSOID, outputs=("rgb",)
    )
    rng = np.random.default_rng(window)
    keys = rng.normal(np.arange(60)[:, None], 4, (60, 64)).round(1)  # some are equal
    alpha = rng.uniform(0, 0.6, keys.shape) * (rng.random(keys.shape) < 0.7)
    colors = rng.normal(size=(60, 3))
    wanted, late = simulated(alpha, keys, window, config)
    parts = ordered.Parts(
        None, jnp.asarray(np.column_stack([colors, np.ones(60)]))[None]
    )
    at = ordered.Evaluated(jnp.asarray(alpha)[None])
    found = ordered.blend_ordered(at, parts, jnp.asarray(keys)[None], config)
    passed, live = np.ones(64), np.ones(64, bool)
    image = np.zeros((3, 64))
    for places in wanted:
        a = alpha[places, np.arange(64)]
        behind = passed * (1 - a)
        live &= (behind if rule == "before" else passed) > config.transmittance_min
        image += np.where(live, passed * a, 0) * colors[places].T
        passed = behind
    assert late > 0
    assert found["misordered"].sum() == late
    np.testing.assert_allclose(found["sums"][0, :3], image, atol=1e-13)


CASES = {  # primitive, outputs, depth along rays, window, rule
    "colours": (ELLIPSOID, ("rgb",), False, 2, "before"),
    "depth of the means": (ELLIPSOID, ("rgb", "median_depth"), False, 2, "after"),
    "geometry along rays": (
        ELLIPSOID,
        ("rgb", "depth", "distortion"),
        True,
        1,
        "after",
    ),
    "surfels": (SURFEL, ("rgb", "depth", "normals"), True, 1, "before"),
}


@on_cpu
@pytest.mark.parametrize("case", CASES)
def test_kernels_agree(case, report):
    """The fused kernels, forward and reverse, and the one that JAX differentiates."""
    primitive, outputs, ray, window, rule = CASES[case]
    config = WINDOW.replace(
        **RULES[rule], order_window=window, primitive=primitive, outputs=outputs,
        ray_depth=ray,
    )  # fmt: skip
    tiles = ordered_tiles("float64", config)
    assert tiles.lists.length.max() >= fused_window_vjp.SIZE
    task = task_of(config, "float64")
    exact_task = task_of(config.replace(order="pixel"), "float64")
    forward = {
        kernel.name: jax.jit(partial(kernel.forward, task=some))(tiles)
        for kernel, some in ((WINDOWED, task), (SORTED, exact_task))
    }
    differences = []
    for name, some in (("window", task), ("sorted", exact_task)):
        plain = jax.jit(partial(ORDERED.forward, task=some))(tiles)
        differences.append(plain["sums"])
        for image, wanted in plain.items():
            np.testing.assert_allclose(forward[name][image], wanted, atol=1e-12)
        assert (plain["misordered"].sum() > 10) == (name == "window")
    assert np.abs(differences[0] - differences[1]).max() > 1e-3
    if "median_depth" in outputs:
        return
    rng, images = np.random.default_rng(0), forward["window"]
    cotangents = {k: jnp.asarray(rng.normal(size=v.shape)) for k, v in images.items()}

    def automatic(splat, channels):
        return ORDERED.forward(tiles._replace(splat=splat, channels=channels), task)

    def by_hand(tiles, cotangents):
        _, arrived = fused_window.composite_window(tiles, task)
        return fused_window_vjp.backward(tiles, arrived, cotangents, task)

    def transposed(tiles, cotangents):
        return jax.vjp(automatic, tiles.splat, tiles.channels)[1](cotangents)

    wanted = jax.jit(transposed)(tiles, cotangents)
    found = jax.jit(by_hand)(tiles, cotangents)
    leaves = zip(*map(jax.tree.leaves, (found, wanted)), strict=True)
    for number, (a, b) in enumerate(leaves):
        error = np.abs(a - b).max() / max(1, np.abs(b).max())
        report(f"{case}, leaf {number}", error, 1e-11)
        assert error <= 1e-11, number


@pytest.mark.parametrize("order", ["pixel", "window"])
def test_derivatives_are_those_of_differences(order, report):
    """Forward mode, and its transpose, of the kernel that JAX differentiates."""
    config = WINDOW.replace(order=order, primitive=ELLIPSOID, outputs=("rgb",))
    tiles = ordered_tiles("float64", config.replace(alpha_min=1e-6))
    task, rng = task_of(config, "float64"), np.random.default_rng(0)
    given = tiles.splat._replace(key=()), tiles.channels
    weights = jnp.asarray(rng.normal(size=(9, 4, 64)))
    steps = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * a, given)

    @jax.jit
    def total(splat, channels):
        splat = splat._replace(key=tiles.splat.key)
        some = tiles._replace(splat=splat, channels=channels)
        return jnp.sum(ORDERED.forward(some, task)["sums"] * weights)

    slope = jax.jit(lambda *a: jax.jvp(total, a, steps)[1])(*given)
    gradient = jax.jit(jax.grad(total, (0, 1)))(*given)
    along = sum(jnp.vdot(*a) for a in zip(*map(jax.tree.leaves, (gradient, steps))))
    assert abs(along - slope) <= 1e-10 * abs(slope)

    def at(size):
        return total(*jax.tree.map(lambda a, b: a + size * b, given, steps))

    size = 1e-7
    difference = (at(size) - at(-size)) / (2 * size)
    error = abs(slope - difference) / abs(difference)
    report(f"{order}, derivative against differences", error, 1e-4)
    assert error <= 1e-4


def interpreted(program: str) -> list[str]:
    """Loops of a compiled program that are neither kernels nor hold kernels alone."""
    entry = program[program.index("ENTRY") :]
    bodies = re.findall(r" while\(.*?body=(%[\w.]+)", entry)
    starts = [program.index(f"\n{body} ") for body in bodies]
    texts = [program[start : program.index("\n}", start)] for start in starts]
    return [body for body, text in zip(bodies, texts) if " while(" in text]


@on_cpu
@pytest.mark.parametrize("window", [2, 4])
def test_loops_are_kernels(window):
    config = WINDOW.replace(
        order_window=window, primitive=ELLIPSOID, outputs=("rgb", "alpha")
    )
    task = task_of(config, "float32")
    assert fused_window_vjp.suits(task)
    assert not fused_window.suits(task_of(config.replace(order_window=20), "float32"))
    with jax.enable_x64(False):
        tiles = ordered_tiles("float32", config)

        def both(tiles):
            images, arrived = fused_window.composite_window(tiles, task)
            return images, fused_window_vjp.backward(tiles, arrived, images, task)

        exact = task_of(config.replace(order="pixel"), "float32")
        for program in (both, partial(SORTED.forward, task=exact)):
            compiled = jax.jit(program, compiler_options=AS_USERS).lower(tiles)
            assert not interpreted(compiled.compile().as_text())


def test_surfels():
    """With the reference order, of scenes whose surfels cut each other."""
    gaussians, camera = scene_of("random")
    config = PIXEL.replace(primitive="surfel", outputs=("rgb", "depth", "normals"))
    view = render(gaussians, camera, config)
    dense = jax.jit(partial(dense_geometry, gaussians, camera, config))()
    by_mean = render(gaussians, camera, config.replace(order="center"))
    assert np.abs(by_mean.rgb - view.rgb).max() > 0.01
    sure = np.asarray(dense["margin"]) > 1e-9
    assert sure.mean() > 0.9
    for name in ("rgb", "depth", "normals"):
        error = np.abs(getattr(view, name) - dense[name])[sure].max()
        assert error <= 1e-10, name


@pytest.mark.parametrize("kind", ["random", "huge", "wall", "fog"])
def test_float32(kind, report):
    """Where neither a threshold nor the order of two neighbours is close."""
    gaussians, camera = scene_of(kind)
    dense = reference(gaussians, camera, PIXEL)
    clear = np.asarray(dense["margin"]) > 1e-4
    clear &= closest_keys(gaussians, camera) > 1e-5
    assert clear.mean() > 0.3
    given = cast((gaussians, camera), jnp.float32)
    view = render(*given, PIXEL)
    assert view.rgb.dtype == jnp.float32
    error = np.abs(np.asarray(view.rgb) - dense["rgb"])[clear].max()
    report(f"{kind}, float32", error, 1e-5)
    assert error <= 1e-5


def closest_keys(gaussians, camera) -> np.ndarray:
    """Smallest relative gap [H, W] between depths that follow each other at a pixel."""
    keys = np.asarray(jax.jit(reference_ray_depths)(gaussians, camera))
    keys = np.sort(keys, axis=0)
    gaps = np.diff(keys, axis=0) / np.maximum(np.abs(keys[1:]), np.abs(keys[:-1]))
    return gaps.min(0).reshape(camera.height, camera.width)


def test_gradients(report):
    """Of the hand-written reverse pass, against differences, through the whole."""
    gaussians, camera = scene_of("random")
    config = RasterConfig.accurate(order="window", outputs=("rgb",), devices=1)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)))
    rng = np.random.default_rng(1)
    step = jax.tree.map(
        lambda a: jnp.asarray(rng.normal(size=a.shape)), gaussians.params
    )

    def loss(params):
        rgb = gsjax.render(gaussians.replace(params=params), camera, config).rgb
        return jnp.sum(rgb * weights)

    value, gradient = jax.jit(jax.value_and_grad(loss))(gaussians.params)
    along = sum(
        jnp.vdot(*some) for some in zip(*map(jax.tree.leaves, (gradient, step)))
    )

    def at(size):
        return loss(jax.tree.map(lambda a, b: a + size * b, gaussians.params, step))

    size = 1e-7
    difference = (at(size) - at(-size)) / (2 * size)
    error = abs(along - difference) / abs(difference)
    report("gradient against differences", error, 1e-4)
    assert error <= 1e-4
    assert abs(value - at(0.0)) <= 1e-12 * abs(value)


def test_equal_depths_go_by_slot():
    """Equal ellipsoids at one place, of several colours, in any order of slots."""
    one = gaussians_at(np.float64([[0.1, 0.2, 3.0]]), [[0.3, 0.2, 0.4]], 0.5)
    gaussians = jax.tree.map(lambda a: jnp.repeat(a, 4, 0), one)
    colors = jnp.eye(4)[:, :3]
    by_mean = PIXEL.replace(order="center", outputs=("rgb",))
    for places in ([0, 1, 2, 3], [3, 1, 0, 2]):
        features = colors[np.array(places)]
        plain = render(gaussians, camera_of(), by_mean, features=features)
        assert plain.rgb.max() > 0.2
        for order in ("pixel", "window"):
            config = by_mean.replace(order=order)
            view = render(gaussians, camera_of(), config, features=features)
            assert view.misordered == 0
            np.testing.assert_allclose(view.rgb, plain.rgb, atol=1e-15)


def test_misordered_are_counted_and_mended():
    """Over all cameras of a batch; `render_exact` sorts where no window is enough."""
    gaussians, camera = scene_of("huge")
    config = PIXEL.replace(order="window", order_window=8, outputs=("rgb",))
    late = gsjax.render(gaussians, camera, config)
    assert late.misordered > 100
    both = gsjax.render(gaussians, gsjax.stack_cameras([camera, camera]), config)
    assert both.misordered == 2 * late.misordered
    mended = gsjax.render_exact(gaussians, camera, config, mend_order=True)
    assert mended.misordered == 0
    exact = gsjax.render(gaussians, camera, config.replace(order="pixel"))
    np.testing.assert_allclose(mended.rgb, exact.rgb, atol=1e-12)
    assert np.abs(late.rgb - exact.rgb).max() > 1e-4
    plain = gsjax.render(gaussians, camera, PIXEL.replace(order="center"))
    assert plain.misordered is None


def test_bad_settings():
    with pytest.raises(gsjax.InputError, match="occlusion: expected False"):
        RasterConfig(order="pixel", occlusion=True)
    with pytest.raises(gsjax.InputError, match="order: expected one of"):
        RasterConfig(order="depth")
    gaussians, _ = scene_of("random")
    camera = gsjax.make_camera(
        viewmat=np.eye(4),
        K=np.diag([9.0, 9, 1]),
        width=8,
        height=8,
        lens="orthographic",
    )
    with pytest.raises(gsjax.InputError, match="orthographic"):
        gsjax.render(gaussians, camera, RasterConfig(order="window"))
