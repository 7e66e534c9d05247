"""Python and commands in Markdown, run and parsed as they stand.

A page is one program: its ```python blocks, from top to bottom. Where a `print` has a
comment behind it, that is what it must print. Blocks below <!-- no-run --> are only
compiled; those that want photographs, say. Run as a program, this file runs the pages
it is given, all in one process, so that they share what is compiled.
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
_TOLD = re.compile(r"^\s*print\(.*\)  # (.*)$")


def blocks(text: str, language: str, *, marked: str = "") -> list[tuple[int, str]]:
    """(Line before it, code) of each block of a language, with this mark or none."""
    return [
        (text[: found.start(3)].count("\n"), found[3])
        for found in _BLOCK.finditer(text)
        if found[2] == language and (found[1] or "") == marked
    ]


def program(text: str) -> str:
    """The Python of a page, each line at the number that it has there."""
    lines = [""] * (text.count("\n") + 1)
    for start, code in blocks(text, "python"):
        for offset, line in enumerate(code.splitlines()):
            lines[start + offset] = line
    return "\n".join(lines) + "\n"


def typed(text: str) -> list[list[str]]:
    """Words of every command in ```sh blocks, as they can be typed."""
    found = []
    for _, code in blocks(text, "sh"):
        for line in code.replace("\\\n", " ").splitlines():
            parts = re.split(r"&&|\||;", line)
            found += [shlex.split(part, comments=True) for part in parts]
    return [words for words in found if words]


def commands(text: str) -> list[list[str]]:
    """Arguments of every ``gsjax …`` among them."""
    return [words[1:] for words in typed(text) if words[0] == "gsjax"]


def mentions(text: str) -> list[list[str]]:
    """Arguments of every `gsjax …` in the text, which may leave out some."""
    spans = re.findall(r"`(gsjax [^`]*)`", _BLOCK.sub("", text))
    return [shlex.split(span)[1:] for span in spans]


def bare_options(text: str) -> list[str]:
    """Every ``--option`` in a code span that begins with one, of whatever command."""
    spans = re.findall(r"`(-[^`]*)`", _BLOCK.sub("", text))
    return [option for span in spans for option in re.findall(r"--[a-z][\w-]*", span)]


def run_pages(paths: list[Path], *, claims: str = "", cwd: Path) -> str:
    """What went wrong when these pages were run in a process of their own; or "".

    In float32, as for a user; a single page on all cores, if it asks for them.
    """
    from conftest import older_emitters

    flags = [f"--{name}={value}" for name, value in older_emitters().items()]
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_ENABLE_X64": "0",
        # Many programs, each run once: compiled quickly, see conftest.py.
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "XLA_FLAGS": " ".join([os.environ.get("XLA_FLAGS", ""), *flags]),
    }
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
    """Run a page, then its claims."""
    text = path.read_text(encoding="utf-8")
    lines, told = text.splitlines(), []

    def check(*values) -> None:
        line = sys._getframe(1).f_lineno
        told.append(" ".join(map(str, values)))
        if lines[line - 1].endswith("("):
            raise AssertionError(f"{path.name}, line {line}: print on one line")
        claimed = _TOLD.match(lines[line - 1])
        if claimed and " ".join(told[-1].split()) != " ".join(claimed[1].split()):
            raise AssertionError(
                f"{path.name}, line {line}: {told[-1]!r} is printed, not {claimed[1]!r}"
            )

    names = {"print": check, "__name__": "__main__"}
    exec(compile(program(text), str(path), "exec"), names)
    exec(compile(claims, "claims", "exec"), names)
    for _, code in blocks(text, "python", marked="no-run"):
        compile(code, str(path), "exec")


def _compile_little() -> None:
    """One size of the work and short chunks, where a page does not say otherwise: no
    picture changes, and programs compile in a fraction of the time.
    """
    from gsjax.raster.render import DEFAULT_CONFIG
    from gsjax.raster.types import RasterConfig

    little = {"num_size_buckets": 1, "chunk_size": 4}
    names = list(RasterConfig.__dataclass_fields__)
    defaults = dict(zip(names, RasterConfig.__init__.__defaults__ or ())) | little
    RasterConfig.__init__.__defaults__ = tuple(defaults.values())
    for name, value in little.items():
        object.__setattr__(DEFAULT_CONFIG, name, value)


if __name__ == "__main__":
    wanted = sys.stdin.read()
    _compile_little()
    if len(sys.argv) > 2:
        import gsjax

        # Of one device: XLA's collectives gave up waiting for a thread where programs
        # of two devices were queued on a busy machine of two cores.
        gsjax.use_all_cores = lambda *_, **__: 1
    for name in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            here = Path.cwd()
            os.chdir(folder if len(sys.argv) > 2 else here)
            _run(Path(name), wanted)
            os.chdir(here)
