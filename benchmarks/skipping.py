"""Claim: what a view doesn't need isn't paid for.

``python benchmarks/skipping.py`` renders 100 k garden points (or a synthetic stand-in)
and compares, in one run and interleaved, the same view with: four times the capacity;
95 % of the Gaussians moved out of the view; an opaque wall in front; and says what the
compiled program of degree-0 data holds.
"""

from __future__ import annotations

import gsjax

gsjax.use_all_cores(queued=False)

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import measure  # noqa: E402
import numpy as np  # noqa: E402
import scenes  # noqa: E402

from gsjax.cameras import camera_centre  # noqa: E402


def behind_camera(case: scenes.Case, share: float) -> gsjax.Gaussians:
    """The scene with ``share`` of its Gaussians mirrored to behind the camera."""
    viewmat = np.asarray(case.camera.viewmat)
    centre, forward = np.asarray(camera_centre(viewmat)), viewmat[2, :3]
    params = case.gaussians.params
    means = np.asarray(params.means)
    distance = (means - centre) @ forward
    away = np.random.default_rng(0).random(len(means)) < share
    moved = means - 2 * np.abs(distance)[:, None] * forward - forward
    means = np.where((away & (distance > 0))[:, None], moved, means)
    params = params.replace(means=jnp.asarray(means, jnp.float32))
    return case.gaussians.replace(params=params)


def with_wall(case: scenes.Case, across: int, layers: int) -> gsjax.Gaussians:
    """An opaque wall of across² × layers splats close to the camera, then the scene."""
    camera = case.camera
    viewmat, K = np.asarray(camera.viewmat), np.asarray(camera.K)
    centre = np.asarray(camera_centre(viewmat))
    distance = 0.02
    half = 1.3 * distance * np.array([camera.width / K[0, 0], camera.height / K[1, 1]])
    steps = np.linspace(-0.5, 0.5, across)
    xs, ys = (g.ravel() for g in np.meshgrid(steps * half[0], steps * half[1]))
    zs = distance * (1 + 0.01 * np.arange(layers))
    points = np.concatenate([np.stack([xs, ys, np.full_like(xs, z)], -1) for z in zs])
    count = len(points)
    spacing = max(half) / max(across - 1, 1)
    wall = gsjax.make_gaussians(
        means=points @ viewmat[:3, :3] + centre,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(spacing)),
        logit_opacities=np.full(count, 7.0),
        sh=np.zeros((count, 1, 3)),
    )
    return gsjax.concatenate(wall, case.gaussians)


def main() -> None:
    """Measure and save."""
    case = scenes.real_cases()[-1]
    camera = case.camera
    in_front = np.asarray(case.camera.viewmat)[2] @ np.concatenate(
        [
            np.asarray(case.gaussians.params.means).T,
            np.ones((1, case.gaussians.capacity)),
        ]
    )
    base = case.gaussians.replace(active=jnp.asarray(in_front > 0.03))
    case = case._replace(gaussians=base)
    fitted = gsjax.exact_config(base, camera)
    grown = gsjax.grow(base, 4 * base.capacity)
    culled = behind_camera(case, 0.95)
    wall = with_wall(case, 16, 4)
    variants = {
        "base": (base, fitted),
        "capacity × 4": (grown, gsjax.exact_config(grown, camera)),
        "capacity × 4, capacities left to default": (grown, gsjax.RasterConfig()),
        "base, capacities left to default": (base, gsjax.RasterConfig()),
        "95 % culled, config of base": (culled, fitted),
        "wall in front": (wall, gsjax.exact_config(wall, camera)),
        "wall in front, config of base": (wall, fitted),
    }
    render = jax.jit(gsjax.render, static_argnames="config")
    forward, both, rows = {}, {}, []
    for name, (gaussians, config) in variants.items():
        gradient = jax.jit(
            jax.value_and_grad(
                lambda p, g, c=config: jnp.sum(
                    gsjax.render(g.replace(params=p), camera, c).rgb
                )
            )
        )
        forward[name] = lambda g=gaussians, c=config: render(g, camera, config=c)
        both[name] = lambda g=gaussians, f=gradient: f(g.params, g)
    times, gradients = measure.interleaved(forward), measure.interleaved(both, 5)
    for name, (gaussians, config) in variants.items():
        result = render(gaussians, camera, config=config)
        against = "base, capacities left to default" if "default" in name else "base"
        rows.append(
            {
                "view": name,
                "forward ms": times[name],
                "ratio": times[name] / times[against],
                "v+g ms": gradients[name],
                "v+g ratio": gradients[name] / gradients[against],
                "visible": int(result.demand.visible),
                "pairs": int(result.demand.pairs),
                "overflowed": bool(result.overflowed),
            }
        )
    full = render(wall, camera, config=gsjax.exact_config(
        wall, camera, gsjax.RasterConfig(occlusion=False)))  # fmt: skip
    same = bool(jnp.all(full.rgb == render(wall, camera, config=fitted).rgb))
    measure.save("skipping", rows, claim=__doc__, wall_bit_equal=same)


if __name__ == "__main__":
    main()
