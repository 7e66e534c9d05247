"""The one place that chooses a compositing kernel, for every platform.

`COMPOSITORS` lists the kernels in order of preference. A kernel that JAX differentiates
runs as it stands. A kernel with a reverse pass of its own runs with a rule: gradients
go through its reverse pass; forward mode, second order and everything beyond go through
the first kernel that JAX differentiates, so that all of them agree to rounding.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
from jax.custom_batching import sequential_vmap
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from gsjax.raster.compositing.chunked import CHUNKED
from gsjax.raster.compositing.fused_sorted import SORTED
from gsjax.raster.compositing.fused_vjp import FUSED
from gsjax.raster.compositing.fused_window_vjp import WINDOWED
from gsjax.raster.compositing.ordered import ORDERED
from gsjax.raster.compositing.parallel import PARALLEL
from gsjax.raster.compositing.types import Compositor, Images, Task, Tiles
from gsjax.raster.types import Array, Channels, Splat
from gsjax.runtime.custom_transpose import custom_transpose, jvp_of_active

COMPOSITORS = (FUSED, CHUNKED, PARALLEL, WINDOWED, SORTED, ORDERED)

# Under `jax.vmap`, side by side, each element would wait for the longest, and every
# turn of a loop would copy the images of all.
_one_by_one = sequential_vmap


def choose(task: Task) -> Compositor:
    """Return the kernel that draws."""
    return next(each for each in COMPOSITORS if each.suits(task))


def choose_differentiable(task: Task) -> Compositor:
    """Return the kernel that JAX differentiates."""
    return next(x for x in COMPOSITORS if x.differentiable and x.suits(task))


def choose_for_gradient(task: Task) -> Compositor:
    """Return the kernel whose reverse pass a gradient goes through."""
    chosen = choose(task)
    own = chosen.reverse is not None and chosen.reverse.suits(task)
    return chosen if own else choose_differentiable(task)


def composite(tiles: Tiles, task: Task) -> tuple[Images, Array]:
    """Return the images of one device's tiles, and the pair capacity needed.

    Args:
      tiles: what is composited.
      task: static description.

    Returns:
      Images before the background; see `Compositor`. [] int32 pair capacity.
    """
    chosen = choose(task)
    needed = choose_for_gradient(task).capacity(tiles.lists, task)
    if chosen.differentiable is chosen.forward:
        return chosen.forward(tiles, task), needed
    return _composite(tiles, task), needed


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _composite(tiles: Tiles, task: Task) -> Images:
    @_one_by_one
    def one(tiles):
        return choose(task).forward(tiles, task)

    return one(tiles)


@partial(_composite.defjvp, symbolic_zeros=True)
def _composite_jvp(task, primals, tangents):
    (tiles,) = primals
    leaves, tree = jax.tree.flatten(tiles)
    slopes = tree.flatten_up_to(tangents[0])
    chosen = choose(task)
    own = chosen.reverse is not None and chosen.reverse.suits(task)
    automatic = _automatic(task._replace(room_for_all=own))

    def stepped(*leaves):
        return automatic(jax.tree.unflatten(tree, leaves))

    if not own:
        return jvp_of_active(stepped, leaves, slopes, SymbolicZero)
    images, residuals = _with_residuals(tiles, task)
    names = tuple(images)
    active = [i for i, s in enumerate(slopes) if not isinstance(s, SymbolicZero)]
    count, kinds = len(leaves), _kinds(tiles, active)
    residuals, of_residuals = jax.tree.flatten(residuals)

    def forward(*values):
        slopes = dict(zip(active, values[count + len(residuals) :]))
        slopes = [slopes.get(i) for i in range(count)]
        rates = jvp_of_active(stepped, values[:count], slopes, type(None))[1]
        return [rates[name] for name in names]

    def transpose(*values):
        tiles = jax.tree.unflatten(tree, values[:count])
        residuals = jax.tree.unflatten(of_residuals, values[count : -len(names)])
        cotangents = dict(zip(names, values[-len(names) :]))
        back = _backward(tiles, residuals, cotangents, task, kinds)
        return [jax.tree.leaves(back)[i] for i in active]

    slopes, like = [slopes[i] for i in active], [images[name] for name in names]
    rates = custom_transpose(forward, transpose, (*leaves, *residuals), slopes, like)
    return images, dict(zip(names, rates))


def _automatic(task: Task) -> Callable[[Tiles], Images]:
    """Return the kernel that JAX differentiates, as a function of `Tiles`."""
    differentiable = choose_differentiable(task).differentiable
    assert differentiable is not None
    return lambda tiles: differentiable(tiles, task)


def _kinds(tiles: Tiles, active: list[int]) -> frozenset[str]:
    """Return the kinds of cotangents needed, from the indices of active leaves."""
    of_splat = len(jax.tree.leaves(tiles.splat))
    kinds = {"splats" if i < of_splat else "channels" for i in active}
    return frozenset(kinds)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _with_residuals(tiles: Tiles, task: Task) -> tuple[Images, Any]:
    """Return the images and the residuals, of which no derivative is taken."""
    reverse = choose(task).reverse
    assert reverse is not None

    @_one_by_one
    def one(tiles):
        return reverse.forward(tiles, task)

    return one(tiles)


@partial(_with_residuals.defjvp, symbolic_zeros=True)
def _with_residuals_jvp(task, primals, tangents):
    images, residuals = _with_residuals(*primals, task)
    _, slopes = _composite_jvp(task, primals, tangents)
    return (images, residuals), (slopes, jax.tree.map(zero_from_primal, residuals))


@partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _backward(
    tiles: Tiles, residuals: Any, cotangents: Images, task: Task, kinds: frozenset[str]
) -> tuple[Splat, Channels]:
    """Return the reverse pass; its own derivative is that of the automatic kernel."""
    reverse = choose(task).reverse
    assert reverse is not None

    @_one_by_one
    def one(tiles, residuals, cotangents):
        return reverse.backward(tiles, residuals, cotangents, task, kinds)

    return one(tiles, residuals, cotangents)


@_backward.defjvp
def _backward_jvp(task, kinds, primals, tangents):
    tiles, _, cotangents = primals
    automatic = _automatic(task._replace(room_for_all=True))

    def by_transpose(splat, channels, cotangents):
        def images(splat, channels):
            return automatic(tiles._replace(splat=splat, channels=channels))

        return jax.vjp(images, splat, channels)[1](cotangents)

    given = tiles.splat, tiles.channels, cotangents
    slopes = tangents[0].splat, tangents[0].channels, tangents[2]
    back = _backward(*primals, task, kinds)
    return back, jax.jvp(by_transpose, given, slopes)[1]
