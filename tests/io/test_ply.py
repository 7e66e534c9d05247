"""PLY files round-trip bit by bit, and damaged ones are rejected by name."""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import ply_file, rejects, warned
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.gaussians import Gaussians, grow, make_gaussians, select
from gsjax.io.formats import load, save
from gsjax.io.numerals import BLOCK
from gsjax.io.ply import read_ply, write_ply
from gsjax.runs.export import export_scene

FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def random_fields(count: int, degree: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3)]
    return {
        name: rng.normal(-1, 2, (count, *shape)).astype(np.float32)
        for name, shape in zip(FIELDS, shapes)
    }


def table_of(fields: dict[str, np.ndarray], *, normals=True) -> dict[str, np.ndarray]:
    """Columns in the standard order, independent of the library's own."""
    count, bases = fields["sh"].shape[:2]
    means, sh = fields["means"], fields["sh"]
    table = dict(zip("xyz", means.T))
    if normals:
        table |= dict.fromkeys(("nx", "ny", "nz"), np.zeros(count, np.float32))
    table |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    rest = [sh[:, basis, c] for c in range(3) for basis in range(1, bases)]
    table |= {f"f_rest_{i}": column for i, column in enumerate(rest)}
    table["opacity"] = fields["logit_opacities"]
    table |= {f"scale_{i}": fields["log_scales"][:, i] for i in range(3)}
    return table | {f"rot_{i}": fields["quats"][:, i] for i in range(4)}


def standard(fields: dict[str, np.ndarray]) -> bytes:
    """The file that the library writes."""
    return ply_file(table_of(fields)).replace(b"comment made by a test\n", b"")


def put(folder: Path, content: bytes) -> Path:
    path = folder / "scene.ply"
    path.write_bytes(content)
    return path


def assert_bits_equal(gaussians: Gaussians, fields: dict[str, np.ndarray]) -> None:
    assert gaussians.active.all()
    for name in FIELDS:
        found = np.asarray(getattr(gaussians.params, name)).astype(np.float32)
        assert found.shape == fields[name].shape
        assert found.tobytes() == fields[name].tobytes(), name


@pytest.mark.parametrize("degree", range(5))
def test_round_trip_is_bit_exact(tmp_path, degree):
    fields = random_fields(17, degree)
    path = tmp_path / "scene.PLY"
    save(path, make_gaussians(**fields))
    assert_bits_equal(load(path), fields)
    assert path.read_bytes() == standard(fields)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.PLY"]


@pytest.mark.parametrize("count", [1, 40_000])  # more rows than are read at a time
def test_means_far_from_the_origin_round_trip_bit_by_bit(tmp_path, count):
    """Also through an export; and near ones are written as float32."""
    fields = random_fields(count, 0)
    near, origin = fields["means"], np.asarray([4e6, -5e6, 123.456])
    path, exported = tmp_path / "a.ply", tmp_path / "b.ply"
    with jax.enable_x64(True):
        far = fields | {"means": near + origin}
        save(path, make_gaussians(**far))
        back = np.asarray(load(path).params.means)
        wide = make_gaussians(**{k: v.astype(np.float64) for k, v in fields.items()})
        save(tmp_path / "near.ply", wide)
    assert (tmp_path / "near.ply").read_bytes() == standard(fields)
    assert back.tobytes() == far["means"].tobytes()
    assert np.abs(back - origin - near).max() < 1e-8
    kinds = [line.split()[1:] for line in path.read_bytes().split(b"\n")[3:20]]
    assert [name for kind, name in kinds if kind == b"double"] == [b"x", b"y", b"z"]
    assert export_scene(path, exported) == (count, count)
    assert exported.read_bytes() == path.read_bytes()


def test_means_that_float32_moves_are_warned_about(tmp_path):
    fields = random_fields(50, 0)
    fields["log_scales"][:] = -3
    with jax.enable_x64(True):
        for name, by in {"near": 0.1, "far": 1e6}.items():
            moved = fields | {"means": fields["means"].astype(np.float64) + by}
            save(tmp_path / f"{name}.ply", make_gaussians(**moved))
    with jax.enable_x64(False):
        assert load(tmp_path / "near.ply").params.means.dtype == np.float32
        message = r"far\.ply: float32 moves \d+ of 50 .*by up to 0\.03.*x64"
        found = warned(message, load, tmp_path / "far.ply")
    np.testing.assert_allclose(found.params.means, fields["means"] + 1e6, rtol=1e-7)


def test_only_active_slots_are_written_in_order(tmp_path):
    fields = random_fields(6, 1)
    keep = np.asarray([True, False, True, True, False, True])
    gaussians = grow(select(make_gaussians(**fields), jnp.asarray(keep)), 10)
    write_ply(tmp_path / "a.ply", gaussians)
    kept = {name: array[keep] for name, array in fields.items()}
    assert_bits_equal(read_ply(tmp_path / "a.ply"), kept)
    write_ply(tmp_path / "b.ply", make_gaussians(**random_fields(0, 3)))
    empty = read_ply(tmp_path / "b.ply")
    assert (empty.capacity, empty.sh_degree, empty.active.any()) == (1, 3, False)


def test_an_existing_file_is_replaced_only_when_asked(tmp_path):
    first, second = random_fields(2, 0, 1), random_fields(3, 0, 2)
    path = tmp_path / "a.ply"
    save(path, make_gaussians(**first))
    rejects(r"a\.ply: exists.*overwrite=True", save, path, make_gaussians(**second))
    assert_bits_equal(load(path), first)
    save(path, make_gaussians(**second), overwrite=True)
    assert_bits_equal(load(path), second)


def test_values_that_are_not_finite_are_written_with_a_warning(tmp_path):
    fields = random_fields(4, 0)
    fields["means"][2] = np.nan, np.inf, -0.0
    with pytest.warns(UserWarning, match=r"a\.ply: 1 of the Gaussians written"):
        save(tmp_path / "a.ply", make_gaussians(**fields))
    assert (tmp_path / "a.ply").read_bytes() == standard(fields)
    rejects("drop_nonfinite", load, tmp_path / "a.ply")


@settings(max_examples=20, deadline=None)
@given(
    order=st.randoms(use_true_random=False),
    degree=st.integers(0, 4),
    normals=st.booleans(),
    kind=st.sampled_from(["binary_little_endian", "binary_big_endian", "ascii"]),
    eol=st.sampled_from(["\n", "\r\n"]),
)
def test_any_order_and_encoding_reads_the_same(
    tmp_path_factory, order, degree, normals, kind, eol
):
    fields = random_fields(3, degree)
    table = table_of(fields, normals=normals) | {"extra": np.ones(3, np.float32)}
    items = list(table.items())
    order.shuffle(items)
    content = ply_file(dict(items), kind=kind, eol=eol)
    path = put(tmp_path_factory.mktemp("ply"), content)
    assert_bits_equal(read_ply(path), fields)


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian"])
def test_other_scalar_types(tmp_path, kind):
    fields = random_fields(4, 0)
    fields["quats"] = np.asarray([[1, 0, 0, 0], [0, 2, 0, 0]] * 2, np.float32)
    types = dict.fromkeys(("x", "y", "opacity"), "double")
    types |= {f"rot_{i}": "uchar" for i in range(4)} | {"nx": "int"}
    path = put(tmp_path, ply_file(table_of(fields), kind=kind, types=types))
    assert_bits_equal(read_ply(path), fields)


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_other_elements_before_and_after(tmp_path, kind):
    fields = random_fields(3, 1)
    chunk = "element chunk 2\nproperty float a\nproperty uchar b"
    face = "element face 1\nproperty list uchar int vertex_indices"
    ascii_body, binary_body = b"1.0 2\n3.0 4\n", bytes(10)
    scalars = ascii_body if kind == "ascii" else binary_body
    lists = b"3 0 1 2\n" if kind == "ascii" else b"\3" + bytes(12)
    for after in ((chunk, scalars), (face, lists)):
        element = ply_file(
            table_of(fields),
            kind=kind,
            before=(chunk.replace("chunk", "first"), scalars),
            after=after,
        )
        assert_bits_equal(read_ply(put(tmp_path, element)), fields)
    content = ply_file(table_of(fields), kind=kind, before=(face, lists))
    rejects(r"element face has a list.*before vertex", read_ply, put(tmp_path, content))


@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_text_in_many_blocks(tmp_path, eol):
    fields = random_fields(5_000, 0)
    after = ("element extra 2\nproperty int a", f"1{eol}2{eol}".encode())
    content = ply_file(table_of(fields), kind="ascii", eol=eol, after=after)
    assert len(content) > 3 * BLOCK
    assert_bits_equal(read_ply(put(tmp_path, content)), fields)
    start = content.index(b"end_header") + len("end_header" + eol)
    lines = content[start:].split(eol.encode())
    for at in (0, 2_345, 4_999):
        before = start + sum(len(line) + len(eol) for line in lines[:at])
        bad = content[:before] + b"x" + content[before:]
        message = rf"vertex {at} \(byte {before}\): expected 17 numbers, got 'x"
        rejects(message, read_ply, put(tmp_path, bad))


@pytest.mark.parametrize("degree", [0, 3])
def test_agrees_with_plyfile(tmp_path, degree):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed")
    fields = random_fields(7, degree)
    write_ply(tmp_path / "a.ply", make_gaussians(**fields))
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    expected = table_of(fields)
    assert list(vertex.dtype.names) == list(expected)
    for name, column in expected.items():
        np.testing.assert_array_equal(vertex[name], column)
    for text, order in ((True, "="), (False, ">"), (False, "<")):
        element = plyfile.PlyElement.describe(np.asarray(vertex), "vertex")
        data = plyfile.PlyData([element], text=text, byte_order=order)
        data.write(str(tmp_path / "b.ply"))
        gaussians = read_ply(tmp_path / "b.ply")
        for name in FIELDS:
            found = np.asarray(getattr(gaussians.params, name))
            np.testing.assert_allclose(found, fields[name], rtol=1e-6 * text)


def assert_rejected(path: Path, message: str) -> None:
    """With this message, and before much is read or allocated."""
    start = time.perf_counter()
    rejects(rf"(?s)scene\.ply.*{message}", read_ply, path)
    assert time.perf_counter() - start < 1


def test_truncated_text(tmp_path):
    content = ply_file(table_of(random_fields(3, 0)), kind="ascii")
    warned("the last line has no newline", read_ply, put(tmp_path, content[:-1]))
    short = content[: content.rindex(b" ")]
    assert_rejected(put(tmp_path, short), r"vertex 2 \(byte \d+\): .* 17 .* got 16;")
    assert_rejected(put(tmp_path, short + b" one\n"), "vertex 2 .* got 'one'")
    gone = content[: content.rindex(b"\n", 0, -1) + 1] + b" " * 100 + b"\n"
    assert_rejected(put(tmp_path, gone), "vertex 2 .* got 0;")


GOOD = ply_file(table_of(random_fields(3, 0)))
COMMENT, COUNT = "comment made by a test", "vertex 3"
# (old, new) in the header of a good file, and the message.
BAD_HEADERS = [
    ("format binary_little_endian 1.0\n", "", "'format'"),
    ("binary_little", "binary_middle", "line 2.*one format"),
    ("endian 1.0", "endian 2.0", "line 2.*one format 1.0"),
    (COMMENT, "format ascii 1.0", r"line 3 \(byte 36\).*one format"),
    ("element vertex", "element corner", "corner"),
    ("end_header", "element vertex 3\nend_header", "declared twice"),
    ("float nx", "float x", "property float x.*declared twice"),
    (COUNT, "vertex", "line 4.*expected"),
    (COUNT, "vertex 3.5", "line 4.*expected"),
    (COUNT, "vertex " + "9" * 5000, "line 4"),
    (COUNT, "vertex 4", "truncated.*272 .*got 204"),
    ("property float x", "propertyfloat x", "line 5"),
    (COMMENT, "", "line 3"),
    (COMMENT, "property float a", "line 3.*property float a.*'element"),
]


@pytest.mark.parametrize("row", range(len(BAD_HEADERS)))
def test_bad_headers(tmp_path, row):
    old, new, message = BAD_HEADERS[row]
    content = GOOD.replace(old.encode(), new.encode())
    assert_rejected(put(tmp_path, content), message)


def renamed(change) -> bytes:
    """A file of degree 1 with properties renamed, or removed where that is None."""
    table = {change(k): v for k, v in table_of(random_fields(3, 1)).items()}
    return ply_file({k: v for k, v in table.items() if k is not None})


PACKED = ply_file({"packed_position": np.ones(3)}, types={"packed_position": "int"})
HUGE = GOOD.replace(b"vertex 3", b"vertex %d" % 2**63)
OTHER_FILES = [
    (b"ply\nend_header\n", "no 'format'"),
    (renamed(lambda k: k.replace("rest_4", "rest_40")), "properties f_rest_4;"),
    (
        renamed(lambda k: None if k[-2:] == "_8" else k),
        r"72\] properties f_rest.*got 8",
    ),
    (PACKED, "compressed"),
    (HUGE.replace(b"binary_little_endian", b"ascii"), "truncated.*at least"),
]


@pytest.mark.parametrize("row", range(len(OTHER_FILES)))
def test_other_files(tmp_path, row):
    content, message = OTHER_FILES[row]
    assert_rejected(put(tmp_path, content), message)


def test_rows_that_are_not_finite_are_named_or_dropped(tmp_path):
    fields = random_fields(9, 1)
    table = {k: v.astype(np.float64) for k, v in table_of(fields).items()}
    table["z"][1], table["f_rest_5"][4], table["opacity"][7] = np.inf, np.nan, np.nan
    path = put(tmp_path, ply_file(table, types=dict.fromkeys(table, "double")))
    message = (
        r"in 3 of 9 Gaussians .*means: 1, logit_opacities: 1, sh: 1.*"
        r"first: \[1, 4, 7\].*drop_nonfinite=True"
    )
    rejects(message, read_ply, path)
    gaussians = warned(r"3 of 9 .* dropped", read_ply, path, drop_nonfinite=True)
    assert_bits_equal(gaussians, {k: v[[0, 2, 3, 5, 6, 8]] for k, v in fields.items()})


def test_infinite_opacities_are_clamped(tmp_path):
    fields = random_fields(4, 0)
    fields["logit_opacities"][:2] = np.inf, -np.inf
    path = put(tmp_path, ply_file(table_of(fields)))
    with pytest.warns(UserWarning, match="2 opacities of ±inf"):
        found = np.asarray(read_ply(path).params.logit_opacities, np.float64)
    probabilities = 1 / (1 + np.exp(-found[:2]))
    np.testing.assert_allclose(probabilities, [1 - 2.0**-23, 2.0**-23], rtol=1e-6)
    slopes = jax.vmap(jax.grad(jax.nn.sigmoid))(jnp.float32(found[:2]))
    assert np.all(np.asarray(slopes) > 0)  # or training could never change them
    np.testing.assert_array_equal(found[2:], fields["logit_opacities"][2:])


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    """Scales become √(s² + σ²), and opacities are multiplied by Π s / Π scales."""
    fields, rng = random_fields(50, 1), np.random.default_rng(1)
    table = table_of(fields)
    sigmas = table["filter_3D"] = np.exp(rng.normal(-1, 2, 50)).astype(np.float32)
    sigmas[:4] = 0
    fields["logit_opacities"][2:6] = 60, -60, 60, -60
    read = read_ply(put(tmp_path, ply_file(table))).params
    scales = np.exp(fields["log_scales"].astype(np.float64))
    wide = np.sqrt(scales**2 + sigmas[:, None].astype(np.float64) ** 2)
    np.testing.assert_allclose(np.exp(read.log_scales), wide, rtol=3e-6)
    seen = 1 / (1 + np.exp(-fields["logit_opacities"].astype(np.float64)))
    seen *= np.prod(scales / wide, axis=1)
    found = 1 / (1 + np.exp(-np.asarray(read.logit_opacities, np.float64)))
    np.testing.assert_allclose(found, seen, rtol=3e-5)
    for name in ("means", "quats", "sh"):
        np.testing.assert_array_equal(getattr(read, name), fields[name])
    np.testing.assert_array_equal(read.log_scales[:4], fields["log_scales"][:4])


def zero_quaternion(fields):
    fields["quats"][2] = 0


def activated(fields):
    fields["logit_opacities"] = 1 / (1 + np.exp(-fields["logit_opacities"]))
    fields["log_scales"] = np.exp(fields["log_scales"])


@pytest.mark.parametrize(
    ("change", "kind", "tail", "message"),
    [
        (zero_quaternion, "ascii", b"", r"1 of 4 quaternions.*\[2\].*culled"),
        (activated, "ascii", b"", "looks like activated values"),
        (id, "binary_little_endian", b"12345", "5 bytes after the last element"),
        (id, "ascii", b"12345", "text after the last element"),
    ],
)
def test_suspicious_contents_are_warned_about(tmp_path, change, kind, tail, message):
    fields = random_fields(4, 0)
    change(fields)
    path = put(tmp_path, ply_file(table_of(fields), kind=kind) + tail)
    assert_bits_equal(warned(rf"scene\.ply: .*{message}", read_ply, path), fields)
