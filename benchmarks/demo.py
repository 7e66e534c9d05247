"""Claim: the demo takes less than two minutes on two cores and reaches 30 dB.

``python benchmarks/demo.py`` runs `gsjax demo` without compiled programs, from the
start of Python to the turntable. PSNR and SSIM are those of the five held-out views.
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

import measure

from gsjax.runs.demo import demo_files
from gsjax.runs.folder import run_files
from gsjax.runs.history import read_metrics


def main() -> None:
    """Measure and save."""
    with tempfile.TemporaryDirectory() as folder:
        files = demo_files(Path(folder) / "demo")
        begun = time.perf_counter()
        measure.run_cold(["-m", "gsjax.cli.main", "demo", "-o", f"{folder}/demo"])
        seconds = time.perf_counter() - begun
        found = json.loads(run_files(files.run).eval.read_text())
        logged = read_metrics(run_files(files.run).metrics)[-1]
        turntable = files.turntable.stat().st_size
    row = {
        "seconds": seconds,
        "psnr": found["psnr"],
        "ssim": found["ssim"],
        **{k: logged[k] for k in ("gaussians", "compile_seconds")},
        "turntable bytes": turntable,
    }
    measure.save("demo", [row], claim=__doc__)


if __name__ == "__main__":
    main()
