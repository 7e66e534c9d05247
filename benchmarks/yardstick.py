"""A plain C++ Gaussian-splat compositor as a yardstick for the JAX one.

``yardstick.cpp`` is compiled on first use into a cache folder and loaded by ctypes.
It composites 2D Gaussians over per-tile depth-sorted lists, forward and backward, in
float32 and without early termination; :func:`exact_lists` builds those lists.

``python benchmarks/yardstick.py`` prints the time per pixel-Gaussian evaluation.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import itertools
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("yardstick.cpp")
COMPILE = ["-O3", "-march=native", "-ffast-math", "-std=c++17", "-fPIC", "-pthread"]
LINK = ["-shared", "-pthread"]
TILE_SIZES = (8, 16, 32)


def _cache_folder() -> Path:
    """Return the folder of compiled libraries; create it if missing."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    try:
        folder = Path(base) / "gsjax-yardstick"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="gsjax-yardstick-"))


@functools.cache
def _library() -> ctypes.CDLL:
    """Compile (unless cached) and load the C++ compositor."""
    compiler = shutil.which("g++")
    if compiler is None:
        raise RuntimeError("the yardstick needs g++, which was not found")
    # The meaning of -march=native depends on the machine, so it is part of the hash.
    target = [compiler, "-march=native", "-Q", "--help=target", "--version"]
    version = subprocess.run(target, capture_output=True, check=True).stdout
    source = SOURCE.read_bytes()
    flags = " ".join(COMPILE + LINK).encode()
    key = hashlib.sha256(b"\0".join((source, flags, version))).hexdigest()[:20]
    folder = _cache_folder()
    path = folder / f"yardstick-{key}.so"
    if not path.exists():
        # Linking with -ffast-math would switch the whole process to flushing
        # denormals when the library is loaded; hence two steps.
        with tempfile.TemporaryDirectory(dir=folder) as build:
            obj, out = f"{build}/yardstick.o", f"{build}/yardstick.so"
            for command in (
                [compiler, *COMPILE, "-c", str(SOURCE), "-o", obj],
                [compiler, *LINK, obj, "-o", out],
            ):
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    raise RuntimeError(f"g++ failed:\n{done.stderr}")
            os.replace(out, path)
    library = ctypes.CDLL(str(path))
    library.yardstick_forward.restype = ctypes.c_int
    library.yardstick_backward.restype = ctypes.c_int
    return library


def available() -> bool:
    """Return whether the C++ compositor can be compiled and loaded here."""
    try:
        _library()
    except (RuntimeError, OSError, subprocess.CalledProcessError):
        return False
    return True


def _array(value, shape, dtype=np.float32) -> np.ndarray:
    """Return ``value`` as a contiguous array of a shape, or raise ValueError."""
    array = np.ascontiguousarray(value, dtype)
    if array.shape != shape:
        raise ValueError(f"expected shape {shape}, got {array.shape}")
    return array


def _arguments(
    means2d, conics, opacities, colors, tile_ranges, ids, width, height, background,
    tile_size, threads,
):  # fmt: skip
    """Check the inputs; return them in the order of the C++ functions."""
    if tile_size not in TILE_SIZES:
        raise ValueError(f"tile_size must be one of {TILE_SIZES}, got {tile_size}")
    count, pairs = len(means2d), len(ids)
    tiles = -(-width // tile_size) * -(-height // tile_size)
    ids = _array(ids, (pairs,), np.int32)
    ranges = _array(tile_ranges, (tiles, 2), np.int32)
    if ranges.size and not (ranges.min() >= 0 and ranges.max() <= pairs):
        raise ValueError("tile_ranges out of range")
    used = ids[: ranges.max(initial=0)]  # the rest may be padding
    if used.size and not (used.min() >= 0 and used.max() < count):
        raise ValueError("ids out of range")
    return (
        _array(means2d, (count, 2)),
        _array(conics, (count, 3)),
        _array(opacities, (count,)),
        _array(colors, (count, 3)),
        ranges,
        ids,
        count,
        width,
        height,
        tile_size,
        _array(background, (3,)),
        threads,
    )


def _call(function, arguments) -> None:
    """Call a C++ function with arrays passed as pointers and the rest as ints."""
    status = function(
        *(
            ctypes.c_void_p(a.ctypes.data)
            if isinstance(a, np.ndarray)
            else ctypes.c_int(a)
            for a in arguments
        )
    )
    if status:
        raise ValueError("the yardstick refused its arguments")


def forward(
    means2d, conics, opacities, colors, tile_ranges, ids, width, height, background,
    tile_size=16, threads=2,
):  # fmt: skip
    """Composite the Gaussians of each tile's list, front to back.

    Args:
        means2d: [N, 2] means in pixels; pixel centres lie at +0.5.
        conics: [N, 3] entries (a, b, c) of the inverse 2D covariances.
        opacities: [N].
        colors: [N, 3].
        tile_ranges: [T, 2] int32, start and end of each tile's part of ``ids``; tiles
            are numbered row by row.
        ids: [P] int32 indices of Gaussians, sorted by (tile, depth).
        width, height: image size in pixels.
        background: [3].
        tile_size: 8, 16 or 32.
        threads: number of threads.

    Returns:
        ``(image, transmittance)`` of shapes [H, W, 3] and [H, W].
    """
    inputs = _arguments(
        means2d, conics, opacities, colors, tile_ranges, ids, width, height,
        background, tile_size, threads,
    )  # fmt: skip
    image = np.empty((height, width, 3), np.float32)
    transmittance = np.empty((height, width), np.float32)
    _call(_library().yardstick_forward, (*inputs, image, transmittance))
    return image, transmittance


def forward_backward(
    means2d, conics, opacities, colors, tile_ranges, ids, width, height, background,
    v_image, v_alpha, tile_size=16, threads=2, by_pixel=False,
):  # fmt: skip
    """:func:`forward` together with its vector-Jacobian product.

    Args:
        v_image: [H, W, 3] cotangent of the image.
        v_alpha: [H, W] cotangent of the accumulated alpha, 1 - transmittance.
        by_pixel: walk the lists pixel by pixel, as GPU code does (plain), instead
            of Gaussian by Gaussian with the pixels vectorised (tuned).
        The others are those of :func:`forward`.

    Returns:
        ``(image, transmittance, grads)``; ``grads`` maps ``means2d`` [N, 2],
        ``conics`` [N, 3], ``opacities`` [N] and ``colors`` [N, 3] to gradients (views
        of one [N, 9] array). The gradient through a clamped alpha is zero.
    """
    inputs = _arguments(
        means2d, conics, opacities, colors, tile_ranges, ids, width, height,
        background, tile_size, threads,
    )  # fmt: skip
    v_image = _array(v_image, (height, width, 3))
    v_alpha = _array(v_alpha, (height, width))
    image = np.empty((height, width, 3), np.float32)
    transmittance = np.empty((height, width), np.float32)
    out = np.empty((len(means2d), 9), np.float32)
    _call(
        _library().yardstick_backward,
        (*inputs, int(by_pixel), v_image, v_alpha, image, transmittance, out),
    )
    grads = {
        "means2d": out[:, 0:2],
        "conics": out[:, 2:5],
        "opacities": out[:, 5],
        "colors": out[:, 6:9],
    }
    return image, transmittance, grads


def time_ms(fn, repeats=5) -> list[float]:
    """Return milliseconds of each of ``repeats`` calls, after one untimed call."""
    fn()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        fn()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def _rectangle_minimum(a, b, c, x0, x1, y0, y1) -> np.ndarray:
    """Return the minimum of the quadratic form over rectangles, elementwise."""

    def sigma(x, y):
        return 0.5 * (a * x * x + c * y * y) + b * x * y

    best = np.full(np.shape(a), np.inf)
    for x in (x0, x1):
        best = np.minimum(best, sigma(x, np.clip(-b * x / c, y0, y1)))
    for y in (y0, y1):
        best = np.minimum(best, sigma(np.clip(-b * y / a, x0, x1), y))
    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    return np.where(inside, 0.0, best)


def exact_lists(
    means2d, conics, opacities, depths, width, height, tile_size=16, cut=1 / 255
):
    """Return per-tile lists of Gaussians, each sorted by (depth, id).

    A pair is listed iff the ellipse {sigma <= ln(opacity / cut)} meets the closed
    rectangle of the tile. Gaussians with opacity <= cut, with a non-finite depth or
    other value, or with a conic that is not positive definite are left out.

    Args:
        means2d: [N, 2].
        conics: [N, 3].
        opacities: [N].
        depths: [N].
        width, height: image size in pixels.
        tile_size: side of a tile in pixels.
        cut: smallest alpha that counts.

    Returns:
        ``(tile_ranges, ids)`` of shapes [T, 2] and [P], int32.
    """
    means2d, conics = np.asarray(means2d, float), np.asarray(conics, float)
    opacities, depths = np.asarray(opacities, float), np.asarray(depths, float)
    across, down = -(-width // tile_size), -(-height // tile_size)

    keep = np.isfinite(depths) & np.isfinite(means2d).all(1)
    keep &= np.isfinite(conics).all(1) & (opacities > cut) & np.isfinite(opacities)
    a, b, c = np.where(keep[:, None], conics, [1.0, 0.0, 1.0]).T
    keep &= (a > 0) & (c > 0) & (a * c > b * b)
    order = np.flatnonzero(keep)
    order = order[np.argsort(depths[order], kind="stable")]  # by (depth, id)
    (a, b, c), (x, y) = conics[order].T, means2d[order].T
    limit = np.log(opacities[order] / cut)

    # Candidates: the tiles of the ellipse's bounding box.
    det = a * c - b * b
    half_x, half_y = np.sqrt(2 * limit * c / det), np.sqrt(2 * limit * a / det)

    def tiles(low, high, n):
        first = np.clip(np.ceil(low / tile_size) - 1, 0, n)
        return first.astype(int), np.clip(high // tile_size + 1, 0, n).astype(int)

    left, right = tiles(x - half_x, x + half_x, across)
    top, bottom = tiles(y - half_y, y + half_y, down)
    columns = np.maximum(right - left, 0)
    counts = columns * np.maximum(bottom - top, 0)

    # Test them in chunks of about a million, each of whole Gaussians.
    total = np.cumsum(counts)
    bounds = np.searchsorted(total, np.arange(0, total[-1:].sum(), 1 << 20), "right")
    bounds = np.unique(np.r_[0, bounds, len(order)])
    tile_parts, id_parts = [np.empty(0, int)], [np.empty(0, int)]
    for begin, end in itertools.pairwise(bounds):
        g = np.repeat(np.arange(begin, end), counts[begin:end])
        k = np.arange(len(g)) - (total - counts - (total - counts)[begin])[g]
        row, column = top[g] + k // columns[g], left[g] + k % columns[g]
        x0, y0 = column * tile_size - x[g], row * tile_size - y[g]
        low = _rectangle_minimum(
            a[g], b[g], c[g], x0, x0 + tile_size, y0, y0 + tile_size
        )
        hit = low <= limit[g]
        tile_parts.append((row * across + column)[hit])
        id_parts.append(order[g[hit]])

    tile = np.concatenate(tile_parts)
    tile = tile.astype(np.uint16 if across * down <= 1 << 16 else np.int32)
    ids = np.concatenate(id_parts)[np.argsort(tile, kind="stable")]
    ends = np.cumsum(np.bincount(tile, minlength=across * down))
    tile_ranges = np.stack([np.r_[0, ends[:-1]], ends], axis=1)
    return tile_ranges.astype(np.int32), ids.astype(np.int32)


def random_splats(count, width, height, seed=0, scale=4.0) -> dict[str, np.ndarray]:
    """Return random 2D Gaussians of standard deviations around ``scale`` pixels.

    Returns:
        ``means2d`` [N, 2], ``conics`` [N, 3], ``opacities`` [N], ``colors`` [N, 3]
        and ``depths`` [N], float32.
    """
    rng = np.random.default_rng(seed)
    size = np.array([width, height])
    sd = scale * np.exp(rng.normal(0, 0.5, (count, 2)))
    angle = rng.uniform(0, np.pi, count)
    cos, sin = np.cos(angle), np.sin(angle)
    u, v = (1 / sd**2).T
    conics = np.stack(
        [u * cos**2 + v * sin**2, (u - v) * cos * sin, u * sin**2 + v * cos**2], 1
    )
    splats = {
        "means2d": rng.uniform(-0.1 * size, 1.1 * size, (count, 2)),
        "conics": conics,
        "opacities": rng.uniform(0.02, 1.0, count),
        "colors": rng.uniform(0, 1, (count, 3)),
        "depths": rng.uniform(1, 10, count),
    }
    return {name: value.astype(np.float32) for name, value in splats.items()}


def main() -> None:
    """Print the time per pixel-Gaussian evaluation."""
    width, height, tile_size = 640, 480, 16
    splats = random_splats(20_000, width, height)
    depths = splats.pop("depths")
    start = time.perf_counter()
    shape = splats["means2d"], splats["conics"], splats["opacities"]
    ranges, ids = exact_lists(*shape, depths, width, height)
    lists = time.perf_counter() - start
    v = np.random.default_rng(1).normal(size=(height, width, 4)).astype(np.float32)
    scene = (*splats.values(), ranges, ids, width, height, np.zeros(3))
    evaluations = len(ids) * tile_size**2
    print(
        f"{len(ids)} pairs, {evaluations / 1e6:.0f} M evaluations, lists {lists:.2f} s"
    )
    for threads in (1, 2):
        f = time_ms(lambda t=threads: forward(*scene, threads=t), 7)
        b = time_ms(
            lambda t=threads: forward_backward(
                *scene, v[..., :3], v[..., 3], threads=t
            ),
            7,
        )
        p = time_ms(
            lambda t=threads: forward_backward(
                *scene, v[..., :3], v[..., 3], threads=t, by_pixel=True
            ),
            3,
        )
        rows = ("forward", f), ("forward + backward", b), ("the same by pixel", p)
        for name, times in rows:
            ms = float(np.median(times))
            print(
                f"{threads} thread(s), {name}: {ms:.1f} ms, "
                f"{1e6 * ms / evaluations:.3f} ns per evaluation"
            )


if __name__ == "__main__":
    main()
