"""The 3D filter of Mip-Splatting, against references in float64 and closed forms."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DATA, LIGHT, cast, frustum_points, gaussians_at
from test_seams import SLOTS, clone_all
from training import EXTENT, RASTER, VIEWS, rough_start

import gsjax
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import InputError
from gsjax.gaussians import activate
from gsjax.io.ply import read_ply, write_ply
from gsjax.math.sh import C0
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.types import Inputs, RasterConfig
from gsjax.train.config import Level, TrainConfig, mip_raster
from gsjax.train.mip import filter_radii, mip_model, smoothed
from gsjax.train.models import Model, ModelParams
from gsjax.train.state import (
    Metrics,
    init_state,
    make_setup,
    setup_state,
    shown_gaussians,
)
from gsjax.train.step import make_stages, make_train_step, refresh_table

BAR = 1e-9
# No thresholds, as in the references.
PLAIN = RasterConfig(
    **LIGHT, alpha_min=1e-14, alpha_max=1.0, transmittance_min=0.0, stop_rule="after",
    outputs=("rgb",),
)  # fmt: skip
MIP = mip_raster(PLAIN)


@cache
def table() -> dict[str, np.ndarray]:
    path = DATA / "methods" / "mip.npz"
    if not path.exists():
        pytest.skip(f"{path.name} is absent (../shared/data/methods)")
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def given(prefix: str = "", colors=None) -> gsjax.Gaussians:
    """Return the Gaussians of the file."""
    t = {name: table()[prefix + name] for name in ("means", "quats", "scales")}
    opacities = table()[prefix + "opacities"]
    sh = np.zeros((len(opacities), 1, 3))
    if colors is not None:
        sh[:, 0] = (colors - 0.5) / C0
    return gsjax.make_gaussians(
        means=t["means"],
        quats=t["quats"],
        log_scales=np.log(t["scales"]),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh=sh,
    )


def cameras() -> gsjax.Camera:
    t = table()
    viewmat = np.tile(np.eye(4), (len(t["cam_R"]), 1, 1))
    viewmat[:, :3, :3], viewmat[:, :3, 3] = t["cam_R"], t["cam_t"]
    width, height = map(int, t["cam_wh"].max(0))
    made = gsjax.make_camera(viewmat=viewmat, K=t["cam_K"], width=width, height=height)
    return made.replace(visible_size=jnp.asarray(t["cam_wh"]))


radii_of = jax.jit(filter_radii)


def worst(found, wanted) -> float:
    return float(np.max(np.abs(np.asarray(found) / wanted - 1)))


def test_radii_and_fused_parameters_agree(report):
    scene, t = given(), table()
    radii = radii_of(scene.params.means, scene.active, cameras())
    fused = activate(smoothed(scene, radii).params)
    for name, found, wanted in (
        ("radii", radii, t["filter_paper"]),
        ("scales", fused["scales"], t["scales_paper"]),
        ("opacities", fused["opacities"], t["opacities_paper"]),
    ):
        error = worst(found, wanted)
        report(name, error, BAR)
        assert error <= BAR, name


@jax.jit
def compensation(scene, camera):
    count = scene.capacity
    order = jnp.arange(count), jnp.int32(count)
    out = ELLIPSOID.project(Inputs(scene, camera), MIP, *order)
    return out.splat.shape[3] / jax.nn.sigmoid(scene.params.logit_opacities)


@pytest.mark.parametrize("name", ["raw", "filter3d"])
def test_compensation_agrees(name, report):
    """Above the floor of 0.005; where the renderer does not limit the Jacobian."""
    scene, t, batch = given(), table(), cameras()
    if name == "filter3d":
        log_scales = jnp.asarray(np.log(t["scales_paper"]))
        scene = scene.replace(params=scene.params.replace(log_scales=log_scales))
    size, error, count = t["cam_wh"], 0.0, 0
    for index in range(len(size)):
        camera = jax.tree.map(lambda a, i=index: a[i], batch)
        mine = t["pair_camera"] == index
        slots, wanted = t["pair_gaussian"][mine], t[f"comp_{name}"][mine]
        point = t["means"][slots] @ t["cam_R"][index].T + t["cam_t"][index]
        pixel = np.stack(camera.project(tuple(point.T)), -1)
        inside = ((pixel >= 0) & (pixel <= size[index])).all(1)
        found = np.asarray(compensation(scene, camera))[slots[inside]]
        wanted = np.maximum(wanted[inside], 0.005)
        error, count = max(error, worst(found, wanted)), count + len(found)
    assert count > 500
    report(f"compensation, {name}, {count} pairs", error, BAR)
    assert error <= BAR


@jax.jit
def picture(scene, camera):
    return gsjax.render(scene, camera, MIP).rgb


def test_pictures_of_the_supersampled_truth(report):
    """At most half the error of the dilation at 1/4 and 1/8, and no more at 1."""
    t = table()
    scene = given("r_", t["r_colours"])
    width, height = int(t["r_width"]), int(t["r_height"])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = t["r_R"], t["r_t"]
    for scale in (1, 2, 4, 8):
        # One program for all sizes: the picture fills the upper left corner.
        K = np.diag([1 / scale, 1 / scale, 1]) @ t["r_K"]
        camera = gsjax.make_camera(viewmat=viewmat, K=K, width=width, height=height)
        rows, cols = height // scale, width // scale
        camera = camera.replace(visible_size=jnp.asarray([cols, rows]))
        found = np.asarray(picture(scene, camera))[:rows, :cols]
        # At 1/8 a splat reaches the floor of the compensation, 0.005.
        same = np.abs(found - t[f"r_mip01_{scale}"][..., :3]).max()
        assert same < (3e-4 if scale == 8 else 1e-6)
        error, before = (
            float(np.sqrt(np.mean((a - t[f"r_box_{scale}"])[..., :3] ** 2)))
            for a in (np.dstack([found, found[..., 0]]), t[f"r_dilate03_{scale}"])
        )
        limit, share = 0.5 if scale >= 4 else 1.0, error / before
        report(f"error at 1/{scale}, of that of the dilation", share, limit)
        assert share <= limit


def test_radii_through_other_lenses():
    """The inverse of the smaller stretch: of a fisheye, f / r, at any angle."""
    rng = np.random.default_rng(0)
    points = frustum_points(rng, 40) * rng.uniform(0.5, 3, (40, 1))
    K = np.asarray([[90.0, 0, 30], [0, 90, 20], [0, 0, 1]])
    active = jnp.arange(40) < 35
    for lens, coefficients in (
        ("opencv", [0.0] * 4),
        ("fisheye", [0.0] * 4),
    ):
        camera = gsjax.make_camera(
            viewmat=np.eye(4)[None], K=K, width=60, height=40, lens=lens,
            coefficients=coefficients,
        )  # fmt: skip
        found = np.asarray(radii_of(jnp.asarray(points), active, camera))
        depth = np.linalg.norm(points, axis=1) if lens == "fisheye" else points[:, 2]
        one = jax.tree.map(lambda a: a[0], camera)
        u, v = (np.asarray(a) for a in one.project(tuple(points.T)))
        seen = (u > -9) & (u < 69) & (v > -6) & (v < 46) & np.asarray(active)
        seen &= points[:, 2] > 0.2
        assert 3 < seen.sum() < 36
        wanted = np.sqrt(0.2) * depth / 90
        np.testing.assert_allclose(found[seen], wanted[seen], 1e-9)
        np.testing.assert_allclose(found[~seen], wanted[seen].max(), 1e-9)


def test_no_camera_sees_anything():
    away = gsjax.make_camera(viewmat=np.eye(4)[None], K=np.eye(3), width=4, height=4)
    found = radii_of(-jnp.ones((3, 3)), jnp.ones(3, bool), away)
    np.testing.assert_array_equal(found, 0)


def stretched(count=64) -> tuple[gsjax.Gaussians, jax.Array]:
    """Return Gaussians and radii of all sizes and opacities, one slot not active."""
    rng = np.random.default_rng(1)
    scene = gaussians_at(frustum_points(rng, count), 0.1, 0.5)
    params = scene.params.replace(
        log_scales=jnp.asarray(rng.uniform(-12, 3, (count, 3))),
        logit_opacities=jnp.asarray(rng.uniform(-17, 17, count)),
    )
    radii = np.exp(rng.uniform(-12, 3, count))
    radii[:5] = 0
    active = np.arange(count) != 7
    params = jax.tree.map(lambda a: a.at[7].set(jnp.nan), params)
    return gsjax.Gaussians(params=params, active=jnp.asarray(active)), radii


def test_smoothing_in_float32_and_of_files(tmp_path):
    """It is accurate in float32, and is what `read_ply` makes of a column filter_3D."""
    scene, radii = stretched()
    wide = smoothed(scene, jnp.asarray(radii)).params
    narrow = smoothed(*cast((scene, jnp.asarray(radii)), np.float32)).params
    kept = np.asarray(scene.active)
    for name, error in (("log_scales", 2e-6), ("logit_opacities", 1e-5)):
        found, wanted = (np.asarray(getattr(p, name)) for p in (narrow, wide))
        assert found.dtype == np.float32
        assert np.isnan(found[7]).all()
        np.testing.assert_allclose(found[kept], wanted[kept], error, error)
    write_ply(tmp_path / "a.ply", scene)
    lines = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    row = np.frombuffer(lines[1], np.uint8).reshape(kept.sum(), -1)
    column = radii[kept].astype("<f4")[:, None].view(np.uint8)
    lines[0] += b"property float filter_3D\nend_header\n"
    body = np.concatenate([row, column], 1).tobytes()
    (tmp_path / "b.ply").write_bytes(lines[0] + body)
    read = read_ply(tmp_path / "b.ply").params
    for name in ("log_scales", "logit_opacities"):
        wanted = np.asarray(getattr(wide, name))[kept]
        np.testing.assert_allclose(getattr(read, name), wanted, 1e-5, 1e-5)


def test_smoothing_has_exact_gradients():
    scene, radii = stretched()
    rng = np.random.default_rng(2)
    wide, faint = rng.normal(size=(64, 3)), rng.normal(size=64)

    @jax.jit
    def loss(params):
        out = smoothed(scene.replace(params=params), jnp.asarray(radii)).params
        each = jnp.sum(wide * out.log_scales, 1) + faint * out.logit_opacities
        return jnp.sum(jnp.where(scene.active, each, 0))

    grads = jax.grad(loss)(scene.params)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(grads))
    step = 1e-6
    for name in ("log_scales", "logit_opacities"):
        value = getattr(scene.params, name)
        for slot in (*range(8), 20, 40):
            index = (slot, 1)[: value.ndim]
            up, down = (
                loss(scene.params.replace(**{name: value.at[index].add(s)}))
                for s in (step, -step)
            )
            slope = float(getattr(grads, name)[index])
            assert abs(slope - (up - down) / (2 * step)) <= 1e-7 * max(1, abs(slope))


CONFIG = TrainConfig(
    steps=1000,
    sh_degree=0,
    strategy="mcmc",
    mcmc=McmcSettings(start=0, stop=500, every=70),
    levels=(Level(0.0, 2), Level(0.25, 1)),
    raster=RASTER,
    mip=True,
)


def test_radii_are_recomputed_on_schedule():
    """At first, after edits, at a new resolution, every 100 steps but the last 100."""
    due = np.flatnonzero(refresh_table(make_setup(CONFIG, EXTENT)))
    edits = range(70, 500, 70)
    assert {*due} == {0, 250, *edits, *range(100, 1000, 100)}
    plain = make_setup(CONFIG.replace(mip=False), EXTENT)
    assert not refresh_table(plain).any()
    assert make_stages(plain).refresh is None


def test_radii_follow_their_gaussians():
    """Copied by an edit, padded with the slots, and not trained."""
    setup = make_setup(CONFIG, EXTENT, strategy=clone_all(SLOTS))
    start = setup_state(setup, rough_start(0, SLOTS), VIEWS)
    radii = jnp.arange(1.0, SLOTS + 1)
    state = start.replace(model=start.model._replace(buffers={"radii": radii}))
    assert jax.tree.structure(state.slot_params.model).num_leaves == 0
    count = int(gsjax.num_active(state.gaussians))
    metrics = Metrics(*[jnp.int32(0)] * len(Metrics._fields))
    edited, _ = jax.jit(make_stages(setup).edit)(state, metrics)
    found = np.asarray(edited.model.buffers["radii"])
    np.testing.assert_array_equal(found[:count], radii[:count])
    np.testing.assert_array_equal(found[count : 2 * count], radii[: SLOTS - count])
    shown = shown_gaussians(edited, CONFIG).params
    wanted = smoothed(edited.gaussians, edited.model.buffers["radii"]).params
    np.testing.assert_array_equal(shown.log_scales, wanted.log_scales)


def test_settings():
    own = RasterConfig.accurate()
    config = TrainConfig(mip=True, raster=own)
    assert config.raster == own.replace(dilation=0.1, antialias=True)
    assert TrainConfig(mip=True).replace(mip=False) == TrainConfig()
    refined = TrainConfig(mip=True, refine_poses=True).raster
    assert refined == mip_raster(TrainConfig(refine_poses=True).raster)
    with pytest.raises(InputError, match="mip: expected False for surfels"):
        TrainConfig(mip=True, primitive="surfel")
    with pytest.raises(InputError, match=r"cameras=frames\.camera"):
        make_train_step(CONFIG, EXTENT)
    other = Model(*mip_model()[:2])
    with pytest.raises(InputError, match=r"expected None with TrainConfig\.mip"):
        make_setup(CONFIG, EXTENT, model=other)
    few = ModelParams(buffers={"radii": jnp.zeros(3)})
    wrong, plain = mip_model()._replace(init=lambda _: few), TrainConfig()
    with pytest.raises(InputError, match="expected buffers"):
        init_state(rough_start(0, SLOTS), plain, EXTENT, VIEWS, model=wrong)
