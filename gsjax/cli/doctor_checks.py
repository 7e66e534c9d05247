"""Is this installation well? Versions, devices, and a render against the oracle."""

import importlib
import os
import platform
from importlib import metadata

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.raster.reference import reference_render
from gsjax.raster.render import DEFAULT_CONFIG, render_exact
from gsjax.runtime.machine import usable_cores
from gsjax.synthetic.torus_knot import torus_knot_scene

# Package that is installed, module that is imported, what is not without it.
_PACKAGES = (
    ("jax", "jax", "everything needs it"),
    ("jaxlib", "jaxlib", "everything needs it"),
    ("numpy", "numpy", "everything needs it"),
    ("opencv-contrib-python-headless", "cv2", "photographs and images need it"),
    ("pycolmap", "pycolmap", "gsjax sfm needs it"),
)
_TOLERANCE = 1e-4


def doctor_lines() -> tuple[list[str], bool]:
    """The report as lines, and whether all packages are there and rendering works."""
    lines = [f"gsjax     {version('gsjax')}", f"python    {platform.python_version()}"]
    packages = {name: _package(*rest) for name, *rest in _package_rows()}
    lines += [f"{name:<9} {told}" for name, (told, _) in packages.items()]
    devices = jax.local_devices()
    kinds = sorted({f"{d.platform} ({d.device_kind})" for d in devices})
    lines.append(f"devices   {len(devices)} × {', '.join(kinds)}")
    lines.append(f"cores     {_cores()}")
    lines.append(f"memory    {_memory()}")
    lines.append(f"float64   {'on' if jax.config.jax_enable_x64 else 'off'}")  # pyright: ignore
    error, compared = render_error()
    good = compared > 0 and error <= _TOLERANCE
    verdict = "well" if good else f"NOT WELL, at most {_TOLERANCE:g} is wanted"
    lines.append(
        f"render    {error:.2g} from the reference at most, over {compared} pixels: "
        f"{verdict}"
    )
    return lines, good and all(there for _, there in packages.values())


def version(package: str) -> str:
    """Installed version of a package, or what to say in its place."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def _package_rows():
    for package, module, use in _PACKAGES:
        yield {"cv2": "opencv"}.get(module, module), package, module, use


def _package(package: str, module: str, use: str) -> tuple[str, bool]:
    """Version, or why the package cannot be used and what then is missing; whether it
    can."""
    try:
        loaded = importlib.import_module(module)
    except Exception as error:  # a broken binary may raise anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return f"NOT WELL, absent ({reason}); {use}: pip install {package}", False
    return getattr(loaded, "__version__", version(package)), True


def _cores() -> str:
    usable = usable_cores()
    return f"{usable} usable of {os.cpu_count() or usable}"


def _memory() -> str:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return "unknown"
    return f"{size / 2**30:.1f} GiB"


def render_error() -> tuple[float, int]:
    """Largest difference from the dense reference in a tiny scene, and the pixels.

    Pixels within a relative 1e-3 of a threshold are left out: there the two may
    rightly differ by a whole Gaussian.
    """
    scene = torus_knot_scene(count=60, frames=1, width=32, height=24)
    gaussians, camera = scene.gaussians, scene.cameras[0]
    config = DEFAULT_CONFIG.replace(num_size_buckets=1)  # compiles faster
    background = jnp.asarray(scene.background)

    def reference(params):
        seen = gaussians.replace(params=params)  # pyright: ignore
        return reference_render(seen, camera, config, background)

    fast = render_exact(gaussians, camera, config, background)
    slow = jax.jit(reference)(gaussians.params)
    away = np.asarray(slow["margin"]) > 1e-3
    away &= np.asarray(slow["alpha"]) > 0
    difference = np.abs(np.asarray(fast.rgb) - np.asarray(slow["rgb"])).max(axis=-1)
    return float(difference[away].max(initial=0)), int(away.sum())
