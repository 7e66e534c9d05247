"""Run the Python and find the commands of Markdown pages.

A page is one program: its ```python blocks, from top to bottom. A comment after a
`print` is what it must print. Blocks below <!-- no-run --> are only compiled. Executed
as a program, this file runs the given pages in one process, so that they share what is
compiled.
"""

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


def typed(text: str) -> list[list[str]]:
    """Return the words of every command in ```sh blocks."""
    found = []
    for _, code in blocks(text, "sh"):
        for line in code.replace("\\\n", " ").splitlines():
            parts = re.split(r"&&|\||;", line)
            found += [shlex.split(part, comments=True) for part in parts]
    return [words for words in found if words]


def commands(text: str) -> list[list[str]]:
    """Return the arguments of every ``gsjax …`` in ```sh blocks."""
    return [words[1:] for words in typed(text) if words[0] == "gsjax"]


def mentions(text: str) -> list[list[str]]:
    """Return the arguments of every `gsjax …` in the text; they may be incomplete."""
    spans = re.findall(r"`(gsjax [^`]*)`", _BLOCK.sub("", text))
    return [shlex.split(span)[1:] for span in spans]


def bare_options(text: str) -> list[str]:
    """Return every ``--option`` in a code span that begins with one."""
    spans = re.findall(r"`(-[^`]*)`", _BLOCK.sub("", text))
    return [option for span in spans for option in re.findall(r"--[a-z][\w-]*", span)]


def run_pages(paths: list[Path], *, claims: str = "", cwd: Path) -> str:
    """Run pages in a process of their own; return the error, or "".

    Args:
      paths: the pages.
      claims: Python to run after each page.
      cwd: the working directory.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_ENABLE_X64": "0"}
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", __file__, *map(str, paths)],
        cwd=cwd,
        env=environment,
        input=claims,
        capture_output=True,
        text=True,
    )
    return done.stderr if done.returncode else ""


def _run(path: Path, claims: str) -> None:
    """Run a page, then the claims."""
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
    exec(compile(claims, "claims", "exec"), names)
    for _, code in blocks(text, "python", marked="no-run"):
        compile(code, str(path), "exec")


def main() -> None:
    """Run the pages of the command line, each in a folder of its own."""
    import gsjax

    claims = sys.stdin.read()
    if len(sys.argv) > 2:
        # Several pages queue calls for several devices, for which XLA's collectives
        # may wait too long on a busy machine.
        gsjax.use_all_cores = lambda *_, **__: 1
    for name in sys.argv[1:]:
        here = Path.cwd()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            _run(here / name, claims)
            os.chdir(here)


if __name__ == "__main__":
    main()
