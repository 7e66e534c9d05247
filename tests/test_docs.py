"""Pages: Python runs, commands parse, names exist, links resolve, and they build."""

import importlib.util
import io
import re
from contextlib import redirect_stdout
from inspect import ismodule
from pathlib import Path
from types import ModuleType

import pytest
from conftest import run_python
from snippets import ROOT, blocks, commands, program, run_pages, spans
from viewing import CHROMIUM, page_requests

import gsjax
from gsjax.cli.main import main
from gsjax.cli.parsing import parse

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
ROOT_PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
TEXTS = {path: path.read_text(encoding="utf-8") for path in [*ROOT_PAGES, *PAGES]}
CLI_PAGE, README = TEXTS[DOCS / "reference" / "cli.md"], TEXTS[ROOT / "README.md"]
CLAIMS = """
```python
gradient = jax.tree.leaves((by_params, by_camera.viewmat, by_camera.K))
assert jnp.isfinite(value) and all(jnp.isfinite(g).all() for g in gradient)
assert all(jnp.abs(g).max() > 0 for g in gradient)
```
"""


def hook(name: str) -> ModuleType:
    """Import a module of docs/, which is not a package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


options, numbers, examples = map(hook, ("options", "numbers", "examples"))


@pytest.mark.long
def test_python_blocks_run(tmp_path):
    assert blocks(README, "python")
    with_python = [path for path in PAGES if program(TEXTS[path]).strip()]
    assert len(with_python) >= 10
    (tmp_path / "README.md").write_text(README + CLAIMS, encoding="utf-8")
    for pages in ([tmp_path / "README.md"], with_python):
        assert run_pages(pages, tmp_path) == ""


def test_a_wrong_comment_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(2)  # 2\n```\n\n```python\nprint(3)  # 4\n```\n")
    assert "page.md, line 6: '3' is printed, not '4'" in run_pages([page], tmp_path)


@pytest.fixture(scope="module")
def helps() -> dict[str, str]:
    """Return the --help of each command."""
    found = {}
    for name in options.command_classes():
        with redirect_stdout(io.StringIO()) as out:
            assert main([name, "--help"]) == 0
        found[name] = out.getvalue()
    return found


def options_in(text: str) -> set[str]:
    return set(re.findall(r"--[a-z][a-z-]*", text))


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_commands_exist(path, helps):
    """Every command on a page parses, and every option is one of a command."""
    for words in commands(TEXTS[path]):
        if words[-1] not in ("--help", "--version"):
            parse(words)
    known = {"--help", "--version"}.union(*map(options_in, helps.values()))
    for span in spans(TEXTS[path]):
        first, *words = span.split() or [""]
        if first == "gsjax" and words and words[0] not in ("--help", "--version", "…"):
            assert words[0] in helps, span
            assert options_in(span) - {"--help"} <= options_in(helps[words[0]]), span
        elif first[:1] == "-":
            assert options_in(span) <= known, span


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


def test_every_benchmark_and_result_is_linked():
    folder = ROOT / "benchmarks"
    claims = {
        path
        for path in folder.glob("*.py")
        if path.read_text(encoding="utf-8").startswith('"""Claim: ')
    }
    assert len(claims) > 15
    text = (folder / "README.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)\s#]+)", text)
    found = {folder / link for link in links if "://" not in link}
    assert claims.union((folder / "results").iterdir()) <= found
    assert [path for path in found if not path.exists()] == []


def test_presets_are_as_in_the_table():
    presets = (gsjax.RasterConfig.compat(), gsjax.RasterConfig.accurate())
    presets += (gsjax.RasterConfig.fast(),)
    table = TEXTS[DOCS / "concepts" / "rasteriser.md"].split("### Presets")[1]
    for name in ("alpha_min", "alpha_max", "transmittance_min", "stop_rule"):
        (row,) = re.findall(rf"^\| `{name}` \|(.*)\|$", table, re.M)
        cells = [cell.strip().replace("−", "-") for cell in row.split("|")]
        if name != "stop_rule":
            cells = [eval(cell, {}) for cell in cells]
        assert cells == [getattr(preset, name) for preset in presets]


def test_every_extension_has_its_example():
    wanted = re.findall(r"<!-- snippet: (\w+) -->", TEXTS[DOCS / "extending.md"])
    assert len(wanted) == 7
    assert [name for name in wanted if name not in examples.snippets()] == []


def public_names() -> list[str]:
    """Return the public names, with those of a public module in its place."""
    found = []
    for name in gsjax.__all__:
        value = getattr(gsjax, name)
        inner = vars(value).items() if ismodule(value) else ()
        found += [
            f"gsjax.{name}.{n}"
            for n, member in inner
            if n[0] != "_" and getattr(member, "__module__", "") == value.__name__
        ] or [f"gsjax.{name}"]
    return found


def test_every_public_name_is_in_the_reference():
    text = "\n".join(TEXTS[path] for path in (DOCS / "reference").glob("*.md"))
    names = re.findall(r"^::: (\S+)$", text, re.M)
    # `gsjax.save_png` and `save_movie` are those of the module `notebook`.
    aliases = {"gsjax.notebook.save_png", "gsjax.notebook.save_movie"}
    assert len(public_names()) > 35
    assert set(public_names()) - aliases <= set(names)
    assert len(set(names)) == len(names), "each once"


def test_every_page_is_in_the_menu():
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    found = re.findall(r"([\w./-]+\.md)$", menu, re.M)
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
    command = ("-m", "mkdocs", "build", "--strict", "--site-dir", str(out))
    done = run_python(*command, cwd=ROOT, PYTHONDONTWRITEBYTECODE="")
    assert done.returncode == 0, done.stderr
    return out


def test_the_site_is_complete_and_fetches_nothing_from_elsewhere(site):
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
    names = ("rendering", "cli")
    page, table = ((site / f"reference/{n}.html").read_text("utf-8") for n in names)
    for shown in ('id="gsjax.render_exact"', "CapacityError", "transmittance_min"):
        assert shown in page, "docstrings and attributes"
    assert "--refine-poses" in table
    assert "options: train" not in table


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_search_works_from_a_disk(site, tmp_path):
    """It needs neither browser workers nor the network."""
    page = f"{(site / 'index.html').as_uri()}?q=refine-intrinsics"
    html, asked = page_requests(page, tmp_path)
    assert re.search(r'search-result__meta">\d+ matching documents', html)
    assert re.search(r'href="[^"]*/cli.html\?h=refine[^"]*#train"', html)
    assert asked == []
