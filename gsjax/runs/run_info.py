"""How a run went, in numbers: what `gsjax info` says of a run's folder."""

from pathlib import Path
from typing import Any

from gsjax.errors import InputError
from gsjax.runs.folder import load_settings, run_files
from gsjax.runs.history import read_metrics
from gsjax.runtime.console import decibels
from gsjax.runtime.files import read_json

_VIEWS = {"test": "held-out", "train": "training"}
# Of an evaluation, what is told of it, and what that may be.
_TOLD = {"which": (str,), "views": (int,), "ssim": (float, int)}
_TOLD["psnr"] = (float, int, type(None))  # null where it is infinite


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
    told = read_json(path, "what `gsjax eval` writes anew")
    for key, kinds in _TOLD.items():
        value = told.get(key, "missing")
        good = type(value) in kinds
        if good and type(value) in (int, float):
            good = abs(value) < 1e30
        if not good or (key == "which" and value not in _VIEWS):
            raise InputError(
                f"{path}: damaged: {key} is {repr(value)[:80]}; `gsjax eval` writes it "
                "anew"
            )
    return {key: told[key] for key in _TOLD}


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
        which = _VIEWS[quality["which"]]
        rows["quality"] = (
            f"PSNR {decibels(quality['psnr'])}, SSIM {quality['ssim']:.4f} "
            f"({quality['views']} {which} views)"
        )
    return "\n".join([path, *(f"  {name:<18}{value}" for name, value in rows.items())])
