"""What a run compiles: the stages of its step, side by side and no more than change.

To differentiate is most of a step's compiling, and alone of the stages depends on the
photographs' size and on the room for pairs. The others go with the slots; they compile
on a second core while that one is traced.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gsjax.densify.schedule import edits_between
from gsjax.raster.render import device_count
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import replicated_sharding
from gsjax.runtime.memory import require
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Frames, draw
from gsjax.train.memory_estimate import step_estimate
from gsjax.train.state import Gradients, Metrics, TrainState, gradients_like
from gsjax.train.step import Stages, make_stages

Array = jax.Array


class StepCompiler:
    """The compiled stages of one run, by their sizes.

    Attributes:
      by_sizes: differentiating, by size of the photographs, slots and settings.
      by_slots: the stages behind it, by slots.
    """

    def __init__(
        self, config: TrainConfig, extent: float, phase: Callable[[str], None]
    ):
        """For a run of these settings; ``phase`` is told what is being compiled."""
        self._config, self._extent, self._phase = config, extent, phase
        self._whole = replicated_sharding(device_count(config.raster))
        self._worker = ThreadPoolExecutor(1)
        self.by_sizes: dict[Any, Any] = {}
        self.by_slots: dict[int, _Behind] = {}

    def close(self) -> None:
        """Begin nothing more; what is being compiled nobody waits for."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def place(self, tree: Any) -> Any:
        """``tree`` where the programs want it: on all devices that they run on."""
        return tree if self._whole is None else jax.device_put(tree, self._whole)

    def step(
        self, state: TrainState, frames: Frames, raster: RasterConfig
    ) -> "CompiledStep":
        """The stages for these sizes, compiled; editing perhaps not yet.

        Raises:
          CapacityError: if it would take more memory than there is.
        """
        slots = state.gaussians.capacity
        kind = (frames.pixels.shape, jax.tree.structure(frames))  # what it lacks, too
        sizes = (kind, slots, raster)
        if sizes not in self.by_sizes:
            self._compile(sizes, state, frames, raster)
        return CompiledStep(self.by_sizes[sizes], self.by_slots[slots])

    def _compile(
        self, sizes: Any, state: TrainState, frames: Frames, raster: RasterConfig
    ) -> None:
        config, slots = self._config, state.gaussians.capacity
        height, width = frames.pixels.shape[1:3]
        told = f"{width} × {height} px, {slots:,} slots, {raster.pair_capacity:,} pairs"
        self._phase(f"compiling, half a minute or so, for {told}")
        require(
            step_estimate(slots, (width, height), config, raster, frames.pixels.nbytes),
            f"a step for {told},",
            "train with smaller photographs (--max-size) or fewer Gaussians "
            "(--max-gaussians)",
        )
        stages = make_stages(config, self._extent, raster)

        def differentiate(state: TrainState, frames: Frames, view: Array) -> Gradients:
            return stages.differentiate(state, draw(frames, view))

        if slots not in self.by_slots:
            self.by_slots[slots] = self._begin(state, stages)
        view = jax.ShapeDtypeStruct((config.batch,), jnp.int32)
        inputs = self._shapes((state, frames, view))
        self.by_sizes[sizes] = self._jit(differentiate).lower(*inputs).compile()
        self.by_slots[slots].advance.result()

    def _begin(self, state: TrainState, stages: Stages) -> "_Behind":
        """Compile in another thread; it is traced in this one, whose settings of JAX
        are meant."""
        config, strategy = self._config, self._config.chosen
        shapes, found = self._shapes((state, gradients_like(state, config.batch)))
        advance = self._jit(stages.advance, donate_argnums=0).lower(shapes, found)
        advancing = self._worker.submit(advance.compile)
        when = strategy.start, strategy.stop, strategy.every
        if not edits_between(0, config.steps, *when):
            return _Behind(advancing, None)
        _, metrics, _ = advance.out_info
        edit = self._jit(stages.edit, donate_argnums=0)
        edit = edit.lower(shapes, self._shapes(metrics))
        return _Behind(advancing, self._worker.submit(edit.compile))

    def _jit(self, stage: Callable, **options):
        return jax.jit(stage, out_shardings=self._whole, **options)

    def _shapes(self, tree: Any) -> Any:
        """Of arrays that lie where the programs want them, or on the one device that
        they were put on."""

        def shape(a):
            put = isinstance(a, jax.Array) and a.committed
            lies = self._whole or (a.sharding if put else None)
            return jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=lies)

        return jax.tree.map(shape, tree)


class _Behind(NamedTuple):
    """What goes with the slots alone; no edit in a run without any."""

    advance: Future
    edit: Future | None


class CompiledStep(NamedTuple):
    """One step of a run by its compiled stages; see `gsjax.train.step.make_stages`."""

    differentiate: Any
    behind: _Behind

    def __call__(
        self, state: TrainState, frames: Frames, view: Array
    ) -> tuple[TrainState, Metrics]:
        """As `gsjax.train.step.TrainStep`, metrics on the host; the state's memory is
        taken over."""
        found = self.differentiate(state, frames, view)
        state, metrics, due = self.behind.advance.result()(state, found)
        del found
        if due:
            assert self.behind.edit is not None
            state, metrics = self.behind.edit.result()(state, metrics)
        return state, jax.device_get(metrics)
