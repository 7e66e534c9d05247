"""Compare two commits: same bits, same speed, compile time.

    python benchmarks/compare_commits.py OLD NEW              # bits
    python benchmarks/compare_commits.py OLD NEW --speed      # run times in turn
    python benchmarks/compare_commits.py OLD NEW --cold       # compile times

OLD and NEW are commits from d11a333 on, or "." for the working tree. A commit followed
by "+plain" runs unprepared: without `use_all_cores` and `exact_config`. Each side runs
`compare_worker` in its own process with the same environment, the same input arrays and
no compilation cache. The result is added to results/compare_commits.json.

Bits: picture (rgb, alpha, depth) and gradient by every input, in float32 and float64.
Speed: picture, value and gradient by the parameters, and a training step; calls
alternate between two persistent processes, and the ratio is the median over pairs.
Cold: first picture and first gradient in a fresh process, imports apart.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import measure
import numpy as np

from gsjax.runtime import files

WORKER = Path(__file__).with_name("compare_worker.py")
RESULT = measure.RESULTS / "compare_commits.json"
BITS = ("guitar", "garden", "fog", "needles", "huge", "knot")
SPEED = ("guitar", "garden", "bananas")
TASKS = ("picture", "gradient", "step")
SAMPLE_SECONDS = 0.25  # a timed sample repeats the call for about this long


class Side(NamedTuple):
    """One side of the comparison."""

    commit: str
    code: Path
    plain: bool


def open_side(name: str, folder: Path) -> Side:
    """Unpack a commit into the folder; "." is the working tree."""
    commit, *how = name.split("+")
    if how not in ([], ["plain"]):
        raise SystemExit(f"{name}: expected COMMIT or COMMIT+plain")
    if commit == ".":
        return Side("working tree", measure.ROOT, bool(how))
    command = ["git", "rev-parse", "--short", f"{commit}^{{commit}}"]
    found = subprocess.run(
        command, cwd=measure.ROOT, check=True, capture_output=True, text=True
    )
    return Side(
        found.stdout.strip(), measure.code_of(commit, folder / commit), bool(how)
    )


def environment(side: Side, dtype: str = "float32") -> dict[str, str]:
    """Return the environment of a worker."""
    changes = {
        "PYTHONPATH": str(side.code),
        "PYTHONDONTWRITEBYTECODE": "1",
        "JAX_ENABLE_COMPILATION_CACHE": "false",
        "JAX_ENABLE_X64": "1" if dtype == "float64" else "0",
        "COMPARE_PLAIN": str(int(side.plain)),
        "COMPARE_START": str(time.perf_counter()),
    }
    return {**os.environ, **changes}


def run_worker(
    side: Side, *arguments: str, dtype: str = "float32", parse: bool = True
) -> Any:
    """Run the worker once and return its reply."""
    done = subprocess.run(
        [sys.executable, str(WORKER), *arguments],
        env=environment(side, dtype),
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(done.stdout) if parse else None


# Scenes. gsjax is imported where a scene is not in the cache.


def bananas(folder: Path) -> tuple[Any, Any, np.ndarray]:
    """Return the initial Gaussians of the banana photographs, a view and its photo."""
    import scenes

    import gsjax

    dataset = folder / "banana"
    if not dataset.is_dir():
        source = scenes.DATA / "banana" / "images"
        measure.run_cold(
            ["-m", "gsjax.cli.main", "sfm", str(source), "-o", str(dataset)]
        )
    data = gsjax.load_dataset(dataset)
    view = data.views[0]
    photo = gsjax.load_photos([view], 800)[0]
    height, width = photo.pixels.shape[:2]
    camera = gsjax.make_camera(
        viewmat=view.viewmat, K=photo.K, width=width, height=height
    )
    return gsjax.init_gaussians(data, sh_degree=3), camera, photo.pixels


def noise_photo(width: int, height: int) -> np.ndarray:
    """Return a smooth random picture [H, W, 3] uint8."""
    small = np.random.default_rng(0).uniform(
        0, 255, (height // 16 + 1, width // 16 + 1, 3)
    )
    large = small.repeat(16, axis=0).repeat(16, axis=1)
    return large[:height, :width].astype(np.uint8)


def find_scene(name: str, folder: Path) -> tuple[Any, Any, tuple, np.ndarray | None]:
    """Return Gaussians, camera, background and photo of a scene by its name."""
    import scenes

    from gsjax.synthetic.stress_scenes import STRESS_SCENES

    if name in STRESS_SCENES:
        scene = STRESS_SCENES[name]()
        return scene.gaussians, scene.camera, scene.background, None
    background = (0.2, 0.5, 0.9)
    if name == "bananas" and (scenes.DATA / "banana").is_dir():
        gaussians, camera, photo = bananas(folder)
        return gaussians, camera, background, photo
    if (scenes.DATA / name).is_dir():
        case = {"guitar": scenes.guitar, "garden": scenes.garden}[name]()
    else:
        count = {"guitar": 90_000, "garden": 100_000, "bananas": 20_000}[name]
        case = scenes.shell(count, 800, 600, seed=len(name))
    return case.gaussians, case.camera, background, None


def write_scene(name: str, folder: Path, small: int) -> Path:
    """Write a scene's arrays to an .npz, unless it is there.

    Args:
      name: of `BITS` or `SPEED`.
      folder: where to.
      small: divide the image's sides by it, and keep one Gaussian in small².
    """
    out = folder / f"{name}{'' if small == 1 else f'_{small}'}.npz"
    if out.exists():
        return out
    import gsjax

    gaussians, camera, background, photo = find_scene(name, folder)
    width, height = camera.width // small, camera.height // small
    if small > 1:
        camera = gsjax.resize_camera(camera, width, height)
        photo = None
    keep = np.flatnonzero(np.asarray(gaussians.active))[:: small**2]
    params = gaussians.params
    arrays = {
        key: np.asarray(getattr(params, key))[keep]
        for key in ("means", "quats", "log_scales", "logit_opacities", "sh")
    }
    np.savez(
        out,
        **arrays,
        viewmat=np.asarray(camera.viewmat),
        K=np.asarray(camera.K),
        near=float(camera.near),
        far=float(camera.far),
        width=width,
        height=height,
        background=np.asarray(background),
        photo=noise_photo(width, height) if photo is None else photo,
    )
    return out


# Bits


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def difference(old: np.ndarray, new: np.ndarray) -> dict[str, Any]:
    """Return whether two arrays are bit-equal, and the largest difference if not."""
    if old.shape != new.shape or old.dtype != new.dtype:
        told = f"{old.dtype}{old.shape} became {new.dtype}{new.shape}"
        return {"equal": False, "note": told}
    if old.tobytes() == new.tobytes():
        return {"equal": True, "max abs": 0.0, "max rel": 0.0}
    finite = np.isfinite(old) & np.isfinite(new)
    apart = np.abs(np.where(finite, old, 0) - np.where(finite, new, 0))
    scale = float(np.abs(np.where(finite, old, 0)).max())
    largest = float(apart.max())
    relative = largest / scale if scale else 0.0
    found = {"equal": False, "max abs": _short(largest), "max rel": _short(relative)}
    same = np.isfinite(old) == np.isfinite(new)
    return found if same.all() else {**found, "note": "finite on one side only"}


def compare_bits(
    sides: Sequence[Side], names: list[str], dtypes: list[str], work: Path, folder: Path
) -> list[dict]:
    """Return one row for each scene, type and array."""
    rows = []
    for dtype in dtypes:
        outs = []
        for index, side in enumerate(sides):
            outs.append(work / f"bits_{index}_{dtype}.npz")
            run_worker(
                side,
                "bits",
                str(folder),
                dtype,
                str(outs[-1]),
                *names,
                dtype=dtype,
                parse=False,
            )
        with np.load(outs[0]) as old, np.load(outs[1]) as new:
            for key in old.files:
                scene, kind, array = key.split("/")
                row = {
                    "scene": scene.split("_")[0],
                    "type": dtype,
                    "kind": kind,
                    "array": array,
                }
                rows.append({**row, **difference(old[key], new[key])})
    return rows


def bits_table(rows: list[dict]) -> str:
    """Return a table with one line per scene and type, and one per difference."""
    lines = []
    groups = {(row["scene"], row["type"]): [] for row in rows}
    for row in rows:
        groups[row["scene"], row["type"]].append(row)
    for (scene, dtype), some in groups.items():
        unequal = [row for row in some if not row["equal"]]
        told = f"{len(some) - len(unequal)} of {len(some)} arrays bit-equal"
        lines.append(f"{scene:<10}{dtype:<9}{told}")
        for row in unequal:
            largest, relative = (row.get(k, "unknown") for k in ("max abs", "max rel"))
            lines.append(
                f"    {row['kind']:<9}{row['array']:<16}max abs {largest}, relative "
                f"{relative} {row.get('note', '')}".rstrip()
            )
    return "\n".join(lines)


# Speed


class Worker:
    """A persistent worker process; see `compare_worker.serve`."""

    def __init__(self, side: Side, folder: Path):
        self.process = subprocess.Popen(
            [sys.executable, str(WORKER), "serve", str(folder)],
            env=environment(side),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, *request: Any) -> float:
        """Send a request and return the reply, seconds."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(request), file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"the worker ended during {request}; see its messages")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def compare_speed(
    sides: Sequence[Side], names: list[str], tasks: list[str], pairs: int, folder: Path
) -> list[dict]:
    """Return one row for each scene and task."""
    workers = [Worker(side, folder) for side in sides]
    rows = []
    for name in names:
        for task in tasks:
            once = min([worker.ask("prepare", name, task) for worker in workers])
            count = max(1, round(SAMPLE_SECONDS / once))
            times: list[list[float]] = [[], []]
            for pair in range(pairs):
                # The order alternates, so that drift falls on both sides alike.
                for index in (0, 1) if pair % 2 == 0 else (1, 0):
                    times[index].append(1e3 * workers[index].ask("time", count))
            ratios = np.asarray(times[1]) / np.asarray(times[0])
            low, middle, high = np.percentile(ratios, (25, 50, 75)).tolist()
            rows.append(
                {
                    "scene": name.split("_")[0],
                    "task": task,
                    "old ms": float(np.median(times[0])),
                    "new ms": float(np.median(times[1])),
                    "new / old": middle,
                    "quartiles": f"{low:.3f}-{high:.3f}",
                    "pairs": pairs,
                }
            )
            print(measure.table(rows[-1:]).splitlines()[-1], flush=True)
    for worker in workers:
        worker.close()
    return rows


# Compile time


def compare_cold(
    sides: Sequence[Side], names: list[str], repeats: int, folder: Path
) -> list[dict]:
    """Return one row for each scene and task: seconds, medians of fresh processes."""
    rows = []
    for name in names:
        capacities = json.dumps(run_worker(sides[1], "capacities", str(folder), name))
        for task in ("picture", "gradient"):
            found: list[list[dict]] = [[], []]
            for _ in range(repeats):
                for index, side in enumerate(sides):
                    wanted = "{}" if side.plain else capacities
                    found[index].append(
                        run_worker(side, "cold", str(folder), name, task, wanted)
                    )
            row: dict[str, Any] = {"scene": name.split("_")[0], "first": task}
            for side, told in zip(("old", "new"), found):
                for key in ("import", "first"):
                    label = f"{side} {'compile and run' if key == 'first' else key} s"
                    row[label] = float(np.median([one[key] for one in told]))
            rows.append(row)
    return rows


# The command


def main() -> None:
    """Compare, print and save."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old")
    parser.add_argument("new")
    parser.add_argument("--scenes", nargs="+", choices=sorted({*BITS, *SPEED}))
    parser.add_argument("--types", nargs="+", default=["float32", "float64"])
    parser.add_argument("--bits", action="store_true", help="the default")
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--repeats", type=int, default=3, help="of --cold")
    parser.add_argument("--small", type=int, default=1, help="divide the sizes by it")
    parser.add_argument("--cache", type=Path, help="folder for the scenes' arrays")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        folder = given.cache or work / "scenes"
        folder.mkdir(parents=True, exist_ok=True)
        sides = [
            open_side(side, work / f"code_{i}")
            for i, side in enumerate((given.old, given.new))
        ]

        def prepared(default: Sequence[str]) -> list[str]:
            names = given.scenes or default
            return [write_scene(name, folder, given.small).stem for name in names]

        found: dict[str, list[dict]] = {}
        if given.bits or not (given.speed or given.cold):
            found["bits"] = compare_bits(
                sides, prepared(BITS), given.types, work, folder
            )
            print(bits_table(found["bits"]))
        if given.speed:
            found["speed"] = compare_speed(
                sides, prepared(SPEED), given.tasks, given.pairs, folder
            )
            print(measure.table(found["speed"]))
        if given.cold:
            found["cold"] = compare_cold(
                sides, prepared(SPEED[:1]), given.repeats, folder
            )
            print(measure.table(found["cold"]))
    if given.small == 1:
        save(given.old, given.new, sides, found)


def save(old: str, new: str, sides: Sequence[Side], found: dict) -> None:
    """Replace the parts of the result that were measured."""
    kept = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    about = {
        "machine": measure.machine(),
        "old": sides[0].commit,
        "new": sides[1].commit,
    }
    plain = "_plain" if any(side.plain for side in sides) else ""
    for part, rows in found.items():
        kept[part + plain] = {**about, "sides": [old, new], "rows": rows}
    files.write_json(RESULT, kept)
    print(f"written to {RESULT}")


if __name__ == "__main__":
    main()
