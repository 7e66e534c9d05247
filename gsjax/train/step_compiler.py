"""Concurrent compilation of the stages of a training step, by their sizes.

Differentiation is most of the compile time, and the only stage that depends on the size
of the photographs and the pair capacity. The other stages depend on the slots alone;
they compile in a second thread while differentiation is traced.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gsjax.raster.tile_render import device_count
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import replicated_sharding
from gsjax.runtime.memory import require
from gsjax.train.frames import Frames, draw
from gsjax.train.memory_estimate import step_estimate
from gsjax.train.state import Gradients, Metrics, Setup, TrainState, gradients_like
from gsjax.train.step import Stages, make_stages, step_raster

Array = jax.Array


class StepCompiler:
    """Compiled stages of one run, by their sizes.

    Attributes:
      by_sizes: differentiation, by size of the photographs, slots and render settings.
      by_slots: the other stages, by number of slots.
    """

    def __init__(self, setup: Setup, phase: Callable[[str], None]):
        """Prepare the compilation of a run; ``phase`` receives progress messages."""
        self._setup, self._phase = setup, phase
        self._sharding = replicated_sharding(device_count(setup.config.raster))
        self._worker = ThreadPoolExecutor(1)
        refresh = make_stages(setup).refresh
        self._refresh = None if refresh is None else self._jit(refresh)
        self.by_sizes: dict[Any, Any] = {}
        self.by_slots: dict[int, tuple[Future, Future | None]] = {}

    def close(self) -> None:
        """Cancel compilations that have not started."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def place(self, tree: Any) -> Any:
        """Return ``tree`` on all devices that the programs run on."""
        return tree if self._sharding is None else jax.device_put(tree, self._sharding)

    def refresh(self, state: TrainState, frames: Frames) -> TrainState:
        """Return the state after `Stages.refresh`, or unchanged without one."""
        if self._refresh is None:
            return state
        return self._refresh(state, frames.camera.replace(visible_size=frames.size))

    def step(
        self, state: TrainState, frames: Frames, raster: RasterConfig
    ) -> "CompiledStep":
        """Return the step for these sizes; its edit may still be compiling.

        Raises:
          CapacityError: if it would take more memory than is available.
        """
        slots = state.gaussians.capacity
        sizes = (frames.pixels.shape, jax.tree.structure(frames), slots, raster)
        if sizes not in self.by_sizes:
            self._compile(sizes, state, frames, raster)
        return CompiledStep(self.by_sizes[sizes], *self.by_slots[slots])

    def _compile(
        self, sizes: Any, state: TrainState, frames: Frames, raster: RasterConfig
    ) -> None:
        setup, slots = self._setup, state.gaussians.capacity
        height, width = frames.pixels.shape[1:3]
        told = f"{width} × {height} px, {slots:,} slots, {raster.pair_capacity:,} pairs"
        self._phase(f"compiling (about 30 s) for {told}")
        size, raster_used = (width, height), step_raster(setup, raster)
        nbytes = frames.pixels.nbytes
        require(
            step_estimate(slots, size, setup.config, raster_used, nbytes),
            f"a step for {told},",
            "train with smaller photographs (--max-size) or fewer Gaussians "
            "(--max-gaussians)",
        )
        stages = make_stages(setup, raster)

        def differentiate(state: TrainState, frames: Frames, view: Array) -> Gradients:
            return stages.differentiate(state, draw(frames, view))

        if slots not in self.by_slots:
            self.by_slots[slots] = self._compile_slot_stages(state, stages)
        view = jax.ShapeDtypeStruct((setup.config.batch,), jnp.int32)
        inputs = self._shapes((state, frames, view))
        self.by_sizes[sizes] = self._jit(differentiate).lower(*inputs).compile()
        self.by_slots[slots][0].result()

    def _compile_slot_stages(
        self, state: TrainState, stages: Stages
    ) -> tuple[Future, Future | None]:
        """Trace here, because JAX's settings are per thread; compile in the other."""
        config, schedule = self._setup.config, self._setup.schedule
        shapes, found = self._shapes((state, gradients_like(state, config.batch)))
        advance = self._jit(stages.advance, donate_argnums=0).lower(shapes, found)
        advancing = self._worker.submit(advance.compile)
        if not schedule.edits_between(0, config.steps):
            return advancing, None
        metrics = self._shapes(advance.out_info[1])
        edit = self._jit(stages.edit, donate_argnums=0).lower(shapes, metrics)
        return advancing, self._worker.submit(edit.compile)

    def _jit(self, stage: Callable, **options):
        return jax.jit(stage, out_shardings=self._sharding, **options)

    def _shapes(self, tree: Any) -> Any:
        """Return shapes with the sharding of the programs, or of committed arrays."""

        def shape(a):
            committed = isinstance(a, jax.Array) and a.committed
            sharding = self._sharding or (a.sharding if committed else None)
            return jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=sharding)

        return jax.tree.map(shape, tree)


class CompiledStep(NamedTuple):
    """A training step from compiled stages; see `gsjax.train.step.make_stages`."""

    differentiate: Any
    advance: Future
    edit: Future | None  # None in runs without edits

    def __call__(
        self, state: TrainState, frames: Frames, view: Array
    ) -> tuple[TrainState, Metrics]:
        """Run a step; donates the state and returns the metrics on the host."""
        found = self.differentiate(state, frames, view)
        state, metrics, due = self.advance.result()(state, found)
        del found
        if due:
            assert self.edit is not None
            state, metrics = self.edit.result()(state, metrics)
        return state, jax.device_get(metrics)
