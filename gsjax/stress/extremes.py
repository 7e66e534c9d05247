"""Cases about values at and beyond the limits of valid Gaussians."""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import NEAREST
from gsjax.math.numerics import logit
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.raster.lists.binning import make_grid, row_spans
from gsjax.stress import scenes
from gsjax.stress.scenes import BACKGROUND, COMPAT, SIZE, SLOTS, camera_of, images_of
from gsjax.stress.types import Measurement, StressCase

_GARBAGE = (0.0, np.nan, np.inf, -np.inf, 1e30, -1e30)


def _render_changed(fields: dict):
    """Render the default scene with other parameters; see `render_and_gradients`."""
    changed = scenes.with_params(scenes.default_scene(), **fields)
    return scenes.render_and_gradients(changed)


def _level_fields(scale, opacity) -> dict:
    """Return `gaussian_fields` for a camera at the origin."""
    points = scenes.frustum_points(np.random.default_rng(0))
    return scenes.gaussian_fields(points, scale, opacity, np.eye(4))


def quaternions(_full: bool) -> Measurement:
    """Measure rotations of quaternions of extreme norm; those of norm 0 are culled."""
    drawn = np.random.default_rng(0).normal(size=(SLOTS, 4))
    size = np.resize([1e-30, 1e-23, 1e-10, 1, 1e10, 1e20, 1e30], SLOTS)[:, None]
    quats = scenes.to_float32(drawn * size)
    exact = scenes.to_float64(quats)
    unit = exact / np.abs(exact).max(1, keepdims=True)
    w, *v = (unit / np.linalg.norm(unit, axis=1, keepdims=True)).T
    v = np.stack(v, 1)
    cross = np.stack([np.cross(np.eye(3)[i], v) for i in range(3)], 1)
    wanted = np.eye(3) * (w * w - (v * v).sum(1))[:, None, None]
    wanted = wanted + 2 * v[:, :, None] * v[:, None, :] + 2 * w[:, None, None] * cross
    error = np.abs(np.asarray(quaternion_to_matrix(jnp.asarray(quats))) - wanted).max()
    bad = scenes.to_float32([0, 0, 1e-45, np.nan, np.inf])
    fields = scenes.numpy_fields(scenes.default_scene())
    fields["quats"][:5] = bad[:, None]
    out, gradients = _render_changed(fields)
    wrong = int((out.radii[:5] > 0).sum())
    wrong += scenes.count_nonfinite((images_of(out), gradients))
    return Measurement(
        np.nan if wrong else error, f"{SLOTS} rotations, 5 of no norm culled"
    )


def log_scales(_full: bool) -> Measurement:
    """Count non-finite numbers and wrong culling with extreme log scales."""
    fields = scenes.numpy_fields(scenes.default_scene())
    values = (-200, -50, 0, 40, 88, 120, np.inf, -np.inf)
    for slot, value in enumerate(values):
        fields["log_scales"][slot] = value
        fields["log_scales"][slot + 8, slot % 3] = value
    out, gradients = _render_changed(fields)
    wrong = np.isfinite(np.resize(values, 16)) != (out.radii[:16] > 0)
    count = scenes.count_nonfinite((images_of(out), out.radii, gradients))
    note = "16 Gaussians; those of a finite scale seen, others culled"
    return Measurement(count + int(wrong.sum()), note)


def isotropic(_full: bool) -> Measurement:
    """Count non-finite gradients of spheres, whose covariance has equal eigenvalues."""
    points = scenes.frustum_points(np.random.default_rng(0))
    points[::2, :2] = 0
    fields = scenes.gaussian_fields(points, 0.2, 0.05, np.eye(4))
    fields["quats"][::3] = (1, 0, 0, 0)
    out, gradients = scenes.render_and_gradients(
        scenes.scene_of(fields), camera_of(np.eye(4))
    )
    count = scenes.count_nonfinite((images_of(out), out.radii, gradients))
    live = int(np.any(gradients.params.log_scales != 0, 1).sum())
    return Measurement(
        count if live > SLOTS // 2 else np.nan, f"{live} of {SLOTS} live"
    )


def near_plane(_full: bool) -> Measurement:
    """Measure the largest gradient by Gaussians culled at the near and far planes."""
    near = np.float32(0.01)
    up, down = (np.nextafter(near, x, dtype=np.float32) for x in (1, 0))
    depths = {-1: 0, -1e-30: 0, 0: 0, 1e-30: 0, down: 0, near: 0, up: 1, 1e10: 0}
    depths |= {np.float32(9.9e9): 1, np.inf: 0, -np.inf: 0, np.float32(3e38): 0}
    fields = _level_fields(0.05, 0.5)
    for slot, z in enumerate(depths):
        fields["means"][slot] = (0, 0, z)
        fields["log_scales"][slot] = np.log(max(0.1 * float(min(abs(z), 1e10)), 1e-4))
    out, gradients = scenes.render_and_gradients(
        scenes.scene_of(fields), camera_of(np.eye(4))
    )
    culled = np.array([not seen for seen in depths.values()])
    ahead = slice(0, len(depths))
    wrong = int(np.sum((out.radii[ahead] == 0) != culled))
    wrong += scenes.count_nonfinite((images_of(out), gradients))
    rows = [np.abs(leaf[ahead][culled]) for leaf in jax.tree.leaves(gradients.params)]
    largest = max(float(row.max()) for row in rows)
    return Measurement(np.nan if wrong else largest, f"{len(depths)} depths")


def dead_slots(_full: bool) -> Measurement:
    """Count numbers that depend on the contents of inactive slots."""
    dead = np.random.default_rng(3).uniform(size=SLOTS) < 0.5
    wanted, count = None, 0
    for value in _GARBAGE:
        fields = scenes.numpy_fields(scenes.default_scene())
        for field in fields.values():
            field[dead] = value
        changed = scenes.with_params(scenes.default_scene(), **fields)
        out, gradients = scenes.render_and_gradients(scenes.with_active(changed, ~dead))
        found = images_of(out), gradients
        wanted = found if wanted is None else wanted
        count += scenes.count_unequal(found, wanted)
        leaves = jax.tree.leaves(gradients.params)
        count += sum(int(np.sum(leaf[dead] != 0)) for leaf in leaves)
    return Measurement(count, f"{len(_GARBAGE)} contents of {int(dead.sum())} slots")


def nonfinite_depth(_full: bool) -> Measurement:
    """Count pixels that a Gaussian of NaN or infinite depth changes."""
    count = 0
    without = scenes.with_active(scenes.default_scene(), np.arange(SLOTS) != 40)
    wanted, _ = scenes.render_and_gradients(without)
    for value in (np.nan, np.inf, -np.inf):
        fields = scenes.numpy_fields(scenes.default_scene())
        fields["means"][40] = value
        out, _ = _render_changed(fields)
        count += scenes.count_unequal(images_of(out), images_of(wanted))
    return Measurement(count, "NaN, inf, -inf")


@scenes.with_numpy
@jax.jit
def _num_rows(footprint):
    """Return in how many rows of tiles the footprints are listed."""
    grid = make_grid(SIZE, SIZE, COMPAT.tile_size, 1)
    return jnp.sum(row_spans(footprint, grid, jnp.int32(0)).rows)


def wild_coordinates(_full: bool) -> Measurement:
    """Count rows of tiles listed for splats 1e10 px or infinitely far away."""
    footprint = scenes.projected(scenes.default_scene(), camera_of()).footprint
    usually, count = int(_num_rows(footprint)), 0
    for value in scenes.to_float32([1e10, 1e20, 1e30, 3e38, np.inf]):
        far = np.where(np.arange(SLOTS) % 2 == 0, value, -value)
        moved = footprint._replace(u=far), footprint._replace(v=far)
        count += sum(int(_num_rows(some)) for some in moved)
    note = f"beside {usually} in view"
    return Measurement(count if usually > SLOTS // 2 else np.nan, note)


def equal_depths(full: bool) -> Measurement:
    """Count numbers that change if slots are permuted, except among equal depths."""
    rng = np.random.default_rng(7)
    points = scenes.frustum_points(rng)
    points[:, 2] = rng.choice([2.0, 3.0, 4.0], SLOTS)
    scene = scenes.scene_of(scenes.gaussian_fields(points, 0.2, 0.4, np.eye(4)))
    camera = camera_of(np.eye(4))
    wanted, _ = scenes.render_and_gradients(scene, camera)
    z, count = np.asarray(scene.params.means)[:, 2], 0
    for _ in range(20 if full else 3):
        order = rng.permutation(SLOTS)
        for depth in np.unique(z):
            places = np.flatnonzero(z[order] == depth)
            order[places] = np.sort(order[places])
        permuted = jax.tree.map(lambda a, o=order: a[o], scene)
        out, _ = scenes.render_and_gradients(permuted, camera)
        count += scenes.count_unequal(images_of(out), images_of(wanted))
    reverse = jax.tree.map(lambda a: a[::-1], scene)
    flipped, _ = scenes.render_and_gradients(reverse, camera)
    matters = np.max(np.abs(flipped.rgb - wanted.rgb))
    return Measurement(
        count if matters > 0.01 else np.nan, "permutations of three depths"
    )


def within_a_step(full: bool) -> Measurement:
    """Measure the colour error if float32 cannot order two Gaussians by depth.

    Opaque Gaussians less than a step of float32 apart, in a view far from the origin.
    """
    viewmat, worst = scenes.random_pose(), 0.0
    viewmat[:3, 3] += 9, -7, 5
    camera, row = camera_of(viewmat), viewmat[2]
    for seed in range(20 if full else 3):
        rng = np.random.default_rng(seed)
        points = np.zeros((SLOTS, 3))
        points[:, 2] = 3 + 2e-8 * rng.permutation(SLOTS)
        fields = scenes.gaussian_fields(points, 0.2, 0.7, viewmat, seed)
        scene, means = scenes.scene_of(fields), fields["means"]
        z = scenes.to_float64(means) @ scenes.to_float64(row[:3])
        computed = sum(row[i] * means[:, i] for i in range(3)) + row[3]
        if (np.argsort(z) == np.argsort(computed, kind="stable")).all():
            return Measurement(np.nan, "float32 has the order too")
        out, _ = scenes.render_and_gradients(scene, camera)
        images, inside, _ = scenes.reference(scene, camera)
        error = np.abs(np.asarray(out.rgb) - images[..., :3])[inside]
        worst = max(worst, float(error.max()))
    return Measurement(worst, f"{SLOTS} in 2.6e-6 of depth 3")


def at_the_camera(_full: bool) -> Measurement:
    """Count non-finite numbers where the view direction is almost undefined.

    Gaussians at the camera centre, which every near plane culls, and straight ahead so
    close to it that the fourth power of the distance underflows.
    """
    fields = _level_fields(0.1, 0.5)
    depths = scenes.to_float32([0, 1e-30, 0.9 * NEAREST, 1.1 * NEAREST, 1e-11, 1e-10])
    fields["means"][:6] = depths[:, None] * (0, 0, 1)
    fields["log_scales"][:6] = np.log(np.maximum(depths, NEAREST))[:, None] - 2
    camera = camera_of(np.eye(4), near=1e-30)
    out, gradients = scenes.render_and_gradients(scenes.scene_of(fields), camera)
    wrong = int(np.sum((out.radii[:6] > 0) != (depths > NEAREST)))
    count = scenes.count_nonfinite((images_of(out), gradients))
    return Measurement(np.nan if wrong else count, "6, of which 3 are drawn")


def empty(_full: bool) -> Measurement:
    """Count pixels other than the background, and nonzero gradients, of empty views."""
    scene, count = scenes.default_scene(), 0
    logits = np.full(SLOTS, -30, np.float32)
    faint = scenes.with_params(scene, logit_opacities=logits)
    none = scenes.with_active(scene, np.zeros(SLOTS, bool))
    for given, camera in ((none, None), (faint, None), (scene, camera_of(near=1e9))):
        out, gradients = scenes.render_and_gradients(given, camera)
        background = np.broadcast_to(BACKGROUND, out.rgb.shape)
        count += scenes.count_unequal(out.rgb, background)
        count += sum(int(np.sum(a != 0)) for a in (out.alpha, out.depth, out.radii))
        leaves = jax.tree.leaves((gradients.params, gradients.camera))
        count += sum(int(np.sum(leaf != 0)) for leaf in leaves)
    return Measurement(count, "none active, none opaque, none in range")


def probabilities(_full: bool) -> Measurement:
    """Measure the error of sigmoid(logit(p)) for p in [0, 1].

    All logits have to be finite and have a gradient.
    """
    p = scenes.to_float32(
        [0, 1e-45, 1e-30, 2**-24, 1e-6, 0.01, 0.5, 0.99, 1 - 2**-24, 1]
    )
    p = np.concatenate([p, np.linspace(0, 1, 10_001, dtype=np.float32)])
    logits = logit(jnp.asarray(p))
    gradients = jax.vmap(jax.grad(jax.nn.sigmoid))(logits)
    good = bool(jnp.all(jnp.isfinite(logits) & (gradients > 0)))
    error = np.abs(np.asarray(jax.nn.sigmoid(logits)) - scenes.to_float64(p)).max()
    return Measurement(error if good else np.nan, f"{len(p)} values")


CASES = (
    StressCase("quaternions/rotation", "error, any norm", 1e-6, quaternions),
    StressCase("scales/extreme", "non-finite or wrongly culled", 0, log_scales),
    StressCase("covariance/isotropic", "non-finite gradients", 0, isotropic),
    StressCase("depth/near plane", "gradient by culled Gaussians", 0, near_plane),
    StressCase("depth/NaN", "pixels changed", 0, nonfinite_depth),
    StressCase("depth/equal", "pixels changed by slot order", 0, equal_depths),
    StressCase("depth/within a step", "colour error", 1e-4, within_a_step),
    StressCase("slots/dead", "numbers changed by contents", 0, dead_slots),
    StressCase("bins/wild coordinates", "rows of tiles", 0, wild_coordinates),
    StressCase("colour/at the camera", "non-finite numbers", 0, at_the_camera),
    StressCase("scene/empty", "numbers unlike the background", 0, empty),
    StressCase("opacity/round trip", "error of a probability", 1e-6, probabilities),
)
