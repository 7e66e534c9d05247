"""`gsjax doctor`: checks of the installation."""

from dataclasses import dataclass

from gsjax.cli.common import Command, start_jax
from gsjax.runtime.console import say


@dataclass(kw_only=True)
class DoctorCommand(Command):
    """Check the installation: versions, devices, and a small render against a
    reference. The exit code is 1 if a check fails."""

    def run(self) -> int:
        start_jax()
        from gsjax.cli.doctor_checks import doctor_lines

        lines, good = doctor_lines()
        for line in lines:
            say(line)
        return 0 if good else 1
