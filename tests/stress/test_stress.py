"""The short form of `gsjax stress`, random values on top of it, and the command."""

import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from conftest import on_cpu
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.cli.main import main
from gsjax.stress import poison, precision, run, scenes
from gsjax.stress.types import Measurement, StressCase

pytestmark = pytest.mark.as_users

ROOT = Path(__file__).parents[2]
SHORT = run.select_cases(False)
# Of the thousand scenes of the full form, those with the largest errors of image and
# gradient: benchmarks/results/stress.json.
WORST = (94, 976)


@on_cpu
@pytest.mark.long
@pytest.mark.parametrize("case", SHORT, ids=lambda case: case.name)
def test_within_its_bound(case, report):
    (result,) = run.run_cases((case,), False)
    report(case.name, result.measured, case.bound or 1)
    assert result.good, run.line(result)


@on_cpu
@settings(max_examples=25)
@given(
    value=st.floats(width=32),
    entry=st.integers(0, 58),
    slots=st.sets(st.integers(0, 127), min_size=1, max_size=40),
)
def test_any_value_in_any_parameter(value, entry, slots):
    """Everything stays finite, and Gaussians that are not drawn have no effect."""
    field, index = poison.entries()[entry]
    poisoned = sorted(slots)
    with jax.enable_x64(False):
        fields = scenes.numpy_fields(scenes.default_scene())
        fields[field][poisoned, *index] = value
        scene = scenes.with_params(scenes.default_scene(), **fields)
        found = poison.find_violations(scene, poisoned, value)
    assert found.nonfinite == 0
    assert found.drawn == []
    assert found.changed == 0
    assert found.in_view > 80


@on_cpu
@settings(max_examples=25)
@given(
    values=st.lists(st.floats(width=32), min_size=3, max_size=3),
    places=st.sets(st.sampled_from(list(poison.camera_entries())), max_size=3),
)
def test_any_camera_and_background(values, places):
    with jax.enable_x64(False):
        camera = poison.poisoned_camera(dict(zip(sorted(places), values)))
        scene, background = scenes.default_scene(), np.float32(values)
        out, gradients = scenes.render_and_gradients(scene, camera, background)
    assert scenes.count_nonfinite((scenes.images_of(out), out.radii, gradients)) == 0


@on_cpu
@pytest.mark.parametrize("seed", WORST)
def test_the_worst_of_a_thousand_scenes(seed, report):
    with jax.enable_x64(False):
        image, gradient, clear = precision.scene_errors(seed)
    assert clear > 0.5
    for what, error, bar in (("image", image, 1e-4), ("gradient", gradient, 1e-3)):
        report(f"scene {seed}, {what}", error, bar)
        assert 0 < error <= bar


def test_the_published_page_matches_the_cases_and_results():
    page = (ROOT / "docs/benchmarks/stability.md").read_text(encoding="utf-8")
    counts = re.search(r"short form, (\d+) of the (\d+)", " ".join(page.split()))
    assert counts is not None
    assert [*map(int, counts.groups())] == [len(SHORT), len(run.CASES)]
    told = json.loads((ROOT / "benchmarks/results/stress.json").read_text())
    assert told["form"] == "full"
    assert between_marks(run.markdown(told)) in page
    rows = {row["name"]: row for row in told["rows"]}
    worst = [rows[f"scenes/{n}"]["more"]["worst seed"] for n in ("image", "gradient")]
    assert tuple(worst) == WORST
    assert len(rows) == len(run.CASES) > 40
    for case in run.CASES:
        row = rows.pop(case.name)
        assert row["good"], case.name
        assert (row["claim"], row["bound"]) == (case.claim, case.bound), case.name


def between_marks(text: str) -> str:
    return f"<!-- gsjax stress -->\n{text}\n<!-- /gsjax stress -->\n"


# --- the command ---


def measured(value: float, note: str = ""):
    return lambda full: Measurement(value / (1 + full), note)


def raising(full: bool) -> Measurement:
    raise ValueError(f"nothing to measure\nin full: {full}")


FAKE = {
    "well": StressCase("a/well", "share |α|", 1.0, measured(0.25, "of 4")),
    "none": StressCase("b/none", "count", 0, measured(0), "px"),
    "over": StressCase("c/over", "share", 1.0, measured(1.5)),
    "nan": StressCase("d/nan", "share", 1.0, measured(np.nan)),
    "raises": StressCase("e/raises", "share", 1.0, raising),
    "full": StressCase("f/full", "share", 1.0, measured(3), full_only=True),
}


def stress(monkeypatch, names: str, *args) -> int:
    cases = tuple(FAKE[name] for name in names.split())
    monkeypatch.setattr(run, "CASES", cases)
    return main(["stress", *map(str, args)])


@pytest.mark.parametrize(
    ("names", "args", "code", "text"),
    [
        ("well none full", "", 0, "2 of 2 cases within their bounds"),
        ("well none", "", 0, "ok  a/well"),
        ("well over", "", 1, "RED c/over"),
        ("well nan", "", 1, "RED d/nan"),
        ("well raises", "", 1, "ValueError: nothing to measure"),
        ("well full", "--full", 1, "1 of 2 cases within their bounds"),
        ("well over", "--only a/", 0, "1 of 1 cases"),
        ("well full", "--only full", 2, "--full for f/full"),
        ("well full", "--full --only z", 2, "--only 'z': no such case"),
        ("well", "--markdown none.md", 3, "no such file"),
        ("well", "--markdown latin.md", 3, "not UTF-8"),
        ("well", "--markdown bare.md", 3, "no marks"),
    ],
)
def test_exit_code_and_output(names, args, code, text, monkeypatch, tmp_path, capsys):
    """Bad options and pages are rejected before measuring."""
    monkeypatch.chdir(tmp_path)
    Path("latin.md").write_bytes(b"caf\xe9")
    Path("bare.md").write_text("without a table")
    assert stress(monkeypatch, names, *args.split()) == code
    told = capsys.readouterr()
    assert text in told.out + told.err
    assert (told.out == "") == (code > 1)


def test_json_and_markdown(monkeypatch, tmp_path, capsys):
    path, page = tmp_path / "new" / "found.json", tmp_path / "page.md"
    page.write_text(f"# a\n{between_marks('old')}b\n")
    args = ("--json", path, "--markdown", page)
    assert stress(monkeypatch, "well none nan raises", *args) == 1
    told = json.loads(path.read_text())
    assert told["form"] == "short"
    assert told["machine"]["jax"] == jax.__version__
    rows = {row["name"]: row for row in told["rows"]}
    assert (rows["a/well"]["margin"], rows["a/well"]["good"]) == (4, True)
    assert rows["d/nan"]["measured"] is None
    assert rows["e/raises"]["error"].startswith("ValueError")
    text = page.read_text()
    assert text == f"# a\n{between_marks(run.markdown(told))}b\n"
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in table} == {6}
    assert r"| a/well | share \|α\| | 0.25 | 1 | 4 × |" in table
    assert "nan **(outside)**" in text
    assert stress(monkeypatch, "well", *args) == 3
    assert "--overwrite" in capsys.readouterr().err
