"""Pages: Python runs, commands parse, names exist, links resolve, and they build."""

import importlib.util
import io
import os
import re
import subprocess
import sys
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
from viewing import CHROMIUM, page_requests

import gsjax
from gsjax.cli.main import main
from gsjax.cli.parsing import parse

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
ROOT_PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
TEXTS = {path: path.read_text(encoding="utf-8") for path in [*ROOT_PAGES, *PAGES]}
CLI_PAGE = TEXTS[DOCS / "reference" / "cli.md"]


def hook(name: str) -> ModuleType:
    """Import a module of docs/, which is not a package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


options, numbers, examples = map(hook, ("options", "numbers", "examples"))


@pytest.mark.long
def test_python_blocks_run(tmp_path):
    with_python = [path for path in PAGES if program(TEXTS[path]).strip()]
    assert len(with_python) >= 10
    assert run_pages(with_python, cwd=tmp_path) == ""


def test_a_wrong_comment_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```python\nprint(1 + 1)  # 2\n```\n\n```python\nprint(3)  # 4\n```\n"
    )
    assert "page.md, line 6: '3' is printed, not '4'" in run_pages([page], cwd=tmp_path)


def test_blocks_know_their_lines():
    text = "a\n```python\nx = 1\n```\n<!-- no-run -->\n```python\ny\n```\n"
    assert blocks(text, "python") == [(2, "x = 1\n")]
    assert blocks(text, "python", marked="no-run") == [(6, "y\n")]
    assert program(text).splitlines()[2] == "x = 1"


@pytest.fixture(scope="module")
def helps() -> dict[str, str]:
    """The --help of each command."""

    def help_of(*words: str) -> str:
        out = io.StringIO()
        with redirect_stdout(out):
            assert main([*words, "--help"]) == 0
        return out.getvalue()

    return {name: help_of(name) for name in options.command_classes()}


def options_in(text: str) -> set[str]:
    return set(re.findall(r"--[a-z][a-z-]*", text))


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_commands_exist(path, helps):
    """Every command on a page parses, and every option is one of a command."""
    for words in commands(TEXTS[path]):
        if words[-1] not in ("--help", "--version"):
            parse(words)
    for words in mentions(TEXTS[path]):
        if words[0] in ("--help", "--version", "…"):
            continue
        assert words[0] in helps, words
        given = options_in(" ".join(words)) - {"--help"}
        assert given <= options_in(helps[words[0]]), words
    known = {"--help", "--version"}.union(*map(options_in, helps.values()))
    assert [x for x in bare_options(TEXTS[path]) if x not in known] == []


def test_every_command_has_its_section_and_table(helps):
    assert set(re.findall(r"^## (\w+)$", CLI_PAGE, re.M)) == set(helps)
    assert set(re.findall(r"<!-- options: (\w+) -->", CLI_PAGE)) == set(helps)
    for command, text in helps.items():
        # In the help an option begins a line or follows its short form.
        heads = re.findall(r"^[│| ]{0,3}(?:-\w \S+, )?(--[a-z][a-z-]*)", text, re.M)
        rows = options.table(command).splitlines()[2:]
        firsts = {found for row in rows for found in options_in(row.split(" | ")[0])}
        assert firsts == set(heads) - {"--debug", "--help"}, command


def test_generated_tables_are_current():
    for page in numbers.PAGES:
        assert numbers.updated(page) == page.read_text(encoding="utf-8"), page
    assert len(numbers.headline(ROOT / "README.md")) == 5


def test_every_extension_has_its_example():
    wanted = re.findall(r"<!-- snippet: (\w+) -->", TEXTS[DOCS / "extending.md"])
    assert len(wanted) == 7
    assert [name for name in wanted if name not in examples.snippets()] == []


def documented() -> list[str]:
    text = "\n".join(TEXTS[path] for path in (DOCS / "reference").glob("*.md"))
    return re.findall(r"^::: (\S+)$", text, re.M)


def public_names() -> list[str]:
    """Return the public names, with those of a public module in its place."""
    found = []
    for name in gsjax.__all__:
        value = getattr(gsjax, name)
        if not ismodule(value):
            found.append(f"gsjax.{name}")
            continue
        found += [
            f"gsjax.{name}.{inner}"
            for inner, member in vars(value).items()
            if not inner.startswith("_")
            and (isfunction(member) or isclass(member))
            and member.__module__ == value.__name__
        ]
    return found


def test_every_public_name_is_in_the_reference():
    names = documented()
    # `gsjax.save_png` is that of the module `notebook`.
    aliases = {"gsjax.notebook.save_png"}
    assert len(public_names()) > 35
    assert set(public_names()) - aliases <= set(names)
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


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_links_resolve(path):
    for link in re.findall(r"\]\(([^)\s]+)\)", TEXTS[path]):
        if "://" in link:  # pages work offline
            assert path in ROOT_PAGES, link
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        assert target.exists(), link
        if anchor:
            heads = re.findall(r"^#+ (.*)$", TEXTS[target], re.M)
            assert anchor in map(slug, heads), link


def slug(heading: str) -> str:
    plain = re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower()
    return re.sub(r"[\s-]+", "-", plain)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built pages; a warning of the build is an error."""
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
    assert done.returncode == 0, done.stderr
    return out


def test_the_site_fetches_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(PAGES)  # and 404.html
    fetched = (
        r"<(?:script|link|img|iframe|source|video)\b[^>]*?"
        r"(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)"
    )
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert re.findall(fetched, text) == [], page
        assert "```" not in text, "every code block is rendered"
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert not re.search(r"(?:@import|url\()\s*[\"']?(?:https?:)?//", text), sheet
    assert list(site.rglob("*.py*")) == [], "sources are not published"


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_search_works_from_a_disk(site, tmp_path):
    """It needs neither browser workers nor the network."""
    page = f"{(site / 'index.html').as_uri()}?q=refine-intrinsics"
    html, asked = page_requests(page, tmp_path)
    assert re.search(r'search-result__meta">\d+ matching documents', html)
    assert re.search(r'href="[^"]*/cli.html\?h=refine[^"]*#train"', html)
    assert asked == []


def test_the_reference_shows_docstrings_and_options(site):
    page = (site / "reference" / "rendering.html").read_text(encoding="utf-8")
    assert 'id="gsjax.render_exact"' in page
    assert "CapacityError" in page
    assert "transmittance_min" in page, "attributes are listed"
    table = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    assert "--refine-poses" in table
    assert "options: train" not in table
