"""The README's commands run, one after another, in one folder.

They are executed as written, on photographs made by code; options that make them small
are appended.
"""

import contextlib
import io
import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
from corner_room import make_room
from snippets import ROOT, blocks, commands, typed

from gsjax.cli.main import main

pytestmark = [
    pytest.mark.long,
    pytest.mark.usefixtures("float32", "shared_programs"),
]

README = (ROOT / "README.md").read_text(encoding="utf-8")
SMALLER = {
    "demo": ["--photos", "9", "--size", "64x48", "--steps", "4"],
    "render": ["--frames", "3"],
    "train": ["--steps", "4", "--max-size", "80"],
}
# Rows of the README's table that other tests do not run on a whole run folder.
TABLE = ["eval run", "render run -o dir", "export run out.ply", "info run"]


def execute(words: list[str], folder: Path) -> None:
    """Run a command in ``folder``; it succeeds and prints something."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        assert main([*words, *SMALLER.get(words[0], [])]) == 0, err.getvalue()
    assert out.getvalue().strip()


def test_commands_run_in_order(tmp_path):
    pytest.importorskip("pycolmap", reason="pycolmap is absent")
    (tmp_path / "photos").mkdir()
    make_room(tmp_path / "photos")
    for words in commands(README):
        if words[0] != "view" or find_spec("viser"):  # needs gsjax[viewer]
            execute(words, tmp_path)
    comments = re.findall(r" # (.*)", "".join(code for _, code in blocks(README, "sh")))
    paths = re.findall(r"[\w.-]+/[\w./-]*", " ".join(comments))
    assert {"run/splat.ply", "gsjax-demo/"} <= set(paths)
    assert [path for path in paths if not (tmp_path / path).exists()] == []
    for line in TABLE:
        assert f"`gsjax {line.split()[0]} RUN" in README
        execute(line.split(), tmp_path)


def test_other_commands_install_or_test():
    others = [words for words in typed(README) if words[0] != "gsjax"]
    kinds = {" ".join(words[:3]) for words in others}
    assert kinds == {"pip install -e", "python -m pytest"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(re.findall(r"pip install[^`\n]*\[(\w+)\]", README))
    assert {"test", "viewer"} <= extras <= set(project["optional-dependencies"])
