"""Progress and quality of a run, for `gsjax info`."""

from pathlib import Path
from typing import Any

from gsjax.errors import InputError
from gsjax.runs.folder import load_settings, run_files
from gsjax.runs.history import read_metrics
from gsjax.runtime.console import decibels
from gsjax.runtime.files import read_json

_VIEWS = {"test": "held-out", "train": "training"}
# Reported keys of an evaluation and their types; psnr is null if it is infinite.
_REPORTED = {
    "which": (str,),
    "views": (int,),
    "ssim": (float, int),
    "psnr": (float, int, type(None)),
}


def describe_run(folder: Path) -> dict[str, Any]:
    """Return the main settings, progress and quality of a run, ready for JSON.

    ``evaluation`` is None if there is none yet.

    Raises:
      InputError: if the folder is not a run, or its files are damaged.
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
    data = read_json(path, "the eval.json of a run")
    for key, kinds in _REPORTED.items():
        value = data.get(key, "missing")
        good = type(value) in kinds
        if good and type(value) in (int, float):
            good = abs(value) < 1e30
        if not good or (key == "which" and value not in _VIEWS):
            raise InputError(
                f"{path}: damaged: {key} is {repr(value)[:80]}; write it again with "
                "`gsjax eval`"
            )
    return {key: data[key] for key in _REPORTED}


def run_text(path: str, facts: dict[str, Any]) -> str:
    """Return `describe_run` as readable lines."""
    rows = {
        "dataset": facts["dataset"],
        "strategy": facts["strategy"],
        "steps": f"{facts['steps_done']:,} of {facts['steps']:,}",
        "training": f"{facts['seconds']:.0f} s",
    }
    quality = facts["evaluation"]
    if quality is not None:
        which = _VIEWS[quality["which"]]
        rows["quality"] = (
            f"PSNR {decibels(quality['psnr'])}, SSIM {quality['ssim']:.4f} "
            f"({quality['views']} {which} views)"
        )
    return "\n".join([path, *(f"  {name:<18}{value}" for name, value in rows.items())])
