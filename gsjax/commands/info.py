"""`gsjax info`: what a scene consists of."""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from gsjax.commands.common import Command, use_all_cores
from gsjax.console import say


@dataclass(kw_only=True)
class InfoCommand(Command):
    """Say what a scene consists of."""

    scene: Positional[Path]
    """The Gaussians: a .ply file."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        use_all_cores()
        from gsjax.info import describe, info_text
        from gsjax.io import load

        facts = describe(load(self.scene))
        facts["file_bytes"] = self.scene.stat().st_size
        if self.json:
            say(json.dumps({"path": str(self.scene), **facts}, indent=2))
        else:
            say(info_text(str(self.scene), facts))
        return 0
