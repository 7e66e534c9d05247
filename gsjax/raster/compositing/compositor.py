"""Front-to-back compositing of sorted tile lists on a CPU, and which way it goes; see
`gsjax.raster.compositing.parallel` for accelerators.

Gaussian by Gaussian (`gsjax.raster.compositing.fused`), and back so for a gradient
(`gsjax.raster.compositing.fused_vjp`), where XLA makes one kernel of that. Else chunk by chunk
(`gsjax.raster.compositing.chunked`), as what is differentiated forward, or more than once, always
goes: then JAX differentiates, and both ways agree to rounding.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks.
"""

from functools import partial

import jax
from jax.custom_batching import sequential_vmap
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from gsjax.raster.compositing import fused, fused_vjp
from gsjax.raster.compositing.chunked import composite_chunks, composite_steps
from gsjax.raster.compositing.fused import Residuals, composite_fused
from gsjax.raster.compositing.schedules import Schedule
from gsjax.raster.lists.binning import Grid, Lists
from gsjax.raster.types import Array, Projected, RasterConfig
from gsjax.runtime.custom_transpose import custom_transpose, jvp_of_active

# Under `jax.vmap`: side by side each would wait for the longest, and every turn of a
# loop copy the images of all.
_one_by_one = sequential_vmap


@partial(jax.custom_jvp, nondiff_argnums=(4, 5, 6))
def composite(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
) -> dict[str, Array]:
    """Images of one device's tiles, before the background.

    Args:
      projected: [R].
      lists: of the tiles.
      schedule: of the lists.
      device: [] its number.
      grid: its tiles.
      room: steps there is room for where a derivative is taken.
      config: static settings.

    Returns:
      "sums" [T, C, P]: colour, depth where asked for, alpha; "median" [T, P] where
      asked for. T in the grid's order.
    """
    del room

    @_one_by_one
    def one(projected, lists, schedule, device):
        if fused.suits(*_sizes(projected), grid):
            return composite_fused(projected, lists, device, grid, config)[0]
        return composite_chunks(projected, lists, schedule, device, grid, config)

    return one(projected, lists, schedule, device)


@partial(composite.defjvp, symbolic_zeros=True)
def _composite_jvp(grid, room, config, primals, tangents):
    """By what is differentiated alone."""
    projected, lists, schedule, device = primals
    leaves, tree = jax.tree.flatten(primals)
    slopes = tree.flatten_up_to(tangents)

    def stepped(*leaves):
        projected, lists, schedule, device = jax.tree.unflatten(tree, leaves)
        return composite_steps(projected, lists, schedule, device, grid, room, config)

    if not fused_vjp.suits(*_sizes(projected), grid, config):
        return jvp_of_active(stepped, leaves, slopes, SymbolicZero)
    images, kept = _keeping(projected, lists, schedule, device, grid, room, config)
    moving = [i for i, s in enumerate(slopes) if not isinstance(s, SymbolicZero)]
    count, by = len(leaves), _kinds(moving)
    kept, of_kept = jax.tree.flatten(kept)

    def forward(*values):
        slopes = dict(zip(moving, values[count + len(kept) :]))
        slopes = [slopes.get(i) for i in range(count)]
        return [jvp_of_active(stepped, values[:count], slopes, type(None))[1]["sums"]]

    def transpose(*values):
        primals = jax.tree.unflatten(tree, values[:count])
        kept = jax.tree.unflatten(of_kept, values[count:-1])
        back = _pulled_back(*primals, kept, values[-1], grid, room, config, by)
        return [jax.tree.leaves(back)[i] for i in moving]

    slopes = [slopes[i] for i in moving]
    like = [images["sums"]]
    (sums,) = custom_transpose(forward, transpose, (*leaves, *kept), slopes, like)
    return images, {"sums": sums}


def _sizes(projected: Projected) -> tuple[int, int]:
    """(Colours, bytes of a number)."""
    return projected.colors.shape[0], projected.u.dtype.itemsize


def _kinds(moving: list[int]) -> frozenset[str]:
    """What `fused_vjp.vjp` is asked for, given which fields of `Projected`, its
    probe None, are differentiated by."""
    fields = {Projected._fields[i] for i in moving}
    channels = {"colors", "depth"}
    kinds = {"splats": fields - channels, "channels": fields & channels}
    return frozenset(kind for kind, some in kinds.items() if some)


@partial(jax.custom_jvp, nondiff_argnums=(4, 5, 6))
def _keeping(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
) -> tuple[dict[str, Array], Residuals]:
    """`composite`, one by one, and what the way back needs, of which no derivative is
    taken."""
    del schedule, room

    @_one_by_one
    def one(projected, lists, device):
        return composite_fused(projected, lists, device, grid, config, keeping=True)

    return one(projected, lists, device)


@partial(_keeping.defjvp, symbolic_zeros=True)
def _keeping_jvp(grid, room, config, primals, tangents):
    images, kept = _keeping(*primals, grid, room, config)
    _, slopes = _composite_jvp(grid, room, config, primals, tangents)
    return (images, kept), (slopes, jax.tree.map(zero_from_primal, kept))


@partial(jax.custom_jvp, nondiff_argnums=(6, 7, 8, 9))
def _pulled_back(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    kept: Residuals,
    cotangent: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
    by: frozenset[str],
) -> Projected:
    """`fused_vjp.vjp`, whose own derivative is that of the steps."""
    del schedule, room

    @_one_by_one
    def one(projected, lists, device, kept, cotangent):
        given = projected, lists, device, kept, cotangent
        return fused_vjp.vjp(*given, grid, config, by)

    return one(projected, lists, device, kept, cotangent)


@_pulled_back.defjvp
def _pulled_back_jvp(grid, room, config, by, primals, tangents):
    projected, lists, schedule, device, _, cotangent = primals

    def by_transpose(projected, cotangent):
        def sums(projected):
            given = projected, lists, schedule, device
            return composite_steps(*given, grid, room, config)["sums"]

        return jax.vjp(sums, projected)[1](cotangent)[0]

    given, slopes = (projected, cotangent), (tangents[0], tangents[-1])
    back = _pulled_back(*primals, grid, room, config, by)
    return back, jax.jvp(by_transpose, given, slopes)[1]
