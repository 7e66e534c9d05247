"""SOG scenes, compared with an independent decoder and with other programs' files.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

import json
import shutil
import time
import tracemalloc
from pathlib import Path

import jax
import numpy as np
import pytest
from captures import rejects, warned
from conftest import DATA
from scipy.spatial.transform import Rotation
from sog_files import bundle, contents, decoded, older_scene, texels, texture

import gsjax
from gsjax.cli.main import main
from gsjax.io.formats import render_mode, stored_bytes
from gsjax.io.morton import morton_order
from gsjax.io.sog import read_sog

pytestmark = pytest.mark.usefixtures("float32")
FOLDER = DATA / "formats"
NAMES = ("means", "quats", "log_scales", "sh")
FOREIGN = (
    *(f"synthetic/{name}/{name}" for name in ("sh1", "sh3", "extreme", "extreme_mip")),
    *("synthetic/misc/one", "synthetic/misc/flat", "guitar/guitar"),
)
UNBUNDLED = tuple(f"{name}_sog" for name in FOREIGN[:4])
FILES = (*(f"{name}.sog" for name in FOREIGN), *UNBUNDLED)
BAD = (
    *("count_exceeds_texture", "means_texture_missing", "meta_json_missing"),
    *("path_traversal_in_meta_files", "truncated_no_central_directory"),
    *("webp_not_an_image", "zip_bomb_meta_json_50MB_of_spaces"),
)


def scene(count: int = 50, degree: int = 1, seed: int = 0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "means": rng.normal(0, 3, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(-3, 1, (count, 3)),
        "logit_opacities": rng.normal(0, 3, count),
        "sh": rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)),
    }
    return gsjax.make_gaussians(**fields | changes)


def arrays_of(gaussians: gsjax.Gaussians) -> dict[str, np.ndarray]:
    found = {name: np.array(value) for name, value in vars(gaussians.params).items()}
    return found | {"opacities": opacities(found["logit_opacities"])}


def opacities(logits) -> np.ndarray:
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def foreign(name: str) -> Path:
    if not FOLDER.is_dir():
        pytest.skip(f"{name} is absent (../shared/data/formats)")
    return FOLDER / name


def values_of(name: str) -> dict[str, np.ndarray]:
    with np.load(foreign(f"{name}.expected.npz")) as arrays:
        return dict(arrays)


@pytest.mark.parametrize("name", FILES)
def test_files_of_another_program_have_the_values_that_it_reads(name):
    found = arrays_of(gsjax.load(foreign(name)))
    expected = values_of(name)
    rows = expected.get("rows", slice(None))
    for key in NAMES:
        np.testing.assert_allclose(found[key][rows], expected[key], rtol=0, atol=1e-7)
    # The bytes 0 and 255 stand for a quarter of a step within.
    shares = found["opacities"][rows], opacities(expected["logit_opacities"])
    np.testing.assert_allclose(*shares, rtol=0, atol=0.2501 / 255)
    mode = "mip" if "extreme_mip" in name else None
    assert render_mode(foreign(name)) == mode


@pytest.mark.parametrize("name", FOREIGN[:4])
def test_files_of_another_program_approximate_their_source(name):
    """Its writer does not keep the colours of Gaussians with an opacity of 0."""
    expected = values_of(f"{name}.sog")
    most = json.loads(str(expected["info"]))["max_error_vs_source"]
    source, found = (
        arrays_of(gsjax.load(foreign(f"{name}{suffix}"))) for suffix in (".ply", ".sog")
    )
    seen = expected["logit_opacities"] > -13
    errors = {
        key: np.abs(found[key] - source[key][expected["order"]])[seen]
        for key in ("means", "log_scales", "opacities", "sh")
    }
    limits = {
        "means": most["means_abs"],
        "log_scales": most["log_scales_abs"],
        "opacities": most["opacity_abs"],
        "sh": max(most["shN_abs"], most["sh0_abs_where_opacity_byte_gt0"]),
    }
    for key, limit in limits.items():
        assert errors[key].max() <= limit * 1.001 + 1e-6, key


def test_no_file_of_another_program_is_left_out():
    folder = foreign(".")
    found = {*folder.rglob("*.sog"), *folder.rglob("*_sog")}
    names = {str(path.relative_to(folder)) for path in found}
    assert names == {*FILES, *(f"bad/sog_{name}.sog" for name in BAD)}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_rejected_quickly_and_cheaply(name):
    path = foreign(f"bad/sog_{name}.sog")
    tracemalloc.start()
    begun = time.perf_counter()
    try:
        rejects(path.name, gsjax.load, path)
    finally:
        taken, peak = time.perf_counter() - begun, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert taken < 1
    assert peak < 64e6


def quantised(values: np.ndarray, codebook: np.ndarray) -> np.ndarray:
    """Return the nearest entries."""
    nearest = np.abs(values[..., None] - codebook).argmin(axis=-1)
    return codebook[nearest]


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (300, 2), (700, 3)])
def test_files_lose_at_most_half_a_step(tmp_path, count, degree):
    """They follow the layout, and no transparent texel loses its colour."""
    one = scene(count, degree, logit_opacities=np.linspace(-99, 9, count))
    path = tmp_path / "a.sog"
    gsjax.save(path, gsjax.grow(one, count + 5))
    files, source = contents(path), arrays_of(one)
    found, meta = decoded(files), json.loads(files["meta.json"])
    logs = np.sign(source["means"]) * np.log1p(np.abs(source["means"]))
    low, step = logs.min(axis=0), np.ptp(logs, axis=0) / 65535
    rounded = low + np.rint((logs - low) / (step + 1e-30)) * step
    order = morton_order(np.sign(rounded) * np.expm1(np.abs(rounded)))
    source = {name: array[order] for name, array in source.items()}
    assert (np.abs(found["logs"] - logs[order]) <= step / 2 + 1e-6).all()
    for key, name in (("log_scales", "scales"), ("sh", "sh0")):
        values = source[key] if key == "log_scales" else source[key][:, 0]
        stored = found[key] if key == "log_scales" else found[key][:, 0]
        codebook = np.asarray(meta[name]["codebook"], np.float32)
        np.testing.assert_allclose(stored, quantised(values, codebook), atol=1e-6)
        # An even codebook would have errors of √(1/12) of a step.
        even = np.ptp(values) / 255 / np.sqrt(12)
        assert np.std(stored - values) <= even
    shares = found["opacities"], source["opacities"]
    np.testing.assert_allclose(*shares, rtol=0, atol=0.5 / 255 + 1e-6)
    turns = [
        Rotation.from_quat(np.roll(one["quats"], -1, 1)) for one in (found, source)
    ]
    assert np.degrees((turns[0] * turns[1].inv()).magnitude()).max() < 0.93
    codebook = (
        np.asarray(meta["shN"]["codebook"], np.float32) if degree else np.zeros(1)
    )
    expected = quantised(source["sh"][:, 1:], codebook)
    np.testing.assert_allclose(found["sh"][:, 1:], expected, atol=1e-6)
    assert_read_as(gsjax.load(path), found)


def assert_read_as(gaussians: gsjax.Gaussians, expected: dict[str, np.ndarray]) -> None:
    found = arrays_of(gaussians)
    for key in NAMES:
        np.testing.assert_allclose(found[key], expected[key], rtol=2e-7, atol=1e-7)
    if "opacities" in expected:
        shares = found["opacities"], expected["opacities"]
        np.testing.assert_allclose(*shares, rtol=0, atol=0.2501 / 255)


def test_many_harmonics_are_clustered(tmp_path):
    """Here into 1024 entries, as many as there are kinds but for noise."""
    count = 1200
    kinds = np.random.default_rng(1).normal(0, 0.4, (400, 4, 3))
    noise = np.random.default_rng(2).normal(0, 0.01, (count, 4, 3))
    means = np.linspace(0, 9, count)[:, None] * [1, 0, 0]  # along x the order is kept
    one = scene(count, means=means, sh=kinds[np.arange(count) % 400] + noise)
    paths = [tmp_path / f"{name}.sog" for name in "ab"]
    gsjax.save(paths[0], one)
    files = contents(paths[0])
    assert json.loads(files["meta.json"])["shN"]["count"] <= 1024
    error = decoded(files)["sh"] - np.asarray(one.params.sh)
    assert np.sqrt(np.mean(np.square(error[:, 1:]))) < 0.01
    gsjax.save(paths[1], gsjax.load(paths[0]))
    assert contents(paths[1]) == files


def assert_same_bits(one: gsjax.Gaussians, other: gsjax.Gaussians) -> None:
    for name, array in vars(one.params).items():
        np.testing.assert_array_equal(array, getattr(other.params, name), err_msg=name)


def extremes() -> gsjax.Gaussians:
    """Far and near means, ties of quaternions, and values beyond other formats."""
    one = arrays_of(scene(80, 2, seed=5))
    one["means"][:6] = 900 * np.concatenate([np.eye(3), -np.eye(3)])
    one["means"][6:9] = np.diag([1e30, 1e-30, -1e-3])
    one["log_scales"][:2] = [[-25], [9]]
    one["logit_opacities"][:3] = [-np.inf, np.inf, -12]
    signs = np.indices((3, 3, 3, 3)).reshape(4, -1).T - 1.0
    one["quats"] = np.delete(signs, len(signs) // 2, axis=0)  # zero
    del one["opacities"]
    return gsjax.make_gaussians(**one)


@pytest.mark.filterwarnings("ignore:.*have means rounded")
@pytest.mark.parametrize("make", [extremes, lambda: scene(1), lambda: scene(500, 3)])
@pytest.mark.parametrize("wide", [False, True])
def test_a_second_file_holds_the_same_bits(tmp_path, make, wide):
    """Also where quaternions tie, and from float64."""
    with jax.enable_x64(wide):
        gsjax.save(tmp_path / "a.sog", make())
        once = gsjax.load(tmp_path / "a.sog")
        gsjax.save(tmp_path / "b.sog", once)
        assert_same_bits(gsjax.load(tmp_path / "b.sog"), once)
        gsjax.save(tmp_path / "c.sog", gsjax.load(tmp_path / "b.sog"))
    b, c = (contents(tmp_path / f"{name}.sog") for name in "bc")
    assert b == c


def test_few_distinct_values_are_kept(tmp_path):
    """Up to 256 scales and colours, and 1024 rows of harmonics of 256 values."""
    rng, count = np.random.default_rng(0), 3000
    tables = rng.normal(0, 1, (3, 256)).astype(np.float32)
    kinds = tables[2][rng.integers(0, 256, (1024, 3, 3))]
    sh = np.empty((count, 4, 3), np.float32)
    sh[:, 0] = tables[1][rng.integers(0, 256, (count, 3))]
    sh[:, 1:] = kinds[rng.integers(0, 1024, count)]
    scales = tables[0][rng.integers(0, 256, (count, 3))]
    lattice = np.linspace(0, 1, count, dtype=np.float32)[:, None] * [1, 0, 0]
    one = scene(count, means=lattice, log_scales=scales, sh=sh)
    gsjax.save(tmp_path / "a.sog", one, mode="2dgs")
    found = gsjax.load(tmp_path / "a.sog").params  # along x the order is kept
    np.testing.assert_array_equal(found.log_scales, scales)
    np.testing.assert_array_equal(found.sh, sh)


def test_folders_hold_the_same_as_bundles(tmp_path, capsys):
    one = scene(degree=2)
    for path in (tmp_path / "a.sog", tmp_path / "b" / "meta.json"):
        path.parent.mkdir(exist_ok=True)
        gsjax.save(path, one, mode="mip")
    folder = tmp_path / "b"
    assert contents(tmp_path / "a.sog") == contents(folder / "meta.json")
    expected = gsjax.load(tmp_path / "a.sog")
    for path in (folder, folder / "meta.json"):
        assert_same_bits(gsjax.load(path), expected)
        assert render_mode(path) == "mip"
        size = sum(file.stat().st_size for file in folder.iterdir())
        assert stored_bytes(path) == size
    out = tmp_path / "c" / "meta.json"
    assert main(["export", str(folder), str(out)]) == 0
    assert_same_bits(gsjax.load(out.parent), expected)
    assert main(["info", str(folder)]) == 0
    assert "SH degree         2" in capsys.readouterr().out
    # A folder of both is that of a run.
    (folder / "config.json").write_text("{}")
    assert main(["info", str(folder)]) == 3
    rejects(r"expected a suffix of .*\.sog", gsjax.load, folder)


def test_folders_are_replaced_as_a_whole(tmp_path):
    path = tmp_path / "meta.json"
    (tmp_path / "quats.webp").write_bytes(b"mine")
    rejects(r"quats\.webp: exists; .*overwrite=True", gsjax.save, path, scene())
    assert [file.name for file in tmp_path.iterdir()] == ["quats.webp"]
    gsjax.save(path, scene(), overwrite=True)
    gsjax.save(path, scene(seed=1), overwrite=True)
    (tmp_path / "other").mkdir()
    gsjax.save(tmp_path / "other" / "meta.json", scene(seed=1))
    assert_same_bits(gsjax.load(path), gsjax.load(tmp_path / "other"))
    shutil.rmtree(tmp_path / "other")
    (tmp_path / "scales.webp").unlink()
    (tmp_path / "scales.webp").mkdir()  # cannot be replaced
    rejects("scales.webp", gsjax.save, path, scene(seed=2), overwrite=True)
    assert not path.exists()
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


@pytest.mark.parametrize("mode", [None, "mip", "2dgs"])
def test_render_modes_are_recorded(tmp_path, mode):
    path = tmp_path / "a.sog"
    gsjax.save(path, scene(), mode=mode)
    assert render_mode(path) == mode


def test_surfels_have_a_third_scale_of_one_value(tmp_path):
    gsjax.save(tmp_path / "a.sog", scene(300), mode="2dgs")
    scales = np.asarray(gsjax.load(tmp_path / "a.sog").params.log_scales)
    assert np.ptp(scales[:, 2]) == 0
    assert scales[0, 2] < scales[:, :2].min() - 6


@pytest.mark.parametrize("degree", range(4))
def test_files_of_version_1(tmp_path, degree):
    raw, expected = older_scene(degree)
    path = tmp_path / "a.SOG"
    path.write_bytes(raw)
    found = arrays_of(read_sog(path))
    for key, values in expected.items():
        np.testing.assert_allclose(found[key], values, rtol=1e-6, atol=1e-6)
    assert render_mode(path) is None


def edited(path: Path, **textures: np.ndarray | bytes) -> None:
    """Replace files of a bundle, textures by their rows."""
    files = contents(path)
    for name, data in textures.items():
        if isinstance(data, bytes):
            files["meta.json"] = data
        else:
            files[f"{name}.webp"] = texture(data)
    path.write_bytes(bundle(files))


def test_other_spellings(tmp_path):
    """The flag of early descriptions, textures without alpha, and invalid tags."""
    path = tmp_path / "a.sog"
    gsjax.save(path, scene(16, 0))
    expected = arrays_of(gsjax.load(path))
    meta = json.loads(contents(path)["meta.json"]) | {"antialias": True}
    opaque = texels(contents(path)["scales.webp"])
    assert (opaque[..., 3] == 255).all()
    quats = texels(contents(path)["quats.webp"]).reshape(-1, 4).copy()
    quats[3, 3] = 7
    edited(path, meta=json.dumps(meta).encode(), quats=quats)
    assert render_mode(path) == "mip"
    found = arrays_of(warned("1 of 16 rotations lack the index", gsjax.load, path))
    expected["quats"][3] = (1, 0, 0, 0)
    for key in NAMES:
        np.testing.assert_array_equal(found[key], expected[key])


FAR = np.asarray([[1e39, 0, 0], [0, 0, 0]])
REFUSED = [
    ("a.sog", {"means": FAR}, "1 of 2 means exceed float32"),
    ("a.sog", {"sh": np.zeros((2, 25, 3))}, "SH degree 0 to 3, got 4; .*--sh-degree"),
    ("a.sog", {"quats": np.zeros((2, 4))}, "quaternions of all 2 Gaussians are zero"),
    ("a.sog", {"log_scales": np.full((2, 3), np.nan)}, "2 of 2 Gaussians are NaN"),
    ("my-meta.json", {}, r"expected the name meta\.json .*, got my-meta\.json"),
    ("none/meta.json", {}, "none is missing; create it"),
]


@pytest.mark.parametrize(("name", "changes", "message"), REFUSED)
def test_scenes_that_sog_cannot_store(tmp_path, name, changes, message):
    with jax.enable_x64(True):
        rejects(message, gsjax.save, tmp_path / name, scene(2, 0, **changes))
    assert list(tmp_path.iterdir()) == []


def test_empty_and_coarse_scenes(tmp_path):
    empty = gsjax.select(scene(), np.zeros(50, bool))
    path = tmp_path / "a.sog"
    rejects("at least one active Gaussian, got none", gsjax.save, path, empty)
    wide = scene(means=np.linspace(0, 1e4, 150).reshape(50, 3))
    warned("of 50 Gaussians have means rounded", gsjax.save, path, wide)
    rejects(r"lod-meta\.json of a streamed", gsjax.load, tmp_path / "lod-meta.json")
