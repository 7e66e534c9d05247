"""`gsjax info`: what a scene or a run consists of."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.runtime.console import say


@dataclass(kw_only=True)
class InfoCommand(HeavyCommand):
    """Say what a scene consists of, and how a run went."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """The Gaussians: a .ply or .spz file, or the folder of a run."""
    json: bool = False
    """Print JSON."""
    plot: Annotated[Path | None, arg(metavar="OUT.png")] = None
    """Also draw histograms of opacity, scale and anisotropy."""
    overwrite: bool = False
    """Replace a plot that exists."""

    def run(self) -> int:
        from gsjax.runtime import files

        if self.plot is not None:
            if self.plot.suffix.lower() != ".png":
                raise UsageError(f"--plot {self.plot}: a name in .png is wanted")
            files.refuse_existing(
                [self.plot], self.overwrite, "another name with --plot"
            )
        start_jax()
        from gsjax.io.formats import load
        from gsjax.plots.histograms import histograms_png
        from gsjax.runs.folder import run_files
        from gsjax.runs.run_info import describe_run, run_text
        from gsjax.runs.scene_info import describe, info_text
        from gsjax.runs.scene_source import is_run, splat_file

        told: dict[str, Any] = {"path": str(self.scene)}
        texts, splat = [], self.scene
        if is_run(self.scene):
            told["run"] = describe_run(self.scene)
            texts.append(run_text(str(self.scene), told["run"]))
            splat = run_files(self.scene).splat
        if self.plot is not None:
            splat = splat_file(self.scene)  # which says what is missing
        if splat.exists() or "run" not in told:
            gaussians = load(splat)
            facts = describe(gaussians)
            facts["file_bytes"] = splat.stat().st_size
            told |= facts
            texts.append(info_text(str(splat), facts))
            if self.plot is not None:
                files.make_folder(self.plot.parent)
                named = self.scene.resolve() if "run" in told else splat
                histograms_png(self.plot, gaussians, title=named.name)
                told["plot"] = str(self.plot)
                texts.append(str(self.plot))
        say(json.dumps(told, indent=2) if self.json else "\n".join(texts))
        return 0
