"""`gsjax eval`: how well a run shows the views that were held out."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from gsjax.cli.common import HeavyCommand, start_jax
from gsjax.runtime.console import decibels, note, say


@dataclass(kw_only=True)
class EvalCommand(HeavyCommand):
    """Measure a run: PSNR and SSIM of held-out views, with pictures."""

    folder: Positional[Path]
    """Folder of the run."""
    views: Literal["test", "train"] = "test"
    """Which views to measure on."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        start_jax()
        from gsjax.runs.checkpoint import latest_step
        from gsjax.runs.folder import load_settings, run_files
        from gsjax.runs.held_out import evaluate_run

        summary = evaluate_run(self.folder, which=self.views)
        files = run_files(self.folder, self.views)
        steps = load_settings(self.folder).config.steps
        saved = latest_step(files.checkpoints)
        if saved is not None and saved < steps:
            note(
                f"this run is not at its end: step {saved:,} of {steps:,} is its last "
                "checkpoint"
            )
        told = json.loads(files.eval.read_text(encoding="utf-8"))
        if self.json:
            say(json.dumps(told, indent=2))
            return 0
        for each in told["each"]:
            if each["ssim"] is None:
                say(f"{each['name']}  masked altogether")
                continue
            say(
                f"{each['name']}  PSNR {decibels(each['psnr'])}  "
                f"SSIM {each['ssim']:.4f}"
            )
        say(
            f"{summary.views} {self.views} views: PSNR {decibels(summary.psnr)}, "
            f"SSIM {summary.ssim:.4f}, LPIPS {summary.lpips}"
        )
        say(str(files.preview))
        return 0
