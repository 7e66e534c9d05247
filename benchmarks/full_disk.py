"""Claim: a full disk loses nothing that was saved.

``python benchmarks/full_disk.py [COUNT]`` (as root: it mounts a small tmpfs) trains a
small scene once with enough space, then COUNT times (default 8) into a tmpfs with a
part of that space, from none to nearly all. Each must end with exit code 3 and a line
that names the remedy, with checkpoints that load and no temporary file. With more
space, the resumed run must end with the bits of the first.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import kills
import measure

from gsjax.runs.checkpoint import load_checkpoint


def mount(folder: Path, size: int, *, again: bool = False) -> None:
    """Mount a tmpfs of so many bytes, rounded to pages, or resize it."""
    options = f"{'remount,' if again else ''}size={size}"
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "gsjax-full-disk", folder], check=True
    )


def main(count: int) -> None:
    """Measure and save."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = kills.prepared(folder)

        def train(run: Path, *more: str):
            return subprocess.run(
                kills.command(folder / "dataset", run, "mcmc", *more),
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )

        train(folder / "whole").check_returncode()
        wanted = kills.left_behind(folder / "whole")
        files = [path for path in (folder / "whole").rglob("*") if path.is_file()]
        needed = sum(path.stat().st_size for path in files)
        disk = folder / "disk"
        disk.mkdir()
        for index in range(count):
            room = max(4096, int(needed * index / count))
            mount(disk, room)
            try:
                run = disk / "run"
                ended = train(run)
                told = ended.stderr.splitlines()[-1]
                kept = sorted(run.glob("checkpoints/*.npz"))
                steps = [load_checkpoint(path).step for path in kept]
                left = [path.name for path in run.rglob("*.tmp")]
                mount(disk, 4 * needed, again=True)
                train(run, "--resume").check_returncode()
                row = {
                    "room": room,
                    "needed": needed,
                    "exit code": ended.returncode,
                    "told": told.replace(str(disk), ""),
                    "steps saved": steps,
                    "temporary files": left,
                    "same bits": kills.left_behind(run) == wanted,
                }
            finally:
                subprocess.run(["umount", disk], check=True)
            rows.append(row)
            print(row, flush=True)
    measure.save("full_disk", rows, claim=__doc__)
    good = [
        row["same bits"]
        and row["exit code"] == 3
        and "free some space" in row["told"]
        and not row["temporary files"]
        for row in rows
    ]
    print(f"{sum(good)} of {len(rows)} lost nothing")
    sys.exit(not all(good))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)
