"""`gsjax bench`: run time against error on this machine."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, check_output, start_jax
from gsjax.cli.options import Budget, OptionalSize, integer
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class BenchCommand(HeavyCommand):
    """Measure run time against error, varying one setting at a time.

    Takes minutes, mostly to compile.
    The exit code is 1 if an error exceeds its theoretical bound."""

    scene: Annotated[Positional[str], arg(metavar="RUN|PLY|NAME")] = "knot"
    """Folder of a run, a file of Gaussians, or a built-in scene: knot, fog, needles or
    huge."""
    cameras: Path | None = None
    """Use the first camera of this transforms.json; default: a camera of the scene, or
    one that faces it."""
    size: OptionalSize = None
    """Size of the image; default: that of the camera, or 400x300 for a .ply."""
    budget: Budget = None
    """Also measure the plan for this maximum error of a colour, e.g. 1/255."""
    popping: bool = False
    """Measure how much each order of blending pops when the camera turns, instead."""
    scales: bool = False
    """Compare the filters of the image at 1/8 to 8 times the resolution with the mean
    over each pixel, instead."""
    repeats: Annotated[int, integer(1, 1000)] = 5
    """Number of timings of each setting; the median is reported."""
    json: Path | None = None
    """Write all numbers to this file."""
    plot: Path | None = None
    """Write the plot to this .png file."""
    overwrite: bool = False
    """Replace existing files."""

    def run(self) -> int:
        kinds = {"--scales": self.scales, "--popping": self.popping}
        kinds["--budget"] = self.budget is not None
        chosen = [name for name, given in kinds.items() if given]
        if len(chosen) > 1:
            raise UsageError(f"{' and '.join(chosen)} exclude each other")
        check_output("--plot", self.plot, self.overwrite, ".png")
        check_output("--json", self.json, self.overwrite)
        start_jax()
        from gsjax.bench.scenes import open_bench_scene

        scene = open_bench_scene(self.scene, cameras=self.cameras, size=self.size)
        if self.popping:
            return self._pop(scene)
        return self._sweep(scene) if self.scales else self._vary(scene)

    def _vary(self, scene) -> int:
        """Vary one setting at a time."""
        from gsjax.bench.pareto import front, make_points, measure_points, time_stages
        from gsjax.bench.report import front_picture, table
        from gsjax.planning.plan import plan
        from gsjax.runtime.timing import machine

        planned = None
        if self.budget is not None:
            behind = scene.background
            planned = plan(
                scene.gaussians, scene.camera, budget=self.budget, background=behind
            )
            for line in planned.lines():
                note(line)
        points = make_points(scene.gaussians, planned)
        rows = measure_points(scene, points, self.repeats)
        parts = time_stages(scene, self.repeats)
        facts = ", ".join(f"{name} {value}" for name, value in machine().items())
        say(f"{scene.name}, {scene.camera.width} × {scene.camera.height}; {facts}")
        say(table(rows, front(rows)))
        say(", ".join(f"{name} {ms:.3g} ms" for name, ms in parts.items()))
        self._write({"stages": parts, "rows": rows}, front_picture, scene)
        bad = [f"{row['knob']} {row['value']}" for row in rows if not row["inside"]]
        within = f"all {len(rows)} errors are within the theoretical bound"
        note(f"errors above the theoretical bound: {', '.join(bad)}" if bad else within)
        return 1 if bad else 0

    def _pop(self, scene) -> int:
        """Turn the camera with each order."""
        from gsjax.bench.popping import measure_popping
        from gsjax.bench.report import popping_picture, popping_table

        rows = measure_popping(scene, repeats=self.repeats)
        say(f"{scene.name}, {scene.camera.width} × {scene.camera.height}")
        say(popping_table(rows))
        self._write({"rows": rows}, popping_picture, scene)
        return 0

    def _sweep(self, scene) -> int:
        """Compare filters at several resolutions."""
        from gsjax.bench.scales import measure_scales, scales_picture, scales_table

        rows = measure_scales(scene)
        say(f"{scene.name}, {scene.camera.width} × {scene.camera.height}")
        say(scales_table(rows))
        told = {"rows": [row._asdict() for row in rows]}
        self._write(told, lambda _, name: scales_picture(rows, name), scene)
        return 0

    def _write(self, found: dict[str, Any], picture: Any, scene: Any) -> None:
        """Write the numbers and the plot that were asked for."""
        from gsjax.io import images
        from gsjax.runtime import files
        from gsjax.runtime.timing import machine

        if self.json is not None:
            files.make_folder(self.json.parent)
            files.write_json(self.json, {"machine": machine(), **found})
        if self.plot is not None:
            files.make_folder(self.plot.parent)
            pixels = picture(found["rows"], scene.name)
            files.write_file(self.plot, images.encode_png(pixels))
