"""Claim: a plan for 1/255 holds on other cameras, and is faster than `accurate`.

``python benchmarks/planning.py [RUN]`` plans guitar.ply at 800 × 600 (or a synthetic
shell) and the scene of a run with 12 cameras each, renders 20 random other cameras with
the plan and with a finer `RasterConfig.accurate`, and times three of them with the
plan, `accurate`, `compat`, and coarse cutoffs of 0.02 and 0.01, alternating.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes

import gsjax

SEEN, UNSEEN, TIMED = 12, 20, 3
BUDGET = 1 / 255


def around(case: scenes.Case, count: int, rng) -> list[gsjax.Camera]:
    """Return random cameras on all sides of a scene that look at its centre."""
    means = np.asarray(case.gaussians.params.means)
    centre = np.median(means, axis=0)
    radius = np.percentile(np.linalg.norm(means - centre, axis=1), 95)
    cameras = []
    for _ in range(count):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        eye = centre + direction * radius * rng.uniform(1.6, 2.4)
        cameras.append(
            gsjax.make_camera(
                viewmat=gsjax.look_at(eye, centre, (0, 1, 0)), K=case.camera.K,
                width=case.camera.width, height=case.camera.height,
            )
        )  # fmt: skip
    return cameras


def of_run(folder: Path, rng):
    """Return (Gaussians, training cameras, random cameras between them) of a run."""
    run = scenes.of_run(folder)
    unseen = []
    for index in rng.choice(400, UNSEEN, replace=False):
        camera = run.between[index]
        shift = np.eye(4)
        shift[:3, 3] = 0.05 * rng.normal(size=3)
        unseen.append(
            gsjax.make_camera(
                viewmat=shift @ np.asarray(camera.viewmat, np.float64), K=camera.K,
                width=camera.width, height=camera.height,
            )
        )  # fmt: skip
    return run.gaussians, run.seen[: 2 * SEEN], unseen


def row(name: str, gaussians, seen, unseen) -> dict:
    """Plan, check and time one scene."""
    start = time.perf_counter()
    made = gsjax.plan(gaussians, seen, budget=BUDGET)
    seconds = time.perf_counter() - start
    print(f"{name}: planned in {seconds:.0f} s")
    for line in made.lines():
        print(f"  {line}")
    finer = gsjax.RasterConfig.accurate(
        alpha_min=1e-6, transmittance_min=1e-7, outputs=("rgb",)
    )
    finer = gsjax.exact_config(gaussians, unseen[0], finer)
    errors = []
    for camera in unseen:
        wanted = gsjax.render_exact(gaussians, camera, finer).rgb
        found = gsjax.render_exact(made.gaussians, camera, made.config).rgb
        errors.append(255 * float(jnp.abs(found - wanted).max()))
    render = jax.jit(gsjax.render, static_argnames="config")
    timed = jax.tree.map(lambda *a: jnp.stack(a), *unseen[:TIMED])
    settings = {"plan": (made.gaussians, made.config)}
    for key, config in (
        ("accurate", gsjax.RasterConfig.accurate(outputs=("rgb",))),
        ("compat", gsjax.RasterConfig(outputs=("rgb",))),
        (
            "coarse",
            gsjax.RasterConfig.fast(
                alpha_min=0.02, transmittance_min=0.01, outputs=("rgb",)
            ),
        ),
    ):
        settings[key] = gaussians, gsjax.exact_config(gaussians, timed, config)
    times: dict[str, list[float]] = {}
    for camera in unseen[:TIMED]:
        functions = {
            key: lambda s=shown, c=config, v=camera: render(s, v, config=c)
            for key, (shown, config) in settings.items()
        }
        for key, function in functions.items():
            assert not bool(function().overflowed), key
        for key, ms in measure.interleaved(functions, 15).items():
            times.setdefault(key, []).append(ms)
    ms = {key: float(np.median(values)) for key, values in times.items()}
    return {
        "scene": name,
        "Gaussians": int(gsjax.num_active(gaussians)),
        "alpha cut": made.config.alpha_min,
        "stop": made.config.transmittance_min,
        "promised /255": 255 * made.error,
        "worst of unseen /255": max(errors),
        "median of unseen /255": float(np.median(errors)),
        "within": max(errors) <= 1,
        **{f"{key} ms": value for key, value in ms.items()},
        "accurate / plan": ms["accurate"] / ms["plan"],
        "accurate / compat": ms["accurate"] / ms["compat"],
        "accurate / coarse": ms["accurate"] / ms["coarse"],
        "planning s": seconds,
    }


def main() -> None:
    """Measure and save."""
    rng = np.random.default_rng(0)
    case = scenes.real_cases()[0]
    rows = [
        row(case.name, case.gaussians, around(case, SEEN, rng),
            around(case, UNSEEN, rng))
    ]  # fmt: skip
    measure.save("planning", rows, claim=__doc__)
    for folder in sys.argv[1:]:
        rows.append(row(Path(folder).name, *of_run(Path(folder), rng)))
        measure.save("planning", rows, claim=__doc__)


if __name__ == "__main__":
    main()
