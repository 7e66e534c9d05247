"""`gsjax info`: statistics of a scene and of its run."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, check_output, start_jax
from gsjax.runtime.console import say
from gsjax.runtime.files import make_folder, write_file


@dataclass(kw_only=True)
class InfoCommand(HeavyCommand):
    """Print statistics of a scene, and the progress and quality of its run."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """Folder of a run, or a file of Gaussians: .ply, .sog, .spz, .glb and others."""
    json: bool = False
    """Print JSON."""
    plot: Annotated[Path | None, arg(metavar="OUT.png")] = None
    """Also plot histograms of opacity, scale and anisotropy."""
    overwrite: bool = False
    """Replace an existing plot."""

    def run(self) -> int:
        check_output("--plot", self.plot, self.overwrite, ".png")
        start_jax()
        from gsjax.io import images
        from gsjax.io.formats import load, stored_bytes
        from gsjax.plots.figures import histograms
        from gsjax.runs.folder import run_files
        from gsjax.runs.info import describe, describe_run, info_text, run_text
        from gsjax.runs.scene_source import is_run, splat_file

        report: dict[str, Any] = {"path": str(self.scene)}
        texts, splat = [], self.scene
        if is_run(self.scene):
            report["run"] = describe_run(self.scene)
            texts.append(run_text(str(self.scene), report["run"]))
            splat = run_files(self.scene).splat
        if self.plot is not None:
            splat = splat_file(self.scene)  # raises if there is no scene yet
        if splat.exists() or "run" not in report:
            gaussians = load(splat)
            facts = describe(gaussians)
            facts["file_bytes"] = stored_bytes(splat)
            report |= facts
            texts.append(info_text(str(splat), facts))
            if self.plot is not None:
                make_folder(self.plot.parent)
                named = self.scene.resolve() if "run" in report else splat
                plot = histograms(gaussians, title=named.name)
                write_file(self.plot, images.encode_png(plot))
                report["plot"] = str(self.plot)
                texts.append(str(self.plot))
        say(json.dumps(report, indent=2) if self.json else "\n".join(texts))
        return 0
