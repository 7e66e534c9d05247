"""Worker of `compare_commits`: runs the gsjax that PYTHONPATH points to.

It works with gsjax from commit d11a333 on. Names that have changed since are resolved
in `first_import`. Scenes come from .npz files, so that all commits see the same inputs.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gsjax

PARAMS = ("means", "quats", "log_scales", "logit_opacities", "sh")
INPUTS = (*PARAMS, "viewmat", "K", "background")
OUTPUTS = ("rgb", "alpha", "depth")


def first_import(*names: str) -> Any:
    """Return the first ``module:attribute`` that exists; None if none does."""
    for name in names:
        module, attribute = name.split(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError):
            continue
    return None


def replicate(tree: Any) -> Any:
    """Put the arrays on all devices, if this version has a function for it."""
    place = first_import(
        "gsjax.runtime.devices:replicate", "gsjax.devices:on_all_devices"
    )
    return tree if place is None else place(tree)


class Case(NamedTuple):
    """A scene and what is rendered of it.

    Attributes:
      inputs: arrays by name, see `INPUTS`.
      view: width, height, near and far.
      photo: [H, W, 3] uint8, the target of a training step.
    """

    inputs: dict[str, jax.Array]
    view: dict[str, Any]
    photo: np.ndarray

    def gaussians(self, inputs: dict) -> Any:
        return gsjax.make_gaussians(**{name: inputs[name] for name in PARAMS})

    def camera(self, inputs: dict) -> Any:
        return gsjax.make_camera(viewmat=inputs["viewmat"], K=inputs["K"], **self.view)


def load_case(path: Path, dtype: str) -> Case:
    """Load a scene that `compare_commits.write_scene` wrote."""
    with np.load(path) as data:
        inputs = {name: jnp.asarray(data[name].astype(dtype)) for name in INPUTS}
        view = {name: int(data[name]) for name in ("width", "height")}
        view |= {name: float(data[name]) for name in ("near", "far")}
        return Case(inputs, view, data["photo"])


def prepare_case(case: Case, plain: bool) -> tuple[Case, Any]:
    """Return the case as a render takes it, and its config.

    A plain side uses the default config and leaves the arrays where they are; the
    other side uses capacities that fit, and arrays on all devices.
    """
    config = gsjax.RasterConfig()
    if plain:
        return case, config
    gaussians, camera = case.gaussians(case.inputs), case.camera(case.inputs)
    config = gsjax.exact_config(gaussians, camera, config)
    return case._replace(inputs=replicate(case.inputs)), config


def cotangents(case: Case, name: str) -> dict[str, jax.Array]:
    """Return fixed random cotangents of the images."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    size = case.view["height"], case.view["width"]
    dtype = case.inputs["means"].dtype
    shapes = {"rgb": (*size, 3), "alpha": size, "depth": size}
    return {k: jnp.asarray(rng.normal(size=s), dtype) for k, s in shapes.items()}


def make_picture(case: Case, config: Any) -> Callable[[dict], Any]:
    """Return inputs → `gsjax.Render`, not jitted."""

    def picture(inputs: dict):
        gaussians, camera = case.gaussians(inputs), case.camera(inputs)
        return gsjax.render(gaussians, camera, config, inputs["background"])

    return picture


def make_gradient(
    case: Case, config: Any, by_image: dict, names: tuple[str, ...]
) -> Callable[[dict], tuple[Any, Any]]:
    """Return inputs → (value, gradient by the named inputs), jitted."""
    picture = make_picture(case, config)

    def objective(some, rest):
        view = picture({**rest, **some})
        return sum(jnp.vdot(by_image[name], getattr(view, name)) for name in by_image)

    slopes = jax.jit(jax.value_and_grad(objective))

    def call(inputs: dict):
        some = {name: inputs[name] for name in names}
        rest = {name: inputs[name] for name in inputs if name not in names}
        return slopes(some, rest)

    return call


def make_step(case: Case, config: Any) -> Callable[[dict], Any]:
    """Return inputs → (state, metrics) of one training step, jitted."""
    train = gsjax.TrainConfig()
    batch_type = first_import("gsjax.train.frames:Batch")
    init_state = first_import("gsjax.train.state:init_state")
    camera = case.camera(case.inputs)
    batch = batch_type(
        pixels=jnp.asarray(case.photo[None]),
        valid=None,
        camera=jax.tree.map(lambda a: a[None], camera),
        view=jnp.zeros(1, jnp.int32),
    )
    state = init_state(case.gaussians(case.inputs), train, 1.0, 1)
    raster = train.raster.replace(pair_capacity=config.pair_capacity)
    step = jax.jit(gsjax.make_train_step(train, 1.0, raster=raster))
    if config.pair_capacity is not None:
        state, batch = replicate((state, batch))
    return lambda _: step(state, batch)


TASKS = ("picture", "gradient", "step")


def make_task(case: Case, config: Any, task: str) -> Callable[[], Any]:
    """Return what one timed call runs."""
    if task == "picture":
        function = jax.jit(make_picture(case, config))
    elif task == "gradient":
        weights = {"rgb": cotangents(case, "speed")["rgb"]}
        function = make_gradient(case, config, weights, PARAMS)
    else:
        function = make_step(case, config)
    return partial(function, case.inputs)


def write_bits(folder: Path, names: list[str], dtype: str, out: Path) -> None:
    """Write picture and gradient of the scenes to an .npz, as ``scene/kind/name``."""
    found = {}
    for name in names:
        case, config = prepare_case(load_case(folder / f"{name}.npz", dtype), False)
        view = jax.jit(make_picture(case, config))(case.inputs)
        gradient = make_gradient(case, config, cotangents(case, name), INPUTS)
        _, slopes = gradient(case.inputs)
        assert not bool(view.overflowed), f"{name}: {view.demand}"
        found |= {f"{name}/picture/{k}": getattr(view, k) for k in OUTPUTS}
        found |= {f"{name}/gradient/{k}": v for k, v in slopes.items()}
    np.savez(out, **jax.device_get(found))


def seconds(call: Callable[[], Any], count: int = 1) -> float:
    """Return the seconds a call takes, the mean of ``count``."""
    start = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(call())
    return (time.perf_counter() - start) / count


def first_call(path: Path, task: str, capacities: str, start: float) -> dict:
    """Return seconds of the import and of the first call of a task in this process."""
    imported = time.perf_counter() - start
    case = load_case(path, "float32")
    config = gsjax.RasterConfig(**json.loads(capacities))
    call = make_task(case, config, task)
    jax.block_until_ready(jnp.zeros(3) + 1)
    return {"import": imported, "first": seconds(call), "second": seconds(call)}


def capacities_of(path: Path) -> dict:
    """Return the capacities that fit a scene."""
    _, config = prepare_case(load_case(path, "float32"), False)
    return {k: getattr(config, k) for k in ("pair_capacity", "visible_capacity")}


def serve(folder: Path, plain: bool, reply: Any) -> None:
    """Answer the requests on standard input, one JSON list a line.

    ["prepare", scene, task] → seconds of a call; ["time", count] → seconds.
    """
    call: Callable[[], Any] = lambda: None  # noqa: E731
    for line in sys.stdin:
        what, *given = json.loads(line)
        if what == "prepare":
            scene, task = given
            case = load_case(folder / f"{scene}.npz", "float32")
            case, config = prepare_case(case, plain)
            call = make_task(case, config, task)
            seconds(call)
            found = seconds(call, 3)
        else:
            found = seconds(call, given[0])
        print(json.dumps(found), file=reply, flush=True)


def main() -> None:
    """Run one of: bits, cold, capacities, serve."""
    # Replies go to the original standard output, and all else to standard error.
    reply = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    mode, folder, *rest = sys.argv[1:]
    start = float(os.environ.get("COMPARE_START", "0")) or time.perf_counter()
    plain = os.environ.get("COMPARE_PLAIN") == "1"
    if not plain:
        gsjax.use_all_cores()
    print(f"gsjax of {Path(gsjax.__file__).parent}", file=sys.stderr)
    if mode == "bits":
        dtype, out, *names = rest
        write_bits(Path(folder), names, dtype, Path(out))
    elif mode == "cold":
        scene, task, capacities = rest
        path = Path(folder) / f"{scene}.npz"
        print(json.dumps(first_call(path, task, capacities, start)), file=reply)
    elif mode == "capacities":
        print(json.dumps(capacities_of(Path(folder) / f"{rest[0]}.npz")), file=reply)
    else:
        serve(Path(folder), plain, reply)


if __name__ == "__main__":
    main()
