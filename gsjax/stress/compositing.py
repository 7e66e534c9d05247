"""Cases about compositing, counts and capacities, and image sizes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.gaussians import make_gaussians
from gsjax.math.numerics import in_float64
from gsjax.math.sh import dc_to_rgb
from gsjax.raster.compositing.alpha import evaluate
from gsjax.raster.compositing.blending import running_product, transmittance
from gsjax.raster.exact import render_exact
from gsjax.raster.lists.counting import total_count
from gsjax.raster.reference import reference_render
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.stress import scenes
from gsjax.stress.scenes import BACKGROUND, COMPAT, MAX_FULL, SIZE, SLOTS, camera_of
from gsjax.stress.types import Measurement, StressCase

_TILES = (SIZE // COMPAT.tile_size) ** 2
_render = scenes.with_numpy(jax.jit(render, static_argnames="config"))


@partial(jax.jit, static_argnames="product")
def _transmittance_gradient(product, alpha, weights):
    """Differentiate Σ_k weights_k T_k + T_end by α [S, 1, K, 1], chunk by chunk."""

    def step(carried, inputs):
        chunk, weights = inputs
        total, before = product(chunk)
        return carried * total, jnp.sum(weights * carried[:, None] * before)

    def weighted(alpha):
        last, sums = jax.lax.scan(step, jnp.ones_like(alpha[0, :, 0]), (alpha, weights))
        return jnp.sum(last) + jnp.sum(sums)

    return jax.grad(weighted)(alpha)


def opaque_alpha(product, most: float, full: bool) -> Measurement:
    """Measure the gradient of T if one or two of 1024 α are ``most``.

    The error is relative to the largest gradient without them. ``product`` is the
    function that settings with such a cap use.
    """
    rng = np.random.default_rng(0)
    shape, worst = (32, 1, 32, 1), 0.0
    for _ in range(100 if full else 5):
        alpha = rng.uniform(0, 0.004, shape).astype(np.float32)
        weights = rng.normal(size=shape).astype(np.float32)
        gradient = _transmittance_gradient(product, alpha, weights)
        usually = float(jnp.max(jnp.abs(gradient)))
        for count in (1, 2):
            places = rng.choice(alpha.size, count, replace=False)
            spoilt = alpha.copy()
            spoilt.flat[places] = most
            gradient = _transmittance_gradient(product, spoilt, weights)
            exact = scenes.to_float64(spoilt).ravel()
            wanted = _product_gradient(exact, weights.ravel())
            error = np.max(np.abs(np.asarray(gradient).ravel() - wanted))
            worst = np.maximum(worst, float(error) / usually)
    return Measurement(worst, f"of {np.prod(shape)}")


def _product_gradient(alpha: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Differentiate Π (1 − α) + Σ_k weights_k Π_{j<k} (1 − α_j), without division."""
    passed = 1 - alpha
    gradient = np.zeros_like(alpha)
    # behind[j] = Π after j, plus its part in the later weights.
    behind, before = 1.0, np.concatenate([[1.0], np.cumprod(passed)[:-1]])
    for j in range(len(alpha) - 1, -1, -1):
        gradient[j] = -before[j] * behind
        behind = weights[j] + passed[j] * behind
    return gradient


def cap_tie(_full: bool) -> Measurement:
    """Measure dα / d opacity if α equals the cap, where it has to be 0."""
    pixel = np.asarray([[0.5], [0.5]], np.float32)

    def alpha(opacity):
        half, zero = jnp.full((1, 1), 0.5), jnp.zeros((1, 1))
        splats = (half, zero, half, opacity.reshape(1, 1), half, half)
        return evaluate(splats, pixel, COMPAT).alpha[0, 0, 0]

    cap = np.float32(COMPAT.alpha_max)
    below = np.nextafter(cap, np.float32(0))
    tie, inside = jax.jit(jax.vmap(jax.grad(alpha)))(jnp.asarray([cap, below]))
    tie, inside = float(tie), float(inside)
    return Measurement(abs(tie) if inside == 1 else np.nan, f"{inside:g} just below")


def capacities(full: bool) -> Measurement:
    """Count scenes near the capacity whose overflow or images are reported wrongly."""
    points = scenes.frustum_points(np.random.default_rng(0))
    fields = scenes.gaussian_fields(points, 50.0, 0.02, np.eye(4))
    fields["means"][MAX_FULL:] = (0.2, 0.2, 2)  # in one tile each
    fields["log_scales"][MAX_FULL:] = -9
    scene, camera = scenes.scene_of(fields), camera_of(np.eye(4))
    room, wrong, tried = COMPAT.pair_capacity or 0, 0, 0
    for wide in range(0 if full else MAX_FULL - 2, MAX_FULL + 1):
        for more in range(SLOTS - MAX_FULL + 1):
            need, tried = wide * _TILES + more, tried + 1
            active = np.arange(SLOTS) < wide
            active[MAX_FULL : MAX_FULL + more] = True
            given = scenes.with_active(scene, active)
            out, _ = scenes.render_and_gradients(given, camera)
            wrong += int(bool(out.overflowed) != (need > room))
            wrong += int(out.demand.pairs != need or out.demand.capacity < need)
            if need in (room, room - 1):
                channels, clear, _ = scenes.reference(given, camera)
                error = np.abs(out.alpha - channels[..., 3])[clear].max()
                wrong += int(error > 1e-5)
    return Measurement(wrong, f"{tried} scenes, room for {room} pairs")


def past_32_bits(full: bool) -> Measurement:
    """Count sums above 2³¹ that are not reported as overflow."""
    sums = [[2**30, 2**30, 1], [2**30] * 4, [2**30] * 4 + [100], [2**31 - 1] * 3]
    wrong, most = 0, 2**31 - 1
    for counts in sums:
        total, safe = total_count(jnp.asarray(counts, jnp.int32))
        wrong += int(total != most) + int(bool(safe))
    total, safe = total_count(jnp.asarray([3, 0, 2**20], jnp.int32))
    wrong += int(total != 3 + 2**20) + int(not safe)
    if full:  # 4096 splats over 2^20 tiles of one pixel: 2^32 pairs
        count = 4096
        scene = make_gaussians(
            means=np.tile([0.0, 0, 1], (count, 1)),
            quats=np.tile([1.0, 0, 0, 0], (count, 1)),
            log_scales=np.full((count, 3), 18.0),
            logit_opacities=np.zeros(count),
            sh=np.zeros((count, 1, 3)),
        )
        camera = camera_of(np.eye(4), focal=1, width=2**20, height=1)
        tiny = {"tile_size": 1, "chunk_size": 1, "tiles_per_step": 1024}
        config = COMPAT.replace(
            **tiny, outputs=("alpha",), occlusion=False, pair_capacity=8192
        )
        out = _render(scene, camera, config=config)
        wrong += int(not out.overflowed) + int(out.demand.pairs != most)
    return Measurement(wrong, f"{len(sums) + 1} sums" + ", 2^32 pairs" * full)


_SIZES = ((1, 1), (17, 1), (1, 40), (33, 19), (8, 8), (100, 3))


def odd_sizes(_full: bool) -> Measurement:
    """Measure the error of α and colour in images of odd sizes."""
    rng = np.random.default_rng(3)
    points = scenes.frustum_points(rng, 24, spread=0.3)
    fields = scenes.gaussian_fields(points, 0.3, 0.6, np.eye(4))
    fields["sh"] = fields["sh"][:, :1]
    scene, config = make_gaussians(**fields), COMPAT.replace(outputs=("rgb", "alpha"))

    @jax.jit
    def slow(params, camera):
        active = np.ones(len(points), bool)
        seen = scene.replace(params=params, active=active)  # pyright: ignore
        out = reference_render(seen, camera, config)
        return {name: out[name] for name in ("rgb", "alpha", "margin")}

    worst = 0.0
    for width, height in _SIZES:
        centre = (0.5 * width, 0.5 * height)
        camera = camera_of(np.eye(4), centre=centre, width=width, height=height)
        found = _render(scene, camera, config=config)
        with jax.enable_x64(True):
            wanted = scenes.to_numpy(slow(*in_float64((scene.params, camera))))
        errors = found.rgb - wanted["rgb"], (found.alpha - wanted["alpha"])[..., None]
        error = np.abs(np.concatenate(errors, -1)).max(-1)
        clear = (wanted["margin"] > scenes.THRESHOLD_BAND) & (wanted["alpha"] > 0)
        largest = float(error[clear].max(initial=0)) if clear.any() else np.nan
        worst = np.maximum(worst, largest)
    return Measurement(worst, ", ".join(f"{w} × {h}" for w, h in _SIZES))


def splats_everywhere(_full: bool) -> Measurement:
    """Measure the colour error of a scene whose splats all cover all tiles."""
    rng = np.random.default_rng(3)
    points, scales = scenes.frustum_points(rng), rng.uniform(20, 500, (SLOTS, 1))
    fields = scenes.gaussian_fields(points, scales, 0.05, np.eye(4))
    scene, camera = scenes.scene_of(fields), camera_of(np.eye(4))
    scene = scenes.with_active(scene, np.arange(SLOTS) < MAX_FULL)
    out, _ = scenes.render_and_gradients(scene, camera)
    channels, clear, _ = scenes.reference(scene, camera)
    error = float(np.abs(out.rgb - channels[..., :3])[clear].max())
    pairs = int(out.demand.pairs)
    whole = pairs == MAX_FULL * _TILES and not out.overflowed
    return Measurement(error if whole else np.nan, f"{pairs} pairs")


def full_screen_splats(_full: bool) -> Measurement:
    """Measure the colour error of 120,000 faint splats over the whole image."""
    rng = np.random.default_rng(4)
    count, opacity = 120_000, 0.01
    depths = rng.permutation(np.linspace(4, 5, count, dtype=np.float32))
    points = np.stack([0 * depths, 0 * depths, depths], axis=-1)
    fields = scenes.gaussian_fields(points, 3000, opacity, np.eye(4), degree=0)
    camera = camera_of(np.eye(4), width=128, height=96)
    out = render_exact(
        make_gaussians(**fields), camera, background=jnp.asarray(BACKGROUND)
    )
    # Every pixel is the same sum, and nothing of the background remains.
    colors = scenes.to_float64(dc_to_rgb(fields["sh"][:, 0]))
    passed = (1 - opacity) ** np.arange(count)
    wanted = opacity * passed @ colors[np.argsort(depths)]
    error = np.abs(np.asarray(out.rgb) - wanted).max()
    return Measurement(
        float(error), f"{count:,} splats, {int(out.demand.pairs):,} pairs"
    )


def captured_arrays(_full: bool) -> Measurement:
    """Measure the bytes of constants that a compiled render captures."""

    def size(jaxpr) -> int:
        total = 0
        for equation in jaxpr.eqns:
            for inner in jax.tree.leaves(
                tuple(equation.params.values()), is_leaf=lambda x: hasattr(x, "jaxpr")
            ):
                if hasattr(inner, "jaxpr"):
                    constants = sum(np.size(c) * 4 for c in inner.consts)
                    total += constants + size(inner.jaxpr)
        return total

    given = scenes.default_scene(), camera_of()
    made = jax.make_jaxpr(lambda g, c: render(g, c, COMPAT))(*given)
    captured = sum(np.size(c) * 4 for c in made.consts) + size(made.jaxpr)
    scene = sum(np.size(leaf) * 4 for leaf in jax.tree.leaves(given[0]))
    return Measurement(captured, f"the scene has {scene}")


_GRADIENT = "relative error of the gradient of T"
_OF_1 = partial(opaque_alpha, running_product, 1.0)
_AT_CAP = partial(opaque_alpha, transmittance, RasterConfig.accurate().alpha_max)
CASES = (
    StressCase("alpha/of 1", _GRADIENT, 1e-6, _OF_1),
    StressCase("alpha/at the cap", _GRADIENT, 1e-6, _AT_CAP),
    StressCase("alpha/tie at the cap", "gradient", 0, cap_tie),
    StressCase("capacity/overflow", "unreported or wrong", 0, capacities),
    StressCase("capacity/past 2^31", "unreported or wrong", 0, past_32_bits),
    StressCase("sizes/odd", "error of α or colour", 1e-5, odd_sizes, full_only=True),
    StressCase("sizes/splats everywhere", "colour error", 1e-5, splats_everywhere),
    StressCase(
        "sizes/full-screen splats",
        "colour error",
        1e-4,
        full_screen_splats,
        full_only=True,
    ),
    StressCase("compiling/captured arrays", "size", 1024, captured_arrays, "bytes"),
)
