"""Bad input: an `InputError` that names it, or a Gaussian that vanishes completely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COUNT,
    HEIGHT,
    WHOLE,
    WIDTH,
    assert_not_empty,
    camera_of,
    cast,
    loss_and_gradients,
    on_cpu,
    render,
    scene_of,
)

import gsjax
from gsjax import InputError, RasterConfig

GOOD = {
    "means": np.zeros((4, 3)),
    "quats": np.ones((4, 4)),
    "log_scales": np.zeros((4, 3)),
    "logit_opacities": np.zeros(4),
    "sh": np.zeros((4, 1, 3)),
}
EYE, K = np.eye(4), np.array([[50.0, 0, 8], [0, 50, 8], [0, 0, 1]])


def put(matrix, place, value):
    matrix = matrix.copy()
    matrix[place] = value
    return matrix


# --- rejected on the host ---


@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("means", np.zeros((4, 2)), "means"),
        ("means", np.zeros(4), "means"),
        ("means", np.zeros((5, 3)), "quats"),  # the others are one short
        ("means", np.zeros((4, 3), complex), "means"),
        ("quats", np.zeros((4, 3)), "quats"),
        ("log_scales", np.zeros((4, 1)), "log_scales"),
        ("logit_opacities", np.zeros((4, 2)), "logit_opacities"),
        ("sh", np.zeros((4, 3)), "sh"),
        ("sh", np.zeros((3, 1, 3)), "sh"),
        ("sh", np.zeros((4, 5, 3)), "5"),
        *(("capacity", v, "capacity") for v in (3, 100.5, "100", True)),
    ],
    ids=str,
)
def test_gaussians_are_checked(name, value, named):
    with pytest.raises(InputError, match=named):
        gsjax.make_gaussians(**{**GOOD, name: value})


def test_opacities_may_be_a_column():
    column = {**GOOD, "logit_opacities": np.arange(4.0)[:, None]}
    flat = gsjax.make_gaussians(**column).params.logit_opacities
    np.testing.assert_array_equal(flat, np.arange(4.0))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"width": 0}, "image size"),
        ({"height": -3}, "image size"),
        ({"width": 8.5}, "image size"),
        ({"width": np.nan}, "image size"),
        ({"height": None}, "image size"),
        ({"lens": 3}, "lens"),
        ({"lens": "unknown"}, "lens"),
        ({"coefficients": [1.0]}, "coefficients"),
        ({"viewmat": 1j * EYE}, "viewmat"),
        ({"K": K + 0j}, "K"),
        ({"viewmat": np.eye(3)}, "viewmat"),
        ({"viewmat": np.zeros((2, 3, 4, 4))}, "viewmat"),
        ({"viewmat": np.zeros((0, 4, 4))}, "viewmat.* at least one"),
        ({"viewmat": put(EYE, (3, 0), 1)}, "viewmat.* transpose"),
        ({"viewmat": put(EYE, (0, 3), np.nan)}, "viewmat"),
        ({"viewmat": put(EYE, (0, 0), np.inf)}, "viewmat"),
        ({"viewmat": 2 * EYE}, "viewmat"),
        ({"viewmat": np.diag([2, 2, 2, 1.0])}, r"viewmat.*\[2. 2. 2.\]"),
        ({"viewmat": put(EYE, (0, 1), 0.1)}, "viewmat.* rotation"),
        ({"viewmat": np.diag([1, -1, 1, 1.0])}, "viewmat.* mirror"),
        ({"viewmat": np.stack([EYE, np.diag([-1.0, -1, -1, 1])])}, "viewmat.* mirror"),
        ({"K": np.eye(4)}, "K"),
        ({"K": K.T}, "K: .*last row.*transpose"),
        ({"K": 2 * K}, "K: .*last row.*divide"),
        ({"K": put(K, (0, 1), 0.1)}, "K: .*skew"),
        ({"K": put(K, (1, 0), -0.1)}, "K: .*skew"),
        ({"K": np.zeros((2, 3, 3))}, "K"),
        ({"K": put(K, (0, 2), np.nan)}, "K"),
        ({"K": put(K, (0, 0), 0.0)}, "K: .*focal"),
        ({"K": put(K, (1, 1), -50.0)}, "K: .*focal"),
        ({"K": put(K, (0, 0), 1e16)}, "K: .*focal"),
        ({"K": put(K, (0, 2), -1e16)}, "K: .*principal"),
        ({"near": 0.0}, "near"),
        ({"near": np.nan}, "near"),
        ({"near": [0.1, 0.2]}, "near"),
        ({"near": 5.0, "far": 4.0}, "far"),
        ({"far": np.nan}, "far"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_cameras_are_checked(changes, named):
    with pytest.raises(InputError, match=named):
        gsjax.make_camera(
            **{"viewmat": EYE, "K": K, "width": 16, "height": 16} | changes
        )


def test_rounded_intrinsics_have_no_skew():
    """As a product with an inverse leaves them."""
    near = K * (1 + 1e-7) + 1e-7
    camera = gsjax.make_camera(viewmat=EYE, K=near, width=16, height=16)
    np.testing.assert_allclose(camera.K, K, atol=1e-5)


def test_values_of_tracers_are_not_checked():
    @jax.jit
    def focal(viewmat, K):
        return gsjax.make_camera(viewmat=viewmat, K=K, width=16, height=16).K[0, 0]

    assert focal(jnp.diag(jnp.array([1, -1, 1, 1.0])), jnp.asarray(K.T)) == 50


def test_look_at_normalises_and_rejects_missing_directions():
    wanted = gsjax.look_at((1, 2, 3), (0, 0, 0), (0, 1, 1))
    for length in (1e-30, 1e30):
        found = gsjax.look_at((1, 2, 3), (0, 0, 0), (0, length, length))
        np.testing.assert_allclose(found, wanted, atol=1e-12)
    for bad in ({"target": (1, 2, 3)}, {"up": (0, 0, 0)}, {"target": (np.nan, 0, 0)}):
        with pytest.raises(InputError, match="direction"):
            gsjax.look_at(**{"eye": (1, 2, 3), "target": (0, 0, 0), **bad})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("alpha_min", v) for v in (0.0, 1.0, np.nan)),
        *(("alpha_max", v) for v in (1e-6, 1.1, np.nan)),
        *(("transmittance_min", v) for v in (-1e-4, 1.0, np.nan)),
        ("stop_rule", "never"),
        *(("dilation", v) for v in (-0.1, np.inf, np.nan)),
        *(("outputs", v) for v in ((), ("rgb", "normal"), "rgb")),
        ("tile_size", 0),
        ("chunk_size", 0),
        ("tiles_per_step", 0),
        *(("pair_capacity", v) for v in (0, -5, 2**30)),
        ("visible_capacity", 0),
        ("num_size_buckets", 0),
        ("devices", 0),
    ],
    ids=str,
)
def test_settings_are_checked(name, value):
    with pytest.raises(InputError, match=rf"RasterConfig\.{name}"):
        RasterConfig(**{name: value})


def arguments(scene="random"):
    """Return bad arguments of a render by the word that an error must contain."""
    gaussians, camera = scene_of(scene)
    both = gsjax.stack_cameras([camera, camera])
    for name, array in vars(gaussians.params).items():
        # JAX would repeat the last row for slots beyond it.
        for wrong in (array[:-1], array[:, None], array + 0j):
            params = gaussians.params.replace(**{name: wrong})
            yield name, (gaussians.replace(params=params), camera), {}
    active = gaussians.active
    for wrong in (active[:-1], active[None], active.astype(float)):
        yield "active|shape", (gaussians.replace(active=wrong), camera), {}
    params = gaussians.params.replace(sh=gaussians.params.sh[:, :5])
    yield "5", (gaussians.replace(params=params), camera), {}
    for name in ("viewmat", "K", "near", "far"):
        single = getattr(camera, name)
        yield "make_camera", (gaussians, both.replace(**{name: single})), {}
        yield name, (gaussians, camera.replace(**{name: single + 0j})), {}
    yield "make_camera", (gaussians, jax.tree.map(lambda a: a[None], both)), {}
    yield "camera", (gaussians, jax.tree.map(lambda a: a[None][:0], camera)), {}
    yield "slot", (jax.tree.map(lambda a: a[:0], gaussians), camera), {}
    for name, value in (
        ("config", BACKGROUND),
        ("features", jnp.zeros((COUNT, 3), complex)),
        ("features", jnp.zeros((COUNT + 1, 3))),
        ("features", jnp.zeros(COUNT)),
        ("features", [1, 2, 3]),
        ("features", np.zeros((COUNT, 0))),
        ("background", jnp.zeros(3, complex)),
        ("background", np.zeros(4)),
        ("background", np.zeros((HEIGHT, WIDTH, 3))),
        ("probe", jnp.zeros((COUNT, 3))),
        ("probe", jnp.zeros((1, COUNT, 2))),
    ):
        yield name, (gaussians, camera), {name: value}
    yield "probe", (gaussians, camera), {"config": WHOLE.replace(absgrad=True)}
    yield "devices", (gaussians, camera), {"config": WHOLE.replace(devices=1000)}


def test_arguments_of_render_are_checked():
    for named, args, options in arguments():
        with pytest.raises(InputError, match=named):
            jax.eval_shape(
                lambda g, c, o=options: gsjax.render(g, c, **{"config": WHOLE, **o}),
                *args,
            )


def test_slots_and_cameras_are_checked():
    gaussians, camera = scene_of("random")
    for keep in (np.ones((COUNT, 1), bool), np.ones(1, bool), np.ones(COUNT, int)):
        with pytest.raises(InputError, match="keep"):
            gsjax.select(gaussians, keep)
    for degree in (-1, 5):
        with pytest.raises(InputError, match="0 to 4"):
            gsjax.with_sh_degree(gaussians, degree)
    unseen = gsjax.select(gaussians, np.zeros(COUNT, bool))
    for change in (gsjax.compact, gsjax.grow):
        for capacity in (0, -1, 100.5):
            with pytest.raises(InputError, match="capacity"):
                change(unseen, capacity)
    assert gsjax.compact(unseen, 1).capacity == 1
    assert gsjax.grow(gaussians, np.int64(COUNT + 1)).capacity == COUNT + 1
    for size in ((0, 8), (8, -1), (8.5, 8)):
        with pytest.raises(InputError, match="image size"):
            gsjax.resize_camera(camera, *size)
    assert type(gsjax.resize_camera(camera, 8.0, 4).width) is int
    for cameras in ([], [camera_of(8, 8), camera_of(8, 9)]):
        with pytest.raises(InputError, match="cameras"):
            gsjax.stack_cameras(cameras)


# --- accepted ---


def test_numpy_arrays_and_other_dtypes_are_accepted():
    """A probe may be float64 with a float32 scene, as an optimiser's zeros are."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    given = {
        "features": np.random.default_rng(0).random((COUNT, 2), np.float32),
        "probe": np.zeros((COUNT, 2), np.float32),
    }
    host = jax.device_get(gaussians)
    found = jax.jit(lambda c: gsjax.render(host, c, WHOLE, **given).rgb)(camera)
    given = jax.tree.map(jnp.asarray, given)
    wanted = jax.jit(lambda g, c: gsjax.render(g, c, WHOLE, **given).rgb)
    assert np.std(found) > 0.01
    np.testing.assert_allclose(found, wanted(gaussians, camera), atol=1e-5)
    config, zeros = WHOLE.replace(absgrad=True), np.zeros((COUNT, 2))
    assert jnp.asarray(zeros).dtype == jnp.float64
    out = jax.eval_shape(
        lambda p: gsjax.render(gaussians, camera, config, probe=p), zeros
    )
    assert out.rgb.dtype == jnp.float32


# --- bad values under jit ---


def placed_as(old, new):
    """Return arrays on the devices of others, so that no program is compiled again."""
    return jax.tree.map(lambda a, b: jax.device_put(b, a.sharding), old, new)


def spoilt(gaussians, value):
    """Return the scene with one number spoilt in each of some slots, and the slots."""
    slots, out = {}, {n: np.array(a) for n, a in vars(gaussians.params).items()}
    places = iter(range(0, COUNT, 2))
    for name, array in out.items():
        for entry in np.ndindex(array.shape[1:]):
            slot = next(places, None)
            if slot is not None:
                array[slot, *entry] = value
                slots[slot] = f"{name}{list(entry)}"
    params = placed_as(gaussians.params, gsjax.GaussianParams(**out))
    return gaussians.replace(params=params), slots


@on_cpu
@pytest.mark.parametrize(
    ("dtype", "value"),
    [
        *((jnp.float32, value) for value in (np.nan, np.inf, -np.inf)),
        (jnp.float64, np.nan),
    ],
)
def test_gaussians_that_are_not_finite_vanish(value, dtype):
    """For each of the 59 numbers, the image is that without the Gaussian."""
    gaussians, camera = cast(scene_of("random"), dtype)
    scene, slots = spoilt(gaussians, value)
    assert len(slots) == 59
    keep = np.ones(COUNT, bool)
    keep[list(slots)] = False
    wanted, wanted_grads = loss_and_gradients(gsjax.select(gaussians, keep), camera)
    out, grads = loss_and_gradients(scene, camera)
    assert_not_empty(wanted.alpha)
    assert (wanted.radii[keep] > 0).any()
    everything, _ = loss_and_gradients(gaussians, camera)
    assert np.abs(everything.rgb - wanted.rgb).max() > 0.05
    for slot, entry in slots.items():
        assert out.radii[slot] == 0, entry
    for name in (*ALL, "radii"):
        np.testing.assert_array_equal(getattr(out, name), getattr(wanted, name))
    for a, b in zip(*(jax.tree.leaves(g[0]) for g in (grads, wanted_grads))):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()
        assert np.any(a != 0)
    # Gradients of the camera are sums over all ranks, some of which are empty here.
    rtol = 200 * jnp.finfo(dtype).eps
    for a, b in zip(*(jax.tree.leaves(g[1]) for g in (grads, wanted_grads))):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(b).max())
        assert np.isfinite(a).all()


def extremes(gaussians, camera):
    """Return the scene with extreme finite values in one slot each.

    Also returns whether some of the slots are visible, and the number used.
    """
    p = {name: np.array(array) for name, array in vars(gaussians.params).items()}
    viewmat = np.asarray(camera.viewmat)
    slot = iter(range(COUNT))
    wanted = {}

    def at_depth(z, visible=None):
        i = next(slot)
        point = np.array([0.02, 0.01, z]) if np.isfinite(z) else [0, 0, z]
        p["means"][i] = viewmat[:3, :3].T @ (point - viewmat[:3, 3])
        wanted[i] = visible

    for value in (-200, -50, 0, 40, 88, 120, 700, -1e30, 1e30):
        p["log_scales"][next(slot)] = value
        p["log_scales"][next(slot), 1] = value
    for size, seen in ((0.0, False), (1e-23, True), (1e-30, None), (1e20, True)):
        i = next(slot)
        p["means"][i] = p["means"][100]
        p["logit_opacities"][i], p["log_scales"][i] = 2, -1
        p["quats"][i] = size * np.array([0.3, -0.2, 0.1, 0.5])
        wanted[i] = seen
    for value in (1e30, -1e30, 1e10, 1e18):
        p["means"][next(slot)] = value
        p["means"][next(slot), 0] = value
    for value in (-1e30, -200, 200, 1e30):
        p["logit_opacities"][next(slot)] = value
    p["sh"][next(slot)] = 1e30
    p["sh"][next(slot)] = -1e30
    near = float(camera.near)
    for z in (-1.0, 0.0, 1e-30, near * 0.99):
        at_depth(z, visible=False)
    for factor in (1 - 1e-6, 1, 1 + 1e-6):
        at_depth(near * factor)
    for z in (1e10, 2e10, 1e25):
        at_depth(z, visible=False)
    params = placed_as(gaussians.params, gsjax.GaussianParams(**p))
    return gaussians.replace(params=params), wanted, next(slot)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_extreme_values_stay_finite(dtype):
    gaussians, camera = cast(scene_of("random"), dtype)
    scene, wanted, used = extremes(gaussians, camera)
    out, grads = loss_and_gradients(scene, camera)
    assert not out.overflowed
    assert used > 40
    for name in ("alpha", "depth", "median_depth", "radii"):
        assert np.isfinite(getattr(out, name)).all(), name
    for leaf in jax.tree.leaves(grads):
        assert np.isfinite(leaf).all()
    for slot, visible in wanted.items():
        if visible is not None:
            assert (out.radii[slot] > 0) == visible, slot
    unseen = np.asarray(out.radii == 0)
    for leaf in jax.tree.leaves(grads[0]):
        assert (leaf[unseen] == 0).all()


def test_gaussians_at_the_camera_far_from_the_origin_stay_finite():
    """They are in front of the camera, but behind it as float32 sums their depth."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    viewmat = np.array(camera.viewmat)
    centre = 3e5 * np.asarray([1.0, -0.7, 0.4])
    rng = np.random.default_rng(0)
    seen = np.stack(
        [*(0.01 * rng.normal(size=(2, COUNT))), rng.uniform(0, 0.05, COUNT)]
    )
    means = (centre + seen.T @ viewmat[:3, :3]).astype(np.float32)
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre
    row = viewmat[2]
    true = means.astype(float) @ row[:3].astype(float) + float(row[3])
    found = row[0] * means[:, 0] + row[1] * means[:, 1] + row[2] * means[:, 2] + row[3]
    near = 1e-3
    behind = (true > near) & (found <= 0)
    assert behind.sum() > 5
    params = gaussians.params.replace(means=placed_as(gaussians.params.means, means))
    moved = placed_as((camera.viewmat, camera.near), (viewmat, np.float32(near)))
    camera = camera.replace(viewmat=moved[0], near=moved[1])
    out, grads = loss_and_gradients(gaussians.replace(params=params), camera)
    assert (out.radii[behind] == 0).all()
    assert (out.radii > 0).any()
    for leaf in jax.tree.leaves(grads):
        assert np.isfinite(leaf).all()


def test_an_impossible_camera_draws_nothing_under_jit():
    gaussians, camera = scene_of("random")
    for bad in (
        camera.replace(K=camera.K.at[0, 0].multiply(-1)),
        camera.replace(K=camera.K.at[1, 1].multiply(-1)),
        camera.replace(viewmat=camera.viewmat * np.nan),
        camera.replace(near=camera.near * np.nan),
    ):
        out = render(gaussians, bad, WHOLE, BACKGROUND)
        np.testing.assert_array_equal(
            out.rgb, np.broadcast_to(BACKGROUND, out.rgb.shape)
        )
        assert out.demand.visible == 0


def empty_scenes():
    gaussians, camera = scene_of("random")
    params = gaussians.params
    none = {name: np.asarray(array)[:0] for name, array in vars(params).items()}
    faint = params.replace(logit_opacities=params.logit_opacities * 0 - 30)
    return {
        "no Gaussians": (gsjax.make_gaussians(**none, capacity=COUNT), camera),
        "none active": (gsjax.select(gaussians, jnp.zeros(COUNT, bool)), camera),
        "all culled": (gaussians, camera.replace(near=camera.far / 2)),
        "all transparent": (gaussians.replace(params=faint), camera),
    }


@pytest.mark.parametrize("kind", empty_scenes())
def test_an_empty_scene_is_exactly_the_background(kind):
    scene = (*empty_scenes()[kind], BACKGROUND)
    gaussians, camera, background = cast(scene, jnp.float32)
    out = render(gaussians, camera, WHOLE, background)
    assert out.rgb.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(out.rgb, np.broadcast_to(background, out.rgb.shape))
    for name in ("alpha", "depth", "median_depth", "radii"):
        assert (getattr(out, name) == 0).all(), name
    assert out.demand.pairs == out.demand.visible == 0
    assert not out.overflowed
    _, grads = loss_and_gradients(gaussians, camera)
    for leaf in jax.tree.leaves(grads):
        assert (leaf == 0).all()


def test_no_gaussians_have_one_slot_and_render_the_background():
    none = {name: array[:0] for name, array in GOOD.items()}
    gaussians = gsjax.make_gaussians(**none)
    assert gaussians.capacity == 1
    assert gsjax.num_active(gaussians) == 0
    out = render(gaussians, camera_of(1, 1), WHOLE, BACKGROUND)
    np.testing.assert_array_equal(out.rgb[0, 0], BACKGROUND)
