"""`gsjax stress`: is what is computed here numerically sound?"""

from dataclasses import dataclass
from pathlib import Path

from gsjax.cli.common import Command, UsageError, start_jax
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class StressCommand(Command):
    """Measure numerical stability: one line a case, exit code 1 if one is outside its
    bound."""

    full: bool = False
    """Over more scenes and values, and all cases: minutes in place of one."""
    only: str = ""
    """Only the cases whose name has this in it."""
    json: Path | None = None
    """Write the results to this file."""
    markdown: Path | None = None
    """Put the table into this file, between its comments "(/)gsjax stress"."""
    overwrite: bool = False
    """Replace a --json file that exists."""

    def run(self) -> int:
        start_jax()
        from gsjax.runtime import files
        from gsjax.stress import run as stress

        if self.json is not None:
            files.refuse_existing(
                [self.json], self.overwrite, "another name with --json"
            )
        if self.markdown is not None:
            if self.only:
                raise UsageError("--markdown and --only exclude each other")
            stress.around_marks(self.markdown)  # before minutes go by
        cases = [c for c in stress.chosen(self.full) if self.only in c.name]
        if not cases:
            raise UsageError(f"--only {self.only!r}: {self._no_case()}")
        results = []
        for result in stress.run_cases(tuple(cases), self.full):
            results.append(result)
            say(stress.line(result))
        say(stress.summary(results))
        told = stress.as_json(results, self.full)
        if self.json is not None:
            files.make_folder(self.json.parent)
            files.write_json(self.json, told)
            note(f"{self.json} written")
        if self.markdown is not None:
            stress.put_between_marks(self.markdown, stress.markdown(told))
            note(f"{self.markdown} written")
        return 0 if all(result.good for result in results) else 1

    def _no_case(self) -> str:
        """Why --only chooses none."""
        from gsjax.stress import run as stress

        names = [c.name for c in stress.chosen(True) if self.only in c.name]
        if names:
            return f"only with --full: {', '.join(names)}"
        names = [c.name for c in stress.chosen(self.full)]
        more = "" if self.full else "; more with --full"
        return f"no case; there are {', '.join(names)}{more}"
