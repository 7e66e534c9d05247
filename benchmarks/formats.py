"""Claim: another program reads from the files of gsjax what gsjax reads from them.

``python benchmarks/formats.py [PLY...]`` writes scenes in every format, converts each
file to a plain PLY by PlayCanvas' splat-transform, and compares its values with those
that gsjax reads from the same file. Scenes are random, of SH degree 0, 1 and 3, and the
files that are passed. The sizes of the tool's own files of these scenes are there for
comparison. The exit status is 1 if a bound is exceeded. It needs ``npm``, which
installs the tool in a temporary folder, or keeps it in that of ``--tool``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

import as_cli  # noqa: F401
import measure
import numpy as np
from plyfile import PlyData
from scipy.spatial import KDTree

import gsjax
from gsjax.io.formats import FORMATS

PACKAGE = "@playcanvas/splat-transform@3.7.0"
COUNT, DEGREES, SEEDS = 3000, (0, 1, 3), (0, 1)
NOT_READ = (".glb",)  # by the tool
# Largest differences; that of means relative to the largest coordinate.
BOUNDS = {
    "means": 1e-6,
    "angles °": 0.01,
    "log scales": 1e-5,
    "opacities": 0.26 / 255,
    "DC": 1e-5,
    "SH": 1e-5,
}
# Known differences. gsjax reads the bytes 0 and 255 as opacities a quarter of a step
# inside of (0, 1), hence the bound above. Of bytes b of quaternions in .splat, which
# both write as 128 + 128 q, the tool reads b / 127.5 - 1, that is up to 4 / 255 radians
# away.
KNOWN = {".splat": {"angles °": 0.91}}
# The tool does not convert the axes of SPZ, which are ours after half a turn about x.
# Factors of xyz, of wxyz and of the harmonics.
HALF_TURN = (1, -1, -1), (1, 1, -1, -1)
HALF_TURN_SH = np.array([1 if c == "+" else -1 for c in "+--+-++-+-+--+-+"])


class Values(NamedTuple):
    """Values in a file: [N, 3], [N, 4] wxyz, [N, 3], [N] in [0, 1], and [N, K, 3]."""

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


def opacities(logits: np.ndarray) -> np.ndarray:
    """Return the opacities of logits, in float64."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logits.astype(np.float64)))


def random_scene(degree: int, seed: int) -> gsjax.Gaussians:
    """Return Gaussians as after training, within what all formats store."""
    rng = np.random.default_rng(seed)
    sh = 0.12 * rng.normal(size=(COUNT, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.7, 1.7, (COUNT, 3))
    return gsjax.make_gaussians(
        means=rng.normal(0, 3, (COUNT, 3)),
        quats=rng.normal(size=(COUNT, 4)) * rng.lognormal(0, 1, (COUNT, 1)),
        log_scales=rng.normal(-4, 1.2, (COUNT, 3)),
        logit_opacities=rng.normal(0, 3, COUNT),
        sh=np.clip(sh, -1.7, 1.7),
    )


def read_ours(path: Path) -> Values:
    """Return what gsjax reads."""
    gaussians = gsjax.load(path)
    keep = np.asarray(gaussians.active)
    p = gaussians.params
    arrays = p.means, p.quats, p.log_scales, opacities(np.asarray(p.logit_opacities))
    return Values(*(np.asarray(a, np.float64)[keep] for a in (*arrays, p.sh)))


def read_ply(path: Path) -> Values:
    """Return what another reader finds in a plain PLY."""
    rows = PlyData.read(path)["vertex"].data

    def columns(prefix: str, names) -> np.ndarray:
        found = [rows[f"{prefix}{name}"] for name in names]
        return np.stack(found, -1).astype(np.float64)

    rest = sum(name.startswith("f_rest_") for name in rows.dtype.names)
    sh = columns("f_dc_", range(3))[:, None]
    if rest:  # all of red, then all of green, then all of blue
        above = columns("f_rest_", range(rest)).reshape(len(rows), 3, -1)
        sh = np.concatenate([sh, above.swapaxes(1, 2)], 1)
    return Values(
        columns("", "xyz"),
        columns("rot_", range(4)),
        columns("scale_", range(3)),
        opacities(rows["opacity"]),
        sh,
    )


def turned(values: Values) -> Values:
    """Return values after half a turn about x."""
    means, quats, *rest, sh = values
    signs = HALF_TURN_SH[: sh.shape[1], None]
    return Values(means * HALF_TURN[0], quats * HALF_TURN[1], *rest, sh * signs)


def aligned(ours: Values, theirs: Values) -> Values | None:
    """Return their rows in our order; None if not the same Gaussians are there."""
    if len(ours.means) != len(theirs.means):
        return None
    tolerance = 1e-3 * np.abs(ours.means).max()
    if np.abs(ours.means - theirs.means).max() <= tolerance:
        return theirs
    order = KDTree(theirs.means).query(ours.means)[1]
    if len(np.unique(order)) < len(order):
        return None
    return Values(*(array[order] for array in theirs))


def differences(ours: Values, theirs: Values) -> dict[str, float]:
    """Return the largest difference of each quantity; infinity for other bands."""
    p, q = (v.quats / np.linalg.norm(v.quats, axis=1)[:, None] for v in (ours, theirs))
    chord = np.minimum(*(np.linalg.norm(p - s * q, axis=1) for s in (1, -1)))
    angles = np.degrees(4 * np.arcsin(np.minimum(chord / 2, 1)))
    apart = [angles, *(np.abs(a - b) for a, b in zip(ours[2:4], theirs[2:4]))]
    means = np.abs(ours.means - theirs.means) / np.abs(ours.means).max()
    sh = np.full((1, 2, 3), np.inf)
    if ours.sh.shape == theirs.sh.shape:
        sh = np.abs(ours.sh - theirs.sh)
    found = [means, *apart, sh[:, 0], sh[:, 1:]]
    return {n: float(a.max(initial=0)) for n, a in zip(BOUNDS, found, strict=True)}


def file_in(folder: Path, suffix: str) -> Path:
    """Return a path in a new folder that the suffix selects."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    return folder / (f"scene{suffix}" if suffix.startswith(".") else suffix)


def bytes_beside(path: Path) -> int:
    """Return the size of all files in the folder of one."""
    return sum(file.stat().st_size for file in path.parent.iterdir())


class Tool:
    """splat-transform, in a folder that is outside of the repository."""

    def __init__(self, folder: Path):
        self.program = folder / "node_modules" / ".bin" / "splat-transform"
        if self.program.exists():
            return
        folder.mkdir(parents=True, exist_ok=True)
        install = ["npm", "install", "--no-audit", "--no-fund", PACKAGE]
        done = subprocess.run(install, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"cannot install {PACKAGE}: {done.stderr.strip()}")

    @property
    def package(self) -> str:
        """Name and version of what is installed."""
        name = PACKAGE.rpartition("@")[0]
        file = self.program.parents[1] / name / "package.json"
        return f"{name}@{json.loads(file.read_text())['version']}"

    def convert(self, source: Path, out: Path) -> str:
        """Convert a file, and return the error, or ""."""
        options = ["--quiet", "--overwrite", "--gpu", "cpu"]
        done = subprocess.run(
            [self.program, *options, source, out], capture_output=True, text=True
        )
        return "" if done.returncode == 0 and out.exists() else done.stderr or "failed"


def row(name: str, scene: gsjax.Gaussians, suffix: str, tool: Tool, folder: Path):
    """Return sizes and differences of one scene in one format."""
    count = int(gsjax.num_active(scene))
    plain, ours, theirs = (file_in(folder, s) for s in (".ply", suffix, suffix))
    gsjax.save(plain, scene)
    gsjax.save(ours, scene)
    cells = {"scene": name, "format": suffix, "Gaussians": count}
    cells["bytes per Gaussian"] = bytes_beside(ours) / count
    failed = tool.convert(plain, theirs)
    cells["of the tool"] = None if failed else bytes_beside(theirs) / count
    cells |= dict.fromkeys(BOUNDS)
    readable = any(suffix in form.suffixes and form.load for form in FORMATS)
    if suffix in NOT_READ or not readable:
        return {**cells, "exceeded": "not compared"}
    decoded = file_in(folder, ".ply")
    if fault := tool.convert(ours, decoded):
        return {**cells, "exceeded": f"not read: {fault.strip().splitlines()[-1]}"}
    values, read = read_ours(ours), read_ply(decoded)
    read = aligned(values, turned(read) if suffix == ".spz" else read)
    if read is None:
        return {**cells, "exceeded": "other Gaussians"}
    found = differences(values, read)
    bounds = BOUNDS | KNOWN.get(suffix, {})
    worse = [key for key, value in found.items() if not value <= bounds[key]]
    return cells | found | {"exceeded": ", ".join(worse)}


def main() -> int:
    """Compare, save, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="*", metavar="PLY")
    parser.add_argument("--tool", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    if not shutil.which("node") or not shutil.which("npm"):
        sys.exit(f"install Node.js with npm from nodejs.org; npm installs {PACKAGE}")
    warnings.simplefilter("ignore")  # of rounding and clipping
    scenes = {
        f"degree {degree}, seed {seed}": random_scene(degree, seed)
        for degree in DEGREES
        for seed in SEEDS
    }
    scenes |= {path.name: gsjax.load(path) for path in given.files}
    suffixes = [suffix for form in FORMATS if form.save for suffix in form.suffixes]
    rows = []
    with tempfile.TemporaryDirectory() as name:
        tool = Tool(given.tool or Path(name) / "tool")
        package = tool.package
        for label, scene in scenes.items():
            for suffix in suffixes:
                rows.append(row(label, scene, suffix, tool, Path(name)))
                print(rows[-1])
    bounds = {"all formats": BOUNDS, **KNOWN}
    measure.save("formats", rows, claim=__doc__, package=package, bounds=bounds)
    compared = [r for r in rows if r["exceeded"] != "not compared"]
    return int(not compared or any(r["exceeded"] for r in compared))


if __name__ == "__main__":
    sys.exit(main())
