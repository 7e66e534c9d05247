"""The README's Python runs as it stands, and its table is that of the code."""

import re
from pathlib import Path

import pytest
from snippets import ROOT, blocks, run_pages

import gsjax

BENCHMARKS = ROOT / "benchmarks"
README = (ROOT / "README.md").read_text(encoding="utf-8")
# What the snippets claim in their comments.
CLAIMS = """
gradient = jax.tree.leaves((by_params, by_camera.viewmat, by_camera.K))
assert np.isfinite(value) and all(np.isfinite(g).all() for g in gradient)
assert all(np.abs(g).max() > 0 for g in gradient) and image.rgb.std() > 0.05
assert images.shape == (3, 48, 64, 3) and images.std() > 0.05
np.testing.assert_allclose(mapped, images, atol=1e-6)
assert of_features.shape == (n, 8) and np.abs(of_features).max() > 0
assert (np.abs(screen_abs) >= np.abs(screen) * (1 - 1e-3) - 1e-5).all()
assert np.abs(screen).max() > 0
"""


@pytest.mark.long
def test_python_blocks_run(tmp_path):
    assert len(blocks(README, "python")) >= 5
    assert run_pages([ROOT / "README.md"], claims=CLAIMS, cwd=tmp_path) == ""
    assert (tmp_path / "scene.ply").exists()


def links(page: Path) -> list[Path]:
    """The files that a page links to."""
    found = re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8"))
    return [page.parent / link for link in found if "://" not in link]


def test_linked_files_are_there():
    found = [*links(ROOT / "README.md"), *links(BENCHMARKS / "README.md")]
    assert len(found) > 100
    assert [path for path in found if not path.exists()] == []


def test_benchmarks_and_their_results_are_linked():
    """The README links every picture, and that of the benchmarks all there is."""
    results = set((BENCHMARKS / "results").iterdir())
    pictures = {path for path in results if path.suffix in (".png", ".webp")}
    assert pictures - set(links(ROOT / "README.md")) == set()
    claims = {
        path
        for path in BENCHMARKS.glob("*.py")
        if path.read_text(encoding="utf-8").startswith('"""Claim: ')
    }
    assert len(claims) > 15
    assert (results | claims) - set(links(BENCHMARKS / "README.md")) == set()


def test_presets_are_as_in_the_table():
    presets = [gsjax.RasterConfig.compat(), gsjax.RasterConfig.accurate()]
    presets.append(gsjax.RasterConfig.fast())
    for name in ("alpha_min", "alpha_max", "stop", "stop_rule"):
        row = re.search(rf"^\| `{name}`.*$", README, re.M)
        assert row is not None
        cells = [cell.strip() for cell in row[0].strip("|").split("|")[1:]]
        values = [getattr(preset, name) for preset in presets]
        if name == "stop_rule":
            assert cells == values
        else:
            numbers = [eval(cell.replace("−", "-"), {}) for cell in cells]
            assert numbers == values


def test_names_exist():
    table = README.split("## The names")[1].split("### Presets")[0]
    names = set(re.findall(r"`([A-Za-z_]\w*)", table)) - {"capacity", "config"}
    missing = [name for name in sorted(names) if not hasattr(gsjax, name)]
    assert missing == []
