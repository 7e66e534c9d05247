"""Claim: the demo is over within two minutes on two cores, at 30 dB or more.

``python benchmarks/demo.py`` runs `gsjax demo` in a process that has nothing compiled,
from starting Python to the turntable. PSNR and SSIM are of the five held-out views.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import measure

from gsjax.demo import demo_files
from gsjax.train.folder import run_files


def main() -> None:
    """Measure and save."""
    cold = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"}
    with tempfile.TemporaryDirectory() as folder:
        files = demo_files(Path(folder) / "demo")
        command = [sys.executable, "-m", "gsjax.cli", "demo", "-o", f"{folder}/demo"]
        begun = time.perf_counter()
        subprocess.run(command, check=True, env=cold)
        seconds = time.perf_counter() - begun
        found = json.loads(run_files(files.run).eval.read_text())
        logged = run_files(files.run).metrics.read_text().splitlines()[-1]
        turntable = files.turntable.stat().st_size
    row = {
        "seconds": seconds,
        "psnr": found["psnr"],
        "ssim": found["ssim"],
        **{k: json.loads(logged)[k] for k in ("gaussians", "compile_seconds")},
        "turntable bytes": turntable,
    }
    measure.save("demo", [row], claim=__doc__)


if __name__ == "__main__":
    main()
