"""Blending, counts and capacities, sizes of images."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.gaussians import make_gaussians
from gsjax.math.numerics import in_float64
from gsjax.math.sh import dc_to_rgb
from gsjax.raster.compositing.alpha import alphas
from gsjax.raster.compositing.blending import running_product, transmittance
from gsjax.raster.exact import render_exact
from gsjax.raster.lists.counting import total_count
from gsjax.raster.reference import reference_render
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.stress.scenes import (
    BACKGROUND,
    BAND,
    COMPAT,
    SIZE,
    SLOTS,
    WIDE,
    camera_of,
    double,
    fields_at,
    frustum,
    on_host,
    oracle,
    scene_of,
    usual,
    usual_gradients,
)
from gsjax.stress.types import Case, Measured, worse

_TILES = (SIZE // COMPAT.tile_size) ** 2
_render = jax.jit(render, static_argnames="config")


@partial(jax.jit, static_argnames="product")
def _slopes_of_transmittance(product, alpha, weigh):
    """Of Σ_k weigh_k T_k + T at the end by α [S, 1, K, 1], chunk after chunk."""

    def step(carried, inputs):
        chunk, weights = inputs
        total, before = product(chunk)
        return carried * total, jnp.sum(weights * carried[:, None] * before)

    def weighted(alpha):
        last, sums = jax.lax.scan(step, jnp.ones_like(alpha[0, :, 0]), (alpha, weigh))
        return jnp.sum(last) + jnp.sum(sums)

    return jax.grad(weighted)(alpha)


def opaque(product, most: float):
    """Error of the slopes of T with α = ``most`` once and twice in a thousand.

    Relative to the largest of the slopes without them. ``product`` is what settings of
    such a cap take.
    """

    def measure(full: bool) -> Measured:
        rng = np.random.default_rng(0)
        shape, worst = (32, 1, 32, 1), 0.0
        for _ in range(100 if full else 5):
            alpha = rng.uniform(0, 0.004, shape).astype(np.float32)
            weigh = rng.normal(size=shape).astype(np.float32)
            slopes = _slopes_of_transmittance(product, alpha, weigh)
            usually = float(jnp.max(jnp.abs(slopes)))
            for count in (1, 2):
                places = rng.choice(alpha.size, count, replace=False)
                spoilt = alpha.copy()
                spoilt.flat[places] = most
                slopes = _slopes_of_transmittance(product, spoilt, weigh)
                wanted = _slopes_of_products(double(spoilt).ravel(), weigh.ravel())
                error = np.max(np.abs(np.asarray(slopes).ravel() - wanted))
                worst = worse(worst, float(error) / usually)
        return Measured(worst, f"of {np.prod(shape)}")

    return measure


def _slopes_of_products(alpha: np.ndarray, weigh: np.ndarray) -> np.ndarray:
    """Of Π (1 − α) + Σ_k weigh_k Π_{j<k} (1 − α_j) by each α, without dividing."""
    passed = 1 - alpha
    slopes = np.zeros_like(alpha)
    # behind[j] = Π after j, plus what the later weights see of it.
    behind, before = 1.0, np.concatenate([[1.0], np.cumprod(passed)[:-1]])
    for j in range(len(alpha) - 1, -1, -1):
        slopes[j] = -before[j] * behind
        behind = weigh[j] + passed[j] * behind
    return slopes


def cap_tie(full: bool) -> Measured:
    """Slope of α by the opacity where α is the cap exactly: that of the cap, 0."""
    del full
    pixel = np.asarray([[0.5], [0.5]], np.float32)

    def alpha(opacity):
        half, zero = jnp.full((1, 1), 0.5), jnp.zeros((1, 1))
        splats = (half, zero, half, opacity.reshape(1, 1), half, half)
        return alphas(splats, pixel, COMPAT)[0, 0, 0]

    cap = np.float32(COMPAT.alpha_max)
    below = np.nextafter(cap, np.float32(0))
    tie, inside = (float(jax.grad(alpha)(jnp.asarray(o))) for o in (cap, below))
    return Measured(abs(tie) if inside == 1 else np.nan, f"{inside:g} just below")


def capacities(full: bool) -> Measured:
    """Scenes that need more than there is room for and do not say so, or wrongly."""
    fields = fields_at(frustum(np.random.default_rng(0)), 50.0, 0.02, np.eye(4))
    fields["means"][WIDE:] = (0.2, 0.2, 2)  # of one tile each
    fields["log_scales"][WIDE:] = -9
    scene, camera = scene_of(fields), camera_of(np.eye(4))
    room, wrong, tried = COMPAT.pair_capacity or 0, 0, 0
    for wide in range(0 if full else WIDE - 2, WIDE + 1):
        for more in range(SLOTS - WIDE + 1):
            need, tried = wide * _TILES + more, tried + 1
            active = np.arange(SLOTS) < wide
            active[WIDE : WIDE + more] = True
            given = scene.replace(active=jnp.asarray(active))  # pyright: ignore
            out, _ = usual_gradients(given, camera)
            wrong += int(bool(out.overflowed) != (need > room))
            wrong += int(out.demand.pairs != need or out.demand.capacity < need)
            if need in (room, room - 1):
                channels, clear, _ = oracle(given, camera)
                error = np.abs(out.alpha - channels[..., 3])[clear].max()
                wrong += int(error > 1e-5)
    return Measured(wrong, f"{tried} scenes, room for {room} pairs")


def past_32_bits(full: bool) -> Measured:
    """Sums beyond 2³¹ that are not reported as such."""
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
        out = _render(scene, camera, config)
        wrong += int(not out.overflowed) + int(out.demand.pairs != most)
    return Measured(wrong, f"{len(sums) + 1} sums" + (", 2^32 pairs" if full else ""))


_SIZES = ((1, 1), (17, 1), (1, 40), (33, 19), (8, 8), (100, 3))


def sizes(full: bool) -> Measured:
    """Largest error of α and colour in images of odd sizes, against the oracle."""
    rng = np.random.default_rng(3)
    points = frustum(rng, 24, spread=0.3)
    fields = fields_at(points, 0.3, 0.6, np.eye(4))
    fields["sh"] = fields["sh"][:, :1]
    scene, config, worst = (
        make_gaussians(**fields),
        COMPAT.replace(outputs=("rgb", "alpha")),
        0.0,
    )

    def slow(params, camera):
        active = np.ones(len(points), bool)
        seen = scene.replace(params=params, active=active)  # pyright: ignore
        out = reference_render(seen, camera, config)
        return {name: out[name] for name in ("rgb", "alpha", "margin")}

    del full
    for width, height in _SIZES:
        centre = (0.5 * width, 0.5 * height)
        camera = camera_of(np.eye(4), centre=centre, width=width, height=height)
        found = on_host(_render(scene, camera, config))
        with jax.enable_x64(True):
            given = in_float64((scene.params, camera))
            wanted = on_host(jax.jit(slow)(*given))
        errors = found.rgb - wanted["rgb"], (found.alpha - wanted["alpha"])[..., None]
        error = np.abs(np.concatenate(errors, -1)).max(-1)
        clear = (wanted["margin"] > BAND) & (wanted["alpha"] > 0)
        worst = worse(
            worst, float(error[clear].max(initial=0)) if clear.any() else np.nan
        )
    return Measured(worst, ", ".join(f"{w} × {h}" for w, h in _SIZES))


def everywhere(full: bool) -> Measured:
    """Largest error of a scene in which every splat lies over every tile."""
    del full
    rng = np.random.default_rng(3)
    fields = fields_at(frustum(rng), rng.uniform(20, 500, (SLOTS, 1)), 0.05, np.eye(4))
    scene, camera = scene_of(fields), camera_of(np.eye(4))
    scene = scene.replace(active=jnp.arange(SLOTS) < WIDE)  # pyright: ignore
    out, _ = usual_gradients(scene, camera)
    channels, clear, _ = oracle(scene, camera)
    error = np.abs(out.rgb - channels[..., :3])[clear].max()
    whole = int(out.demand.pairs) == WIDE * _TILES and not out.overflowed
    return Measured(float(error) if whole else np.nan, f"{int(out.demand.pairs)} pairs")


def full_screen(full: bool) -> Measured:
    """Largest error of a colour behind 120 000 faint splats over the whole image."""
    del full
    rng = np.random.default_rng(4)
    count, opacity = 120_000, 0.01
    depths = rng.permutation(np.linspace(4, 5, count, dtype=np.float32))
    points = np.stack([0 * depths, 0 * depths, depths], axis=-1)
    fields = fields_at(points, 3000, opacity, np.eye(4), degree=0)
    scene, camera = make_gaussians(**fields), camera_of(np.eye(4), width=128, height=96)
    out = render_exact(scene, camera, background=jnp.asarray(BACKGROUND))
    # Flat over the image, so that any pixel is a sum; the background is behind it all.
    colors = double(dc_to_rgb(fields["sh"][:, 0]))
    through = (1 - opacity) ** np.arange(count)
    wanted = opacity * through @ colors[np.argsort(depths)]
    error = np.abs(np.asarray(out.rgb) - wanted).max()
    pairs = int(out.demand.pairs)
    return Measured(float(error), f"{count:,} splats, {pairs:,} pairs")


def constants(full: bool) -> Measured:
    """Bytes of arrays that a compiled render captures; scenes are arguments."""
    del full

    def size(jaxpr) -> int:
        total = 0
        for equation in jaxpr.eqns:
            for inner in jax.tree.leaves(
                tuple(equation.params.values()), is_leaf=lambda x: hasattr(x, "jaxpr")
            ):
                if hasattr(inner, "jaxpr"):
                    total += sum(np.size(c) * 4 for c in inner.consts) + size(
                        inner.jaxpr
                    )
        return total

    made = jax.make_jaxpr(lambda g, c: render(g, c, COMPAT))(usual(), camera_of())
    captured = sum(np.size(c) * 4 for c in made.consts) + size(made.jaxpr)
    scene = sum(np.size(leaf) * 4 for leaf in jax.tree.leaves(usual()))
    return Measured(captured, f"the scene has {scene}")


CASES = (
    Case(
        "alpha/of 1",
        "error of slopes of T, relative",
        1e-6,
        opaque(running_product, 1.0),
    ),
    Case(
        "alpha/at the cap",
        "error of slopes of T, relative",
        1e-6,
        opaque(transmittance, RasterConfig.accurate().alpha_max),
    ),
    Case("alpha/tie at the cap", "slope", 0, cap_tie),
    Case("capacity/overflow", "silent or wrong", 0, capacities),
    Case("capacity/past 2^31", "silent or wrong", 0, past_32_bits),
    Case("sizes/odd", "largest error of α or colour", 1e-5, sizes, full_only=True),
    Case("sizes/splats everywhere", "largest error of a colour", 1e-5, everywhere),
    Case(
        "sizes/full-screen splats",
        "error of a colour",
        1e-4,
        full_screen,
        full_only=True,
    ),
    Case("compiling/captured arrays", "size", 1024, constants, "bytes"),
)
