"""Bad input: a typed error that names it, or a Gaussian that vanishes without trace."""

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


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (4, 2)),
        ("means", (4,)),
        ("means", (5, 3)),  # then all others are one short
        ("quats", (4, 3)),
        ("quats", (3, 4)),
        ("log_scales", (4,)),
        ("log_scales", (4, 1)),
        ("logit_opacities", (4, 2)),
        ("logit_opacities", (3,)),
        ("sh", (4, 3)),
        ("sh", (4, 1, 4)),
        ("sh", (3, 1, 3)),
    ],
)
def test_shapes_of_gaussians(name, shape):
    with pytest.raises(InputError, match="quats" if shape == (5, 3) else name):
        gsjax.make_gaussians(**{**GOOD, name: np.zeros(shape)})


def test_other_errors_of_gaussians():
    with pytest.raises(InputError, match="5 spherical-harmonic"):
        gsjax.make_gaussians(**{**GOOD, "sh": np.zeros((4, 5, 3))})
    with pytest.raises(InputError, match="means is complex"):
        gsjax.make_gaussians(**{**GOOD, "means": np.zeros((4, 3), complex)})
    with pytest.raises(InputError, match="capacity: expected at least 4"):
        gsjax.make_gaussians(**GOOD, capacity=3)
    with pytest.raises(InputError, match="capacity: expected at least the present 4"):
        gsjax.grow(gsjax.make_gaussians(**GOOD), 3)


@pytest.mark.parametrize("capacity", [100.5, "100", True])
def test_capacities_are_whole(capacity):
    gaussians = gsjax.make_gaussians(**GOOD)
    for make in (
        lambda: gsjax.make_gaussians(**GOOD, capacity=capacity),
        lambda: gsjax.grow(gaussians, capacity),
        lambda: gsjax.compact(gaussians, capacity),
    ):
        with pytest.raises(InputError, match=f"capacity = {capacity!r}"):
            make()
    assert gsjax.grow(gaussians, np.int64(100)).capacity == 100


def test_opacities_may_be_a_column():
    column = {**GOOD, "logit_opacities": np.arange(4.0)[:, None]}
    flat = gsjax.make_gaussians(**column).params.logit_opacities
    np.testing.assert_array_equal(flat, np.arange(4.0))


EYE, K = np.eye(4), np.array([[50.0, 0, 8], [0, 50, 8], [0, 0, 1]])


def put(matrix, place, value):
    matrix = matrix.copy()
    matrix[place] = value
    return matrix


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"width": 0}, "width"),
        ({"height": -3}, "height"),
        ({"width": 8.5}, "width"),
        ({"width": np.nan}, "width"),
        ({"height": np.inf}, "height"),
        ({"height": None}, "height"),
        ({"lens": 3}, "expected a gsjax.cameras.lenses.Lens"),
        ({"viewmat": 1j * EYE}, "viewmat is complex"),
        ({"K": K + 0j}, "K is complex"),
        ({"model": "fisheye"}, "unknown camera model 'fisheye'"),
        ({"viewmat": np.eye(3)}, "viewmat"),
        ({"viewmat": np.zeros((2, 3, 4, 4))}, "viewmat"),
        ({"viewmat": np.zeros((0, 4, 4))}, "viewmat .*at least one camera"),
        ({"viewmat": EYE.T + put(0 * EYE, (3, 0), 1)}, "transposed"),
        ({"viewmat": put(EYE, (0, 3), np.nan)}, "viewmat"),
        ({"viewmat": put(EYE, (0, 0), np.inf)}, "viewmat"),
        ({"viewmat": 2 * EYE}, "transposed"),
        ({"viewmat": np.diag([2, 2, 2, 1.0])}, r"lengths \[2. 2. 2.\]"),
        ({"viewmat": put(EYE, (0, 1), 0.1)}, "no rotation"),
        ({"viewmat": np.diag([1, -1, 1, 1.0])}, "mirrors"),
        ({"viewmat": np.stack([EYE, np.diag([-1.0, -1, -1, 1])])}, "mirrors"),
        ({"K": np.eye(4)}, "K"),
        ({"K": K.T}, "last row of K .*transpose"),
        ({"K": 2 * K}, "last row of K .*divide"),
        ({"K": put(K, (2, 2), 0.5)}, "last row of K .*divide"),
        ({"K": put(K, (0, 1), 0.1)}, "skew is not rendered"),
        ({"K": put(K, (1, 0), -0.1)}, "skew is not rendered"),
        ({"K": np.zeros((2, 3, 3))}, "K"),
        ({"K": put(K, (0, 2), np.nan)}, "K"),
        ({"K": put(K, (0, 0), 0.0)}, "focal"),
        ({"K": put(K, (1, 1), -50.0)}, "focal"),
        ({"K": put(K, (0, 0), 1e16)}, "focal length of .* nothing could be drawn"),
        ({"K": put(K, (0, 2), -1e16)}, "principal point at .* nothing could be"),
        ({"near": 0.0}, "near"),
        ({"near": np.nan}, "near"),
        ({"near": [0.1, 0.2]}, "near"),
        ({"near": 5.0, "far": 4.0}, "far"),
        ({"far": np.nan}, "far"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_cameras(changes, named):
    good = {"viewmat": EYE, "K": K, "width": 16, "height": 16}
    gsjax.make_camera(**good)
    with pytest.raises(InputError, match=named):
        gsjax.make_camera(**{**good, **changes})


def test_rounding_of_intrinsics_is_no_skew():
    """As a product with an inverse leaves it."""
    near = K * (1 + 1e-7) + 1e-7
    camera = gsjax.make_camera(viewmat=EYE, K=near, width=16, height=16)
    np.testing.assert_allclose(camera.K, K, atol=1e-5)


def test_tracers_are_not_looked_into():
    """Under jit the numbers of a camera are not known, and so cannot be refused."""

    @jax.jit
    def focal(viewmat, K):
        return gsjax.make_camera(viewmat=viewmat, K=K, width=16, height=16).K[0, 0]

    assert focal(jnp.diag(jnp.array([1, -1, 1, 1.0])), jnp.asarray(K.T)) == 50


def test_other_sizes_of_cameras():
    camera = camera_of(16, 8)
    for size in ((0, 8), (8, -1), (8.5, 8)):
        with pytest.raises(InputError, match="whole and ≥ 1"):
            gsjax.resize_camera(camera, *size)
    assert type(gsjax.resize_camera(camera, 8.0, 4).width) is int


def test_where_a_camera_looks():
    wanted = gsjax.look_at((1, 2, 3), (0, 0, 0), (0, 1, 1))
    for length in (1e-30, 1e30):
        up = (0, length, length)
        found = gsjax.look_at((1, 2, 3), (0, 0, 0), up)
        np.testing.assert_allclose(found, wanted, atol=1e-12)
    for bad in ({"target": (1, 2, 3)}, {"up": (0, 0, 0)}, {"target": (np.nan, 0, 0)}):
        with pytest.raises(InputError, match="gives no direction"):
            gsjax.look_at(**{"eye": (1, 2, 3), "target": (0, 0, 0), **bad})


def test_a_batch_needs_one_size():
    with pytest.raises(InputError, match="one image size and model; found 2"):
        gsjax.stack_cameras([camera_of(8, 8), camera_of(8, 9)])
    with pytest.raises(InputError, match="found 0"):
        gsjax.stack_cameras([])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("alpha_min", v) for v in (0.0, 1.0, -0.1, np.nan)),
        *(("alpha_max", v) for v in (1e-6, 1.1, np.nan)),
        *(("stop", v) for v in (-1e-4, 1.0, np.nan)),
        ("stop_rule", "never"),
        *(("dilation", v) for v in (-0.1, np.inf, np.nan)),
        *(("outputs", v) for v in ((), ("rgb", "normal"), ["rgb"], "rgb")),
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
def test_settings(name, value):
    with pytest.raises(InputError, match=rf"RasterConfig\.{name} = "):
        RasterConfig(**{name: value})
    with pytest.raises(InputError, match=name):
        RasterConfig.accurate().replace(**{name: value})


def test_gaussians_of_unequal_length():
    """JAX would take the last row for every slot beyond it, in silence."""
    gaussians, camera = scene_of("random")
    for name, array in vars(gaussians.params).items():
        for wrong in (array[:-1], array[:, None], array + 0j):
            params = gaussians.params.replace(**{name: wrong})
            with pytest.raises(InputError, match=name):
                gsjax.render(gaussians.replace(params=params), camera, WHOLE)
    for wrong in (gaussians.active[:-1], gaussians.active[None]):
        with pytest.raises(InputError, match="wanted"):
            gsjax.render(gaussians.replace(active=wrong), camera, WHOLE)
    numbers = gaussians.replace(active=gaussians.active.astype(float))
    with pytest.raises(InputError, match=r"active .* of float"):
        gsjax.render(numbers, camera, WHOLE)
    params = gaussians.params.replace(sh=gaussians.params.sh[:, :5])
    with pytest.raises(InputError, match="5 spherical-harmonic"):
        gsjax.render(gaussians.replace(params=params), camera, WHOLE)


def test_cameras_put_together_by_hand():
    gaussians, camera = scene_of("random")
    both = gsjax.stack_cameras([camera, camera])
    for name in ("viewmat", "K", "near", "far"):
        mixed = gsjax.Camera(**{**vars(both), name: getattr(camera, name)})
        with pytest.raises(InputError, match="see make_camera"):
            gsjax.render(gaussians, mixed, WHOLE)
        imaginary = getattr(camera, name) + 0j
        with pytest.raises(InputError, match=f"{name} is complex"):
            gsjax.render(
                gaussians, gsjax.Camera(**{**vars(camera), name: imaginary}), WHOLE
            )
    twice = jax.tree.map(lambda a: a[None], both)
    with pytest.raises(InputError, match="see make_camera"):
        gsjax.render(gaussians, twice, WHOLE)


def test_a_background_in_the_place_of_settings():
    with pytest.raises(InputError, match="a RasterConfig is wanted, and the backgr"):
        gsjax.render(*scene_of("random"), BACKGROUND)


@pytest.mark.parametrize(
    ("named", "kwargs"),
    [
        ("features is complex", {"features": jnp.zeros((COUNT, 3), complex)}),
        ("background is complex", {"background": jnp.zeros(3, complex)}),
        ("features", {"features": jnp.zeros((COUNT + 1, 3))}),
        ("features", {"features": jnp.zeros(COUNT)}),
        ("features", {"features": [1, 2, 3]}),
        ("features", {"features": np.zeros((COUNT, 0))}),
        ("1000 devices|devices = 1000", {"config": WHOLE.replace(devices=1000)}),
        ("probe", {"probe": jnp.zeros((COUNT, 3))}),
        ("probe", {"probe": jnp.zeros((1, COUNT, 2))}),
        ("abs_probe", {"abs_probe": jnp.zeros((COUNT, 2))}),  # without absgrad
        ("abs_probe", {"config": WHOLE.replace(absgrad=True)}),
        ("background", {"background": np.zeros(4)}),
        ("background", {"background": np.zeros((3, 3))}),
        ("background", {"background": np.zeros((HEIGHT, WIDTH, 3))}),
    ],
    ids=str,
)
def test_arguments_of_render(named, kwargs):
    kwargs = {"config": WHOLE, **kwargs}
    config = kwargs.pop("config")
    with pytest.raises(InputError, match=named):
        jax.eval_shape(
            lambda g, c: gsjax.render(g, c, config, **kwargs), *scene_of("random")
        )


def test_nothing_to_render():
    """No cameras, or no slots, which arrays that are cut can come to."""
    gaussians, camera = scene_of("random")
    none = jax.tree.map(lambda a: a[None][:0], camera)
    empty = jax.tree.map(lambda a: a[:0], gaussians)
    for draw in (gsjax.render, gsjax.render_exact, gsjax.exact_config):
        with pytest.raises(InputError, match="no cameras: at least one"):
            draw(gaussians, none)
        with pytest.raises(InputError, match="no slots: at least one"):
            draw(empty, camera)
    unseen = gsjax.select(gaussians, np.zeros(COUNT, bool))
    for capacity in (0, -1):
        with pytest.raises(InputError, match=f"capacity {capacity}: at least 1"):
            gsjax.compact(unseen, capacity)
    assert gsjax.compact(unseen, 1).capacity == 1


def test_slots_and_bands():
    gaussians, _ = scene_of("random")
    for keep in (np.ones((COUNT, 1), bool), np.ones(1, bool), np.ones(COUNT, int)):
        with pytest.raises(InputError, match="one for each slot"):
            gsjax.select(gaussians, keep)
    for degree in (-1, 5):
        with pytest.raises(InputError, match="0 to 4"):
            gsjax.with_sh_degree(gaussians, degree)


@pytest.mark.parametrize("batched", [False, True])
def test_arrays_of_numpy(batched):
    """Closed over by a jitted function they are as good as JAX's."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    camera = gsjax.stack_cameras([camera, camera]) if batched else camera
    given = {
        "features": np.random.default_rng(0).random((COUNT, 2), np.float32),
        "probe": np.zeros((*camera.viewmat.shape[:-2], COUNT, 2), np.float32),
    }
    host = jax.device_get(gaussians)
    found = jax.jit(lambda c: gsjax.render(host, c, WHOLE, **given).rgb)(camera)
    given = jax.tree.map(jnp.asarray, given)
    wanted = jax.jit(lambda g, c: gsjax.render(g, c, WHOLE, **given).rgb)
    assert np.std(found) > 0.01
    np.testing.assert_allclose(found, wanted(gaussians, camera), atol=1e-5)


def test_a_probe_of_another_precision():
    """It follows the scene's, as the optimiser's zeros under x64 may not."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    config = WHOLE.replace(absgrad=True)
    zeros = np.zeros((COUNT, 2))
    assert jnp.asarray(zeros).dtype == jnp.float64
    out = jax.eval_shape(
        lambda p, a: gsjax.render(
            gaussians, camera, config, probe=p, abs_probe=a
        ),
        zeros,
        zeros,
    )  # fmt: skip
    assert out.rgb.dtype == jnp.float32


def spoilt(gaussians, value):
    """One slot spoilt in each single number of the parameters: (scene, slots)."""
    fields = vars(gaussians.params)
    slots, out = {}, {name: np.array(array) for name, array in fields.items()}
    places = iter(range(0, COUNT, 2))
    for name, array in out.items():
        for entry in np.ndindex(array.shape[1:]):
            slot = next(places, None)
            if slot is not None:
                array[slot, *entry] = value
                slots[slot] = f"{name}{list(entry)}"
    params = gsjax.GaussianParams(**{k: jnp.asarray(v) for k, v in out.items()})
    return gaussians.replace(params=params), slots


@on_cpu
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_vanishes(value, dtype):
    """In every one of the 59 numbers: the image is that without the Gaussian."""
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
    by_params, wanted_by_params = (jax.tree.leaves(g[0]) for g in (grads, wanted_grads))
    for a, b in zip(by_params, wanted_by_params):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()
        assert np.any(a != 0)
    # Those of the camera are sums over all ranks, of which some are empty here.
    rtol = 200 * jnp.finfo(dtype).eps
    for a, b in zip(jax.tree.leaves(grads[1]), jax.tree.leaves(wanted_grads[1])):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(b).max())
        assert np.isfinite(a).all()


def extremes(gaussians, camera):
    """Wild but finite values, and depths at the edges, one slot each."""
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
    params = gsjax.GaussianParams(**{k: jnp.asarray(v) for k, v in p.items()})
    return gaussians.replace(params=params), wanted, next(slot)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_wild_values_stay_finite(dtype):
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


def test_at_the_lens_in_a_far_world():
    """In front of the camera, but behind it as float32 adds up its depth."""
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
    params = gaussians.params.replace(means=jnp.asarray(means))
    moved = {"viewmat": jnp.asarray(viewmat), "near": jnp.float32(near)}
    camera = gsjax.Camera(**{**vars(camera), **moved})
    out, grads = loss_and_gradients(gaussians.replace(params=params), camera)
    assert (out.radii[behind] == 0).all()
    assert (out.radii > 0).any()
    for leaf in jax.tree.leaves(grads):
        assert np.isfinite(leaf).all()


def test_a_camera_that_there_cannot_be_draws_nothing_under_jit():
    """Outside jit it cannot be made; under jit it cannot raise."""
    gaussians, camera = scene_of("random")
    for spoilt_camera in (
        gsjax.Camera(**{**vars(camera), "K": camera.K.at[0, 0].multiply(-1)}),
        gsjax.Camera(**{**vars(camera), "K": camera.K.at[1, 1].multiply(-1)}),
        gsjax.Camera(**{**vars(camera), "viewmat": camera.viewmat * np.nan}),
        gsjax.Camera(**{**vars(camera), "near": camera.near * np.nan}),
    ):
        out = render(gaussians, spoilt_camera, WHOLE, BACKGROUND)
        np.testing.assert_array_equal(
            out.rgb, np.broadcast_to(BACKGROUND, out.rgb.shape)
        )
        assert out.demand.visible == 0


def empty_scenes():
    gaussians, camera = scene_of("random")
    none = {
        name: np.asarray(array)[:0] for name, array in vars(gaussians.params).items()
    }
    behind = gsjax.Camera(**{**vars(camera), "near": camera.far / 2})
    return {
        "no Gaussians": (gsjax.make_gaussians(**none, capacity=COUNT), camera),
        "none active": (gsjax.select(gaussians, jnp.zeros(COUNT, bool)), camera),
        "all culled": (gaussians, behind),
        "all transparent": (
            gaussians.replace(
                params=gaussians.params.replace(logit_opacities=jnp.full(COUNT, -30.0))
            ),
            camera,
        ),
    }


@pytest.mark.parametrize("kind", empty_scenes())
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_an_empty_scene_is_exactly_the_background(kind, dtype):
    gaussians, camera, background = cast((*empty_scenes()[kind], BACKGROUND), dtype)
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


def test_no_slot_is_still_a_scene():
    """The default capacity of no Gaussians is 1, and a 1 × 1 image is an image."""
    none = {name: array[:0] for name, array in GOOD.items()}
    gaussians = gsjax.make_gaussians(**none)
    assert gaussians.capacity == 1
    assert gsjax.num_active(gaussians) == 0
    out = render(gaussians, camera_of(1, 1), WHOLE, BACKGROUND)
    np.testing.assert_array_equal(out.rgb[0, 0], BACKGROUND)
