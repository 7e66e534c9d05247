"""Cases that put extreme values into parameters, camera and background.

Images and gradients have to stay finite, and Gaussians with non-finite values are not
drawn. A Gaussian that is not drawn has no effect: images and the gradients by other
Gaussians and by the background equal, bit for bit, those of the scene without it. The
gradient by the camera is a sum over all Gaussians, so only its rounding may differ.
"""

from collections.abc import Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.lenses import ORTHOGRAPHIC
from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig
from gsjax.stress import scenes
from gsjax.stress.scenes import BACKGROUND, COMPAT, FIELDS, SLOTS, camera_of, images_of
from gsjax.stress.types import Measurement, StressCase

_F32 = np.finfo(np.float32)
VALUES = (
    *(np.nan, -np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0),
    *(1e-45, -1e-45, 1e-40, float(_F32.tiny), 1e-30, -1e-30, 1e-23, 1e-10),
    *(17.0, 88.8, -88.8, 2.0**24, 2.0**31, -(2.0**31), 1e10, -1e10),
    *(1e19, 1e20, -1e20, 1e30, -1e30, float(_F32.max), -float(_F32.max)),
)


class Violations(NamedTuple):
    """Violations of the rules of this module in one scene.

    Attributes:
      nonfinite: number of non-finite values in images and gradients.
      drawn: poisoned slots that are drawn although their value is not finite.
      changed: number of values that differ from those without the undrawn Gaussians.
      in_view: number of Gaussians drawn.
    """

    nonfinite: int
    drawn: list[int]
    changed: int
    in_view: int


@cache
def entries() -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Return all scalars of a Gaussian as (field, index)."""
    fields = scenes.numpy_fields(scenes.default_scene())
    return tuple((f, i) for f in FIELDS for i in np.ndindex(fields[f].shape[1:]))


def poisoned(value: float, shift: int) -> tuple[Gaussians, dict[int, str]]:
    """Return the default scene with one slot poisoned in each scalar, and which where.

    Over `SLOTS` shifts every scalar of every slot is poisoned once.
    """
    scene, slots = scenes.default_scene(), {}
    fields = scenes.numpy_fields(scene)
    for place, (field, index) in enumerate(entries()):
        slot = (2 * place + shift) % SLOTS
        fields[field][slot, *index] = value
        slots[slot] = f"{field}{list(index)}"
    return scenes.with_params(scene, **fields), slots


def find_violations(
    scene: Gaussians, slots: list[int], value: float, setting: str = "usual"
) -> Violations:
    """Render a scene in which ``slots`` hold ``value``, and check the rules.

    Args:
      setting: key of `settings`.
    """
    draw = partial(scenes.render_and_gradients, **settings()[setting])
    out, gradients = draw(scene)
    images = (*images_of(out), out.median_depth)
    undrawn = out.radii == 0
    clean = scenes.where_slots(undrawn, scenes.default_scene().params, scene.params)
    without = scene.replace(  # pyright: ignore
        params=clean, active=scene.active & ~undrawn
    )
    wanted, others = draw(without)
    changed = scenes.count_unequal(images, (*images_of(wanted), wanted.median_depth))
    changed += scenes.count_unequal(gradients.params, others.params)
    changed += scenes.count_unequal(gradients.background, others.background)
    changed += _beyond_rounding(gradients.camera, others.camera)
    return Violations(
        scenes.count_nonfinite((images, out.radii, gradients)),
        [slot for slot in slots if not np.isfinite(value) and not undrawn[slot]],
        changed,
        int((~undrawn).sum()),
    )


def _beyond_rounding(found: Camera, wanted: Camera) -> int:
    """Return how many gradients differ by more than the order of a sum can cause.

    Non-finite ones are counted elsewhere.
    """
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted))
    return sum(
        int(np.sum(np.abs(a - b) > 1e-5 * np.abs(b).max(initial=1))) for a, b in pairs
    )


@cache
def settings() -> dict[str, dict[str, Any]]:
    """Return ways to render, as arguments of `render_and_gradients`."""
    accurate = RasterConfig.accurate().replace(
        num_size_buckets=1,
        devices=1,
        pair_capacity=COMPAT.pair_capacity,
        outputs=(*COMPAT.outputs, "median_depth"),
    )
    return {
        "usual": {},
        "antialiased": {"config": COMPAT.replace(antialias=True)},
        "accurate": {"config": accurate},
        "occlusion culling": {"config": COMPAT.replace(occlusion=True)},
        "orthographic": {"camera": camera_of(focal=6.0, lens=ORTHOGRAPHIC)},
    }


def other_settings(_full: bool) -> Measurement:
    """Count all violations over ways to render."""
    count, words = 0, []
    others = [setting for setting in settings() if setting != "usual"]
    for setting in others:
        for value in VALUES:
            scene, slots = poisoned(value, 0)
            found = find_violations(scene, list(slots), value, setting)
            some = found.nonfinite + len(found.drawn) + found.changed
            some += found.in_view < SLOTS // 4
            count += some
            if some:
                words.append(f"{value:g}, {setting}: {found}")
    what = f"{', '.join(others)}: {len(VALUES)} values × {len(entries())} numbers"
    return _counted(count, what, words)


def _counted(count: int, what: str, words: list[str]) -> Measurement:
    return Measurement(count, "; ".join([what, *words[:2]]), {"wrong": words})


@cache
def _totals(full: bool) -> tuple[dict[str, int], list[str]]:
    """Return the violations over all values and shifts, and descriptions of them."""
    totals, words = {"nonfinite": 0, "drawn": 0, "changed": 0}, []
    for value in VALUES:
        for shift in range(SLOTS) if full else (0,):
            scene, slots = poisoned(value, shift)
            found = find_violations(scene, list(slots), value)
            totals["nonfinite"] += found.nonfinite
            totals["drawn"] += len(found.drawn)
            totals["changed"] += found.changed
            if found.in_view < SLOTS // 4:
                words.append(f"{value:g} at {shift}: hardly anything was in view")
                totals["changed"] += 1
            if found.nonfinite:
                words.append(f"{value:g} at shift {shift}: not finite")
            words += [f"{value:g} in {slots[slot]} drawn" for slot in found.drawn]
    return totals, words


def parameters(kind: str, full: bool) -> Measurement:
    """Count one kind of violation over all values, scalars and slots."""
    totals, words = _totals(full)
    where = f"{len(VALUES)} values × {len(entries())} numbers"
    where += f" × {SLOTS} slots" if full else ""
    return _counted(totals[kind], where, words)


def camera_entries() -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield all scalars of a camera as (field, index)."""
    for name in ("viewmat", "K", "near", "far"):
        for index in np.ndindex(getattr(camera_of(), name).shape):
            yield name, index


def poisoned_camera(values: dict[tuple[str, tuple[int, ...]], float]) -> Camera:
    """Return a camera with other scalars, unchecked, as it can arise under jit."""
    fields = vars(camera_of()).copy()
    for (name, index), value in values.items():
        array = np.array(fields[name])
        array[index] = value
        fields[name] = jnp.asarray(array)
    return Camera(**fields)


def cameras(_full: bool) -> Measurement:
    """Count non-finite values in images and gradients over poisoned cameras."""
    count, words, renders = 0, [], 0
    for entry in camera_entries():
        for value in VALUES:
            renders += 1
            camera = poisoned_camera({entry: value})
            out, gradients = scenes.render_and_gradients(scenes.default_scene(), camera)
            wrong = scenes.count_nonfinite((images_of(out), out.radii, gradients))
            count += wrong
            if wrong:
                words.append(f"{value:g} in {entry[0]}{list(entry[1])}")
    return _counted(count, f"{renders} cameras", words)


def backgrounds(_full: bool) -> Measurement:
    """Count non-finite values in images and gradients over poisoned backgrounds."""
    count, words = 0, []
    for index in range(3):
        for value in VALUES:
            background = BACKGROUND.copy()
            background[index] = value
            out, gradients = scenes.render_and_gradients(
                scenes.default_scene(), background=background
            )
            wrong = scenes.count_nonfinite((images_of(out), gradients))
            count += wrong
            if wrong:
                words.append(f"{value:g} in background[{index}]")
    return _counted(count, f"{len(VALUES)} values × 3", words)


_NONFINITE = "non-finite images and gradients"
CASES = (
    StressCase("poison/not finite", _NONFINITE, 0, partial(parameters, "nonfinite")),
    StressCase("poison/seen", "NaN or inf drawn", 0, partial(parameters, "drawn")),
    StressCase(
        "poison/traces", "live numbers changed", 0, partial(parameters, "changed")
    ),
    StressCase(
        "poison/settings", "any of the above", 0, other_settings, full_only=True
    ),
    StressCase("poison/camera", _NONFINITE, 0, cameras),
    StressCase("poison/background", _NONFINITE, 0, backgrounds),
)
