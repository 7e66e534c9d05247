"""Poison in every number of the parameters, the camera and the background.

The law: images and gradients stay finite; what is not a number vanishes; and what is
not seen leaves no trace, so that images and the gradients by each Gaussian and by the
background are those, bit for bit, of the scene in which it does not exist. Gradients by
the camera are sums over all Gaussians, whose order may change: those are held to the
rounding of such sums.
"""

from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.lenses import ORTHOGRAPHIC
from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig
from gsjax.stress.scenes import (
    BACKGROUND,
    COMPAT,
    FIELDS,
    SLOTS,
    camera_of,
    changed,
    host_fields,
    not_finite,
    unequal,
    usual,
    usual_gradients,
)
from gsjax.stress.types import Case, Measured

_F32 = np.finfo(np.float32)
VALUES = (
    *(np.nan, -np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0),
    *(1e-45, -1e-45, 1e-40, float(_F32.tiny), 1e-30, -1e-30, 1e-23, 1e-10),
    *(17.0, 88.8, -88.8, 2.0**24, 2.0**31, -(2.0**31), 1e10, -1e10),
    *(1e19, 1e20, -1e20, 1e30, -1e30, float(_F32.max), -float(_F32.max)),
)


@cache
def entries() -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Every single number of a Gaussian: (field, index)."""
    fields = host_fields(usual())
    return tuple((f, i) for f in FIELDS for i in np.ndindex(fields[f].shape[1:]))


def poisoned(value: float, shift: int) -> tuple[Gaussians, dict[int, str]]:
    """The usual scene, one slot spoilt in each number: which slot in which.

    Over all `SLOTS` shifts every number of every slot has its turn.
    """
    fields, slots = host_fields(usual()), {}
    for place, (field, index) in enumerate(entries()):
        slot = (2 * place + shift) % SLOTS
        fields[field][slot, *index] = value
        slots[slot] = f"{field}{list(index)}"
    return changed(usual(), **fields), slots


def traces(
    scene: Gaussians, spoilt: list[int], value: float, setting: str = "usual"
) -> dict[str, list[int]]:
    """What is wrong with a scene of which ``spoilt`` slots hold ``value``.

    Args:
      setting: of `settings`.

    Returns:
      "not finite": how many numbers; "seen": spoilt slots that show although their
      value is no finite number; "traces": how many numbers differ from those of the
      scene without what is not seen.
    """
    seen_by = partial(usual_gradients, **settings()[setting])
    out, slopes = seen_by(scene)
    images = (out.rgb, out.alpha, out.depth, out.median_depth, out.radii)
    unseen = out.radii == 0
    clean = jax.tree.map(
        lambda bad, good: jnp.where(
            unseen.reshape(-1, *(1,) * (bad.ndim - 1)), good, bad
        ),
        scene.params,
        usual().params,
    )
    without = scene.replace(params=clean, active=scene.active & ~unseen)  # pyright: ignore
    wanted, wanted_slopes = seen_by(without)
    others = (wanted.rgb, wanted.alpha, wanted.depth, wanted.median_depth)
    difference = unequal(images[:4], others)
    difference += unequal(slopes.params, wanted_slopes.params)
    difference += unequal(slopes.background, wanted_slopes.background)
    difference += _beyond_rounding(slopes.camera, wanted_slopes.camera)
    return {
        "not finite": [not_finite(images), not_finite(slopes)],
        "seen": [s for s in spoilt if not np.isfinite(value) and not unseen[s]],
        "traces": [difference, int((~unseen).sum())],
    }


def _beyond_rounding(found: Camera, wanted: Camera) -> int:
    """Slopes of a camera, sums over all that is seen, that differ by more than the
    order of the terms of a sum can do; not finite ones are counted elsewhere.
    """
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted))
    return sum(
        int(np.sum(np.abs(a - b) > 1e-5 * np.abs(b).max(initial=1))) for a, b in pairs
    )


def _sweep(full: bool) -> Iterator[tuple[float, int, dict, dict]]:
    for value in VALUES:
        for shift in range(SLOTS) if full else (0,):
            scene, slots = poisoned(value, shift)
            yield value, shift, slots, traces(scene, list(slots), value)


@cache
def settings() -> dict[str, dict[str, Any]]:
    """Ways to render, as arguments of `usual_gradients`."""
    outputs = (*COMPAT.outputs, "median_depth")
    accurate = RasterConfig.accurate().replace(
        num_size_buckets=1,
        devices=1,
        pair_capacity=COMPAT.pair_capacity,
        outputs=outputs,
    )
    level = {"focal": 6.0, "lens": ORTHOGRAPHIC}
    return {
        "usual": {},
        "antialiased": {"config": COMPAT.replace(antialias=True)},
        "accurate": {"config": accurate},
        "orthographic": {"camera": camera_of(**level)},
    }


def of_settings(full: bool) -> Measured:
    """All that `traces` counts, over ways to render, values and numbers."""
    del full
    count, words, others = 0, [], [name for name in settings() if name != "usual"]
    for setting in others:
        for value in VALUES:
            scene, slots = poisoned(value, 0)
            wrong = traces(scene, list(slots), value, setting)
            changes, seen = wrong["traces"]
            some = sum(wrong["not finite"]) + len(wrong["seen"]) + changes
            some += seen < SLOTS // 4
            count += some
            if some:
                words.append(f"{value:g}, {setting}: {wrong}")
    what = f"{', '.join(others)}: {len(VALUES)} values × {len(entries())} numbers"
    return Measured(count, "; ".join([what, *words[:2]]), {"wrong": words})


@cache
def _found(full: bool) -> tuple[dict[str, int], list[str]]:
    """Counts over the sweep, and some words on what was wrong."""
    totals, words = {"not finite": 0, "seen": 0, "traces": 0}, []
    for value, shift, slots, wrong in _sweep(full):
        totals["not finite"] += sum(wrong["not finite"])
        totals["seen"] += len(wrong["seen"])
        totals["traces"] += wrong["traces"][0]
        if wrong["traces"][1] < SLOTS // 4:
            words.append(f"{value:g} at {shift}: hardly anything was in view")
            totals["traces"] += 1
        if sum(wrong["not finite"]):
            words.append(f"{value:g} at shift {shift}: not finite")
        words += [f"{value:g} in {slots[s]} seen" for s in wrong["seen"]]
    return totals, words


def of_parameters(kind: str):
    """Measures one of the counts of `traces` over all values, numbers and slots."""

    def measure(full: bool) -> Measured:
        totals, words = _found(full)
        where = f"{len(VALUES)} values × {len(entries())} numbers"
        where += f" × {SLOTS} slots" if full else ""
        return Measured(totals[kind], "; ".join([where, *words[:2]]), {"wrong": words})

    return measure


def camera_entries() -> Iterator[tuple[str, tuple[int, ...]]]:
    """Every single number of a camera: (field, index)."""
    for name in ("viewmat", "K", "near", "far"):
        for index in np.ndindex(getattr(camera_of(), name).shape):
            yield name, index


def spoilt_camera(values: dict[tuple[str, tuple[int, ...]], float]) -> Camera:
    """As it can arise under jit, where nothing can be refused."""
    fields = vars(camera_of()).copy()
    for (name, index), value in values.items():
        array = np.array(fields[name])
        array[index] = value
        fields[name] = jnp.asarray(array)
    return Camera(**fields)


def of_cameras(full: bool) -> Measured:
    """Numbers that are not finite, in images and gradients, over spoilt cameras."""
    del full
    count, words, renders = 0, [], 0
    for entry in camera_entries():
        for value in VALUES:
            renders += 1
            out, slopes = usual_gradients(usual(), spoilt_camera({entry: value}))
            wrong = not_finite((out.rgb, out.alpha, out.depth, out.radii, slopes))
            count += wrong
            if wrong:
                words.append(f"{value:g} in {entry[0]}{list(entry[1])}")
    return Measured(
        count, "; ".join([f"{renders} cameras", *words[:2]]), {"wrong": words}
    )


def of_backgrounds(full: bool) -> Measured:
    """Numbers that are not finite, in images and gradients, over backgrounds."""
    del full
    count, words = 0, []
    for index in range(3):
        for value in VALUES:
            background = BACKGROUND.copy()
            background[index] = value
            out, slopes = usual_gradients(usual(), background=background)
            wrong = not_finite((out.rgb, out.alpha, out.depth, slopes))
            count += wrong
            if wrong:
                words.append(f"{value:g} in background[{index}]")
    what = f"{len(VALUES)} values × 3"
    return Measured(count, "; ".join([what, *words[:2]]), {"wrong": words})


CASES = (
    Case("poison/not finite", "images and gradients", 0, of_parameters("not finite")),
    Case("poison/seen", "Gaussians of NaN or inf seen", 0, of_parameters("seen")),
    Case("poison/traces", "live numbers changed", 0, of_parameters("traces")),
    Case("poison/settings", "any of these", 0, of_settings, full_only=True),
    Case("poison/camera", "images and gradients not finite", 0, of_cameras),
    Case("poison/background", "images and gradients not finite", 0, of_backgrounds),
)
