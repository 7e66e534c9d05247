"""The instrument: what theory allows at a pixel, the front, the plot, the scenes."""

import itertools
import json

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, frustum_points, gaussians_at

import gsjax
from gsjax import RasterConfig
from gsjax.bench import pixelwise, report
from gsjax.bench.fronts import Box, Mark, label_boxes, scatter
from gsjax.bench.pareto import Point, front, pareto, points
from gsjax.bench.report import front_picture, table
from gsjax.bench.scenes import facing, open_stress_scene
from gsjax.cli.main import main
from gsjax.errors import InputError
from gsjax.plots.curves import BOTTOM, LEFT, RIGHT, TOP
from gsjax.synthetic.stress_scenes import STRESS_SCENES, StressScene

BEHIND = np.array([0.2, 0.5, 0.9])
COUNT, SIZE = 60, 16
EXACT = RasterConfig(
    alpha_min=1e-12, alpha_max=1.0, stop=0.0, stop_rule="after", outputs=("rgb",)
)
# Each turned so far that it shows.
TURNED = {
    "cut": EXACT.replace(alpha_min=0.05),
    "cap": EXACT.replace(alpha_max=0.7),
    "after": EXACT.replace(stop=0.05),
    "before": EXACT.replace(stop=0.02, stop_rule="before", alpha_max=0.9),
    "all": EXACT.replace(alpha_min=0.02, alpha_max=0.9, stop=0.05),
}


@pytest.fixture(scope="module")
def view():
    rng = np.random.default_rng(4)
    points = frustum_points(rng, COUNT)
    scene = gaussians_at(
        points, rng.uniform(0.1, 1, (COUNT, 3)), rng.beta(1, 1, COUNT),
        viewmat=np.eye(4), degree=1,
    )  # fmt: skip
    camera = camera_of(SIZE, SIZE, np.eye(4), centre=(8, 8))
    pixels = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1).reshape(-1, 2)
    return scene, camera, pixelwise.dense(scene, camera, BEHIND, pixels)


def blended(found: pixelwise.Dense, config: RasterConfig) -> np.ndarray:
    """[P, 3] by the settings' own rules, one splat after another."""
    alpha = np.minimum(found.alpha, config.alpha_max)
    alpha = np.where(alpha < config.alpha_min, 0, alpha)
    through, going = np.ones(alpha.shape[1]), np.ones(alpha.shape[1], bool)
    total = np.zeros((alpha.shape[1], 3))
    left = np.ones_like(through)
    for a, color in zip(alpha, found.colors):
        tested = through * (1 - a) if config.stop_rule == "before" else through
        going = going & (tested > config.stop)
        weight = np.where(going, a * through, 0)
        total += weight[:, None] * color
        left = left - weight
        through = through * (1 - a)
    return total + left[:, None] * BEHIND


def test_the_dense_picture_is_the_reference(view):
    scene, camera, found = view
    wanted = gsjax.reference_render(scene, camera, None, BEHIND)["rgb"]
    np.testing.assert_allclose(
        found.picture, np.asarray(wanted).reshape(-1, 3), atol=1e-12
    )
    assert found.picture.std() > 0.05


@pytest.mark.parametrize("name", TURNED)
def test_what_is_allowed_holds_at_every_pixel(view, name):
    scene, camera, found = view
    config = TURNED[name]
    error = np.abs(blended(found, config) - found.picture).max(axis=1)
    bound = pixelwise.allowed(found, scene, camera, config, degree=1, dtype="float64")
    assert (error <= bound).all()
    assert error.max() > 0.01
    assert (error / bound).max() > 0.1, "the bound says something"
    # Nothing turned, nothing allowed.
    still = pixelwise.allowed(found, scene, camera, EXACT, degree=1, dtype="float64")
    assert still.max() < 1e-7


def test_what_is_allowed_for_bands_holds(view):
    scene, camera, found = view
    fewer = gsjax.with_sh_degree(scene, 0)
    pixels = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1).reshape(-1, 2)
    cut = pixelwise.dense(fewer, camera, BEHIND, pixels).picture
    error = np.abs(cut - found.picture).max(axis=1)
    bound = pixelwise.allowed(found, scene, camera, EXACT, degree=0, dtype="float64")
    assert (error <= bound).all()
    assert error.max() > 0.005


@pytest.mark.parametrize("behind", [BEHIND, np.zeros(3)])
def test_where_nothing_is_the_background_may_be_rounded(view, behind):
    scene, camera, _ = view
    found = pixelwise.dense(scene, camera, behind, np.array([[10**4, 10**4]]))
    np.testing.assert_array_equal(found.picture, [behind])
    error = np.abs(np.float32(behind) - behind).max()
    bound = pixelwise.allowed(found, scene, camera, EXACT, degree=1, dtype="float32")
    assert error <= bound <= 1e-3
    assert (error > 0) == behind.any()


def row(ms: float, error: float, knob: str = "cut", inside: bool = True) -> dict:
    return {
        "scene": "x", "knob": knob, "value": "1", "forward ms": ms, "gradient ms": 3.0,
        "max": error, "psnr": 50.0, "gradient": error, "at worst": error,
        "bound": 2 * error, "inside": inside,
    }  # fmt: skip


def test_the_front_is_what_nothing_beats():
    rows = [row(3, 1e-3), row(1, 1e-1), row(2, 1e-2), row(2.5, 2e-2), row(9, 1e-3)]
    assert front(rows) == [1, 2, 0]
    hardly = {**rows[0], "forward ms": 9.0, "max": 0.999 * rows[0]["max"]}
    assert front([*rows, hardly]) == [1, 2, 0], "not for a thousandth"


def test_table_and_plot():
    rows = [row(1, 1e-1), row(2, 1e-2, "stop"), row(3, 0.0, "tile", inside=False)]
    lines = table(rows, front(rows)).splitlines()
    assert [line.endswith("OUTSIDE") for line in lines[2:5]] == [False, False, True]
    assert all(line.startswith("*") for line in lines[2:5])
    picture = front_picture(rows, "x")
    assert picture.dtype == np.uint8
    assert picture.shape == (1120, 860, 3)


def test_of_other_devices_the_fronts_are_drawn(monkeypatch):
    drawn = []

    def keep(marks, fronts, **words):
        drawn.append((marks, [[marks[i].x for i in front] for front in fronts]))
        return scatter(marks, fronts, **words)

    monkeypatch.setattr(report, "scatter", keep)
    mine = [row(30, 1e-1), row(20, 1e-2), row(40, 1e-3)]
    other = [row(1, 1e-1), row(3, 1e-1, "slower"), row(2, 1e-2)]
    assert front_picture(mine, "x", [("chip", other)]).shape == (1120, 860, 3)
    assert len(drawn) == 2
    marks, fronts = drawn[0]
    assert fronts == [[20, 40], [1, 2]]
    assert [mark.x for mark in marks if "chip" not in mark.label] == [30, 20, 40]
    assert [mark.x for mark in marks if "chip" in mark.label] == [1, 2]


def test_marks_are_where_their_values_are():
    """To the right is slower, above is worse."""
    marks = [Mark(1, 1e-1, "", "a"), Mark(100, 1e-3, "", "b")]
    plot = scatter(marks, size=(400, 300)).astype(int)
    colors = ((38, 98, 186), (214, 92, 52))
    spots = []
    for color in colors:
        off = np.abs(plot - color).sum(axis=-1)
        spots.append(np.argwhere(off < 20).mean(axis=0))
    (above, left), (below, right) = spots
    assert left < right - 100
    assert above < below - 100


def test_labels_are_clear_of_dots_and_of_one_another():
    """Of dots in one place, at the edge too; beside the dot if that may be."""
    spots = [(200, 150)] * 6 + [(390, 151)] * 6 + [(75, 149)] * 6 + [(206, 40)]
    boxes = label_boxes(spots, ["label"] * len(spots), (400, 300))
    for one, other in itertools.combinations(boxes, 2):
        assert one.clear_of(other)
    for box in boxes:
        assert LEFT < box.left < box.right <= 400 - RIGHT
        assert TOP <= box.top < box.bottom <= 300 - BOTTOM
        dots = (Box(x - 4, y - 4, x + 4, y + 4) for x, y in spots)
        assert all(box.clear_of(dot) for dot in dots)
    first, second = sorted(boxes[:6], key=lambda box: abs(box.bottom - 150))[:2]
    assert {first.left > 200, second.left > 200} == {True, False}
    assert all(box.right < 390 for box in boxes[6:12])
    (wide,) = label_boxes([(200, 150)], ["w" * 99], (400, 300))
    assert wide.left == LEFT + 1


@pytest.mark.parametrize("name", STRESS_SCENES)
def test_scenes_that_are_built_in(name):
    trial = open_stress_scene(name)
    assert trial.name == name
    assert trial.gaussians.capacity > 1000
    params = trial.gaussians.params
    assert all(np.isfinite(leaf).all() for leaf in params.__dict__.values())
    sized = open_stress_scene(name, size=(40, 30)).camera
    assert (sized.width, sized.height) == (40, 30)
    assert {point.knob for point in points(trial.gaussians)} >= {"cut", "tile", "dtype"}


def test_a_camera_for_a_scene_that_nothing_is_known_of(view):
    scene = view[0]
    camera = facing(scene, 40, 30)
    middle = np.median(np.asarray(scene.params.means), axis=0)
    seen = np.asarray(camera.viewmat) @ np.append(middle, 1)
    np.testing.assert_allclose(seen[:2], 0, atol=1e-5)
    assert seen[2] > 0
    with pytest.raises(InputError, match="no Gaussian"):
        facing(gsjax.select(scene, jnp.zeros(COUNT, bool)), 40, 30)


def test_scenes_that_are_not_there():
    with pytest.raises(InputError, match="knot, fog"):
        open_stress_scene("nowhere")


@pytest.mark.long
def test_points_are_measured(view):
    """One compiled pair beside the exact one: times, errors, bounds, the gradient."""
    scene, camera, _ = view
    trial = StressScene("small", scene, camera, tuple(BEHIND))
    light = {
        "num_size_buckets": 1,
        "devices": 1,
        "outputs": ("rgb",),
        "pair_capacity": 2048,
    }
    config = RasterConfig.compat(**light)
    (found,) = pareto(trial, [Point("compat", "", config, double=True)], repeats=1)
    assert found["inside"]
    assert 1e-5 < found["max"] < 0.05
    assert found["at worst"] <= found["bound"]
    assert 1e-6 < found["gradient"] < 0.1
    assert 0 < found["forward ms"] < found["gradient ms"] * 10
    json.dumps(found)


def test_refusals_of_the_command(tmp_path, capsys):
    plot = tmp_path / "a.png"
    plot.touch()
    for args, code, text in (
        (["bench", "nowhere"], 3, "knot"),
        (["bench", "--repeats", "0"], 2, "--repeats"),
        (["bench", "--budget", "x"], 2, "--budget"),
        (["bench", "--budget", "2"], 2, "above 0 and below 1"),
        (["bench", "--plot", str(plot)], 3, "a.png"),
        (["bench", "--plot", str(plot.with_suffix(".jpg"))], 2, "in .png is wanted"),
    ):
        assert main.main(args) == code
        assert text in capsys.readouterr().err
