"""glTF files with KHR_gaussian_splatting, compared with an independent parser.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

import copy
from pathlib import Path

import numpy as np
import pytest
from captures import rejects, warned
from conftest import DATA
from glb_files import (
    arrays_of,
    edited,
    primitive,
    put_together,
    taken_apart,
    with_array,
)
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.io.formats import render_mode
from gsjax.io.gltf import read_glb
from gsjax.math.sh import eval_sh

pytestmark = pytest.mark.usefixtures("float32")
FOLDER = DATA / "formats" / "synthetic"
FILES = ("sh3/sh3", "sh1/sh1", "extreme/extreme", "extreme_mip/extreme_mip")
FILES += ("misc/one", "misc/flat")
C0 = 0.28209479177387814
TURN = np.diag([-1.0, -1, 1])  # between the axes of PLY and glTF
# Signs of the basis under that turn, by degree.
SIGNS = [[1], [-1, 1, -1], [1, -1, 1, -1, 1], [-1, 1, -1, 1, -1, 1, -1]]


def signs_of(bases: int) -> np.ndarray:
    """Return [K, 1]"""
    return np.asarray([s for band in SIGNS for s in band])[:bases, None]


def scene(count: int = 5, degree: int = 3, seed: int = 0, **changes) -> gsjax.Gaussians:
    rng = np.random.default_rng(seed)
    fields = {
        "means": rng.normal(0, 3, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(-2, 1, (count, 3)),
        "logit_opacities": rng.normal(0, 3, count),
        "sh": rng.normal(0, 0.5, (count, (degree + 1) ** 2, 3)),
    }
    return gsjax.make_gaussians(**fields | changes)


def fields_of(gaussians: gsjax.Gaussians) -> dict[str, np.ndarray]:
    """Return float64 arrays, with opacities and covariances [N, 3, 3]."""
    found = {k: np.asarray(v, np.float64) for k, v in vars(gaussians.params).items()}
    with np.errstate(over="ignore"):
        found["opacities"] = 1 / (1 + np.exp(-found["logit_opacities"]))
    half = matrices(found["quats"]) * np.exp(found["log_scales"])[:, None]
    return found | {"covariances": half @ half.transpose(0, 2, 1)}


def matrices(quats: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()


def assert_equal(found: gsjax.Gaussians, expected: gsjax.Gaussians) -> None:
    """Equal to the rounding of float32; quaternions as rotations."""
    one, other = fields_of(found), fields_of(expected)
    for name in ("means", "sh"):
        np.testing.assert_array_equal(one[name], other[name])
    for name, bound in (("log_scales", 5e-7), ("opacities", 1e-7)):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-7, atol=bound)
    turns = matrices(one["quats"]), matrices(other["quats"])
    np.testing.assert_allclose(*turns, atol=1e-6)


def foreign(name: str) -> Path:
    if not FOLDER.is_dir():
        pytest.skip(f"{name} is absent (../shared/data/formats)")
    return FOLDER / name


@pytest.mark.parametrize("name", FILES)
def test_files_of_another_program_hold_their_source(name):
    """Its accessors hold the same values in the axes of the file."""
    path = foreign(f"{name}.glb")
    found = gsjax.load(path)
    assert_equal(found, gsjax.load(path.with_suffix(".ply")))
    assert render_mode(path) is None
    with np.load(f"{path}.expected.npz") as arrays:
        values = dict(arrays)
    rows = values["rows"] if "rows" in values else slice(None)
    params = {key: np.asarray(value)[rows] for key, value in vars(found.params).items()}
    np.testing.assert_array_equal(params["means"] @ TURN, values["means"])
    turned = params["sh"] * signs_of(params["sh"].shape[1])
    np.testing.assert_array_equal(turned, values["sh"])
    axes = np.square(TURN @ matrices(params["quats"]))
    expected = np.square(matrices(values["quats"]))
    np.testing.assert_allclose(axes, expected, atol=1e-6)


def test_no_file_of_another_program_is_left_out():
    folder = foreign(".")
    found = {str(p.relative_to(folder).with_suffix("")) for p in folder.rglob("*.glb")}
    assert found == {*FILES}


@pytest.mark.parametrize("degree", range(4))
def test_files_are_read_as_they_were_written(tmp_path, degree):
    one = scene(degree=degree)
    gsjax.save(tmp_path / "a.glb", gsjax.grow(one, 9))
    assert_equal(read_glb(tmp_path / "a.glb"), one)


def test_written_files_follow_the_specification(tmp_path):
    one = scene(logit_opacities=[-np.inf, np.inf, -80, 3, 0])
    path = tmp_path / "a.glb"
    gsjax.save(path, one)
    data, body = taken_apart(path.read_bytes())
    assert data["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert data["asset"]["version"] == "2.0"
    assert data["buffers"] == [{"byteLength": len(body)}]
    shape = primitive(data)
    assert shape["mode"] == 0
    settings = shape["extensions"]["KHR_gaussian_splatting"]
    assert settings["kernel"] == "ellipse"
    assert settings["colorSpace"] == "srgb_rec709_display"
    found, params = arrays_of(path), fields_of(one)
    bounds = data["accessors"][shape["attributes"]["POSITION"]]
    for key, function in (("min", np.min), ("max", np.max)):
        assert np.float32(bounds[key]).tolist() == bounds[key]
        assert bounds[key] == function(found["POSITION"], axis=0).tolist()
    np.testing.assert_array_equal(found["POSITION"], params["means"] @ TURN)
    np.testing.assert_allclose(found["SCALE"], np.exp(params["log_scales"]), rtol=1e-6)
    np.testing.assert_allclose(found["OPACITY"][:, 0], params["opacities"], rtol=1e-6)
    x, y, z, w = found["ROTATION"].T
    np.testing.assert_allclose(x**2 + y**2 + z**2 + w**2, 1, rtol=1e-6)
    turned = matrices(np.stack([w, x, y, z], axis=1))
    np.testing.assert_allclose(turned, TURN @ matrices(params["quats"]), atol=1e-6)
    names = [f"SH_DEGREE_{l}_COEF_{n}" for l in range(4) for n in range(2 * l + 1)]
    sh = np.stack([found[name] for name in names], axis=1)
    np.testing.assert_array_equal(sh, params["sh"] * signs_of(16))
    # COLOR_0 is linear.
    srgb = np.clip(0.5 + C0 * params["sh"][:, 0], 0, 1)
    linear = np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)
    expected = np.column_stack([linear, params["opacities"]])
    np.testing.assert_allclose(found["COLOR_0"] / 255, expected, atol=0.51 / 255)
    colors = data["accessors"][shape["attributes"]["COLOR_0"]]
    assert colors["normalized"]
    assert {*found} == {"POSITION", "COLOR_0", "SCALE", "ROTATION", "OPACITY", *names}


def written(folder: Path, gaussians: gsjax.Gaussians) -> tuple[Path, bytes]:
    path = folder / "a.glb"
    gsjax.save(path, gaussians, overwrite=True)
    return path, path.read_bytes()


def trs(move=(0, 0, 0), turn=(0, 0, 0, 1), scale=(1, 1, 1)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() * np.asarray(scale)
    matrix[:3, 3] = move
    return matrix


PARENT = {
    "translation": [1, -2, 3],
    "rotation": [0.1, 0.3, -0.2, 0.9],
    "scale": [2] * 3,
}
CHILD = {"translation": [0, 5, 0], "rotation": [0.5, -0.5, 0.5, 0.5]}
STRETCH = {"scale": [3, 0.5, 1.5], "rotation": [0.2, 0, 0.1, 0.7]}
SHEAR = np.asarray([[1, 0.5, 0, 2], [0, 1, 0.2, 0], [0, -0.3, 2, 1], [0, 0, 0, 1]])
NODES = {
    "rotation and scale": ([PARENT], trs(*PARENT.values())),
    "hierarchy": ([PARENT, CHILD], trs(*PARENT.values()) @ trs(*CHILD.values())),
    "mirror": ([{"scale": [-1.5] * 3}], trs(scale=(-1.5, -1.5, -1.5))),
    "mirror of one axis": ([{"scale": [1, -1, 1]}], trs(scale=(1, -1, 1))),
    "uneven scale": (
        [STRETCH],
        trs(turn=STRETCH["rotation"], scale=STRETCH["scale"]),
    ),
    "matrix": ([{"matrix": SHEAR.T.ravel().tolist()}], SHEAR),
    "uneven within a turn": (
        [STRETCH, CHILD],
        trs(turn=STRETCH["rotation"], scale=STRETCH["scale"]) @ trs(*CHILD.values()),
    ),
}


@pytest.mark.parametrize("name", NODES)
def test_nodes_transform_their_gaussians(tmp_path, name):
    """Means, covariances, and colours in the direction turned by the polar factor."""
    nodes, matrix = NODES[name]
    one = scene(count=20, seed=4)
    path, raw = written(tmp_path, one)

    def edit(data):
        chain = [{**node, "children": [k + 1]} for k, node in enumerate(nodes)]
        chain[-1] = {**nodes[-1], "mesh": 0}
        data["nodes"] = chain

    path.write_bytes(edited(edit)(raw))
    found, before = fields_of(gsjax.load(path)), fields_of(one)
    linear, offset = TURN @ matrix[:3, :3] @ TURN, TURN @ matrix[:3, 3]
    expected = before["means"] @ linear.T + offset
    np.testing.assert_allclose(found["means"], expected, atol=3e-6)
    expected = linear @ before["covariances"] @ linear.T
    size = np.trace(expected, axis1=1, axis2=2)[:, None, None]
    error = (found["covariances"] - expected) / size
    np.testing.assert_allclose(error, 0, atol=3e-6)
    ways = np.random.default_rng(2).normal(size=(30, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    orthogonal = polar(linear)[0]
    colors, were = (
        np.asarray(eval_sh(sh[:, None], np.float32(d)[None]))
        for sh, d in ((found["sh"], ways @ orthogonal.T), (before["sh"], ways))
    )
    np.testing.assert_allclose(colors, were, atol=1e-5)
    np.testing.assert_allclose(found["opacities"], before["opacities"], atol=1e-7)


def test_thin_gaussians_keep_their_thickness_in_uneven_scales(tmp_path):
    """Relative to their size, 1e-6 would vanish in a covariance of float32."""
    flat = np.tile([0.0, -1.0, -14.0], (20, 1))
    one = scene(count=20, log_scales=flat)
    path, raw = written(tmp_path, one)
    path.write_bytes(edited(lambda d: d["nodes"][0].update(STRETCH))(raw))
    found = fields_of(gsjax.load(path))
    volume = np.sum(flat, axis=1) + np.log(np.prod(STRETCH["scale"]))
    np.testing.assert_allclose(found["log_scales"].sum(axis=1), volume, atol=1e-4)


def test_primitives_of_the_scene_are_joined(tmp_path):
    """In the order of the nodes, with zeros for harmonics that one lacks."""
    one = scene(degree=2)
    path, raw = written(tmp_path, one)

    def edit(data):
        flat = copy.deepcopy(data["meshes"][0])
        attributes = flat["primitives"][0]["attributes"]
        for name in [n for n in attributes if "SH_DEGREE_2" in n or "DEGREE_1" in n]:
            del attributes[name]
        data["meshes"] += [flat, {"primitives": [{"attributes": {"POSITION": 0}}]}]
        data["nodes"] = [{"mesh": 2}, {"mesh": 1}, {"mesh": 0}, {"mesh": 0}]
        data["scenes"] = [{"nodes": []}, {"nodes": [0, 2, 1]}]
        data["scene"] = 1

    path.write_bytes(edited(edit)(raw))
    found = gsjax.load(path)
    sh = np.asarray(one.params.sh)
    low = sh.copy()
    low[:, 1:] = 0
    np.testing.assert_array_equal(found.params.sh, np.concatenate([sh, low]))
    np.testing.assert_array_equal(found.params.means, np.tile(one.params.means, (2, 1)))
    path.write_bytes(edited(lambda d: d.pop("scenes"))(path.read_bytes()))
    assert gsjax.load(path).capacity == 3 * one.capacity  # of all nodes


KINDS = [
    ("ROTATION", np.int8, True, 127, 4),
    ("ROTATION", np.int16, True, 32767, 4),
    ("SCALE", np.uint8, False, 1, 3),
    ("SCALE", np.uint8, True, 255, 3),
    ("SCALE", np.uint16, False, 1, 3),
    ("SCALE", np.uint16, True, 65535, 3),
    ("OPACITY", np.uint8, True, 255, 1),
    ("OPACITY", np.uint16, True, 65535, 1),
]


@pytest.mark.parametrize(("name", "kind", "normalised", "unit", "width"), KINDS)
def test_quantised_attributes(tmp_path, name, kind, normalised, unit, width):
    info = np.iinfo(kind)
    rng = np.random.default_rng(3)
    raw = rng.integers(info.min, info.max, (5, width), kind, endpoint=True)
    raw[0, 0] = info.min or 1
    one = scene()
    path, whole = written(tmp_path, one)
    path.write_bytes(with_array(whole, name, raw, normalized=normalised))
    found = fields_of(gsjax.load(path))
    values = np.maximum(raw / unit, -1)
    if name == "ROTATION":
        turned = matrices(np.roll(values, 1, axis=1))
        np.testing.assert_allclose(TURN @ matrices(found["quats"]), turned, atol=1e-6)
    elif name == "SCALE":
        np.testing.assert_allclose(found["log_scales"], np.log(values), rtol=1e-6)
    else:
        np.testing.assert_allclose(found["opacities"], values[:, 0], atol=1e-7)


def test_interleaved_attributes(tmp_path):
    """A stride of 44 bytes, and offsets within the view."""
    one = scene(degree=0)
    path, raw = written(tmp_path, one)
    data, _ = taken_apart(raw)
    found, rows = arrays_of(path), np.zeros((5, 11), "<f4")
    data["bufferViews"] = [{"buffer": 0, "byteLength": 220, "byteStride": 44}]
    data["buffers"] = [{"byteLength": 222}]
    places = {"ROTATION": 3, "SCALE": 7, "OPACITY": 10, "SH_DEGREE_0_COEF_0": 0}
    for name, start in {"POSITION": 0, **places}.items():
        full = name if name == "POSITION" else f"KHR_gaussian_splatting:{name}"
        accessor = data["accessors"][primitive(data)["attributes"][full]]
        accessor |= {"bufferView": 0, "byteOffset": 4 * start}
        if "SH" not in name:  # which shares the means
            values = found[name]
            rows[:, start : start + values.shape[1]] = values
    path.write_bytes(put_together(data, rows.tobytes() + bytes(2)))
    shared = one.params.replace(sh=np.asarray(found["POSITION"])[:, None])
    assert_equal(gsjax.load(path), one.replace(params=shared))


def test_scales_of_zero_are_read_as_tiny(tmp_path):
    path, raw = written(tmp_path, scene())
    path.write_bytes(with_array(raw, "SCALE", np.zeros((5, 3), np.float32)))
    np.testing.assert_array_equal(gsjax.load(path).params.log_scales, -80)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("colorSpace", "lin_rec709_display", "its colours are linear"),
        ("projection", "orthographic", "projection 'orthographic' is ignored"),
        ("sortingMethod", "z", "sortingMethod 'z' is ignored"),
    ],
)
def test_settings_that_are_ignored_are_warned_about(tmp_path, key, value, message):
    one = scene()
    path, raw = written(tmp_path, one)

    def edit(data):
        primitive(data)["extensions"]["KHR_gaussian_splatting"][key] = value

    path.write_bytes(edited(edit)(raw))
    assert_equal(warned(message, gsjax.load, path), one)


def test_scenes_that_gltf_cannot_store(tmp_path):
    path = tmp_path / "a.glb"
    empty = gsjax.select(scene(), np.zeros(5, bool))
    rejects("at least one active Gaussian, got none", gsjax.save, path, empty)
    four = scene(degree=4)
    rejects("SH degree 0 to 3, got 4; .*--sh-degree", gsjax.save, path, four)
    bad = scene(log_scales=np.full((5, 3), np.nan))
    rejects("5 of 5 Gaussians are NaN or infinite", gsjax.save, path, bad)
    assert not path.exists()
    warned("do not record the render mode", gsjax.save, path, scene(), mode="mip")
    rejects("exists; pass overwrite=True", gsjax.save, path, scene())
