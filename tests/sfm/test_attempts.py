"""Structure from motion that tries again, and several scenes in one folder."""

import json
import shutil

import numpy as np
import pytest
from conftest import DATA
from corner_room import COUNT, corner_view, write_photo

from gsjax.cli.main import main
from gsjax.data.dataset import load_dataset
from gsjax.sfm import attempts as module
from gsjax.sfm.attempts import attempts_of, found_in_groups, map_with_attempts

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is absent")
STREET = DATA / "captures" / "street"


class Model:
    """Stands in for a reconstruction."""

    def __init__(self, names: str):
        self.images = {name: type("Image", (), {"name": name}) for name in names}

    def num_reg_images(self) -> int:
        return len(self.images)

    def num_points3D(self) -> int:
        return 100


def attempted(monkeypatch, tmp_path, found, groups=("abcdefgh",), spent=100.0):
    """Run the attempts of eight photographs that find these models."""
    calls, seconds = [], iter(range(0, 10_000, 40))

    def mapped(*given, limits, **_):
        calls.append((given[2].name, limits))
        return found[len(calls) - 1] if len(calls) <= len(found) else []

    monkeypatch.setattr(module, "map_incrementally", mapped)
    monkeypatch.setattr(module, "match_groups", lambda _: [set(g) for g in groups])
    monkeypatch.setattr(module, "count_rows", lambda *_: 8)
    for step in ("set_camera_model", "match_features"):
        told = lambda *given, step=step: calls.append((step, given[1:]))  # noqa: E731
        monkeypatch.setattr(module, step, told)
    result = map_with_attempts(
        attempts_of(8, "sequential", "SIMPLE_RADIAL"),
        tmp_path / "database",
        (tmp_path, tmp_path / "models"),
        0,
        lambda _: None,
        clock=lambda: next(seconds),
        spent=spent,
    )
    return result, calls


def test_attempts_end_when_nearly_all_that_match_are_found(monkeypatch, tmp_path):
    result, calls = attempted(monkeypatch, tmp_path, [[], [Model("abcdefgh")]])
    assert [name for name, _ in calls] == ["0", "1"]
    assert calls[1][1].forward == 1.0
    assert result.tried == [
        "a first pair that moved sideways: no camera",
        "a first pair that may move forward: 8 cameras",
    ]


def test_the_best_model_is_kept_within_the_budget(monkeypatch, tmp_path):
    found = [[Model("abc")], [Model("abcde")], [Model("ab")]]
    result, _ = attempted(monkeypatch, tmp_path, found)
    assert result.models[0].num_reg_images() == 5
    assert result.tried[-1].startswith("stopped: ")
    assert len(result.tried) == 4


def test_other_lenses_are_tried_if_there_is_no_model(monkeypatch, tmp_path):
    result, calls = attempted(monkeypatch, tmp_path, [], spent=1e6)
    assert result.models == []
    steps = [name for name, _ in calls]
    assert steps == [
        *("0", "1", "2", "match_features", "3"),
        *("set_camera_model", "4", "set_camera_model", "5"),
    ]


def test_models_of_several_scenes_are_enough(monkeypatch, tmp_path):
    models = [Model("abcde"), Model("fgh")]
    groups = ("abcde", "fgh")
    assert found_in_groups(models, [set(g) for g in groups]) == 8
    assert found_in_groups(models, [set("abcdefgh")]) == 5  # fragments of one scene
    _, calls = attempted(monkeypatch, tmp_path, [models], groups)
    assert len(calls) == 1


def test_two_scenes_in_one_folder_are_told_apart(tmp_path, capsys):
    """The second shows the room in a mirror, whose features match no others."""
    for i in range(COUNT):
        for place, pixels in (("a", corner_view(i)), ("b", corner_view(i)[:, ::-1])):
            if place == "a" or i:  # one less
                path = tmp_path / "photos" / place / f"{i}.jpg"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_photo(path, np.ascontiguousarray(pixels), 1, 32)
    out = tmp_path / "out"
    assert main(["sfm", str(tmp_path / "photos"), "-o", str(out)]) == 0
    said = capsys.readouterr().out.splitlines()
    line = next(line for line in said if "another scene" in line)
    assert line.startswith(f"{COUNT - 1} other images show another scene")
    assert line.endswith(str(out / "scenes" / "2"))
    report = json.loads((out / "sfm.json").read_text())
    assert report["unregistered"] == {}
    names = [f"b/{i}.jpg" for i in range(1, COUNT)]
    assert report["scenes"] == {"scenes/2": names}
    assert [view.name for view in load_dataset(out / "scenes" / "2").views] == names
    assert {view.name[0] for view in load_dataset(out).views} == {"a"}


@pytest.mark.skipif(not STREET.is_dir(), reason="../shared/data/captures/street")
def test_a_walk_straight_ahead_has_cameras(tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for i in range(1, 10):
        shutil.copy(STREET / "images" / f"{i:02d}.jpg", photos)
    assert main(["sfm", str(photos), "-o", str(out), "--max-size", "640"]) == 0
    assert "may move forward: " in capsys.readouterr().err
    views = sorted(load_dataset(out).views, key=lambda view: view.name)
    assert len(views) >= 8
    ahead = np.mean([view.viewmat[2, :3] for view in views], 0)
    assert (np.diff([view.centre @ ahead for view in views]) > 0).all()
