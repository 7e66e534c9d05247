"""Claim: surfels give meshes at most half as far from the true surface as ellipsoids.

``python benchmarks/geometry.py`` ray casts 40 photographs of the still life of
`gsjax demo`, trains ellipsoids and surfels on 35 of them (``--steps``, ``--seeds``),
and fuses the depth of those 35 views to meshes. Each mesh is compared with the surface
that the ray caster knows, in both directions:

- mesh to truth: mean distance from points drawn evenly on the mesh to the solids;
- truth to mesh: mean distance from points of the solids in photographs, thinned
  to one in each cube of 0.01, to the mesh;
- F-score: of the shares of both that are within 0.5 % of the diagonal of the scene;
- normals: median angle between those of the mesh and of the solids.

PSNR is that of the five held-out photographs.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import NamedTuple

import as_cli  # noqa: F401
import measure
import numpy as np
import trimesh
from lens_training import SIZE, Capture, held_out, photograph, train
from scipy.spatial import KDTree

import gsjax
from gsjax.data.splits import split_views
from gsjax.mesh import Mesh
from gsjax.runs.demo import demo_config
from gsjax.runs.mesh import MeshSettings, mesh_of_scene
from gsjax.synthetic import raycaster
from gsjax.synthetic.optics import Optics

SAMPLES, CELL, NEAR = 200_000, 0.01, 0.005
TRUNCATION = 6.0  # voxels; the default of 4 leaves more of the error of the depth
SURFELS = {"primitive": "surfel", "normal_weight": 0.05, "distortion_weight": 0.0}


class Way(NamedTuple):
    """A way to a mesh.

    Attributes:
      training: fields of `TrainConfig`.
      depth: "expected" or "median".
      ray_depth: see `RasterConfig`.
    """

    training: dict
    depth: str = "median"
    ray_depth: bool = False


WAYS = {
    "ellipsoids, expected depth": Way({}, "expected"),
    "ellipsoids, expected depth along rays": Way({}, "expected", ray_depth=True),
    "ellipsoids, median depth along rays": Way({}, ray_depth=True),
    "surfels without losses": Way(SURFELS | {"normal_weight": 0.0}),
    "surfels": Way(SURFELS),
}


class Surface(NamedTuple):
    """Points [M, 3] of a mesh, their triangles [M] and normals [M, 3]."""

    points: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray


def drawn(mesh: Mesh, count: int = SAMPLES) -> Surface:
    """Draw points evenly on a mesh."""
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    rng = np.random.default_rng(0)
    which = rng.choice(len(area), count, p=area / area.sum())
    first, second = rng.uniform(size=(2, count, 1))
    first = np.sqrt(first)
    weights = np.stack([1 - first, first * (1 - second), first * second], 1)
    points = np.sum(weights * corners[which], axis=1)
    normals = across[which] / np.maximum(area[which], 1e-30)[:, None]
    return Surface(points, which, normals)


def to_mesh(points: np.ndarray, mesh: Mesh, drawn: Surface) -> np.ndarray:
    """Return distances [M] to the triangles of the nearest points drawn on a mesh."""
    near = np.asarray(KDTree(drawn.points).query(points, 4)[1])
    corners = mesh.vertices[mesh.faces[drawn.triangles[near]]].reshape(-1, 3, 3)
    many = np.repeat(points, 4, axis=0)
    closest = trimesh.triangles.closest_point(corners, many)
    return np.linalg.norm(closest - many, axis=1).reshape(len(points), -1).min(1)


def to_truth(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [M] to the solids, and normals [M, 3] of the nearest ones."""
    nearest, normals = np.full(len(points), np.inf), np.zeros_like(points)
    for solid in raycaster.solids():
        local = solid.local(points.T)
        distance = np.abs(solid.shape.distance(local))
        mine = distance < nearest
        nearest[mine] = distance[mine]
        normals[mine] = (solid.axes @ solid.shape.normal(local[:, mine])).T
    return nearest, normals


def seen(capture: Capture) -> np.ndarray:
    """Return points [M, 3] of the solids in the photographs, evenly thinned."""
    points = []
    for viewmat, optics in zip(capture.viewmats, capture.optics):
        _, depth = raycaster.cast(viewmat, capture.K, *SIZE, 1, optics=optics)
        v, u = np.nonzero(depth)
        pixels = np.stack([u + 0.5, v + 0.5, np.ones(len(u))])
        local = np.linalg.inv(capture.K) @ pixels * depth[v, u]
        points.append((local.T - viewmat[:3, 3]) @ viewmat[:3, :3])
    points = np.concatenate(points)
    _, first = np.unique(np.floor(points / CELL), axis=0, return_index=True)
    return points[first]


def scores(mesh: Mesh, truth: np.ndarray) -> dict:
    """Compare a mesh with the truth."""
    ours = drawn(mesh)
    forth, normals = to_truth(ours.points)
    back = to_mesh(truth, mesh, ours)
    limit = NEAR * np.linalg.norm(np.ptp(truth, axis=0))
    precision, recall = np.mean(forth < limit), np.mean(back < limit)
    cosine = np.clip(np.sum(ours.normals * normals, -1), -1, 1)
    return {
        "mesh to truth": forth.mean(),
        "truth to mesh": back.mean(),
        "F-score": 2 * precision * recall / max(precision + recall, 1e-9),
        "normals, degrees": np.degrees(np.median(np.arccos(cosine))),
        "triangles": len(mesh.faces),
    }


def rows_of(capture: Capture, steps: int, seed: int, ways: dict[str, Way]) -> list:
    """Return the results of one seed."""
    dataset, photos = capture.dataset(seed=seed)
    chosen, _ = split_views(dataset.views)
    truth, rows, trained = seen(capture), [], {}
    cameras = [
        gsjax.make_camera(
            viewmat=dataset.views[i].viewmat,
            K=photos[i].K,
            width=SIZE[0],
            height=SIZE[1],
        )
        for i in chosen
    ]
    for name, way in ways.items():
        key = tuple(way.training.items())
        if key not in trained:
            config = demo_config(steps, seed).replace(**way.training)
            begun = time.perf_counter()
            result = train(dataset, photos, config)
            seconds = time.perf_counter() - begun
            psnr = held_out(result, dataset, photos, config).psnr
            trained[key] = result.gaussians, config.raster, psnr, seconds
        gaussians, raster, psnr, seconds = trained[key]
        raster = raster.replace(ray_depth=way.ray_depth)
        mesh = mesh_of_scene(
            gaussians,
            cameras,
            raster,
            MeshSettings(depth=way.depth, truncation=TRUNCATION),
        ).mesh
        found = scores(mesh._replace(vertices=mesh.vertices + dataset.origin), truth)
        row = {"mesh of": name, "seed": seed, **found, "psnr": psnr}
        rows.append({**row, "seconds of training": seconds})
        print(rows[-1], file=sys.stderr)
    return rows


def main(steps: int, seeds: int) -> None:
    """Measure and save."""
    capture = photograph(Optics())
    rows = [r for seed in range(seeds) for r in rows_of(capture, steps, seed, WAYS)]
    measure.save("geometry", rows, claim=__doc__, steps=steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args()
    main(given.steps, given.seeds)
