"""Run the Python and find the commands of Markdown pages.

A page is one program: its ```python blocks, from top to bottom. A comment after a
`print` is what it must print. Blocks below <!-- no-run --> are only compiled. Executed
as a program, this file runs the given pages in one process, so that they share what is
compiled.
"""

import contextlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
_BLOCK = re.compile(r"^(?:<!-- (\S+) -->\n)?```(\w+)\n((?:.*\n)*?)```$", re.M)
_PRINT = re.compile(r"^\s*print\(.*\)  # (.*)$")


def blocks(text: str, language: str, *, marked: str = "") -> list[tuple[int, str]]:
    """Return (line before it, code) of each block with this language and mark."""
    return [
        (text[: found.start(3)].count("\n"), found[3])
        for found in _BLOCK.finditer(text)
        if found[2] == language and (found[1] or "") == marked
    ]


def program(text: str) -> str:
    """Return the Python of a page, each line at the line number of the page."""
    lines = [""] * (text.count("\n") + 1)
    for start, code in blocks(text, "python"):
        for offset, line in enumerate(code.splitlines()):
            lines[start + offset] = line
    return "\n".join(lines) + "\n"


def commands(text: str) -> list[list[str]]:
    """Return the arguments of every ``gsjax …`` in ```sh blocks."""
    found = []
    for _, code in blocks(text, "sh"):
        for line in re.split(r"\n|&&|\||;", code.replace("\\\n", " ")):
            words = shlex.split(line, comments=True)
            if words[:1] == ["gsjax"]:
                found.append(words[1:])
    return found


def spans(text: str) -> list[str]:
    """Return the code spans of the text outside of blocks."""
    return re.findall(r"`([^`]*)`", _BLOCK.sub("", text))


def run_pages(paths: list[Path], cwd: Path) -> str:
    """Run pages in a process of their own; return the error, or ""."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_ENABLE_X64": "0"}
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", __file__, *map(str, paths)],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
    )
    return done.stderr if done.returncode else ""


def _run(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()

    def check(*values) -> None:
        line = sys._getframe(1).f_lineno
        printed = " ".join(map(str, values))
        if lines[line - 1].endswith("("):
            raise AssertionError(f"{path.name}, line {line}: print on one line")
        claimed = _PRINT.match(lines[line - 1])
        if claimed and " ".join(printed.split()) != " ".join(claimed[1].split()):
            raise AssertionError(
                f"{path.name}, line {line}: {printed!r} is printed, not {claimed[1]!r}"
            )

    names = {"print": check, "__name__": "__main__"}
    exec(compile(program(text), str(path), "exec"), names)
    for _, code in blocks(text, "python", marked="no-run"):
        compile(code, str(path), "exec")


def main() -> None:
    """Run the pages of the command line, each in a folder of its own."""
    import gsjax

    if len(sys.argv) > 2:
        # Several pages queue calls for several devices, for which XLA's collectives
        # may wait too long on a busy machine.
        gsjax.use_all_cores = lambda *_, **__: 1
    for path in [Path(name).resolve() for name in sys.argv[1:]]:
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            _run(path)


if __name__ == "__main__":
    main()
