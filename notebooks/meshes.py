# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From photographs to a printable file
#
# Four commands lead from a folder of photographs to a file for a 3D printer:
#
# ```sh
# gsjax sfm photos -o dataset
# gsjax train dataset -o run --primitive surfel
# gsjax mesh run -o print.stl --closed --triangles 200000
# gsjax view run --mesh
# ```
#
# `sfm` finds the cameras, `train` fits surfels (2D Gaussian splatting), `mesh` fuses
# the depth of the views to a watertight solid, and `view` shows a mesh that was written
# without `-o`. This notebook takes training and mesh in memory, on photographs of a
# still life that are computed, so that depth and normals can be compared with the
# truth. It takes about a minute on two cores.

# %%
import tempfile
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gsjax
from gsjax.mesh import is_watertight, simplified, write_mesh
from gsjax.runs.demo import demo_config
from gsjax.runs.mesh import MeshSettings, mesh_of_scene
from gsjax.synthetic import raycaster
from gsjax.train.geometry_loss import normals_of_depth

WIDTH, HEIGHT, PHOTOS = 112, 84, 24

viewmats, K = raycaster.demo_cameras(PHOTOS, WIDTH, HEIGHT)
pairs = [raycaster.cast(viewmat, K, WIDTH, HEIGHT, 2) for viewmat in viewmats]
cameras = [
    gsjax.make_camera(viewmat=viewmat, K=K, width=WIDTH, height=HEIGHT)
    for viewmat in viewmats
]
dataset, photos = gsjax.make_dataset(
    [rgb for rgb, _ in pairs],
    gsjax.stack_cameras(cameras),
    *raycaster.surface_points(3000),
)

# %% [markdown]
# ## Surfels
#
# A surfel is a Gaussian without thickness: its first two axes span a plane, and a pixel
# meets it where its ray meets that plane. So each surfel has a normal, and a depth that
# is right at each of its pixels. `normal_weight` pulls the normals of the surfels to
# those of the depth image, which lays neighbours in one plane.

# %%
config = demo_config(steps=200).replace(primitive="surfel", normal_weight=0.05)
result = gsjax.fit(dataset, photos, config)
scene = result.gaussians

# %% [markdown]
# ## Depth and normals of a view
#
# `outputs` lists what the compiled program computes. `median_depth` is where half of
# the light has been blocked; `normals` are sums over the surfels of a pixel, in camera
# coordinates. The last picture is the angle between them and the normals of the true
# depth.

# %%
raster = config.raster.replace(outputs=("rgb", "alpha", "median_depth", "normals"))
camera, (rgb, truth) = cameras[3], pairs[3]
origin = dataset.origin
moved = [
    c.replace(viewmat=c.viewmat.at[:3, 3].add(c.viewmat[:3, :3] @ jnp.asarray(origin)))
    for c in cameras
]
view = gsjax.render_exact(scene, moved[3], raster)
true_normals = np.asarray(normals_of_depth(jnp.asarray(truth), camera))
there = (np.abs(true_normals).sum(-1) > 0) & (np.asarray(view.alpha) > 0.5)
ours = np.asarray(view.normals)
ours = ours / np.maximum(np.linalg.norm(ours, axis=-1, keepdims=True), 1e-6)
angle = np.degrees(np.arccos(np.clip(np.sum(ours * true_normals, -1), -1, 1)))
error = np.abs(np.asarray(view.median_depth) - truth)[there]
print(f"median error of depth: {np.median(error / truth[there]):.2%} of the distance")
print(f"median error of normals: {np.median(angle[there]):.1f} degrees")

figure, axes = plt.subplots(1, 4, figsize=(12, 2.6))
hit = np.asarray(view.alpha) > 0.5
depth = np.where(hit, view.median_depth, np.nan)
wrong = np.where(there, np.minimum(angle, 45), np.nan)
shown = view.rgb, depth, 0.5 - 0.5 * ours, wrong
titles = "render", "median depth", "normals", "error of normals, degrees"
for axis, image, title in zip(axes, shown, titles):
    drawn = axis.imshow(np.clip(image, 0, 1) if np.ndim(image) == 3 else image)
    axis.set_title(title)
    axis.axis("off")
figure.colorbar(drawn, ax=axes, shrink=0.8)
plt.show()

# %% [markdown]
# ## The mesh
#
# Each view's depth says of each voxel how far it is before or behind the surface.
# `gsjax.mesh.fuse` averages these distances, and marching cubes finds where the average
# is zero. With `closed`, all that lies behind a surface in the views is filled, down to
# the end of the box: the still life stands on a slab, ready to print.

# %%
box = np.array([-2.2, -2.2, -0.15]) - origin, np.array([2.2, 2.2, 1.4]) - origin
settings = MeshSettings(resolution=112, box=box, closed=True)
report = mesh_of_scene(scene, moved, config.raster, settings)
mesh = simplified(report.mesh, 12_000)
mesh = mesh._replace(vertices=mesh.vertices + origin)
print(f"{len(mesh.faces):,} triangles of {len(report.mesh.faces):,}")
print("watertight:", is_watertight(mesh))
path = Path(tempfile.mkdtemp()) / "print.stl"
write_mesh(path, mesh)
print(f"{path.name}: {path.stat().st_size / 2**20:.1f} MiB")

# %% [markdown]
# The distance from the true solids is below a voxel. It is largest where no photograph
# looks: under the torus and beside the slab, which are not counted here.

# %%
top = mesh.vertices[mesh.vertices[:, 2] > 0.2]
distance = np.min(
    [
        np.abs(solid.shape.distance(solid.local(top.T)))
        for solid in raycaster.solids()[1:]
    ],
    axis=0,
)
print(f"voxel: {report.voxel:.3f}, median distance: {np.median(distance):.3f}")

# %%
light = np.array([0.5, -0.4, 0.75])
corners = mesh.vertices[mesh.faces]
normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
length = np.linalg.norm(normals, axis=1, keepdims=True)
shade = 0.35 + 0.65 * np.clip((normals / np.maximum(length, 1e-12)) @ light, 0, 1)
colors = mesh.colors[mesh.faces].mean(1) * shade[:, None]

figure = plt.figure(figsize=(12, 4.5))
for index, (turn, look) in enumerate([(-55, 25), (35, 25), (-55, -30)]):
    axis = figure.add_subplot(1, 3, index + 1, projection="3d")
    axis.plot_trisurf(
        *mesh.vertices.T, triangles=mesh.faces, linewidth=0, antialiased=False
    ).set_facecolor(colors)
    axis.view_init(look, turn)
    axis.set_box_aspect(np.ptp(mesh.vertices, axis=0), zoom=1.5)
    axis.set_axis_off()
plt.show()
