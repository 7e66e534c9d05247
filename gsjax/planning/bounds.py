"""What leaving things out of a picture may change, bounded from above.

The argument behind all of it: the weights w_i = α_i T_i and what is left for the
background are the probabilities that a ray which passes splat i with probability
1 − α_i ends there. Two pictures whose rays part with probability p differ by at most
D p, D being the range of the colours, background included. So leaving out a set S
costs at most D (1 − Π_S (1 − α_i)), stopping at a transmittance ε at most D ε, and
colours that are off by δ_i at most Σ w_i δ_i.

Bounds here hold for every camera; they know nothing of where splats are. On the host,
in float64. Axis legend: N Gaussians, L bands of spherical harmonics.
"""

import numpy as np

from gsjax.gaussians import Gaussians
from gsjax.math.sh import C0


def opacities(gaussians: Gaussians) -> np.ndarray:
    """Of the active Gaussians [N]: above their α at any pixel."""
    active = np.asarray(gaussians.active)
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)[active]
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logits))


def band_changes(gaussians: Gaussians) -> np.ndarray:
    """[N, L] how far each band above 0 can move a channel, in any direction.

    By Cauchy and Schwarz: |Σ_m c_m Y_lm| ≤ ‖c‖ √((2l + 1) / 4π), since the squares of
    a band add up to (2l + 1) / 4π everywhere (the addition theorem).
    """
    sh = np.asarray(gaussians.params.sh, np.float64)[np.asarray(gaussians.active)]
    bands = [
        np.linalg.norm(sh[:, l * l : (l + 1) ** 2], axis=1).max(axis=1)
        * np.sqrt((2 * l + 1) / (4 * np.pi))
        for l in range(1, gaussians.sh_degree + 1)
    ]
    return np.stack(bands, 1) if bands else np.zeros((len(sh), 0))


def highest_band(gaussians: Gaussians) -> int:
    """Of the active Gaussians: the last that is not 0 throughout; 0 of none."""
    sh = np.asarray(gaussians.params.sh)
    active = np.asarray(gaussians.active)
    for degree in range(gaussians.sh_degree, 0, -1):
        if np.any(sh[:, degree**2 : (degree + 1) ** 2].any(axis=(1, 2)) & active):
            return degree
    return 0


def degree_error(gaussians: Gaussians, degree: int) -> float:
    """Largest change of rgb if the bands above ``degree`` are left out.

    Σ w_i δ_i is largest, whatever the order and the place of the splats, when all of
    them are met at their full opacity in the order of their δ, the greatest first:
    exchanging two neighbours that are not so ordered, or adding one at the end, never
    makes it smaller.
    """
    change = band_changes(gaussians)[:, degree:].sum(axis=1)
    order = np.argsort(-change)
    opacity = opacities(gaussians)[order]
    left = np.concatenate([[1.0], np.cumprod(1 - opacity)])[:-1]
    return float(np.sum(change[order] * opacity * left))


def color_range(gaussians: Gaussians, background=(0.0, 0.0, 0.0)) -> float:
    """D: largest range of a channel, over all splats, directions and the background."""
    sh = np.asarray(gaussians.params.sh, np.float64)[np.asarray(gaussians.active), 0]
    swing = band_changes(gaussians).sum(axis=1)[:, None]
    middle = 0.5 + C0 * sh
    behind = np.asarray(background, np.float64)[None]
    low = np.concatenate([np.maximum(middle - swing, 0), behind]).min(axis=0)
    high = np.concatenate([np.maximum(middle + swing, 0), behind]).max(axis=0)
    return float((high - low).max())


def cut_error(gaussians: Gaussians, cut: float, spread: float) -> float:
    """Largest change of rgb if α below ``cut`` counts as 0; ``spread`` is D.

    As if all splats lay over one another: of use for few or very faint ones.
    """
    left_out = np.minimum(opacities(gaussians), min(cut, 1 - 1e-16))
    return float(-spread * np.expm1(np.log1p(-left_out).sum()))


def cap_error(cap: float, spread: float) -> float:
    """Largest change of rgb if α is at most ``cap``: D Σ_k (1 − cap)^k, k from 1.

    The k-th splat above the cap is reached with (1 − cap)^(k − 1) at most.
    """
    return spread * (1 - cap) / cap


def stop_error(stop: float, rule: str, cap: float, spread: float) -> float:
    """Largest change of rgb by stopping; "before" leaves out what would have stopped
    it, which may have been reached at ε / (1 − cap)."""
    return spread * min(1.0, stop if rule == "after" else stop / max(1 - cap, 1e-16))
