"""Claim: each notebook runs within three minutes on two cores.

``python benchmarks/notebooks.py`` executes them one after another, each in a kernel
without compiled programs.
"""

from __future__ import annotations

import time
from pathlib import Path

import measure

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def main() -> None:
    """Measure and save."""
    rows = []
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        options = ["-q", "-W", "default", "-p", "no:cacheprovider", "--nbmake", "-n0"]
        begun = time.perf_counter()
        measure.run_cold(["-m", "pytest", *options, "--timeout=900", str(path)])
        rows.append({"notebook": path.stem, "seconds": time.perf_counter() - begun})
    measure.save("notebooks", rows, claim=__doc__)


if __name__ == "__main__":
    main()
