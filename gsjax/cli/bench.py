"""`gsjax bench`: run time against error, on this machine."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from gsjax.cli.common import (
    HeavyCommand,
    UsageError,
    parse_budget,
    parse_size,
    start_jax,
)
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class BenchCommand(HeavyCommand):
    """Measure run time against error: every knob of accuracy and size, one at a time.

    Minutes, most of them compiling: of the built-in knot on two cores five or so, of
    larger scenes more. Exit code 1 if a point is outside of the error that theory
    allows it."""

    scene: Annotated[Positional[str], arg(metavar="RUN|PLY|NAME")] = "knot"
    """The folder of a run, a .ply or .spz, or built in: knot, fog, needles or huge."""
    cameras: Path | None = None
    """First camera of this transforms.json; else the scene's own, or one facing it."""
    size: Annotated[str | None, arg(metavar="WxH")] = None
    """Size of the picture; default: that of the cameras, of a .ply 400x300."""
    budget: Annotated[str | None, arg(metavar="ERROR")] = None
    """Also plan for this largest error of a colour, e.g. 1/255."""
    repeats: int = 5
    """How often each is timed, in turn; medians count."""
    json: Path | None = None
    """Write all numbers to this file."""
    plot: Path | None = None
    """Write the plot to this .png."""
    overwrite: bool = False
    """Replace what exists."""

    def run(self) -> int:
        budget = None if self.budget is None else parse_budget(self.budget)
        size = None if self.size is None else parse_size(self.size)
        if not 1 <= self.repeats <= 1000:
            raise UsageError(f"--repeats {self.repeats}: from 1 to 1000 is wanted")
        if self.plot is not None and self.plot.suffix.lower() != ".png":
            raise UsageError(f"--plot {self.plot}: a name in .png is wanted")
        start_jax()
        from gsjax.bench.pareto import front, pareto, points, stages
        from gsjax.bench.report import front_picture, table
        from gsjax.bench.scenes import open_stress_scene
        from gsjax.io import images
        from gsjax.planning.plan import plan
        from gsjax.runtime import files
        from gsjax.runtime.timing import machine

        written = [path for path in (self.json, self.plot) if path is not None]
        files.refuse_existing(written, self.overwrite)
        trial = open_stress_scene(self.scene, cameras=self.cameras, size=size)
        made = None
        if budget is not None:
            made = plan(
                trial.gaussians,
                trial.camera,
                budget=budget,
                background=trial.background,
            )
            for line in made.lines():
                note(line)
        rows = pareto(trial, points(trial.gaussians, made), self.repeats)
        parts = stages(trial, self.repeats)
        where = machine()
        told = ", ".join(f"{name} {value}" for name, value in where.items())
        say(f"{trial.name}, {trial.camera.width} × {trial.camera.height}; {told}")
        say(table(rows, front(rows)))
        say(", ".join(f"{name} {ms:.3g} ms" for name, ms in parts.items()))
        if self.json is not None:
            found: dict[str, Any] = {"machine": where, "stages": parts, "rows": rows}
            files.make_folder(self.json.parent)
            files.write_json(self.json, found)
        if self.plot is not None:
            files.make_folder(self.plot.parent)
            picture = front_picture(rows, trial.name)
            files.write_file(self.plot, images.encode_png(picture))
        bad = [f"{row['knob']} {row['value']}" for row in rows if not row["inside"]]
        if bad:
            note(f"outside of what theory allows: {', '.join(bad)}")
        else:
            note(f"all {len(rows)} are within what theory allows")
        return 1 if bad else 0
