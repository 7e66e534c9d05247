"""Compressed PLY files, compared with a decoder that follows their description."""

import math
import struct
from itertools import islice

import jax
import numpy as np
import pytest
from captures import ply_file, rejects

import gsjax
from gsjax.io.formats import render_mode
from gsjax.io.packed_ply import write_packed_ply
from gsjax.runs.export import export_scene

pytestmark = pytest.mark.usefixtures("float32")
C0 = 0.28209479177387814
SIZES = {"float": ("f", 4), "uint": ("I", 4), "uchar": ("B", 1)}


def scene(count: int = 300, degree: int = 1, **changes) -> gsjax.Gaussians:
    rng = np.random.default_rng(count)
    fields = {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(-2, 1, (count, 3)),
        "logit_opacities": rng.normal(0, 2, count),
        "sh": rng.normal(0, 0.5, (count, (degree + 1) ** 2, 3)),
    }
    return gsjax.make_gaussians(**fields | changes)


def parsed(data: bytes) -> dict[str, list[dict[str, float]]]:
    """The rows of each element."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for line in lines[2:]:
        match line.split():
            case ["element", name, count]:
                elements[name] = int(count), []
            case ["property", kind, name]:
                [*elements.values()][-1][1].append((kind, name))
    found, values = {}, iter(())
    for element, (count, kinds) in elements.items():
        form = "<" + "".join(SIZES[kind][0] for kind, _ in kinds)
        size = count * struct.calcsize(form)
        values, body = struct.iter_unpack(form, body[:size]), body[size:]
        names = [name for _, name in kinds]
        found[element] = [dict(zip(names, row)) for row in islice(values, count)]
    assert body == b""
    return found


def between(low: float, high: float, bits: int, of: int) -> float:
    share = bits / (2**of - 1)
    return low * (1 - share) + high * share


def by_the_book(data: bytes) -> dict[str, np.ndarray]:
    """The values of a file, one number after another."""
    tables = parsed(data)
    rows: dict[str, list] = {name: [] for name in ("means", "scales", "quats", "rgba")}
    for index, row in enumerate(tables["vertex"]):
        chunk = tables["chunk"][index // 256]
        for name, of, prefix in (
            ("means", "packed_position", ""),
            ("scales", "packed_scale", "scale_"),
        ):
            bits = f"{row[of]:032b}"
            parts = bits[:11], bits[11:21], bits[21:]
            ends = [
                (chunk[f"min_{prefix}{a}"], chunk[f"max_{prefix}{a}"]) for a in "xyz"
            ]
            rows[name].append(
                [between(*end, int(p, 2), len(p)) for end, p in zip(ends, parts)]
            )
        bits = f"{row['packed_rotation']:032b}"
        others = [int(bits[k : k + 10], 2) for k in (2, 12, 22)]
        others = [(u / 1023 - 0.5) * math.sqrt(2) for u in others]
        others.insert(int(bits[:2], 2), math.sqrt(1 - sum(v * v for v in others)))
        rows["quats"].append(others)
        red, green, blue, opacity = row["packed_color"].to_bytes(4, "big")
        ends = [(chunk.get(f"min_{c}", 0), chunk.get(f"max_{c}", 1)) for c in "rgb"]
        colors = [between(*end, u, 8) for end, u in zip(ends, (red, green, blue))]
        rows["rgba"].append([*colors, opacity / 255])
    harmonics = [[*row.values()] for row in tables.get("sh", [])]
    ends = {0: 0.0, 255: 1.0}
    shares = [[ends.get(u, (u + 0.5) / 256) for u in row] for row in harmonics]
    rest = 8 * (np.asarray(shares) - 0.5).reshape(len(rows["means"]), 3, -1)
    return {name: np.asarray(row) for name, row in rows.items()} | {"rest": rest}


def assert_is(found: gsjax.Gaussians, expected: dict[str, np.ndarray]) -> None:
    params = found.params
    np.testing.assert_allclose(params.means, expected["means"], atol=1e-6)
    np.testing.assert_allclose(params.log_scales, expected["scales"], atol=1e-6)
    np.testing.assert_allclose(params.quats, expected["quats"], atol=1e-6)
    colors = 0.5 + C0 * params.sh[:, 0]
    np.testing.assert_allclose(colors, expected["rgba"][:, :3], atol=1e-6)
    opacities = 1 / (1 + np.exp(-np.asarray(params.logit_opacities)))
    np.testing.assert_allclose(opacities, expected["rgba"][:, 3], atol=0.2501 / 255)
    rest = np.asarray(params.sh[:, 1:]).swapaxes(1, 2)
    np.testing.assert_allclose(rest, expected["rest"], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_files_follow_the_description(tmp_path, degree):
    """Without inactive slots; under a plain name they are recognised too."""
    whole = scene(600, degree)
    some = gsjax.select(whole, np.arange(600) < 300)
    path = tmp_path / "a.Compressed.PLY"
    gsjax.save(path, some)
    data = path.read_bytes()
    tables = parsed(data)
    counts = {name: len(rows) for name, rows in tables.items()}
    assert counts == {"chunk": 2, "vertex": 300} | ({"sh": 300} if degree else {})
    for name, end in (("min", np.min), ("max", np.max)):
        found = [[row[f"{name}_{axis}"] for axis in "xyz"] for row in tables["chunk"]]
        expected = end(np.asarray(whole.params.means)[:300], axis=0)
        np.testing.assert_array_equal(end(found, axis=0), expected)
    expected = by_the_book(data)
    assert_is(gsjax.load(path), expected)
    plain = tmp_path / "a.ply"
    plain.write_bytes(data)
    assert_is(gsjax.load(plain), expected)


def changed(data: bytes, edit) -> bytes:
    """The file with other elements: lists of rows by name and by property."""
    tables = parsed(data)
    edit(tables)
    lines, body = ["ply", "format binary_big_endian 1.0"], b""
    for element, rows in tables.items():
        lines += [f"element {element} {len(rows)}"]
        kinds = dict.fromkeys(rows[0], "float")
        for name in rows[0]:
            kinds[name] = "uint" if name.startswith("packed") else kinds[name]
            kinds[name] = "uchar" if name.startswith("f_rest") else kinds[name]
        lines += [f"property {kind} {name}" for name, kind in kinds.items()]
        form = ">" + "".join(SIZES[kind][0] for kind in kinds.values())
        body += b"".join(struct.pack(form, *row.values()) for row in rows)
    return "\n".join([*lines, "end_header", ""]).encode() + body


def without_colors(tables) -> None:
    for row in tables["chunk"]:
        for name in "rgb":
            del row[f"min_{name}"], row[f"max_{name}"]


def with_more(tables) -> None:
    """Other elements and properties, in another order."""
    for row in tables["vertex"]:
        row["time"] = 0.5
    for name in ("vertex", "sh"):
        tables[name] = tables.pop(name)
    tables |= {"extra": [{"a": 1.0}], "chunk": tables.pop("chunk")}


@pytest.mark.parametrize("edit", [without_colors, with_more])
def test_files_of_other_writers_are_read(tmp_path, edit):
    """Of the other byte order, and those of older programs."""
    path = tmp_path / "a.compressed.ply"
    write_packed_ply(path, scene())
    expected = by_the_book(path.read_bytes())
    data = changed(path.read_bytes(), edit)
    if edit is without_colors:  # colours are then 0 to 1
        words = [row["packed_color"] for row in parsed(path.read_bytes())["vertex"]]
        bytes_ = [word.to_bytes(4, "big")[:3] for word in words]
        expected["rgba"][:, :3] = np.asarray([[*b] for b in bytes_]) / 255
    path.write_bytes(data)
    assert_is(gsjax.load(path), expected)


MODES = [
    ([], None),
    (["SplatRenderMode: mip"], "mip"),
    (["splatrendermode : MIP"], "mip"),
    (["antialiased 1"], "mip"),
    (["Antialiased 0"], "default"),
    (["antialiased 1", "SplatRenderMode: default"], "default"),
    (["SplatRenderMode: 2dgs", "ANTIALIASED 1"], "mip"),
    (["SplatRenderMode: mip", "antialiased 0"], "default"),
    (["is antialiased 1", "antialiased 12", "SplatRenderModes: mip"], None),
]


@pytest.mark.parametrize(("comments", "expected"), MODES)
@pytest.mark.parametrize("eol", ["\n", "\r\n", "\r"])
def test_render_modes_of_comments(tmp_path, comments, expected, eol):
    """Of Brush and others, and of Postshot; the last one counts."""
    lines = eol.join(f"comment {comment}" for comment in comments or ["none"])
    path = tmp_path / "a.ply"
    for name in ("packed_position", "x"):
        data = ply_file({name: np.zeros(1)}, types={name: "int"}, eol=eol)
        path.write_bytes(data.replace(b"comment made by a test", lines.encode()))
        assert render_mode(path) == expected


@pytest.mark.parametrize("mode", ["mip", "2dgs", "other"])
def test_render_modes_are_kept(tmp_path, mode):
    path, out = tmp_path / "a.compressed.ply", tmp_path / "b.compressed.ply"
    gsjax.save(path, scene(5), mode=mode)
    export_scene(path, out)
    assert render_mode(path) == render_mode(out) == mode


def test_a_file_of_nothing(tmp_path):
    path = tmp_path / "a.compressed.ply"
    gsjax.save(path, gsjax.select(scene(3), np.zeros(3, bool)))
    assert int(gsjax.num_active(gsjax.load(path))) == 0


@pytest.mark.filterwarnings("ignore:.*are zero, the first.*culled")
def test_exports_count_what_is_written(tmp_path):
    """Gaussians with zero quaternions are never drawn."""
    quats = np.asarray([[1, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0]])
    gsjax.save(tmp_path / "a.ply", scene(3, quats=quats))
    out = tmp_path / "b.compressed.ply"
    assert export_scene(tmp_path / "a.ply", out) == (2, 3)
    assert gsjax.load(out).capacity == 2


FEW = np.asarray([[1.0, 0, 0], [0, 0, 0], [1, 2, 3]])
LOST = [
    ({"log_scales": np.full((3, 3), -21.0), "means": 0 * FEW}, "3 of 3 .*log scales"),
    ({"sh": np.full((3, 4, 3), 4.1)}, "3 of 3 .*harmonics beyond -4 to 4"),
    ({"means": [[0] * 3, [1e5] * 3, [3e4] * 3]}, "1 of 3 .*means rounded by a tenth"),
]


@pytest.mark.parametrize(("changes", "message"), LOST)
def test_losses_are_warned_about(tmp_path, changes, message):
    with pytest.warns(UserWarning, match=message) as caught:
        gsjax.save(tmp_path / "a.compressed.ply", scene(3, **changes))
    assert len(caught) == 1


INFINITE = np.asarray([0, np.inf, 0])[:, None] * np.ones(3)
REFUSED = [
    ({"sh": np.zeros((3, 25, 3))}, r"SH degree 0 to 3, got 4; .*--sh-degree"),
    ({"means": INFINITE}, "1 of 3 Gaussians are NaN or infinite"),
    ({"means": 1e39 * FEW}, "1 of 1 chunks have means that exceed float32"),
    ({"quats": np.zeros((3, 4))}, "quaternions of all 3 Gaussians are zero"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_scenes_that_it_cannot_store(tmp_path, changes, message):
    path = tmp_path / "a.compressed.ply"
    with jax.enable_x64(True):
        rejects(message, gsjax.save, path, scene(3, **changes))
    assert list(tmp_path.iterdir()) == []
    path.touch()
    rejects("exists", gsjax.save, path, scene(3))
