"""`gsjax doctor`: checks of the installation."""

import importlib
import os
import platform
from dataclasses import dataclass
from importlib import metadata

from gsjax.cli.common import Command, start_jax
from gsjax.runtime.console import say
from gsjax.runtime.machine import usable_cores

# Name shown, module imported, package to install, and what needs it.
_PACKAGES = (
    ("jax", "jax", "jax", "everything needs it"),
    ("jaxlib", "jaxlib", "jaxlib", "everything needs it"),
    ("numpy", "numpy", "numpy", "everything needs it"),
    ("opencv", "cv2", "opencv-contrib-python-headless", "images need it"),
    ("pycolmap", "pycolmap", "pycolmap", "gsjax sfm needs it"),
)
_TOLERANCE = 1e-4


@dataclass(kw_only=True)
class DoctorCommand(Command):
    """Check the installation: versions, devices, and a small render against a
    reference. The exit code is 1 if a check fails."""

    def run(self) -> int:
        start_jax()
        lines, good = doctor_lines()
        for line in lines:
            say(line)
        return 0 if good else 1


def doctor_lines() -> tuple[list[str], bool]:
    """Return a report as lines, and whether every check passed."""
    import jax

    devices = jax.local_devices()
    kinds = sorted({f"{d.platform} ({d.device_kind})" for d in devices})
    cores = usable_cores()
    rows = {"gsjax": version("gsjax"), "python": platform.python_version()}
    packages = {name: _package(*rest) for name, *rest in _PACKAGES}
    rows |= {name: text for name, (text, _) in packages.items()}
    rows["devices"] = f"{len(devices)} × {', '.join(kinds)}"
    rows["cores"] = f"{cores} usable of {os.cpu_count() or cores}"
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        rows["memory"] = f"{size / 2**30:.1f} GiB"
    except (AttributeError, OSError, ValueError):
        rows["memory"] = "unknown"
    rows["float64"] = "on" if jax.config.jax_enable_x64 else "off"  # pyright: ignore
    error, compared = render_error()
    good = compared > 0 and error <= _TOLERANCE
    verdict = "ok" if good else f"FAILED, expected at most {_TOLERANCE:g}"
    rows["render"] = f"maximum error {error:.2g} over {compared} pixels: {verdict}"
    lines = [f"{name:<9} {text}" for name, text in rows.items()]
    return lines, good and all(found for _, found in packages.values())


def version(package: str) -> str:
    """Return the installed version of a package, or "unknown (not installed)"."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def _package(module: str, package: str, use: str) -> tuple[str, bool]:
    """Return the version of a package or why it fails, and whether it imports."""
    try:
        loaded = importlib.import_module(module)
    except Exception as error:  # a broken binary may raise anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return f"FAILED ({reason}); {use}: pip install {package}", False
    return getattr(loaded, "__version__", version(package)), True


def render_error() -> tuple[float, int]:
    """Return the maximum error of a small render, and the number of pixels compared.

    Pixels within a relative 1e-3 of a threshold are excluded: there, the renders may
    differ by a whole Gaussian.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from gsjax.raster.exact import render_exact
    from gsjax.raster.reference import reference_render
    from gsjax.raster.render import DEFAULT_CONFIG
    from gsjax.synthetic.torus_knot import torus_knot_scene

    scene = torus_knot_scene(count=60, frames=1, width=32, height=24)
    gaussians, camera = scene.gaussians, scene.cameras[0]
    config = DEFAULT_CONFIG.replace(num_size_buckets=1)  # compiles faster
    background = jnp.asarray(scene.background)

    def reference(params):
        with_params = gaussians.replace(params=params)  # pyright: ignore
        return reference_render(with_params, camera, config, background)

    fast = render_exact(gaussians, camera, config, background)
    slow = jax.jit(reference)(gaussians.params)
    away = np.asarray(slow["margin"]) > 1e-3
    away &= np.asarray(slow["alpha"]) > 0
    difference = np.abs(np.asarray(fast.rgb) - np.asarray(slow["rgb"])).max(axis=-1)
    return float(difference[away].max(initial=0)), int(away.sum())
