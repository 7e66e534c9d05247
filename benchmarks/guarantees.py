"""Report the cost of each guarantee.

``python benchmarks/guarantees.py [--queued]`` renders guitar.ply at 400 × 300 (or a
synthetic shell), all variants alternating: float32; float64; `accurate` cutoffs; one
device instead of all, with the same bits; and derivatives in forward mode (`jax.jvp`),
reverse mode (value and gradient) and of second order (a Hessian–vector product). Ratios
are relative to the image, or to the gradient for the last. Reproducible bits cannot be
switched off: sums have a fixed order, and ties of depth are resolved by slot.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import measure
import scenes
from as_cli import QUEUED

import gsjax
from gsjax.math.numerics import in_float64


def functions(gaussians, camera, config=gsjax.RasterConfig()) -> dict:  # noqa: B008
    """Return compiled calls of the image and its derivatives, by name."""
    config = gsjax.exact_config(gaussians, camera, config.replace(outputs=("rgb",)))

    def picture(params):
        return gsjax.render(gaussians.replace(params=params), camera, config).rgb

    def loss(params):
        return jnp.mean((picture(params) - 0.5) ** 2)

    params = gaussians.params
    along = jax.tree.map(jnp.ones_like, params)
    made = {
        "forward": picture,
        "jvp": lambda p: jax.jvp(picture, (p,), (along,)),
        "value and gradient": jax.value_and_grad(loss),
        "Hessian–vector product": lambda p: jax.jvp(jax.grad(loss), (p,), (along,)),
    }
    compiled = {name: jax.jit(function) for name, function in made.items()}
    return {name: lambda f=f: f(params) for name, f in compiled.items()}


def main() -> None:
    """Measure and save."""
    case = scenes.real_cases()[0]
    gaussians, camera = case.gaussians, gsjax.resize_camera(case.camera, 400, 300)
    plain = functions(gaussians, camera)
    finer, alone = gsjax.RasterConfig.accurate(), gsjax.RasterConfig(devices=1)
    calls = {
        **plain,
        "accurate, forward": functions(gaussians, camera, finer)["forward"],
        "one device, forward": functions(gaussians, camera, alone)["forward"],
    }
    with jax.enable_x64(True):
        wide = functions(*in_float64((gaussians, camera)))

        def in_x64(call):
            with jax.enable_x64(True):
                return jax.block_until_ready(call())

    for name in ("forward", "value and gradient"):
        calls[f"float64, {name}"] = lambda call=wide[name]: in_x64(call)
    ms = measure.interleaved(calls)
    against = {
        "Hessian–vector product": "value and gradient",
        "float64, value and gradient": "value and gradient",
    }
    rows = [
        {
            "what": name,
            "ms": value,
            "against": against.get(name, "forward"),
            "ratio": value / ms[against.get(name, "forward")],
        }
        for name, value in ms.items()
    ]
    measure.save(
        "guarantees_queued" if QUEUED else "guarantees",
        rows, claim=__doc__, scene=case.name, gaussians=int(gaussians.capacity),
    )  # fmt: skip


if __name__ == "__main__":
    main()
