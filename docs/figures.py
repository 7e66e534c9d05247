"""Draw the pictures of these pages: ``python -P docs/figures.py``.

``python -P docs/figures.py MESH X Y Z`` draws a mesh, with (X, Y, Z) upwards, and
``python -P docs/figures.py FOLDER`` the scenes that ``benchmarks/mip.py --keep FOLDER``
has trained.
"""

import sys
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.bench import popping
from gsjax.bench.popping import turned
from gsjax.cameras.lenses import panorama_intrinsics
from gsjax.io import images
from gsjax.math.sh import rgb_to_dc
from gsjax.mesh import read_mesh
from gsjax.plots import figures
from gsjax.plots.contact_sheets import depth_colors
from gsjax.raster.lists import binning
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Inputs
from gsjax.runs.scene_source import file_raster
from gsjax.synthetic import raycaster
from gsjax.synthetic.torus_knot import torus_knot_scene

ASSETS = Path(__file__).parent / "assets"
INK = "#464a52"


def write(name: str, rgb: np.ndarray) -> None:
    """Write RGB [H, W, 3] in [0, 1] as a .webp."""
    pixels = np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)[..., ::-1]
    quality = [cv2.IMWRITE_WEBP_QUALITY, 82]
    _, encoded = cv2.imencode(".webp", pixels, quality)
    (ASSETS / name).write_bytes(encoded.tobytes())


def knot() -> None:
    """Draw the torus knot beside its depth."""
    scene = torus_knot_scene(count=20_000, frames=48, width=560, height=420)
    behind = np.asarray(scene.background)
    view = gsjax.render_exact(scene.gaussians, scene.cameras[4], background=behind)
    depth = depth_colors(np.asarray(view.depth))[0] / 255
    alpha = np.asarray(view.alpha)[..., None]
    depth = depth * alpha + behind * (1 - alpha)
    write("knot.webp", np.concatenate([np.asarray(view.rgb), depth], axis=1))


def mesh(path: Path, up: list[float]) -> None:
    """Draw a mesh from five sides, as points under a light of the viewer."""
    given = read_mesh(path)
    assert given.colors is not None
    turn, _ = Rotation.align_vectors([[0, 0, 1]], [up])
    corners = turn.apply(given.vertices - given.vertices.mean(0))[given.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    rng = np.random.default_rng(0)
    which = rng.choice(len(area), 4_000_000, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), len(which))[..., None]
    points = np.sum(weights * corners[which], 1)
    colors = np.sum(weights * given.colors[given.faces[which]], 1)
    normals = across[which] / area[which, None]
    pages, size = [], 560
    for azimuth in np.radians(72) * np.arange(5):
        view = Rotation.from_euler("zx", [-azimuth, np.radians(-55)]).as_matrix()
        x, y, z = view @ points.T  # z towards the viewer
        scale = size / np.ptp(points[:, :2], axis=0).max()
        column = (size / 2 + scale * x).astype(int)
        row = (0.45 * size - scale * y).astype(int)
        inside = (column >= 0) & (column < size) & (row >= 0) & (row < 0.9 * size)
        front = np.argsort(z)
        front = front[inside[front]]
        shade = 0.9 + 0.5 * np.abs(normals[front] @ view[2])
        page = np.ones((int(0.9 * size), size, 3))
        page[row[front], column[front]] = colors[front] * shade[:, None]
        pages.append(
            cv2.resize(page, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        )
    write("mesh.webp", np.concatenate(pages, axis=1))


def aliasing(folder: Path) -> None:
    """Draw the still life trained without and with filters, beside the truth."""
    viewmats, K = raycaster.demo_cameras(40, 320, 240)
    viewmat, rows = viewmats[8], []
    for scale, divisor in ((4, 1), (0.25, 4)):
        size = 320 // divisor, 240 // divisor
        zoomed = np.diag([scale, scale, 1]) @ K
        if scale > 1:
            zoomed[:2, 2] -= (scale - 1) * np.asarray(size) / 2
        cells = []
        for name in ("demo-plain.ply", "demo-mip.ply"):
            camera = gsjax.make_camera(
                viewmat=viewmat, K=zoomed, width=size[0], height=size[1]
            )
            scene, config = gsjax.load(folder / name), file_raster(folder / name)
            view = gsjax.render_exact(scene, camera, config)
            cells.append(np.asarray(view.rgb))
        cells.append(raycaster.cast(viewmat, zoomed, *size, 3 * divisor)[0])
        wide = [np.repeat(np.repeat(c, divisor, 0), divisor, 1) for c in cells]
        rows.append(np.concatenate(wide, axis=1))
    write("aliasing.webp", np.concatenate(rows, axis=0))


def rate_distortion() -> None:
    """Copy the plot of benchmarks/rate_distortion.py."""
    kept = Path(__file__).parents[1] / "benchmarks" / "results" / "rate_distortion.png"
    pixels = cv2.imread(str(kept))
    assert pixels is not None
    write("rate_distortion.webp", pixels[..., ::-1] / 255)


def order() -> None:
    """Draw two splats beside each other, one in front, then the other."""
    K = [[240, 0, 140], [0, 240, 100], [0, 0, 1]]
    camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=280, height=200)
    pictures = []
    for first, second in ((2.0, 2.1), (2.1, 2.0)):
        pair = gsjax.make_gaussians(
            means=[[-0.18, 0, first], [0.18, 0, second]],
            quats=np.tile([1.0, 0, 0, 0], (2, 1)),
            log_scales=np.full((2, 3), np.log(0.22)),
            logit_opacities=np.full(2, np.log(9.0)),
            sh=rgb_to_dc(np.asarray([[[0.86, 0.2, 0.14]], [[0.13, 0.35, 0.8]]])),
        )
        view = gsjax.render_exact(pair, camera, background=np.ones(3))
        pictures.append(np.asarray(view.rgb))
    write("order.webp", np.concatenate(pictures, axis=1))


def turning() -> None:
    """Film a turning camera, with the order of centres and that of each pixel."""
    rng = np.random.default_rng(11)
    count, size = 40, (176, 132)
    scene = gsjax.make_gaussians(
        means=rng.uniform((-1.6, -1.2, 3), (1.6, 1.2, 5), (count, 3)),
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(rng.uniform((0.25, 0.25, 0.1), (0.5, 0.5, 0.2), (count, 3))),
        logit_opacities=np.full(count, 5.0),
        sh=rgb_to_dc(rng.uniform(0.05, 0.95, (count, 1, 3))),
    )
    K = [[152, 0, size[0] / 2], [0, 152, size[1] / 2], [0, 0, 1]]
    camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=size[0], height=size[1])
    config = gsjax.RasterConfig(outputs=("rgb",))
    behind, frames, cameras = np.ones(3), [], turned(camera, 20, 0.8)
    places = np.random.default_rng(0).uniform(0, 1, (400, 2)) * size
    for name in ("center", "pixel"):
        mine = config.replace(order=name)
        print(name, 255 * popping.popping(scene, cameras, mine, points=places))
    for turn in cameras:
        orders = (config.replace(order=name) for name in ("center", "pixel"))
        both = [gsjax.render_exact(scene, turn, mine, behind).rgb for mine in orders]
        frames.append(images.to_8_bit(np.concatenate(both, axis=1)))
    movie = cv2.Animation()
    movie.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in frames]
    movie.durations = [150] * len(frames)
    # Less quality shows blocks where the picture is smooth.
    quality = [cv2.IMWRITE_WEBP_QUALITY, 92]
    _, encoded = cv2.imencodeanimation(".webp", movie, quality)
    (ASSETS / "popping.webp").write_bytes(encoded.tobytes())


def lenses() -> None:
    """Draw the knot through five lenses, from one place."""
    scene = torus_knot_scene(count=20_000, frames=48, width=360, height=270)
    base, behind = scene.cameras[4], np.asarray(scene.background)
    wide = [[115.0, 0, 180], [0, 115.0, 135], [0, 0, 1]]
    rows = [
        ("pinhole", base.K, None),
        ("opencv, k1 = −0.6", base.K, (-0.6, 0.25, 0.0, 0.0)),
        ("fisheye, 180°", wide, (0.0, 0.0, 0.0, 0.0)),
        ("orthographic", np.asarray(base.K) / [[6.0], [6.0], [1.0]], None),
        ("equirectangular", panorama_intrinsics(720, 270), None),
    ]
    figure = figures.new_figure((1480, 860))
    for index, (title, K, coefficients) in enumerate(rows):
        K = np.array(K, np.float64)
        if title == "orthographic":
            K[:2, 2] = 180, 135
        camera = gsjax.make_camera(
            viewmat=base.viewmat,
            K=K,
            width=720 if index == 4 else 360,
            height=270,
            lens=title.split(",")[0],
            coefficients=coefficients,
        )
        config = gsjax.RasterConfig(projection="unscented")
        view = gsjax.render_exact(scene.gaussians, camera, config, behind)
        left, top = 0.01 + 0.33 * (index % 3), 0.53 - 0.49 * (index // 3)
        width = 0.64 if index == 4 else 0.31
        axes = figure.add_axes((left, top, width, 0.42))
        axes.imshow(np.clip(np.asarray(view.rgb), 0, 1))
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, fontsize=17, color=INK, loc="left")
    write("lenses.webp", figures.figure_pixels(figure) / 255)


_TILE = 16


def pipeline() -> None:
    """Draw the way from Gaussians to a picture and back: four panels and arrows."""
    scene = torus_knot_scene(count=6000, frames=48, width=320, height=240)
    gaussians, camera = scene.gaussians, scene.cameras[4]
    white = np.ones(3)
    small = gaussians.replace(
        params=gaussians.params.replace(log_scales=gaussians.params.log_scales - 1.1)
    )
    dots, picture = (
        np.asarray(gsjax.render_exact(one, camera, background=white).rgb)
        for one in (small, gaussians)
    )
    config = gsjax.RasterConfig(tile_size=_TILE, devices=1, num_size_buckets=1)
    inputs = Inputs(gaussians, camera)
    slots, count = visible_order(ELLIPSOID, inputs, config)
    seen = ELLIPSOID.project(inputs, config, slots, count)
    panels = [
        dots,
        _ellipses(seen, dots.shape),
        _lengths(seen.footprint, picture),
        picture,
    ]
    captions = [
        ("Gaussians", "position, rotation,\nscale, opacity, colour"),
        ("project", "each to an ellipse,\nwith its colour from here"),
        ("sort", "by tile and depth:\nred tiles have long lists"),
        ("blend", "tile by tile,\nfront to back"),
    ]
    figure = figures.new_figure((1480, 440))
    across, back = {"arrowstyle": "->", "lw": 2}, "#be4628"
    for index, (panel, (title, text)) in enumerate(zip(panels, captions)):
        left = 0.01 + 0.25 * index
        axes = figure.add_axes((left, 0.42, 0.216, 0.545))
        axes.imshow(np.clip(panel, 0, 1), interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        figure.text(left, 0.35, title, fontsize=19, color=INK)
        figure.text(left, 0.31, text, fontsize=14, color=INK, va="top")
        if index:
            place = {"xycoords": "axes fraction", "arrowprops": across}
            axes.annotate("", (-0.02, 0.5), (-0.14, 0.5), **place)
    told = "jax.grad, jax.jvp: by Gaussians, camera and background"
    ends = {"xycoords": "figure fraction", "arrowprops": {**across, "color": back}}
    axes.annotate("", (0.01, 0.07), (0.98, 0.07), **ends)
    figure.text(
        0.5, 0.07, told, fontsize=15, color=back, ha="center", va="center",
        bbox={"color": "white"},
    )  # fmt: skip
    write("pipeline.webp", figures.figure_pixels(figure) / 255)


def _ellipses(seen, shape: tuple[int, ...]) -> np.ndarray:
    """Draw the one-sigma ellipse of one splat in six, far to near."""
    page, footprint = np.full(shape, 255, np.uint8), seen.footprint
    u, v, var_y, slope, inv_sx = (
        np.asarray(a, np.float64)
        for a in (
            footprint.u,
            footprint.v,
            footprint.var_y,
            footprint.slope,
            footprint.inv_sx,
        )
    )
    colors = 255 * np.clip(np.asarray(seen.channels.colors), 0, 1)
    for rank in range(len(u) - 1, -1, -6):
        if not footprint.reach[rank] > 0:
            continue
        var_x = 1 / inv_sx[rank] ** 2
        cov = slope[rank] * var_x
        axes, turn = np.linalg.eigh([[var_x, cov], [cov, var_y[rank]]])
        angle = float(np.degrees(np.arctan2(turn[1, 1], turn[0, 1])))
        half = (16 * np.sqrt(axes[::-1])).astype(int)
        centre = (round(16 * u[rank]), round(16 * v[rank]))
        color = tuple(float(c) for c in colors[:, rank])
        cv2.ellipse(page, centre, half, angle, 0, 360, color, 1, cv2.LINE_AA, 4)
    return page / 255


def _lengths(footprint, picture: np.ndarray) -> np.ndarray:
    """Return the picture under the lengths of the tile lists, as colours."""
    height, width = picture.shape[:2]
    grid = binning.make_grid(width, height, _TILE, 1)
    device = jnp.int32(0)
    lists = binning.make_lists(footprint, grid, device, 2**17)
    assert lists.fit
    length = np.asarray(lists.length, np.float64).reshape(grid.rows, grid.cols)
    levels = np.rint(255 * length / length.max()).astype(np.uint8)
    heat = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1] / 255
    heat = np.repeat(np.repeat(heat, _TILE, axis=0), _TILE, axis=1)[:height, :width]
    page = 0.35 * picture + 0.65 * heat
    page[::_TILE] = page[:, ::_TILE] = 1
    return page


if __name__ == "__main__":
    if len(sys.argv) == 5:
        mesh(Path(sys.argv[1]), [float(word) for word in sys.argv[2:]])
    elif len(sys.argv) == 2:
        aliasing(Path(sys.argv[1]))
    else:
        gsjax.use_all_cores()
        knot()
        lenses()
        order()
        pipeline()
        rate_distortion()
        turning()
