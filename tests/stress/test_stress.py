"""The short form of `gsjax stress`, a test a case, and fuzzing on top of it."""

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
from gsjax.stress import poison, precision, run
from gsjax.stress.scenes import (
    changed,
    host_fields,
    not_finite,
    usual,
    usual_gradients,
)
from gsjax.stress.types import Case, Measured, worse

pytestmark = pytest.mark.as_users

ROOT = Path(__file__).parents[2]
SHORT = run.chosen(False)
# Of the thousand scenes of the full form, those of the largest errors of image and
# gradient: benchmarks/results/stress.json.
WORST = (94, 976)


@pytest.fixture(scope="module")
def results():
    return {result.name: result for result in run.run_cases(SHORT, False)}


@on_cpu
@pytest.mark.long
@pytest.mark.parametrize("name", [case.name for case in SHORT])
def test_within_its_bound(results, name, report):
    result = results[name]
    report(name, result.measured, result.bound or 1)
    assert result.good, run.line(result)


def test_what_is_left_out_has_a_reason():
    names = [case.name for case in run.CASES]
    assert len(set(names)) == len(names) > 40
    left_out = set(run.chosen(True)) - set(SHORT)
    assert left_out
    assert all(case.full_only for case in left_out)
    readme = (ROOT / "docs/benchmarks/stability.md").read_text(encoding="utf-8")
    said = re.search(r"short form, (\d+) of the (\d+)", " ".join(readme.split()))
    assert said is not None
    assert [*map(int, said.groups())] == [len(SHORT), len(run.CASES)]
    assert len(poison.VALUES) >= 22
    assert len(poison.entries()) == 59


@on_cpu
@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(
    value=st.floats(width=32),
    entry=st.integers(0, 58),
    slots=st.sets(st.integers(0, 127), min_size=1, max_size=40),
)
def test_any_value_anywhere(value, entry, slots):
    """Nothing that is not finite, and no trace of what is not seen."""
    field, index = poison.entries()[entry]
    spoilt = sorted(slots)
    with jax.enable_x64(False):
        fields = host_fields(usual())
        fields[field][spoilt, *index] = value
        wrong = poison.traces(changed(usual(), **fields), spoilt, value)
    assert wrong["not finite"] == [0, 0]
    assert wrong["seen"] == []
    changes, seen = wrong["traces"]
    assert changes == 0
    assert seen > 80


@on_cpu
@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(
    values=st.lists(st.floats(width=32), min_size=3, max_size=3),
    places=st.sets(st.sampled_from(list(poison.camera_entries())), max_size=3),
)
def test_any_camera_and_background(values, places):
    """Several numbers of the camera at a time, and the whole background."""
    with jax.enable_x64(False):
        camera = poison.spoilt_camera(dict(zip(sorted(places), values)))
        out, slopes = usual_gradients(usual(), camera, np.float32(values))
    assert not_finite((out.rgb, out.alpha, out.depth, out.radii, slopes)) == 0


@on_cpu
@pytest.mark.parametrize("seed", WORST)
def test_the_worst_of_a_thousand_scenes(seed, report):
    with jax.enable_x64(False):
        image, gradient, clear = precision.scene_errors(seed)
    assert clear > 0.5
    for what, error, bar in (("image", image, 1e-4), ("gradient", gradient, 1e-3)):
        report(f"scene {seed}, {what}", error, bar)
        assert 0 < error <= bar


# --- the command ---


def found(value: float, note: str = ""):
    return lambda full: Measured(value / (1 + full), note)


def raising(full: bool) -> Measured:
    raise ValueError(f"nothing to measure\nin full: {full}")


FAKE = {
    "well": Case("a/well", "share |α|", 1.0, found(0.25, "of 4")),
    "none": Case("b/none", "count", 0, found(0), "px"),
    "over": Case("c/over", "share", 1.0, found(1.5)),
    "nan": Case("d/nan", "share", 1.0, found(np.nan)),
    "raises": Case("e/raises", "share", 1.0, raising),
    "full": Case("f/full", "share", 1.0, found(3), full_only=True),
}


def test_a_nan_is_the_worst():
    assert np.isnan(worse(0.0, np.nan))
    assert np.isnan(worse(np.nan, 1.0))
    assert worse(1.0, 2.0) == worse(2.0, 1.0) == 2


def stress(monkeypatch, names: str, *args: str) -> int:
    cases = tuple(FAKE[name] for name in names.split())
    monkeypatch.setattr(run, "CASES", cases)
    return main.main(["stress", *args])


def test_exit_codes(monkeypatch, capsys):
    assert stress(monkeypatch, "well none full") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[:2]] == [
        ["ok", "a/well"],
        ["ok", "b/none"],
    ]
    assert "4 ×" in lines[0]
    assert "exact" in lines[1]
    assert lines[2].startswith("2 of 2 cases within their bounds")
    for name in ("over", "nan", "raises"):
        assert stress(monkeypatch, f"well {name}") == 1
        line = capsys.readouterr().out.splitlines()[1]
        assert line.startswith(f"RED {FAKE[name].name}")
    assert "ValueError: nothing to measure" in line
    assert stress(monkeypatch, "well full", "--full") == 1
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert stress(monkeypatch, "well over", "--only", "a/") == 0
    assert stress(monkeypatch, "well over", "--only", "z") == 2
    told = "no case; there are a/well, c/over; more with --full\n"
    assert capsys.readouterr().err.endswith(told)
    assert stress(monkeypatch, "well full", "--only", "full") == 2
    assert "--only 'full': no such case; pass --full for f/full" in capsys.readouterr().err
    assert stress(monkeypatch, "well full", "--full", "--only", "z") == 2
    assert "there are a/well, f/full\n" in capsys.readouterr().err


def test_json_and_markdown(monkeypatch, tmp_path, capsys):
    path, page = tmp_path / "new" / "found.json", tmp_path / "page.md"
    page.write_text(
        "# before\n<!-- gsjax stress -->\nold\n<!-- /gsjax stress -->\nafter\n"
    )
    args = ("--json", str(path), "--markdown", str(page))
    assert stress(monkeypatch, "well none nan raises", *args) == 1
    told = json.loads(path.read_text())
    assert told["form"] == "short"
    assert told["machine"]["jax"] == jax.__version__
    rows = {row["name"]: row for row in told["rows"]}
    assert rows["a/well"]["margin"] == 4
    assert rows["a/well"]["good"] is True
    assert rows["d/nan"]["measured"] is None
    assert rows["e/raises"]["error"].startswith("ValueError")
    text = page.read_text()
    assert text.startswith("# before\n<!-- gsjax stress -->\n| case |")
    assert text.endswith("\n<!-- /gsjax stress -->\nafter\n")
    assert "old" not in text
    assert r"| a/well | share \|α\| | 0.25 | 1 | 4 × |" in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {6}
    assert "| b/none | count | 0 px | 0 px | exact |" in text
    assert "nan **(outside)**" in text
    capsys.readouterr()
    assert stress(monkeypatch, "well", *args) == 3
    assert "exists; pass --overwrite" in capsys.readouterr().err
    page.write_bytes(b"caf\xe9")
    assert stress(monkeypatch, "well", "--markdown", str(page)) == 3
    assert "byte 3 is not UTF-8" in capsys.readouterr().err
    page.write_text("no marks")
    for where, told in ((page, "no place for the table"), (tmp_path / "x", "no such")):
        assert stress(monkeypatch, "well", "--markdown", str(where)) == 3
        output = capsys.readouterr()
        assert told in output.err
        assert output.out == "", "found before anything is measured"


def test_the_published_table_matches_the_results():
    told = json.loads((ROOT / "benchmarks/results/stress.json").read_text())
    assert told["form"] == "full"
    readme = (ROOT / "docs/benchmarks/stability.md").read_text(encoding="utf-8")
    table = readme.split("<!-- gsjax stress -->\n")[1]
    assert table.split("\n<!-- /gsjax stress -->")[0] == run.markdown(told)
    rows = {row["name"]: row for row in told["rows"]}
    assert set(rows) == {case.name for case in run.CASES}
    worst = [rows[f"scenes/{n}"]["more"]["worst seed"] for n in ("image", "gradient")]
    assert tuple(worst) == WORST
    for case in run.CASES:
        row = rows[case.name]
        assert row["good"], case.name
        assert (row["claim"], row["bound"]) == (case.claim, case.bound), case.name
