"""The pages: their Python runs, their commands parse, and nothing is missing in them.

`mkdocs build` itself is held to say nothing, and its pages to fetch nothing.
"""

import html
import importlib.util
import io
import os
import re
import subprocess
import sys
import tomllib
from contextlib import redirect_stdout
from inspect import isclass, isfunction, ismodule
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from snippets import (
    ROOT,
    bare_options,
    blocks,
    commands,
    mentions,
    program,
    run_pages,
)
from viewing import CHROMIUM, opened

import gsjax.public
from gsjax.cli.main import main

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
READMES = [ROOT / "README.md", ROOT / "benchmarks" / "README.md"]
TEXTS = {path: path.read_text(encoding="utf-8") for path in [*READMES, *PAGES]}
CLI_PAGE = TEXTS[DOCS / "cli.md"]
_SPEC = importlib.util.spec_from_file_location("options", DOCS / "options.py")
assert _SPEC is not None
assert _SPEC.loader is not None
options = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(options)


@pytest.mark.long
def test_python_blocks_run(tmp_path):
    with_python = [path for path in PAGES if program(TEXTS[path]).strip()]
    assert len(with_python) >= 10
    assert run_pages(with_python, cwd=tmp_path) == ""


def test_a_wrong_claim_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```python\nprint(1 + 1)  # 2\n```\n\n```python\nprint(3)  # 4\n```\n"
    )
    assert "page.md, line 6: '3' is printed, not '4'" in run_pages([page], cwd=tmp_path)


@pytest.fixture(scope="module")
def helps() -> dict[str, str]:
    """What --help says of each command."""

    def help_of(*words: str) -> str:
        out = io.StringIO()
        with redirect_stdout(out), pytest.raises(SystemExit):
            main._parse([*words, "--help"])
        return out.getvalue()

    return {name: help_of(name) for name in re.findall(r"• (\w+)", help_of())}


def options_in(text: str) -> set[str]:
    return set(re.findall(r"--[a-z][a-z-]*", text))


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_commands_are_those_of_the_program(path, helps):
    for words in commands(TEXTS[path]):
        if words[-1] in ("--help", "--version"):
            assert set(words[:-1]) <= set(helps), words
        else:
            main._parse(words)
    for words in mentions(TEXTS[path]):
        if words[0] not in ("--help", "--version", "…"):
            assert words[0] in helps, words
            assert options_in(" ".join(words)) <= options_in(helps[words[0]]), words


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_options_are_those_of_some_command(path, helps):
    """Or of one of the benchmarks."""
    known = {"--help", "--version"}.union(*map(options_in, helps.values()))
    for source in (ROOT / "benchmarks").glob("*.py"):
        known |= set(re.findall(r'"(--\w+)" in sys.argv', source.read_text("utf-8")))
    assert [x for x in bare_options(TEXTS[path]) if x not in known] == []


def test_commands_are_found_where_they_stand():
    text = "`gsjax eval RUN`\n```sh\nls && gsjax info a.ply  # of a\n```"
    assert commands(text) == [["info", "a.ply"]]
    assert mentions(text) == [["eval", "RUN"]]
    text = "`-o a`, `--up +z --no_such`,\n`x --y`"
    assert bare_options(text) == ["--up", "--no_such"]
    assert sum(len(bare_options(text)) for text in TEXTS.values()) > 80
    assert sum(len(commands(text)) for text in TEXTS.values()) > 50


def test_every_command_has_its_section_and_table(helps):
    assert len(helps) >= 11
    assert set(re.findall(r"^## (\w+)$", CLI_PAGE, re.M)) == set(helps)
    assert set(re.findall(r"<!-- options: (\w+) -->", CLI_PAGE)) == set(helps)


def test_tables_have_the_options_of_the_program(helps):
    for command, text in helps.items():
        # In the list of the help they begin a line, or come behind a short form.
        heads = re.findall(r"^[│| ]{0,3}(?:-\w \S+, )?(--[a-z][a-z-]*)", text, re.M)
        assert options_in(options.table(command)) >= set(heads) - {"--debug"}, command
        rows = options.table(command).splitlines()[2:]
        firsts = [found for row in rows for found in options_in(row.split(" | ")[0])]
        assert set(firsts) <= set(heads), command


def documented() -> list[str]:
    text = "\n".join(TEXTS[path] for path in (DOCS / "reference").glob("*.md"))
    return re.findall(r"^::: (\S+)$", text, re.M)


def own_names(module: ModuleType) -> list[str]:
    """The public functions and classes that a module itself defines."""
    return [
        f"{module.__name__}.{name}"
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (isfunction(value) or isclass(value))
        and value.__module__ == module.__name__
    ]


def test_every_public_name_is_in_the_reference():
    names = documented()
    public = []
    for name, value in vars(gsjax.public).items():
        if name.startswith("_"):
            continue
        public += own_names(value) if ismodule(value) else [f"gsjax.{name}"]
    assert len(public) > 35
    assert "gsjax.viewer.notebook.show" in public
    assert [name for name in public if name not in names] == []
    assert len(set(names)) == len(names), "each once"


def test_every_page_is_in_the_menu():
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))

    def leaves(entry):
        if isinstance(entry, str):
            return [entry]
        inner = entry.values() if isinstance(entry, dict) else entry
        return [leaf for part in inner for leaf in leaves(part)]

    found = leaves(config["nav"])
    assert sorted(found) == sorted(p.relative_to(DOCS).as_posix() for p in PAGES)


def test_links_resolve():
    for path in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", TEXTS[path]):
            assert "://" not in link, f"{path.name}: {link}: these pages work offline"
            file, _, anchor = link.partition("#")
            target = (path.parent / file).resolve() if file else path
            assert target.exists(), f"{path.name}: {link}"
            if anchor:
                heads = re.findall(r"^#+ (.*)$", TEXTS[target], re.M)
                assert anchor in map(slug, heads), f"{path.name}: {link}"


def slug(heading: str) -> str:
    plain = re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower()
    return re.sub(r"[\s-]+", "-", plain)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built pages."""
    pytest.importorskip("mkdocstrings", reason="needs gsjax[docs]")
    pytest.importorskip("material", reason="needs gsjax[docs]")
    out = tmp_path_factory.mktemp("site")
    usual = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)],
        cwd=ROOT,
        env=usual,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr  # a warning is an error
    return out


def test_pages_fetch_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(PAGES)  # and 404.html
    fetched = (
        r"<(?:script|link|img|iframe|source|video)\b[^>]*?"
        r"(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)"
    )
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert re.findall(fetched, text) == [], page
        assert "```" not in text, "all blocks are drawn as such"
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert not re.search(r"(?:@import|url\()\s*[\"']?(?:https?:)?//", text), sheet


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_search_works_from_a_disk(site, tmp_path):
    """Where a browser starts no workers; and the network is asked for nothing."""
    page = f"{(site / 'index.html').as_uri()}?q=refine-intrinsics"
    html, asked = opened(page, tmp_path)
    assert re.search(r'search-result__meta">\d+ matching documents', html)
    assert re.search(r'href="[^"]*/cli.html\?h=refine[^"]*#train"', html)
    assert asked == []


def test_reference_shows_what_docstrings_say(site):
    page = (site / "reference" / "rendering.html").read_text(encoding="utf-8")
    assert 'id="gsjax.render_exact"' in page
    assert "CapacityError" in page
    assert "transmittance T has fallen to this" in page, "attributes are listed"
    options = (site / "cli.html").read_text(encoding="utf-8")
    assert "--refine-poses" in options
    assert "options: train" not in options


def test_reference_has_the_types_of_several_names_at_once(site):
    def entries(page: str) -> dict[str, str]:
        text = (site / "reference" / page).read_text(encoding="utf-8")
        items = re.findall(r'<li class="doc-section-item.*?</li>', text, re.S)
        plain = [html.unescape(re.sub(r"<[^>]+>", "", item)) for item in items]
        heads = [" ".join(item.split()).partition(" – ")[0] for item in plain]
        parts = [head.rstrip(")").partition(" (") for head in heads]
        return {name: kind for name, _, kind in parts if ", " in name}

    training = entries("training.html")
    assert training["refine_poses, refine_intrinsics"] == "bool"
    assert training["pose_rate, intrinsics_rate, exposure_rate"] == "float"
    assert training["trained, held_out"] == "tuple[str, ...]"
    assert training["images, factor, skip_missing"] == "", "they differ"
    assert entries("cameras.html")["width, height"] == "int"
    assert entries("measures.html")["image, target"] == "Array"


def test_signatures_are_broken_into_lines(site):
    page = (site / "reference" / "rendering.html").read_text(encoding="utf-8")
    blocks = re.findall(r"<code>(.*?)</code>", page, re.S)
    signatures = [re.sub("<[^>]+>", "", x) for x in blocks if "render_exact" in x]
    assert any(signature.count("\n") > 4 for signature in signatures)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert any(x.startswith("ruff") for x in project["optional-dependencies"]["docs"])


def test_no_bytecode_is_published(site):
    assert list(site.rglob("*.py*")) == []


def test_blocks_know_their_lines():
    text = "a\n```python\nx = 1\n```\n<!-- no-run -->\n```python\ny\n```\n"
    assert blocks(text, "python") == [(2, "x = 1\n")]
    assert blocks(text, "python", marked="no-run") == [(6, "y\n")]
    assert program(text).splitlines()[2] == "x = 1"
