"""How a run went, in numbers: what `gsjax info` says of a run's folder."""

import json
from pathlib import Path
from typing import Any

from gsjax.console import decibels
from gsjax.errors import InputError
from gsjax.train.folder import load_settings, run_files
from gsjax.train.history import read_metrics


def describe_run(folder: Path) -> dict[str, Any]:
    """Settings that matter most, how far it went, and how well, ready for JSON.

    The latter are None as long as the run has not come to them.

    Raises:
      InputError: if there is no run, or its files are damaged.
    """
    settings, files = load_settings(folder), run_files(folder)
    config = settings.config
    lines = read_metrics(files.metrics)
    last = lines[-1] if lines else {"step": 0, "seconds": 0.0}
    return {
        "dataset": str(settings.dataset),
        "strategy": config.strategy,
        "steps_done": last["step"],
        "steps": config.steps,
        "seconds": last["seconds"],
        "seed": config.seed,
        "max_size": config.max_size,
        "background": config.background,
        "evaluation": _evaluation(files.eval),
    }


def _evaluation(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        return {key: told[key] for key in ("which", "views", "psnr", "ssim")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: damaged: {error}; `gsjax eval` writes it anew"
        ) from error


def run_text(path: str, facts: dict[str, Any]) -> str:
    """`describe_run` as lines to read."""
    rows = {
        "dataset": facts["dataset"],
        "strategy": facts["strategy"],
        "steps": f"{facts['steps_done']:,} of {facts['steps']:,}",
        "training": f"{facts['seconds']:.0f} s",
    }
    quality = facts["evaluation"]
    if quality is not None:
        which = {"test": "held-out", "train": "training"}[quality["which"]]
        rows["quality"] = (
            f"PSNR {decibels(quality['psnr'])}, SSIM {quality['ssim']:.4f} "
            f"({quality['views']} {which} views)"
        )
    return "\n".join([path, *(f"  {name:<18}{value}" for name, value in rows.items())])
