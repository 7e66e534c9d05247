"""The whole renderer against an independent float64 brute-force compositor.

3000 real points, one view of 162 × 105: image, alpha, and the gradients of all inputs
for given cotangents. The rules are those of the preset "compat".
"""

import jax
import jax.numpy as jnp
import numpy as np
from conftest import COMPAT, oracle_data
from pictures import assert_close

import gsjax

VALUE, DERIVATIVE = 1e-9, 1e-7
CONFIG = COMPAT.replace(outputs=("rgb", "alpha"), pair_capacity=65536)


@jax.jit
def render_and_pull(params, colors, camera, background, cotangents):
    active = jnp.ones(params.means.shape[0], bool)

    def images(params, colors):
        scene = gsjax.Gaussians(params=params, active=active)
        out = gsjax.render(scene, camera, CONFIG, background, features=colors)
        return (out.rgb, out.alpha), out.overflowed

    outputs, vjp, overflowed = jax.vjp(images, params, colors, has_aux=True)
    return outputs, vjp(cotangents), overflowed


def test_images_and_gradients_agree(report):
    """No pixel is left out: none lies within rounding of a threshold."""
    data = oracle_data("render_oracle")
    wide = {k: v.astype(np.float64) for k, v in data.items()}
    scales, opacities = wide["scales"], wide["opacities"]
    params = gsjax.make_gaussians(
        means=wide["means"],
        quats=wide["quats"],
        log_scales=np.log(scales),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh=np.zeros((len(opacities), 1, 3)),
    ).params
    size = {name: int(data[name]) for name in ("width", "height")}
    camera = gsjax.make_camera(viewmat=wide["viewmat"], K=wide["K"], **size)
    # The oracle blended 0.1, 0.2, 0.3 as float32; the file holds them as float64.
    background = wide["bg"].astype(np.float32).astype(np.float64)
    cotangents = (jnp.asarray(wide["cot_image"]), jnp.asarray(wide["cot_alpha"]))
    images, (by_params, by_colors), overflowed = render_and_pull(
        params, jnp.asarray(wide["colors"]), camera, background, cotangents
    )
    assert not overflowed
    for name, image in zip(("image", "alpha"), images):
        assert np.std(wide[name]) > 0.05
        error = np.max(np.abs(image - wide[name]))
        report(f"{name}, all pixels", error, VALUE)
        assert error <= VALUE, name
    grads = {
        "means": by_params.means,
        "quats": by_params.quats,
        "scales": by_params.log_scales / scales,
        "opacities": by_params.logit_opacities / (opacities * (1 - opacities)),
        "colors": by_colors,
    }
    for name, found in grads.items():
        wanted = wide[f"grad_{name}"]
        assert np.mean(wanted != 0) > 0.1
        assert_close(report, f"gradient of {name}", found, wanted, DERIVATIVE)
