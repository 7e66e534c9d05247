"""Meshes of analytic depth images: a sphere, holes, colours, files, bad input."""

import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from gsjax.errors import CapacityError, InputError
from gsjax.mesh import (
    DepthImage,
    filled,
    fuse,
    is_watertight,
    largest,
    make_grid,
    make_unbounded_grid,
    read_mesh,
    simplified,
    surface_of,
    write_mesh,
)
from gsjax.mesh.surface import SUFFIXES, components
from gsjax.runs.mesh import sphere_cameras

RADIUS, CENTRE = 0.7, np.array([0.1, -0.05, 0.02])
SIZE, FOCAL, VIEWS = 160, 240.0, 26
BOX = CENTRE - 1, CENTRE + 1


def sphere_image(eye, **lens) -> DepthImage:
    """Return the depth of the sphere; colours are the world's normals."""
    viewmat = gsjax.look_at(eye, CENTRE)
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    camera = gsjax.make_camera(viewmat=viewmat, K=K, width=SIZE, height=SIZE, **lens)
    ys, xs = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = camera.lens.unproject(camera.K, camera.coefficients, (xs, ys))
    rays = np.stack([np.broadcast_to(r, xs.shape) for r in rays], -1)
    rays = (
        rays / np.asarray(camera.lens.depth(tuple(np.moveaxis(rays, -1, 0))))[..., None]
    )
    seen = viewmat[:3, :3] @ CENTRE + viewmat[:3, 3]
    square, along = np.sum(rays * rays, -1), rays @ seen
    left = along**2 - square * (seen @ seen - RADIUS**2)
    depth = np.where(left > 0, (along - np.sqrt(np.maximum(left, 0))) / square, 0)
    normals = (depth[..., None] * rays - seen) @ viewmat[:3, :3] / RADIUS
    colors = 0.5 + 0.5 * normals
    return DepthImage(camera, jnp.asarray(depth, jnp.float32), jnp.asarray(colors))


def eyes(count):
    place = np.arange(count) + 0.5
    down, around = np.arccos(1 - 2 * place / count), np.pi * (1 + 5**0.5) * place
    ways = [np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)]
    return CENTRE + 3 * np.stack(ways, -1)


@pytest.fixture(scope="module")
def field():
    images = (sphere_image(eye) for eye in eyes(VIEWS))
    return fuse(images, make_grid(*BOX, 64))


def euler(mesh) -> int:
    """Return the Euler characteristic of a watertight mesh."""
    return len(mesh.vertices) - len(mesh.faces) // 2


@pytest.mark.parametrize("closed", [False, True])
def test_a_sphere(field, closed, report):
    mesh = largest(surface_of(field, closed=closed), 1)
    radii = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    error = abs(radii.mean() - RADIUS) / field.grid.voxel
    report("radius, voxels", error, 0.2)
    assert error < 0.2
    assert np.abs(radii - RADIUS).max() < 0.5 * field.grid.voxel
    assert is_watertight(mesh)
    assert euler(mesh) == 2
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.sum(across * (corners.mean(1) - CENTRE), -1) > 0).all()
    wanted = 0.5 + 0.5 * (mesh.vertices - CENTRE) / radii[:, None]
    assert np.abs(mesh.colors - wanted).mean() < 0.05


def test_a_sphere_seen_from_one_side():
    """It is open, or a solid that reaches to the end of the box."""
    images = [sphere_image(CENTRE + (3.0, 0, 0)), sphere_image(CENTRE + (2.9, 0.5, 0))]
    field = fuse(images, make_grid(*BOX, 48))
    mesh = largest(surface_of(field), 1)
    assert not is_watertight(mesh)
    assert (mesh.vertices[:, 0] > CENTRE[0] - 0.2).all()
    solid = surface_of(field, closed=True)
    assert len(largest(solid, 1).faces) == len(solid.faces)
    assert is_watertight(solid)
    assert euler(solid) == 2
    assert solid.vertices[:, 0].min() < BOX[0][0] + 2 * field.grid.voxel


def test_unknown_depth_neither_fills_nor_frees():
    """A solid is free where images show nothing, not where depth is unknown."""
    (front,) = [sphere_image(CENTRE + (3.0, 0, 0))]
    side = sphere_image(CENTRE + (0, 3.0, 0))
    unknown = side._replace(depth=jnp.where(side.depth > 0, side.depth, jnp.nan))
    blank = side._replace(depth=0 * side.depth)
    count = {
        name: int(fuse([front, *more], make_grid(*BOX, 32)).inside.sum())
        for name, more in {"front": [], "blank": [blank], "nan": [unknown]}.items()
    }
    assert count["blank"] < 0.2 * count["front"]
    nothing = unknown._replace(depth=jnp.full_like(side.depth, jnp.nan))
    assert fuse([front, nothing], make_grid(*BOX, 32)).inside.sum() == count["front"]


def test_unbounded_space():
    """A sphere outside the fine cube: as accurate as the voxels there."""
    grid = make_unbounded_grid(CENTRE, 0.35, 64)
    inner = np.array([[21.5, 30.0, 40.0]])
    wanted = CENTRE + 0.35 * (grid.origin + grid.voxel * inner)
    np.testing.assert_allclose(grid.places(inner), wanted)
    field = fuse((sphere_image(eye) for eye in eyes(14)), grid)
    mesh = largest(surface_of(field), 1)
    radii = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    stretch = 0.35 * (RADIUS / 0.35) ** 2
    assert abs(radii.mean() - RADIUS) < 0.2 * grid.voxel * stretch
    assert is_watertight(mesh)
    assert euler(mesh) == 2
    far = grid.places(np.array([[63.0, 32.0, 32.0]]))[0, 0]
    assert far == pytest.approx(CENTRE[0] + 0.35 / (0.5 * grid.voxel))


def test_holes_and_fewer_triangles(field):
    """Both keep the sphere; colours follow the nearest vertex."""
    whole = surface_of(field)
    top = whole.vertices[whole.faces].mean(1)[:, 2] > CENTRE[2] + 0.9 * RADIUS
    torn = whole._replace(faces=whole.faces[~top])
    assert not is_watertight(torn)
    mended = filled(torn)
    assert is_watertight(mended)
    assert len(mended.vertices) == len(mended.colors) == len(whole.vertices) + 1
    assert filled(whole) is whole
    few = simplified(whole, 1000)
    assert 900 <= len(few.faces) <= 1000
    assert is_watertight(few)
    radii = np.linalg.norm(few.vertices - CENTRE, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.5 * field.grid.voxel
    wanted = 0.5 + 0.5 * (few.vertices - CENTRE) / radii[:, None]
    assert np.abs(few.colors - wanted).mean() < 0.05
    assert simplified(few, 10**6) is few


def test_cameras_on_a_sphere_see_the_box():
    low, high = np.array([0.0, -1, 2]), np.array([1.0, 3, 2.5])
    corners = np.array(np.meshgrid(*np.stack([low, high], -1))).reshape(3, -1)
    for camera in sphere_cameras(low, high, 9):
        local = np.asarray(camera.viewmat[:3, :3]) @ corners
        u, v = camera.project(tuple(local + np.asarray(camera.viewmat[:3, 3:])))
        assert ((u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)).all()


def test_depth_by_distance():
    """A fisheye measures along the ray."""
    lens = {"lens": "fisheye", "coefficients": [0.0] * 4}
    images = [sphere_image(eye, **lens) for eye in eyes(6)]
    mesh = largest(surface_of(fuse(images, make_grid(*BOX, 48))), 1)
    radii = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    assert abs(radii.mean() - RADIUS) < 0.2 * 2 / 48


def test_parts_are_sorted_by_size(field):
    one = surface_of(field)
    more = one._replace(
        vertices=np.concatenate([one.vertices, one.vertices[:3] + 5]),
        faces=np.concatenate([[[len(one.vertices) + i for i in range(3)]], one.faces]),
        colors=None,
    )
    parts = components(more)
    assert parts[0] == 1
    assert (parts[1:] == 0).all()
    assert len(largest(more, 1).vertices) == len(one.vertices)
    assert not is_watertight(more)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files(field, suffix, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh, path = surface_of(field), tmp_path / f"mesh{suffix}"
    write_mesh(path, mesh)
    read = trimesh.load(path, force="mesh")
    assert read.faces.shape == mesh.faces.shape
    again = read_mesh(path)
    assert len(again.faces) == len(mesh.faces)
    if suffix != ".stl":
        np.testing.assert_allclose(again.colors, mesh.colors, atol=0.003)
    assert read.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    with pytest.raises(InputError, match="exists"):
        write_mesh(path, mesh)


def test_bad_input(field, tmp_path):
    with pytest.raises(InputError, match=r"low < high.*pass a box"):
        make_grid([0, 0, 0], [1, 0, 1], 64)
    with pytest.raises(InputError, match="8 to 4096"):
        make_grid([0, 0, 0], [1, 1, 1], 4)
    with pytest.raises(InputError, match="no depth image"):
        fuse([], make_grid(*BOX, 16))
    blank = sphere_image(eyes(1)[0])
    blank = blank._replace(depth=0 * blank.depth)
    with pytest.raises(InputError, match="no depth image"):
        fuse([blank], make_grid(*BOX, 16))
    with pytest.raises(CapacityError, match=r"4096 × 4096.*lower the resolution"):
        fuse([blank], make_grid(*BOX, 4096))
    with pytest.raises(InputError, match="no surface"):
        surface_of(field._replace(distance=jnp.ones_like(field.distance)))
    with pytest.raises(InputError, match="not read as a mesh"):
        read_mesh(tmp_path / "none.ply")
    with pytest.raises(InputError, match=r"\.glb"):
        write_mesh(tmp_path / "mesh.xyz", surface_of(field))
