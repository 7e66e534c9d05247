"""Ray-cast photographs against geometry computed without the ray caster."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from gsjax.cameras.camera import with_shutter
from gsjax.cameras.distortion import Distortion, project_points
from gsjax.cameras.shutter import exposed_at, moment_at
from gsjax.data.photos import load_photo
from gsjax.synthetic import raycaster
from gsjax.synthetic.moving import moving_solids
from gsjax.synthetic.optics import Optics, exposures, local_rays
from gsjax.synthetic.raycaster import DemoDatasetSettings
from gsjax.synthetic.shapes import box, disc, sphere, torus
from gsjax.synthetic.still_life import GROUND_RADIUS

SIZE = 96, 72


def photograph(index=0, samples=2, size=SIZE, **kwargs):
    """Return (rgb, depth, viewmat, K) of one of eight cameras."""
    viewmats, K = raycaster.demo_cameras(8, *size)
    rgb, depth = raycaster.cast(viewmats[index], K, *size, samples, **kwargs)
    return rgb, depth, viewmats[index], K


def unproject(depth, viewmat, K):
    """Return the world points [H, W, 3] of a depth map."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    local = np.stack([u * depth, v * depth, depth], -1) @ np.linalg.inv(K).T
    whole = np.concatenate([local, np.ones_like(depth)[..., None]], -1)
    return (whole @ np.linalg.inv(viewmat).T)[..., :3]


@pytest.mark.parametrize("index", [0, 6])
def test_depth_matches_the_plane_and_the_sphere(index):
    _, depth, viewmat, K = photograph(index)
    points = unproject(depth, viewmat, K)
    found = depth > 0
    floor = found & (points[..., 2] < 1e-3)
    ball = raycaster.solids()[1]
    to_ball = np.linalg.norm(points - ball.centre, axis=-1)
    on_ball = found & (np.abs(to_ball - ball.shape.reach) < 1e-3)
    assert floor.sum() > 500
    assert on_ball.sum() > 100
    np.testing.assert_allclose(points[floor][:, 2], 0, atol=1e-9)
    np.testing.assert_allclose(to_ball[on_ball], ball.shape.reach, atol=1e-9)
    # The first of the two intersections faces the camera.
    eye = np.linalg.inv(viewmat)[:3, 3]
    outward = points[on_ball] - ball.centre
    assert ((eye - points[on_ball]) * outward).sum(-1).min() > -1e-9
    assert points[found][:, 2].min() > -1e-9


def test_background_beyond_the_disc():
    background = (0.1, 0.6, 0.3)
    rgb, depth, viewmat, K = photograph(5, background=background)
    plane = unproject(np.ones_like(depth), viewmat, K)
    eye = np.linalg.inv(viewmat)[:3, 3]
    along = plane - eye
    ground = eye + along * (-eye[2] / along[..., 2])[..., None]
    beyond = np.hypot(ground[..., 0], ground[..., 1]) > GROUND_RADIUS
    assert not (depth[~beyond] == 0).any()
    empty = (depth == 0) & (cv2.erode((depth == 0).astype(np.uint8), np.ones((3, 3))))
    assert empty.mean() > 0.2
    # Eroded: a pixel at the edge has a share of the floor.
    np.testing.assert_allclose(rgb[empty > 0] - background, 0, atol=1e-6)


def test_samples_are_the_pixels_of_larger_photographs():
    """Colours are in range, and the same in each call."""
    half = photograph(1, samples=2, size=(48, 36))[0]
    full = photograph(1, samples=1, size=(96, 72))[0]
    mean = full.reshape(36, 2, 48, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(half, mean, atol=2e-5)
    assert full.dtype == np.float32
    assert 0 <= full.min() < full.max() <= 1
    assert (full.max(axis=-1) > 0.3).mean() > 0.25
    np.testing.assert_array_equal(photograph(1, samples=1)[0], full)
    with pytest.raises(gsjax.InputError, match="at least 1"):
        photograph(0, samples=0)


LENSES = {
    "opencv": (-0.25, 0.06, 0.001, -0.001),
    "fisheye": (0.05, -0.01, 0.002, 0.001),
}
TWIST = np.array([0.05, -0.04, 0.03, 0.1, -0.05, 0.02])


@pytest.mark.parametrize("lens", LENSES)
def test_rays_through_lenses_match_the_renderer(lens):
    _, K = raycaster.demo_cameras(8, *SIZE)
    u, v = (a.ravel() for a in np.meshgrid(*(np.linspace(0, n, 9) for n in SIZE)))
    rays = local_rays(Optics(lens, LENSES[lens]), K, u, v)
    pixels, _, seen = project_points(Distortion(lens, LENSES[lens]), K, rays.T)
    assert seen.all()
    np.testing.assert_allclose(pixels, np.stack([u, v], -1), atol=1e-6)


@pytest.mark.parametrize("shutter", ["top_to_bottom", "right_to_left"])
def test_rolling_photograph_is_made_of_still_ones(shutter):
    width, height = size = 8, 6
    viewmats, K = raycaster.demo_cameras(8, *size)
    optics = Optics("opencv", LENSES["opencv"], shutter, TWIST)
    still = optics._replace(shutter="global")
    rgb, depth = raycaster.cast(viewmats[2], K, *size, 1, optics=optics)
    u, v = (a.ravel() + 0.5 for a in np.meshgrid(*map(np.arange, size)))
    camera = gsjax.make_camera(viewmat=viewmats[2], K=K, width=width, height=height)
    camera = with_shutter(camera, shutter, twist=TWIST)
    times = set()
    for pose, rays in exposures(optics, viewmats[2], size, u, v):
        expected, far = raycaster.cast(pose, K, *size, 1, optics=still)
        lines = rgb.reshape(-1, 3)[rays], expected.reshape(-1, 3)[rays]
        np.testing.assert_allclose(*lines, atol=1e-5)
        np.testing.assert_allclose(depth.ravel()[rays], far.ravel()[rays], rtol=1e-9)
        of_row, of_column = v[rays] / height, 1 - u[rays] / width
        time = (of_row if shutter == "top_to_bottom" else of_column)[0]
        point = (0.3, -0.2, 0.5)
        seen = exposed_at(camera, point, moment_at(camera, jnp.float32(time)))
        np.testing.assert_allclose(seen, pose[:3] @ (*point, 1), atol=1e-5)
        times.add(time)
    assert len(times) == (height if shutter == "top_to_bottom" else width)


def test_optics_that_cannot_be_cast_are_rejected():
    viewmats, K = raycaster.demo_cameras(8, *SIZE)
    cases = {
        "lens": Optics("orthographic"),
        "shutter": Optics(shutter="top_to_bottom"),
        "fold": Optics("opencv", (-3.0, 0, 0, 0)),
        "180": Optics("fisheye", (-0.9, 0, 0, 0)),
    }
    for match, optics in cases.items():
        with pytest.raises(gsjax.InputError, match=match):
            raycaster.cast(viewmats[0], K, *SIZE, 1, optics=optics)


def test_points_lie_on_visible_surfaces():
    points, colors = raycaster.surface_points(800, seed=3)
    assert points.shape == colors.shape == (800, 3)
    assert colors.dtype == np.uint8
    nearest = np.min(
        [np.abs(s.shape.distance(s.local(points.T))) for s in raycaster.solids()],
        axis=0,
    )
    assert nearest.max() < 0.02  # five times the noise
    assert 0.001 < nearest.mean() < 0.006
    rgb, depth, viewmat, K = photograph(6, size=(320, 240), samples=1)
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    u, v = ((local @ K.T)[:, :2] / local[:, 2:]).astype(int).T
    inside = (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
    u, v, z = u[inside], v[inside], local[inside, 2]
    gap = z - depth[v, u]
    seen = np.abs(gap) < 0.05
    assert seen.mean() > 0.5
    assert (gap > -0.05).mean() > 0.97  # no point floats in front of a surface
    off = rgb[v, u][seen] - colors[inside][seen] / 255
    assert np.median(np.abs(off)) < 0.02  # all surfaces are diffuse


SHAPES = {
    "sphere": sphere(0.7),
    "box": box((0.5, 0.3, 0.6)),
    "torus": torus(0.6, 0.2),
    "disc": disc(0.8),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_hits_are_the_first_on_the_surface(name, dtype):
    """The signed distance is sampled along each ray, independently of the hit."""
    shape = SHAPES[name]
    rng = np.random.default_rng(0)
    origin = np.asarray([1.4, -1.1, 0.9], dtype)
    aims = rng.uniform(-0.8, 0.8, (3, 400)).astype(dtype)
    directions = (aims - origin[:, None]) * dtype(0.4)
    t = shape.hit(origin, directions)
    hit = np.isfinite(t)
    assert t.dtype == dtype
    assert 60 < hit.sum() < 390
    at = origin[:, None] + t[hit] * directions[:, hit]
    assert np.abs(shape.distance(at)).max() < 1e-5
    normals = shape.normal(at)
    np.testing.assert_allclose((normals**2).sum(axis=0), 1, atol=1e-5)
    step = 1e-2
    rise = shape.distance(at + dtype(step) * normals)
    np.testing.assert_allclose(rise, step, atol=2e-5)
    for share in np.linspace(0, 0.995, 40):
        before = shape.distance(origin[:, None] + share * t[hit] * directions[:, hit])
        assert before.min() > 0
    if name != "disc":
        for past in np.linspace(0, 6, 120):
            missed = origin[:, None] + past * directions[:, ~hit]
            assert shape.distance(missed).min() > -1e-3


def test_rays_from_inside_hit_the_surface():
    origin = np.zeros(3)
    directions = np.eye(3)
    np.testing.assert_allclose(sphere(0.7).hit(origin, directions), 0.7)
    half = (0.5, 0.3, 0.6)
    np.testing.assert_allclose(box(half).hit(origin, directions), half)
    found = torus(0.6, 0.2).hit(origin, directions)
    np.testing.assert_allclose(found, [0.4, 0.4, np.inf], atol=1e-5)


def test_dataset_files_round_trip(tmp_path):
    settings = DemoDatasetSettings(photos=6, width=64, height=48, points=200)
    raycaster.write_demo_dataset(tmp_path / "set", settings)
    found = gsjax.load_dataset(tmp_path / "set")
    viewmats, K = raycaster.demo_cameras(6, 64, 48)
    for view, viewmat in zip(found.views, viewmats, strict=True):
        np.testing.assert_allclose(view.viewmat, viewmat, atol=1e-6)
        np.testing.assert_allclose(view.K, K, rtol=1e-6)
    rgb, _ = raycaster.cast(viewmats[4], K, 64, 48, 2)
    pixels = load_photo(found.views[4]).pixels
    np.testing.assert_allclose(pixels / 255, rgb, atol=0.6 / 255)
    points, colors = raycaster.surface_points(200)
    np.testing.assert_allclose(found.points, points, atol=1e-6)
    np.testing.assert_array_equal(found.colors, colors)
    with pytest.raises(gsjax.InputError, match="exists"):
        raycaster.write_demo_dataset(tmp_path / "set", settings)
    raycaster.write_demo_dataset(tmp_path / "set", settings, overwrite=True)


@pytest.mark.parametrize("turn", [0.05, 0.6, 0.7, 3.0])  # a series up to 2 / 3
def test_a_camera_turns_by_its_twist(turn):
    from scipy.spatial.transform import Rotation

    twist = np.array([0.6, -0.64, 0.48, 0, 0, 0]) * turn
    camera = gsjax.make_camera(viewmat=np.eye(4), K=np.eye(3), width=8, height=8)
    camera = with_shutter(camera, "top_to_bottom", twist=twist)
    point = np.array([0.3, -0.2, 0.5])
    for time in (-0.5, 0.4, 1.5):
        seen = exposed_at(camera, tuple(point), moment_at(camera, jnp.float32(time)))
        wanted = Rotation.from_rotvec(time * twist[:3]).apply(point)
        np.testing.assert_allclose(seen, wanted, atol=1e-6)


def test_the_moving_still_life_begins_as_the_still_one():
    """But for the ball, which is elsewhere; and the lid turns about its edge."""
    floor, globe, crate, ring, ball = raycaster.solids()
    begun = moving_solids(0.0)
    viewmats, K = raycaster.demo_cameras(8, *SIZE)
    scene = floor, globe, crate, ring, ball._replace(centre=begun[-1].centre)
    for viewmat in viewmats[::3]:
        rgb, depth = raycaster.cast(viewmat, K, *SIZE, 2, scene=scene)
        found, other = raycaster.cast(viewmat, K, *SIZE, 2, scene=begun)
        np.testing.assert_allclose(other, depth, atol=1e-6)
        # The parts of the crate shade one another a little.
        assert np.abs(found - rgb).mean() < 0.01
    half = float(crate.centre[2])
    for time in (0.0, 0.4, 1.0):
        lid = moving_solids(time)[3]
        closed = begun[3]
        hinge = closed.centre + closed.axes @ np.asarray([0.2, half, -0.06])
        below = lid.centre + lid.axes @ np.asarray([0.2, half, -0.06])
        np.testing.assert_allclose(below, hinge, atol=1e-12)
    up = moving_solids(1.0)[3].axes[:, 2]
    np.testing.assert_allclose(up[2], np.cos(np.radians(75)), atol=1e-12)
    path = np.stack([moving_solids(t)[-1].centre for t in np.linspace(0, 1, 9)])
    assert (np.diff(path[:, 0]) > 0).all()
    turned = begun[4].axes.T @ moving_solids(1.0)[4].axes
    np.testing.assert_allclose((np.trace(turned) - 1) / 2, np.cos(np.radians(150)))
