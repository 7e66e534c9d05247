"""The README's commands do what they say, one after another, in one folder.

Those in its blocks as they stand, on photographs made by code; those in its text with
what they leave out filled in. Options that make them small are appended, no more.
"""

import contextlib
import io
import re
import tomllib
import urllib.request
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
from corner_room import NAMES, make_room, make_video
from snippets import ROOT, blocks, commands, mentions, typed

import gsjax.bench.pareto as pareto_module
import gsjax.cli.view as view_module
from gsjax.cli import main as cli_main
from gsjax.cli.common import UsageError

pytestmark = [
    pytest.mark.long,
    pytest.mark.usefixtures("float32", "shared_programs"),
]

README = (ROOT / "README.md").read_text(encoding="utf-8")

# Not executed, by how they begin, and why.
ELSEWHERE = {
    "pip install": "installs, maybe from elsewhere; the extras are looked up",
    "python -m pytest": "runs this",
}
# What a command is about, where the text leaves it out.
LEFT_OUT = {
    "eval": ["RUN"],
    "render": ["RUN", "-o", "DIR"],
    "train": ["DATASET", "-o", "RUN"],
}
# Appended: the options, and the value of each.
SMALLER = {
    "bench": {"--size": "32x24", "--repeats": "1"},
    "demo": {"--photos": "9", "--size": "64x48", "--steps": "4"},
    "render": {"--frames": "3"},
    "sfm": {"--frames": "6"},
    "stress": {"--only": "opacity/round"},
    "train": {"--preset": "fast", "--steps": "4", "--max-size": "80"},
}
WRITTEN = ("out", "html", "plot", "json")


def smaller(words: list[str]) -> list[str]:
    of_photos = words[:2] == ["sfm", "photos"]  # there are no frames to choose from
    more = {} if of_photos else SMALLER.get(words[0], {})
    return words + [
        word for name, value in more.items() if name not in words
        for word in (name, value)
    ]  # fmt: skip


@contextlib.contextmanager
def soon_done(said: io.StringIO) -> Iterator[None]:
    """Within, who serves is visited once and then told Ctrl-C; few points measured."""

    def visit(_: float) -> None:
        url = said.getvalue().split()[-1]
        assert b"<html" in urllib.request.urlopen(url, timeout=30).read()
        raise KeyboardInterrupt

    points = pareto_module.points
    with (
        mock.patch.object(view_module, "time", SimpleNamespace(sleep=visit)),
        mock.patch.object(pareto_module, "points", lambda *a: points(*a)[:1]),
    ):
        yield


def execute(words: list[str], folder: Path) -> None:
    """Run it there: it succeeds, says something, and writes what it was asked to."""
    said, told = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(told),
        soon_done(said),
    ):
        assert cli_main.main(smaller(words)) == 0, told.getvalue()
        command = cli_main._parse(words)
        paths = [getattr(command, name, None) for name in WRITTEN]
        for path in (path for path in paths if isinstance(path, Path)):
            assert any(path.iterdir()) if path.is_dir() else path.stat().st_size > 0
    assert said.getvalue().strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the commands of the blocks were executed, in the order of the page."""
    pytest.importorskip("pycolmap", reason="pycolmap is absent")
    folder = tmp_path_factory.mktemp("readme")
    (folder / "photos").mkdir()
    make_room(folder / "photos")
    for words in commands(README):
        if words[0] != "view" or find_spec("viser"):  # needs gsjax[viewer]
            execute(words, folder)
    return folder


def test_blocks(folder):
    """Whatever path a comment names is there, too."""
    comments = re.findall(r" # (.*)", "".join(code for _, code in blocks(README, "sh")))
    paths = re.findall(r"[\w.-]+/[\w./-]*", " ".join(comments))
    assert {"run/splat.ply", "gsjax-demo/"} <= set(paths)
    assert [path for path in paths if not (folder / path).exists()] == []


def test_other_commands_have_a_reason():
    others = [words for words in typed(README) if words[0] != "gsjax"]
    found = [key for words in others for key in ELSEWHERE if begins(words, key)]
    assert len(found) == len(others)
    assert set(found) == set(ELSEWHERE)


def test_extras_are_those_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = set(re.findall(r"pip install[^`\n]*\[(\w+)\]", README))
    assert {"test", "viewer"} <= wanted <= set(project["optional-dependencies"])


def begins(words: list[str], key: str) -> bool:
    return words[: len(key.split())] == key.split()


def complete(words: list[str]) -> list[str] | None:
    """As it can be typed, without [OPTIONAL]; None where only the command is named."""
    words = [word for word in words if not word.startswith("[")]
    with contextlib.suppress(UsageError):
        cli_main._parse(words)
        return words
    if len(words) == 1:
        return None
    name, *rest = words
    return [name, *LEFT_OUT[name], *(word for word in rest if word != "…")]


IN_TEXT = {
    " ".join(words): words
    for words in map(complete, mentions(README))
    if words is not None and [w.lower() for w in words] not in commands(README)
}


@pytest.mark.parametrize("name", IN_TEXT)
def test_text(name, folder, tmp_path):
    """What it makes goes elsewhere; what it is about is that of the blocks."""
    if IN_TEXT[name][0] == "view" or "--viewer" in IN_TEXT[name]:
        pytest.importorskip("viser", reason="needs gsjax[viewer]")
    given = {"RUN": "run", "DATASET": "dataset", "PHOTOS": "photos"}
    given["VIDEO"] = "walk.avi"
    given = {mark: str(folder / there) for mark, there in given.items()}
    if "VIDEO" in IN_TEXT[name]:
        make_video(folder / "walk.avi")
    given["IMAGE"] = NAMES[0]
    words = IN_TEXT[name]
    filled = [
        word if before == "-o" else given.get(word, word)
        for before, word in zip(["", *words], words)
    ]
    execute(filled, tmp_path)
