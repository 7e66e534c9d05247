"""The door of compression: `compress`."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.compression.finetune import Finetuning
from gsjax.compression.importance import measure_importance, sample_cameras
from gsjax.compression.measure import Judge
from gsjax.compression.quantise import as_gaussians, make_source, rows_of
from gsjax.compression.search import Trial, search, write_and_read
from gsjax.compression.types import CompressedScene, Goal, HeldOut
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, num_active, select
from gsjax.io.common import warn
from gsjax.io.formats import unrecorded_mode
from gsjax.planning.types import Reason
from gsjax.raster.argument_checks import requires_concrete_values
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import decibels
from gsjax.train.config import render_mode_of

DEFAULT_GOAL = Goal(max_loss=0.3)
_SUFFIXES = (".sog", ".spz", ".compressed.ply", ".glb", ".ply")
_JUDGED = 24  # held-out pictures


@requires_concrete_values()
def compress(
    gaussians: Gaussians,
    cameras: Camera | Sequence[Camera],
    *,
    goal: Goal = DEFAULT_GOAL,
    suffix: str = ".sog",
    config: RasterConfig | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    held_out: HeldOut | None = None,
    finetuning: Finetuning | None = None,
) -> CompressedScene:
    """Return a scene as a small file, for a stated loss or size.

    One price of a bit decides which Gaussians are left out, which harmonics are shared
    or dropped, and how coarsely each number is rounded. The price is found by measuring
    the file, read back, on held-out pictures. Call it outside of jit; it compiles a few
    programs.

    Args:
      gaussians: N slots, concrete.
      cameras: one, a batch, or several, of which at most 48 are used: views that matter
        to the scene, such as those of training.
      goal: what must be met.
      suffix: file format: ".sog", ".spz", ".compressed.ply", ".glb" or ".ply". The
        last three have no entropy coding: there only Gaussians and harmonics are
        reduced.
      config: settings of the render. Their render mode (surfels, antialiasing) is
        recorded in the file; a format that cannot record it causes a warning.
      background: RGB behind the scene.
      held_out: pictures to measure on, of at most 24 cameras; None for the cameras
        themselves without photographs.
      finetuning: train what is kept on photographs, with the quantisation in the loop;
        None not to. For a loss or a size.

    Raises:
      InputError: if the goal cannot be reached, there is no Gaussian or no camera, the
        format is unknown or cannot store the scene, or under a transformation of JAX.
      CapacityError: as `render_exact`.
    """
    goal.check()
    if suffix not in _SUFFIXES:
        known = ", ".join(_SUFFIXES)
        raise InputError(f"suffix: expected one of {known}, got {suffix!r}")
    if finetuning is not None and goal.max_error is not None:
        remedy = "set max_loss or max_size: training changes colours"
        raise InputError(f"finetuning: expected another goal than max_error; {remedy}")
    config = config or RasterConfig()
    mode = render_mode_of(config)
    chosen = sample_cameras(cameras)
    if not chosen:
        raise InputError("cameras: expected at least one camera, got none")
    if (lost := unrecorded_mode(Path(f"scene{suffix}"), mode)) is not None:
        warn(f"{suffix}: {lost}, which the measured loss leaves out")
    rows = rows_of(_drawable(gaussians))
    if not len(rows["means"]):
        raise InputError("gaussians: expected at least one that can be drawn, got none")
    scene = as_gaussians(rows)
    judge = Judge(scene, _few(held_out, chosen), config, background)
    before = judge.judge(scene, timed=True)
    importance = measure_importance(scene, chosen, config, background)
    source = make_source(rows, importance, suffix, goal.parts)
    best = search(source, judge, before, goal, mode, finetuning)
    after = judge.judge(best.gaussians, timed=True)
    return CompressedScene(
        gaussians=best.gaussians,
        files=best.files,
        suffix=suffix,
        before=before,
        after=after,
        size_before=len(write_and_read(scene, ".ply", None)[0]),
        reasons=(
            *_reasons(best, int(num_active(gaussians)), importance.largest),
            *_parts(best, judge),
        ),
    )


def _drawable(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without those that are never drawn."""
    params = gaussians.params
    valid = np.any(np.asarray(params.quats) != 0, axis=1)
    for leaf in params.__dict__.values():
        flat = np.asarray(leaf).reshape(gaussians.capacity, -1)
        valid &= np.isfinite(flat).all(axis=1)
    return select(gaussians, jnp.asarray(valid))


def _few(held_out: HeldOut | None, cameras: Sequence[Camera]) -> HeldOut:
    """Return at most `_JUDGED` pictures, evenly spaced."""
    if held_out is None:
        return HeldOut(sample_cameras(cameras, _JUDGED // 2))
    count = len(held_out.cameras)
    if not count:
        raise InputError("held_out: expected at least one camera, got none")
    places = np.linspace(0, count - 1, min(count, _JUDGED)).astype(int)
    few = [
        None if some is None else [some[place] for place in places] for some in held_out
    ]
    return HeldOut(*few)  # pyright: ignore[reportArgumentType]


def _reasons(best: Trial, count: int, largest: np.ndarray) -> tuple[Reason, ...]:
    scene = best.scene
    kept, unseen = len(scene.kept), int(np.sum(largest < 1 / 255))
    removed = f"{kept:,} of {count:,}; {unseen:,} never exceed 1/255 of a pixel"
    bits = 8 * best.size / kept
    used = best.scene.coding.palette
    harmonics = f"degree {best.gaussians.sh_degree}"
    if used is not None and used.used:
        harmonics += f", {used.used:,} in a palette"
    reasons = [
        Reason("Gaussians", removed, scene.errors["removal"], "estimate"),
        Reason("harmonics", harmonics, scene.errors["harmonics"], "estimate"),
    ]
    for name, error in scene.errors.items():
        if name not in ("removal", "harmonics"):
            levels = len(np.unique(_numbers(scene.rows, name)))
            why = f"{levels:,} distinct values"
            reasons.append(Reason(name, why, error, "estimate"))
    why = (
        f"{bits:.0f} bits a Gaussian; a bit is worth {scene.price:.2g} of squared error"
    )
    return (*reasons, Reason("price", why))


def _parts(best: Trial, judge: Judge) -> list[Reason]:
    """Return what the first files show, if there are several."""
    reasons = []
    parts = np.unique(best.scene.part)  # empty ones have no file
    if len(parts) == 1:
        return []
    for place, (part, data) in enumerate(zip(parts, best.files), 1):
        count = int(np.sum(best.scene.part <= part))
        places = jnp.arange(best.gaussians.capacity) < count
        shown = judge.judge(select(best.gaussians, places))
        quality = shown.psnr_before if shown.psnr is None else shown.psnr
        why = f"{len(data) / 1e6:.2f} MB; with those before it {count:,} Gaussians"
        reasons.append(Reason(f"part {place}", f"{why}, {decibels(quality)}"))
    return reasons


def _numbers(rows, name: str) -> np.ndarray:
    return rows["sh"][:, 0] if name == "colors" else rows[name]
