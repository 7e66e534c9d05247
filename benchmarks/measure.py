"""Results as JSON files and tables, code of other commits, and cold processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import jax

from gsjax.runtime import files
from gsjax.runtime.timing import interleaved as interleaved
from gsjax.runtime.timing import machine as machine
from gsjax.runtime.timing import time_ms as time_ms

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).with_name("results")


def code_of(commit: str, folder: Path) -> Path:
    """Unpack the package as of a commit into the folder, and return the folder."""
    packed = subprocess.run(
        ["git", "archive", commit, "gsjax"], cwd=ROOT, check=True, capture_output=True
    )
    folder.mkdir(parents=True)
    subprocess.run(["tar", "-x", "-C", folder], input=packed.stdout, check=True)
    return folder


def run_cold(arguments: list[str], code: Path | None = None) -> None:
    """Run Python without a compilation cache, with the package in ``code``."""
    changes = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    if code is not None:
        changes["PYTHONPATH"] = str(code)
    command = [sys.executable, *arguments]
    subprocess.run(command, check=True, cwd=code, env={**os.environ, **changes})


def suffixed(name: str) -> str:
    """Append the kind of accelerator to a name, such as "_gpu"."""
    backend = jax.default_backend()
    return name if backend == "cpu" else f"{name}_{backend}"


def result_path(name: str) -> Path:
    """Return the result file of a name on this kind of device."""
    return RESULTS / f"{suffixed(name)}.json"


def load_result(name: str) -> dict:
    """Load the result of a name on this kind of device."""
    return json.loads(result_path(name).read_text())


def results_elsewhere(name: str, **same) -> list[tuple[str, list[dict]]]:
    """Return (device, rows) of results from other kinds of devices.

    Only results whose entries equal ``same`` count.
    """
    found = []
    for kind in ("", "_gpu", "_tpu"):
        path = RESULTS / f"{name}{kind}.json"
        if path.stem == suffixed(name) or not path.exists():
            continue
        told = json.loads(path.read_text())
        if all(told[key] == value for key, value in same.items()):
            found.append((device_name(told["machine"]), told["rows"]))
    return found


def device_name(machine: dict[str, str]) -> str:
    """Return the device of a result."""
    device = machine["devices"].split(" × ")[1]
    return machine["cpu"] if device == "cpu" else device


def save(name: str, rows: list[dict], **more) -> None:
    """Write ``results/name.json`` (see `suffixed`) and print the rows as a table."""
    RESULTS.mkdir(exist_ok=True)
    content = {"machine": machine(), **more, "rows": rows}
    path = result_path(name)
    files.write_json(path, content)
    print(table(rows))
    print(f"written to {path.name}: {content['machine']}")


def table(rows: list[dict]) -> str:
    """Return rows with the same keys as a Markdown table."""
    head = list(rows[0])
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for row in rows:
        cells = (
            f"{v:.3g}" if isinstance(v, float) and abs(v) < 100
            else f"{v:.0f}" if isinstance(v, float) else str(v)
            for v in row.values()
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
