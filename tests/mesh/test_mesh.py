"""Meshes of analytic depth images: a sphere, holes, colours, files, bad input."""

import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from gsjax.errors import CapacityError, InputError
from gsjax.mesh.fusion import DepthImage, fuse, make_grid
from gsjax.mesh.surface import (
    SUFFIXES,
    components,
    is_watertight,
    largest,
    surface_of,
    write_mesh,
)

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


@pytest.mark.parametrize("closed", [False, True])
def test_a_sphere(field, closed, report):
    mesh = largest(surface_of(field, closed=closed), 1)
    radii = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    error = abs(radii.mean() - RADIUS) / field.grid.voxel
    report("radius, voxels", error, 0.2)
    assert error < 0.2
    assert np.abs(radii - RADIUS).max() < 0.5 * field.grid.voxel
    assert is_watertight(mesh)
    edges = 3 * len(mesh.faces) // 2
    assert len(mesh.vertices) - edges + len(mesh.faces) == 2
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.sum(across * (corners.mean(1) - CENTRE), -1) > 0).all()
    wanted = 0.5 + 0.5 * (mesh.vertices - CENTRE) / radii[:, None]
    assert np.abs(mesh.colors - wanted).mean() < 0.05


def test_a_sphere_seen_from_one_side_is_open():
    images = [sphere_image(CENTRE + (3.0, 0, 0)), sphere_image(CENTRE + (2.9, 0.5, 0))]
    mesh = largest(surface_of(fuse(images, make_grid(*BOX, 48))), 1)
    assert not is_watertight(mesh)
    assert (mesh.vertices[:, 0] > CENTRE[0] - 0.2).all()


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
    with pytest.raises(InputError, match=r"\.glb"):
        write_mesh(tmp_path / "mesh.xyz", surface_of(field))
