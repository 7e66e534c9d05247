"""The README is short and its Python runs; tables and links are current."""

import re
from pathlib import Path

import pytest
from snippets import ROOT, blocks, run_pages

import gsjax

BENCHMARKS = ROOT / "benchmarks"
README = (ROOT / "README.md").read_text(encoding="utf-8")
PRESETS = (ROOT / "docs/concepts/rasteriser.md").read_text(encoding="utf-8")
CLAIMS = """
gradient = jax.tree.leaves((by_params, by_camera.viewmat, by_camera.K))
assert jnp.isfinite(value) and all(jnp.isfinite(g).all() for g in gradient)
assert all(jnp.abs(g).max() > 0 for g in gradient)
"""


def test_it_is_short():
    assert len(README.splitlines()) <= 170


@pytest.mark.long
def test_python_blocks_run(tmp_path):
    assert blocks(README, "python")
    assert run_pages([ROOT / "README.md"], claims=CLAIMS, cwd=tmp_path) == ""


def links(page: Path) -> set[Path]:
    """Return the files that a page links to."""
    found = re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8"))
    return {page.parent / link for link in found if "://" not in link}


def test_every_benchmark_and_result_is_linked():
    results = set((BENCHMARKS / "results").iterdir())
    claims = {
        path
        for path in BENCHMARKS.glob("*.py")
        if path.read_text(encoding="utf-8").startswith('"""Claim: ')
    }
    assert len(claims) > 15
    found = links(BENCHMARKS / "README.md")
    assert (results | claims) - found == set()
    assert [path for path in found if not path.exists()] == []


def test_presets_are_as_in_the_table():
    presets = [gsjax.RasterConfig.compat(), gsjax.RasterConfig.accurate()]
    presets.append(gsjax.RasterConfig.fast())
    table = PRESETS.split("### Presets")[1]
    for name in ("alpha_min", "alpha_max", "transmittance_min", "stop_rule"):
        row = re.search(rf"^\| `{name}` .*$", table, re.M)
        assert row is not None
        cells = [cell.strip() for cell in row[0].strip("|").split("|")[1:]]
        values = [getattr(preset, name) for preset in presets]
        if name != "stop_rule":
            cells = [eval(cell.replace("−", "-"), {}) for cell in cells]
        assert cells == values
