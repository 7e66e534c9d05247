"""Claim: parts of a scene that a view does not show cost little.

``python benchmarks/skipping.py`` renders 100 k garden points (or a synthetic stand-in)
and times, alternating, the same view with: four times the capacity; 95 % of the
Gaussians moved out of view; and an opaque wall in front, of eight wide splats or of a
thousand, the latter also alone.
"""

from __future__ import annotations

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes

import gsjax
from gsjax.cameras.camera import camera_centre


def behind_camera(case: scenes.Case, share: float) -> gsjax.Gaussians:
    """Mirror ``share`` of the Gaussians to behind the camera."""
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


def wall_of(case: scenes.Case, across: int, layers: int) -> gsjax.Gaussians:
    """Return an opaque wall of across² × layers splats close to the camera."""
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
    return gsjax.make_gaussians(
        means=points @ viewmat[:3, :3] + centre,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(spacing)),
        logit_opacities=np.full(count, 7.0),
        sh=np.zeros((count, 1, 3)),
    )


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
    many, few = wall_of(case, 16, 4), wall_of(case, 1, 8)
    behind_many = gsjax.concatenate(many, base)
    behind_few = gsjax.concatenate(few, base)
    variants = {
        "base": (base, fitted),
        "capacity × 4": (grown, gsjax.exact_config(grown, camera)),
        "capacity × 4, capacities left to default": (grown, gsjax.RasterConfig()),
        "base, capacities left to default": (base, gsjax.RasterConfig()),
        "95 % culled, config of base": (culled, fitted),
        "95 % culled": (culled, gsjax.exact_config(culled, camera)),
        "behind 8 wide splats": (behind_few, gsjax.exact_config(behind_few, camera)),
        "behind 8, config of base": (behind_few, fitted),
        "behind 1024 splats": (behind_many, gsjax.exact_config(behind_many, camera)),
        "the 1024 splats alone": (many, gsjax.exact_config(many, camera)),
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
    same = {}
    for name, scene in (("8", behind_few), ("1024", behind_many)):
        config = gsjax.exact_config(scene, camera, gsjax.RasterConfig(occlusion=False))
        full = render(scene, camera, config=config)
        same[name] = bool(jnp.all(full.rgb == render(scene, camera, config=fitted).rgb))
    measure.save("skipping", rows, claim=__doc__, bits_with_and_without_occlusion=same)


if __name__ == "__main__":
    main()
