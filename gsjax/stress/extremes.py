"""Values at the edges of what a Gaussian may be, and beyond."""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import NEAREST
from gsjax.gaussians import Gaussians, num_active
from gsjax.math.numerics import logit
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.raster.lists.binning import make_grid, row_spans
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.types import Inputs
from gsjax.stress.scenes import (
    BACKGROUND,
    COMPAT,
    SIZE,
    SLOTS,
    camera_of,
    changed,
    double,
    fields_at,
    frustum,
    host_fields,
    not_finite,
    oracle,
    pose,
    scene_of,
    single,
    unequal,
    usual,
    usual_gradients,
)
from gsjax.stress.types import Case, Measured

GARBAGE = (0.0, np.nan, np.inf, -np.inf, 1e30, -1e30)


def images_of(out):
    """What is compared bit for bit."""
    return out.rgb, out.alpha, out.depth


def quaternions(full: bool) -> Measured:
    """Rotations of quaternions of wild norms; those of no norm have to vanish."""
    del full
    drawn = np.random.default_rng(0).normal(size=(SLOTS, 4))
    size = np.resize([1e-30, 1e-23, 1e-10, 1, 1e10, 1e20, 1e30], SLOTS)[:, None]
    quats = single(drawn * size)
    unit = double(quats) / np.abs(double(quats)).max(1, keepdims=True)
    w, *v = (unit / np.linalg.norm(unit, axis=1, keepdims=True)).T
    v = np.stack(v, 1)
    cross = np.stack([np.cross(np.eye(3)[i], v) for i in range(3)], 1)
    wanted = np.eye(3) * (w * w - (v * v).sum(1))[:, None, None]
    wanted = wanted + 2 * v[:, :, None] * v[:, None, :] + 2 * w[:, None, None] * cross
    error = np.max(
        np.abs(np.asarray(quaternion_to_matrix(jnp.asarray(quats))) - wanted)
    )
    bad = single([0, 0, 1e-45, np.nan, np.inf])
    fields = host_fields(usual())
    fields["quats"][:5] = bad[:, None]
    out, slopes = usual_gradients(changed(usual(), **fields))
    wrong = int((out.radii[:5] > 0).sum()) + not_finite((images_of(out), slopes))
    return Measured(
        np.nan if wrong else error, f"{SLOTS} rotations, 5 of no norm culled"
    )


def log_scales(full: bool) -> Measured:
    """Numbers that are not finite, with every extreme of a log scale in one scene."""
    del full
    fields = host_fields(usual())
    values = (-200, -50, 0, 40, 88, 120, np.inf, -np.inf)
    for slot, value in enumerate(values):
        fields["log_scales"][slot] = value
        fields["log_scales"][slot + 8, slot % 3] = value
    out, slopes = usual_gradients(changed(usual(), **fields))
    wrong = np.isfinite(np.resize(values, 16)) != (out.radii[:16] > 0)
    count = not_finite((images_of(out), out.radii, slopes)) + int(wrong.sum())
    return Measured(count, "16 Gaussians; those of a finite scale seen, others culled")


def isotropic(full: bool) -> Measured:
    """Gradients by balls straight ahead, whose covariance has equal eigenvalues."""
    del full
    points = frustum(np.random.default_rng(0))
    points[::2, :2] = 0
    fields = fields_at(points, 0.2, 0.05, np.eye(4))
    fields["quats"][::3] = (1, 0, 0, 0)
    out, slopes = usual_gradients(scene_of(fields), camera_of(np.eye(4)))
    count = not_finite((images_of(out), out.radii, slopes))
    live = int(np.any(slopes.params.log_scales != 0, 1).sum())
    return Measured(count if live > SLOTS // 2 else np.nan, f"{live} of {SLOTS} live")


def near_plane(full: bool) -> Measured:
    """Largest gradient by what stands at, before and behind the near plane."""
    del full
    near = np.float32(0.01)
    up, down = (
        np.nextafter(near, 1, dtype=np.float32),
        np.nextafter(near, 0, dtype=np.float32),
    )
    depths = {-1: 0, -1e-30: 0, 0: 0, 1e-30: 0, down: 0, near: 0, up: 1, 1e10: 0}
    depths |= {np.float32(9.9e9): 1, np.inf: 0, -np.inf: 0, np.float32(3e38): 0}
    fields = fields_at(frustum(np.random.default_rng(0)), 0.05, 0.5, np.eye(4))
    for slot, z in enumerate(depths):
        fields["means"][slot] = (0, 0, z)
        fields["log_scales"][slot] = np.log(max(0.1 * float(min(abs(z), 1e10)), 1e-4))
    out, slopes = usual_gradients(scene_of(fields), camera_of(np.eye(4)))
    culled = np.array([not seen for seen in depths.values()])
    ahead = slice(0, len(depths))
    wrong = int(np.sum((out.radii[ahead] == 0) != culled))
    wrong += not_finite((images_of(out), slopes))
    rows = [np.abs(leaf[ahead][culled]) for leaf in jax.tree.leaves(slopes.params)]
    largest = max(float(row.max()) for row in rows)
    return Measured(np.nan if wrong else largest, f"{len(depths)} depths")


def dead_slots(full: bool) -> Measured:
    """Numbers that change with what stands in slots that are not active."""
    del full
    dead = np.random.default_rng(3).uniform(size=SLOTS) < 0.5
    wanted, count = None, 0
    for value in GARBAGE:
        fields = host_fields(usual())
        for field in fields.values():
            field[dead] = value
        scene = changed(usual(), **fields).replace(active=jnp.asarray(~dead))  # pyright: ignore
        out, slopes = usual_gradients(scene)
        found = images_of(out), slopes
        wanted = found if wanted is None else wanted
        count += unequal(found, wanted)
        count += sum(int(np.sum(g[dead] != 0)) for g in jax.tree.leaves(slopes.params))
    return Measured(count, f"{len(GARBAGE)} contents of {int(dead.sum())} slots")


def depth_of_nan(full: bool) -> Measured:
    """Pixels that change by a Gaussian whose depth is NaN or infinite."""
    del full
    count = 0
    for value in (np.nan, np.inf, -np.inf):
        fields = host_fields(usual())
        fields["means"][40] = value
        out, _ = usual_gradients(changed(usual(), **fields))
        alone = usual().replace(active=jnp.arange(SLOTS) != 40)  # pyright: ignore
        wanted, _ = usual_gradients(alone)
        count += unequal(images_of(out), images_of(wanted))
    return Measured(count, "NaN, inf, -inf")


@jax.jit
def _rows_of_wild(gaussians: Gaussians, camera, value):
    """Rows of tiles that Gaussians moved to ± ``value`` px are given."""
    order = jnp.arange(SLOTS)
    inputs, count = Inputs(gaussians, camera), num_active(gaussians)
    out = ELLIPSOID.project(inputs, COMPAT, order, count).footprint
    grid = make_grid(SIZE, SIZE, COMPAT.tile_size, 1)
    sign = jnp.where(order % 2 == 0, value, -value)
    rows = [
        row_spans(moved, grid, jnp.int32(0)).rows
        for moved in (out._replace(u=sign), out._replace(v=sign))
    ]
    return jnp.sum(jnp.stack(rows)), jnp.sum(row_spans(out, grid, jnp.int32(0)).rows)


def wild_coordinates(full: bool) -> Measured:
    """Rows of tiles taken by what lies 1e10 px away, or infinitely far."""
    del full
    count = 0
    for value in (1e10, 1e20, 1e30, 3e38, np.inf):
        rows, usually = _rows_of_wild(usual(), camera_of(), np.float32(value))
        count += int(rows) if int(usually) > SLOTS // 2 else SLOTS
    return Measured(count, f"beside {int(usually)} in view")  # pyright: ignore


def equal_depths(full: bool) -> Measured:
    """Numbers that change with the order of the slots, which ties keep."""
    rng = np.random.default_rng(7)
    points = frustum(rng)
    points[:, 2] = rng.choice([2.0, 3.0, 4.0], SLOTS)
    scene, camera = (
        scene_of(fields_at(points, 0.2, 0.4, np.eye(4))),
        camera_of(np.eye(4)),
    )
    wanted, _ = usual_gradients(scene, camera)
    z, count = np.asarray(scene.params.means)[:, 2], 0
    for _ in range(20 if full else 3):
        order = rng.permutation(SLOTS)
        for depth in np.unique(z):
            places = np.flatnonzero(z[order] == depth)
            order[places] = np.sort(order[places])
        out, _ = usual_gradients(jax.tree.map(lambda a, o=order: a[o], scene), camera)
        count += unequal(images_of(out), images_of(wanted))
    flipped, _ = usual_gradients(jax.tree.map(lambda a: a[::-1], scene), camera)
    matters = np.max(np.abs(flipped.rgb - wanted.rgb))
    return Measured(count if matters > 0.01 else np.nan, "permutations of three depths")


def within_a_step(full: bool) -> Measured:
    """Largest error of a colour where float32 cannot tell which of two is in front.

    Opaque ones, one before another by less than a step of float32, in a view far from
    the origin; against the dense oracle in float64.
    """
    viewmat, worst = pose(), 0.0
    viewmat[:3, 3] += 9, -7, 5
    camera, row = camera_of(viewmat), viewmat[2]
    for seed in range(20 if full else 3):
        rng = np.random.default_rng(seed)
        points = np.zeros((SLOTS, 3))
        points[:, 2] = 3 + 2e-8 * rng.permutation(SLOTS)
        scene = scene_of(fields_at(points, 0.2, 0.7, viewmat, seed))
        means = np.asarray(scene.params.means)
        z = double(means) @ double(row[:3])
        computed = sum(row[i] * means[:, i] for i in range(3)) + row[3]
        if (np.argsort(z) == np.argsort(computed, kind="stable")).all():
            return Measured(np.nan, "float32 has the order too")
        out, _ = usual_gradients(scene, camera)
        images, inside, _ = oracle(scene, camera)
        error = np.abs(np.asarray(out.rgb) - images[..., :3])[inside]
        worst = max(worst, float(error.max()))
    return Measured(worst, f"{SLOTS} in 2.6e-6 of depth 3")


def at_the_camera(full: bool) -> Measured:
    """Numbers not finite where the direction of the harmonics is hardly defined.

    At the centre itself, which no near plane lets through, and straight ahead so close
    to it that the fourth power of the distance is zero.
    """
    del full
    fields = fields_at(frustum(np.random.default_rng(0)), 0.1, 0.5, np.eye(4))
    depths = single([0, 1e-30, 0.9 * NEAREST, 1.1 * NEAREST, 1e-11, 1e-10])
    fields["means"][:6] = depths[:, None] * (0, 0, 1)
    fields["log_scales"][:6] = np.log(np.maximum(depths, NEAREST))[:, None] - 2
    scene, camera = scene_of(fields), camera_of(np.eye(4), near=1e-30)
    out, slopes = usual_gradients(scene, camera)
    wrong = int(np.sum((out.radii[:6] > 0) != (depths > NEAREST)))
    count = not_finite((images_of(out), slopes))
    return Measured(np.nan if wrong else count, "6, of which 3 are drawn")


def empty(full: bool) -> Measured:
    """Numbers that are not the background's, nor gradients of zero, of no scene."""
    del full
    faint = changed(usual(), logit_opacities=np.full(SLOTS, -30, np.float32))
    none = usual().replace(active=jnp.zeros(SLOTS, bool))  # pyright: ignore
    far_off = camera_of(near=1e9)
    count = 0
    for scene, camera in ((none, None), (faint, None), (usual(), far_off)):
        out, slopes = usual_gradients(scene, camera)
        count += unequal(out.rgb, np.broadcast_to(BACKGROUND, out.rgb.shape))
        count += sum(int(np.sum(a != 0)) for a in (out.alpha, out.depth, out.radii))
        leaves = jax.tree.leaves((slopes.params, slopes.camera))
        count += sum(int(np.sum(leaf != 0)) for leaf in leaves)
    return Measured(count, "none active, none opaque, none in range")


def probabilities(full: bool) -> Measured:
    """Largest error of sigmoid(logit(p)), p = 0 and 1 included; none of the logits may
    be infinite, nor without a slope.
    """
    del full
    p = single([0, 1e-45, 1e-30, 2**-24, 1e-6, 0.01, 0.5, 0.99, 1 - 2**-24, 1])
    p = np.concatenate([p, np.linspace(0, 1, 10_001, dtype=np.float32)])
    logits = logit(jnp.asarray(p))
    slopes = jax.vmap(jax.grad(jax.nn.sigmoid))(logits)
    good = bool(jnp.all(jnp.isfinite(logits) & (slopes > 0)))
    error = float(np.max(np.abs(np.asarray(jax.nn.sigmoid(logits)) - double(p))))
    return Measured(error if good else np.nan, f"{len(p)} values")


CASES = (
    Case("quaternions/rotation", "error, any norm", 1e-6, quaternions),
    Case("scales/extreme", "not finite, or wrongly culled", 0, log_scales),
    Case("covariance/isotropic", "gradients not finite", 0, isotropic),
    Case("depth/near plane", "gradient by what is culled", 0, near_plane),
    Case("depth/NaN", "pixels changed", 0, depth_of_nan),
    Case("depth/equal", "pixels changed by slot order", 0, equal_depths),
    Case("depth/within a step", "error of a colour", 1e-4, within_a_step),
    Case("slots/dead", "numbers changed by contents", 0, dead_slots),
    Case("bins/wild coordinates", "rows of tiles", 0, wild_coordinates),
    Case("colour/at the camera", "numbers not finite", 0, at_the_camera),
    Case("scene/empty", "numbers not the background's", 0, empty),
    Case("opacity/round trip", "error of a probability", 1e-6, probabilities),
)
