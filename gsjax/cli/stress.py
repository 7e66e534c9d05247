"""`gsjax stress`: checks of numerical stability on this machine."""

from dataclasses import dataclass
from pathlib import Path

from gsjax.cli.common import Command, UsageError, check_output, start_jax
from gsjax.cli.options import suggestion
from gsjax.runtime.console import note, say
from gsjax.runtime.files import make_folder, write_json


@dataclass(kw_only=True)
class StressCommand(Command):
    """Measure numerical stability, one line per case. The exit code is 1 if a case
    exceeds its bound."""

    full: bool = False
    """Run all cases, over more scenes and values: minutes instead of one."""
    only: str = ""
    """Run only the cases whose name contains this text."""
    json: Path | None = None
    """Write the results to this file."""
    markdown: Path | None = None
    """Write the table into this file, between its comments "gsjax stress" and "/gsjax
    stress"."""
    overwrite: bool = False
    """Replace an existing --json file."""

    def run(self) -> int:
        start_jax()
        from gsjax.stress import run as stress

        check_output("--json", self.json, self.overwrite)
        if self.markdown is not None:
            if self.only:
                raise UsageError("--markdown and --only exclude each other")
            stress.around_marks(self.markdown)  # checked before minutes of work
        cases = [c for c in stress.select_cases(self.full) if self.only in c.name]
        if not cases:
            names = [c.name for c in stress.select_cases(True)]
            found = ", ".join(name for name in names if self.only in name)
            hint = f"pass --full for {found}" if found else suggestion(self.only, names)
            raise UsageError(f"--only {self.only!r}: no such case; {hint}")
        results = []
        for result in stress.run_cases(tuple(cases), self.full):
            results.append(result)
            say(stress.line(result))
        say(stress.summary(results))
        report = stress.as_json(results, self.full)
        if self.json is not None:
            make_folder(self.json.parent)
            write_json(self.json, report)
            note(f"{self.json} written")
        if self.markdown is not None:
            stress.put_between_marks(self.markdown, stress.markdown(report))
            note(f"{self.markdown} written")
        return 0 if all(result.good for result in results) else 1
