"""`gsjax eval`: metrics of a run on its held-out views."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from gsjax.cli.common import HeavyCommand, start_jax
from gsjax.runtime.console import decibels, note, say


@dataclass(kw_only=True)
class EvalCommand(HeavyCommand):
    """Evaluate a run: PSNR and SSIM of its held-out views, with renders."""

    folder: Positional[Path]
    """Folder of the run."""
    views: Literal["test", "train"] = "test"
    """Evaluate the held-out or the training views."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        start_jax()
        from gsjax.runs.checkpoint import latest_step
        from gsjax.runs.evaluation import evaluate_run
        from gsjax.runs.folder import load_settings, run_files

        summary = evaluate_run(self.folder, which=self.views)
        files = run_files(self.folder, self.views)
        steps = load_settings(self.folder).config.steps
        saved = latest_step(files.checkpoints)
        if saved is not None and saved < steps:
            note(f"the run is unfinished: step {saved:,} of {steps:,} is saved")
        report = json.loads(files.eval.read_text(encoding="utf-8"))
        if self.json:
            say(json.dumps(report, indent=2))
            return 0
        for each in report["each"]:
            text = "fully masked"
            if each["ssim"] is not None:
                text = f"PSNR {decibels(each['psnr'])}  SSIM {each['ssim']:.4f}"
            say(f"{each['name']}  {text}")
        quality = f"PSNR {decibels(summary.psnr)}, SSIM {summary.ssim:.4f}"
        views = f"{summary.views} {self.views} views"
        say(f"{views}: {quality}, LPIPS {summary.lpips}")
        say(str(files.preview))
        return 0
