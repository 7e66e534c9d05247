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
    cast,
    loss_and_gradients,
    on_cpu,
    render,
    scene_of,
)

import gsjax
from gsjax import InputError, RasterConfig

COUNTS = ("tile_size", "chunk_size", "tiles_per_step", "pair_capacity")
COUNTS += ("visible_capacity", "num_size_buckets", "devices")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("alpha_min", (0.0, 1.0, np.nan)),
        ("alpha_max", (1e-6, 1.1, np.nan)),
        ("transmittance_min", (-1e-4, 1.0, np.nan)),
        ("stop_rule", ("never",)),
        ("dilation", (-0.1, np.inf, np.nan)),
        ("outputs", ((), ("rgb", "normal"), "rgb")),
        *((name, (0, -5)) for name in COUNTS),
        ("pair_capacity", (2**30,)),
    ],
)
def test_settings_are_checked(name, values):
    for value in values:
        with pytest.raises(InputError, match=rf"RasterConfig\.{name}"):
            RasterConfig(**{name: value})


def arguments():
    """Return bad arguments of a render by the word that an error must contain."""
    gaussians, camera = scene_of("random")
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
        ("mask: expected", np.ones((HEIGHT, WIDTH + 1), bool)),
        ("mask: expected", np.ones((HEIGHT, WIDTH))),
        ("probe", jnp.zeros((COUNT, 3))),
        ("probe", jnp.zeros((1, COUNT, 2))),
    ):
        yield name, (gaussians, camera), {name.split(":")[0]: value}
    flat = {"mask": np.ones((HEIGHT, WIDTH), bool)}
    yield "mask: expected", (gaussians, gsjax.stack_cameras([camera])), flat
    yield "probe", (gaussians, camera), {"config": WHOLE.replace(absgrad=True)}
    yield "devices", (gaussians, camera), {"config": WHOLE.replace(devices=1000)}


def test_arguments_of_render_are_checked():
    for named, args, options in arguments():
        with pytest.raises(InputError, match=named):
            jax.eval_shape(
                lambda g, c, o=options: gsjax.render(g, c, **{"config": WHOLE, **o}),
                *args,
            )


def test_numpy_arrays_and_other_dtypes_are_accepted():
    """A probe may be float64 with a float32 scene, as an optimiser's zeros are."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    given = {
        "features": np.random.default_rng(0).random((COUNT, 2), np.float32),
        "probe": np.zeros((COUNT, 2)),
        "config": WHOLE.replace(absgrad=True),
    }
    assert jnp.asarray(given["probe"]).dtype == jnp.float64
    host = jax.device_get(gaussians)
    out = jax.eval_shape(lambda c: gsjax.render(host, c, **given), camera)
    assert out.rgb.dtype == jnp.float32
    assert out.rgb.shape == (HEIGHT, WIDTH, 2)


def placed_as(old, new):
    """Return arrays on the devices of others, so that no program is compiled again."""
    return jax.tree.map(lambda a, b: jax.device_put(b, a.sharding), old, new)


def spoilt(gaussians, value):
    """Return the scene with one number spoilt in some slots, and the other slots."""
    keep, out = np.ones(COUNT, bool), jax.tree.map(np.array, gaussians.params)
    places = iter(range(0, COUNT, 2))
    for array in jax.tree.leaves(out):
        for entry in np.ndindex(array.shape[1:]):
            slot = next(places)
            array[slot, *entry], keep[slot] = value, False
    params = placed_as(gaussians.params, out)
    return gaussians.replace(params=params), keep


@on_cpu
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_gaussians_that_are_not_finite_vanish(value):
    """For each of the 59 numbers, the image is that without the Gaussian."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    scene, keep = spoilt(gaussians, value)
    assert np.sum(~keep) == 59
    wanted, wanted_grads = loss_and_gradients(gsjax.select(gaussians, keep), camera)
    out, grads = loss_and_gradients(scene, camera)
    assert_not_empty(wanted.alpha)
    assert (wanted.radii[keep] > 0).any()
    everything, _ = loss_and_gradients(gaussians, camera)
    assert np.abs(everything.rgb - wanted.rgb).max() > 0.05
    assert (out.radii[~keep] == 0).all()
    for name in (*ALL, "radii"):
        np.testing.assert_array_equal(getattr(out, name), getattr(wanted, name))
    for a, b in zip(*(jax.tree.leaves(g[0]) for g in (grads, wanted_grads))):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()
        assert np.any(a != 0)
    # Gradients of the camera are sums over all ranks, some of which are empty here.
    rtol = 200 * jnp.finfo(jnp.float32).eps
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
    seen = [*(0.01 * rng.normal(size=(2, COUNT))), rng.uniform(0, 0.05, COUNT)]
    means = (centre + np.transpose(seen) @ viewmat[:3, :3]).astype(np.float32)
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


def test_nothing_to_draw_is_exactly_the_background():
    """No Gaussian that can be seen, or under jit a camera that cannot see."""
    gaussians, camera, background = cast((*scene_of("random"), BACKGROUND), jnp.float32)
    params, K = gaussians.params, camera.K
    none = {name: array[:0] for name, array in vars(params).items()}
    faint = params.replace(logit_opacities=params.logit_opacities * 0 - 30)
    for kind, scene in {
        "no Gaussians": (gsjax.make_gaussians(**none, capacity=COUNT), camera),
        "none active": (gsjax.select(gaussians, jnp.zeros(COUNT, bool)), camera),
        "all transparent": (gaussians.replace(params=faint), camera),
        "all culled": (gaussians, camera.replace(near=camera.far / 2)),
        "mirrored in x": (gaussians, camera.replace(K=K.at[0, 0].multiply(-1))),
        "mirrored in y": (gaussians, camera.replace(K=K.at[1, 1].multiply(-1))),
        "no place": (gaussians, camera.replace(viewmat=camera.viewmat * np.nan)),
        "no near plane": (gaussians, camera.replace(near=camera.near * np.nan)),
    }.items():
        out = render(*scene, WHOLE, background)
        assert (out.rgb == background).all(), kind
        for name in ("alpha", "depth", "median_depth", "radii"):
            assert (getattr(out, name) == 0).all(), (kind, name)
        assert out.demand.pairs == out.demand.visible == 0
        assert not out.overflowed
        for leaf in jax.tree.leaves(loss_and_gradients(*scene)[1]):
            assert (leaf == 0).all(), kind
