"""Upper bounds on the error of leaving things out of an image, for every camera.

The weights w_i = α_i T_i and the weight of the background are the probabilities that a
ray ends at splat i, if it passes splat i with probability 1 − α_i. If the rays of two
images differ with probability p, the images differ by at most D p, where D is the range
of the colours including the background. On the host, in float64.

Axis legend: N Gaussians, L bands of spherical harmonics.
"""

import numpy as np
from scipy.special import expit

from gsjax.gaussians import Gaussians
from gsjax.math.sh import C0


def opacities(gaussians: Gaussians) -> np.ndarray:
    """Return the opacities [N] of the active Gaussians, above their α at any pixel."""
    active = np.asarray(gaussians.active)
    return expit(np.asarray(gaussians.params.logit_opacities, np.float64)[active])


def band_changes(gaussians: Gaussians) -> np.ndarray:
    """Return how far each band above 0 can move a channel, in any direction, [N, L].

    By Cauchy–Schwarz, |Σ_m c_m Y_lm| ≤ ‖c‖ √((2l + 1) / 4π), because the squares of a
    band add up to (2l + 1) / 4π everywhere (addition theorem).
    """
    sh = np.asarray(gaussians.params.sh, np.float64)[np.asarray(gaussians.active)]
    bands = [
        np.linalg.norm(sh[:, l * l : (l + 1) ** 2], axis=1).max(axis=1)
        * np.sqrt((2 * l + 1) / (4 * np.pi))
        for l in range(1, gaussians.sh_degree + 1)
    ]
    return np.stack(bands, 1) if bands else np.zeros((len(sh), 0))


def highest_band(gaussians: Gaussians) -> int:
    """Return the last band with a non-zero coefficient of an active Gaussian, or 0."""
    sh = np.asarray(gaussians.params.sh)
    active = np.asarray(gaussians.active)
    for degree in range(gaussians.sh_degree, 0, -1):
        if np.any(sh[:, degree**2 : (degree + 1) ** 2].any(axis=(1, 2)) & active):
            return degree
    return 0


def degree_error(gaussians: Gaussians, degree: int) -> float:
    """Bound the change of rgb if the bands above ``degree`` are left out.

    Σ w_i δ_i is largest if a ray meets all splats at their full opacity, sorted by
    descending δ: exchanging two neighbours that are not in this order, or adding a
    splat at the end, never decreases the sum.
    """
    change = band_changes(gaussians)[:, degree:].sum(axis=1)
    order = np.argsort(-change)
    opacity = opacities(gaussians)[order]
    left = np.concatenate([[1.0], np.cumprod(1 - opacity)])[:-1]
    return float(np.sum(change[order] * opacity * left))


def color_range(gaussians: Gaussians, background=(0.0, 0.0, 0.0)) -> float:
    """Return D, the largest range of a channel over splats, directions, background."""
    sh = np.asarray(gaussians.params.sh, np.float64)[np.asarray(gaussians.active), 0]
    swing = band_changes(gaussians).sum(axis=1)[:, None]
    middle = 0.5 + C0 * sh
    behind = np.asarray(background, np.float64)[None]
    low = np.concatenate([np.maximum(middle - swing, 0), behind]).min(axis=0)
    high = np.concatenate([np.maximum(middle + swing, 0), behind]).max(axis=0)
    return float((high - low).max())


def alpha_min_error(gaussians: Gaussians, alpha_min: float, spread: float) -> float:
    """Bound the change of rgb if α below ``alpha_min`` counts as 0; ``spread`` is D.

    All splats may overlap, so it is useful for few or very faint splats only.
    """
    left_out = np.minimum(opacities(gaussians), min(alpha_min, 1 - 1e-16))
    return float(-spread * np.expm1(np.log1p(-left_out).sum()))


def alpha_max_error(alpha_max: float, spread: float) -> float:
    """Bound the change of rgb if α is at most ``alpha_max``.

    The transmittance before the k-th splat above the limit is at most
    (1 − alpha_max)^(k − 1), so the sum is D Σ_k (1 − alpha_max)^k.
    """
    return spread * (1 - alpha_max) / alpha_max


def stop_error(transmittance: float, rule: str, alpha_max: float, spread: float):
    """Bound the change of rgb by stopping at a transmittance ε.

    The rule "before" also leaves out the splat that crosses ε, which is reached at a
    transmittance of up to ε / (1 − alpha_max).
    """
    if rule == "before":
        transmittance = transmittance / max(1 - alpha_max, 1e-16)
    return spread * min(1.0, transmittance)
