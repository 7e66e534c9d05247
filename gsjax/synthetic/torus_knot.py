"""A generated scene: Gaussians of a torus knot over a checkerboard, and an orbit.

Light is baked on the host: a sun with a shadow map, a sky with ambient occlusion, and a
highlight in SH degree 1. The result is deterministic; z is up, the floor is z = 0.

Axis legend: N Gaussians, M Gaussians of the knot, F frames.
"""

from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import Camera, look_at, make_camera
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.synthetic.albedo import smooth_step

_GOLDEN = (1 + 5**0.5) / 2
_SUN = np.asarray([0.36, -0.3, 0.88]) / np.linalg.norm([0.36, -0.3, 0.88])
_C0, _C1 = 0.28209479177387814, 0.4886025119029199
_CENTRE = np.asarray([0.0, 0.0, 1.42])
_TUBE = 0.3
_FLOOR_RADIUS = 4.4
BACKGROUND = (0.93, 0.945, 0.955)  # the floor fades into it


class SyntheticScene(NamedTuple):
    """Gaussians, an orbit of F cameras, and the matching background."""

    gaussians: Gaussians
    cameras: list[Camera]
    background: tuple[float, float, float]


class _Surfels(NamedTuple):
    """Flat, round Gaussians on a surface, [N] each."""

    means: np.ndarray
    normals: np.ndarray
    radii: np.ndarray
    albedo: np.ndarray
    opacity: np.ndarray
    gloss: np.ndarray


def torus_knot_scene(
    count: int = 20_000, frames: int = 48, width: int = 640, height: int = 480
) -> SyntheticScene:
    """Return a striped torus knot over a checkerboard floor, SH degree 1.

    Args:
      count: number of Gaussians of the knot; the floor adds about half as many.
      frames: number of cameras of the orbit.
      width, height: image size, px.
    """
    knot = _knot(count)
    parts = [_shaded(knot, knot), _shaded(_floor(count), knot)]
    fields = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    gaussians = make_gaussians(**fields, capacity=None)
    return SyntheticScene(gaussians, orbit(frames, width, height), BACKGROUND)


def orbit(
    frames: int,
    width: int,
    height: int,
    *,
    target=(0.0, 0.0, 1.16),
    radius: float = 6.4,
    elevation: float = 24.0,
    field_of_view: float = 38.0,
) -> list[Camera]:
    """Return cameras on a horizontal circle that look at a target.

    Args:
      frames: number of cameras, evenly spaced.
      width, height: image size, px.
      target: point in the middle of the images.
      radius: distance from the target.
      elevation: angle above the horizontal, degrees.
      field_of_view: of the shorter side of the image, degrees.
    """
    focal = 0.5 * min(width, height) / np.tan(np.radians(field_of_view) / 2)
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    up = np.radians(elevation)
    cameras = []
    for turn in np.arange(frames) * (2 * np.pi / frames) - 0.62 * np.pi:
        direction = np.cos(turn), np.sin(turn), np.tan(up)
        eye = np.asarray(target) + radius * np.cos(up) * np.asarray(direction)
        viewmat = look_at(eye, target)
        cameras.append(make_camera(viewmat=viewmat, K=K, width=width, height=height))
    return cameras


def _knot(count: int) -> _Surfels:
    """Return the (2, 3) torus knot as a tube, sampled by the golden ratio."""
    index = np.arange(count) + 0.5
    t = 2 * np.pi * index / count
    around = 2 * np.pi * ((index * _GOLDEN) % 1)
    path, tangent, side, other = _knot_frame(t)
    normals = np.cos(around)[:, None] * side + np.sin(around)[:, None] * other
    cos, sin = np.cos(np.radians(62)), np.sin(np.radians(62))
    tilt = np.asarray([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    means = (path + _TUBE * normals) @ tilt.T + _CENTRE
    length = np.linalg.norm(tangent, axis=1).mean() * 2 * np.pi
    spacing = np.sqrt(length * 2 * np.pi * _TUBE / count)
    # Two families of helical stripes.
    stripe = smooth_step(np.cos(3 * around + 24 * t), 0.2)
    thin = smooth_step(np.cos(24 * t) - 0.9, 0.08)
    albedo = _palette(t / (2 * np.pi)) * (1 - 0.3 * stripe[:, None])
    albedo += (np.asarray([0.98, 0.95, 0.88]) - albedo) * thin[:, None]
    full = np.full(count, 1.0)
    radii, normals = 0.66 * spacing * full, normals @ tilt.T
    return _Surfels(means, normals, radii, albedo, 0.97 * full, 0.3 * full)


def _knot_frame(t: np.ndarray):
    """Return the path [M, 3], its derivative, and two unit normals."""
    ring = np.stack([np.cos(2 * t), np.sin(2 * t), 0 * t], -1)
    along = np.stack([-np.sin(2 * t), np.cos(2 * t), 0 * t], -1)
    up = np.asarray([0.0, 0.0, 1.0])
    cos, sin = np.cos(3 * t)[:, None], np.sin(3 * t)[:, None]
    path = (1 + 0.44 * cos) * ring + 0.44 * sin * up
    tangent = 2 * (1 + 0.44 * cos) * along + 3 * 0.44 * (cos * up - sin * ring)
    unit = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    side = cos * ring + sin * up
    side -= (side * unit).sum(1, keepdims=True) * unit
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return path, tangent, side, np.cross(unit, side)


def _floor(count: int) -> _Surfels:
    """Return a checkerboard disc at z = 0 that fades out, about count / 2 Gaussians."""
    square = 0.55
    per_square = max(2, round(square / np.sqrt(2 * np.pi * _FLOOR_RADIUS**2 / count)))
    spacing = square / per_square
    half = int(_FLOOR_RADIUS / spacing) + 1
    x, y = (np.mgrid[-half:half, -half:half].reshape(2, -1) + 0.5) * spacing
    distance = np.hypot(x, y)
    x, y, distance = (v[distance < _FLOOR_RADIUS] for v in (x, y, distance))
    dark = (np.floor(x / square) + np.floor(y / square)) % 2
    albedo = np.where(dark[:, None] > 0, (0.36, 0.41, 0.47), (0.9, 0.9, 0.89))
    fade = np.clip((_FLOOR_RADIUS - distance) / 1.9, 0, 1)
    full = np.full(len(x), 1.0)
    return _Surfels(
        means=np.stack([x, y, 0 * x], -1),
        normals=np.tile([0.0, 0.0, 1.0], (len(x), 1)),
        radii=0.72 * spacing * full,
        albedo=albedo,
        opacity=0.97 * fade * fade * (3 - 2 * fade),
        gloss=0.06 * full,
    )


def _shaded(surfels: _Surfels, caster: _Surfels) -> dict[str, np.ndarray]:
    """Return fields of `make_gaussians`, lit past the shadow of ``caster``."""
    means, normals = surfels.means, surfels.normals
    facing = normals @ _SUN
    sun = np.clip(facing, 0, 1) * _sunlit(means, caster.means)
    sky = (0.62 + 0.38 * normals[:, 2]) * _open_sky(means, normals, caster.means)
    light = 0.72 * sun[:, None] * (1.0, 0.96, 0.88)
    light = light + 0.6 * sky[:, None] * (0.9, 0.97, 1.06)
    # Highlight towards the mirrored sun; SH directions point away from the camera.
    mirrored = 2 * facing[:, None] * normals - _SUN
    highlight = (surfels.gloss * (sun > 0) * np.sqrt(sun))[:, None]
    sh = np.zeros((len(means), 4, 3))
    sh[:, 0] = (surfels.albedo * light - 0.35 * highlight - 0.5) / _C0
    sh[:, 1:] = (highlight * mirrored[:, (1, 2, 0)] * (1, -1, 1) / _C1)[..., None]
    opacity = np.clip(surfels.opacity, 1e-3, 1 - 1e-3)
    flat = np.stack([surfels.radii, surfels.radii, 0.15 * surfels.radii], -1)
    return {
        "means": means,
        "quats": _quats_of_normals(normals),
        "log_scales": np.log(flat),
        "logit_opacities": np.log(opacity / (1 - opacity)),
        "sh": sh,
    }


def _sunlit(points: np.ndarray, casters: np.ndarray) -> np.ndarray:
    """Return [N] in [0, 1]: share of a patch of the shadow map that is not nearer."""
    size, cells = 5.0, 72
    right = np.cross(_SUN, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(_SUN, right), _SUN])

    def cell(p):
        return np.clip(((p[:, :2] / size + 0.5) * cells), 1, cells - 2)

    seen = (casters - _CENTRE) @ axes.T
    nearest = np.full((cells, cells), -np.inf)
    np.maximum.at(nearest, tuple(cell(seen).astype(int).T), seen[:, 2])
    local = (points - _CENTRE) @ axes.T
    where = cell(local)
    offsets = np.mgrid[-1:2, -1:2].reshape(2, -1).T
    cells_near = [tuple((where + 0.8 * o).astype(int).T) for o in offsets]
    return np.mean([local[:, 2] > nearest[c] - 0.16 for c in cells_near], axis=0)


def _open_sky(points: np.ndarray, normals: np.ndarray, casters: np.ndarray):
    """Return [N] in [0, 1]: visible share of the sky (a heuristic)."""
    some = casters[:: max(1, len(casters) // 400)]
    height = normals @ some.T - (normals * points).sum(1)[:, None]
    square = (points**2).sum(1)[:, None] + (some**2).sum(1) - 2 * points @ some.T
    hidden = np.clip(height, 0, None) / (np.clip(square, 0, None) + 0.02) ** 1.5
    return np.exp(-0.88 * hidden.mean(1))


def _quats_of_normals(normals: np.ndarray) -> np.ndarray:
    """Return the shortest rotations [N, 4] (wxyz) from z to each normal."""
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, 0 * z], -1)
    quats[z < -1 + 1e-6] = (0.0, 1.0, 0.0, 0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _palette(turn: np.ndarray) -> np.ndarray:
    """Return colours [M, 3] of a cyclic palette: teal, blue, violet, coral, amber."""
    red = (0.07, 0.16, 0.45, 0.90, 0.98, 0.42)
    green = (0.60, 0.38, 0.27, 0.34, 0.63, 0.68)
    stops = np.asarray([red, green, (0.62, 0.78, 0.72, 0.42, 0.22, 0.36)]).T
    place = (turn % 1) * len(stops)
    low = place.astype(int) % len(stops)
    mix = (place % 1)[:, None]
    return stops[low] * (1 - mix) + stops[(low + 1) % len(stops)] * mix
