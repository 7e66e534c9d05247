"""PLY files round-trip bit by bit, and damaged ones are rejected by name.

Numbers of text files are parsed in bulk, exactly as Python's float reads them.
"""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import ply_file, rejects, warned
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gsjax.gaussians import Gaussians, grow, make_gaussians, select
from gsjax.io import formats
from gsjax.io.formats import load, save
from gsjax.io.numerals import BLOCK, find_words, parse_number, parse_numbers
from gsjax.io.ply import read_ply, render_mode, write_ply
from gsjax.io.spz import write_spz
from gsjax.raster.types import RasterConfig
from gsjax.runs.export import export_scene
from gsjax.runs.scene_source import open_scene_source

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
    assert len(gaussians.active.devices()) == jax.local_device_count()
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
    """Also through an export; near ones are written as float32, which moves others."""
    fields = random_fields(count, 0)
    fields["log_scales"][:] = -3
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
    with jax.enable_x64(False):
        assert load(tmp_path / "near.ply").params.means.dtype == np.float32
        message = rf"a\.ply: float32 moves \d+ of {count} .*by up to 0\.[12].*x64"
        rounded = warned(message, load, path).params.means
    np.testing.assert_allclose(rounded, far["means"], rtol=1e-7)


def test_only_active_slots_are_written_in_order(tmp_path):
    fields = random_fields(6, 1)
    keep = np.asarray([True, False, True, True, False, True])
    gaussians = grow(select(make_gaussians(**fields), jnp.asarray(keep)), 10)
    path = tmp_path / "a.ply"
    write_ply(path, gaussians)
    kept = {name: array[keep] for name, array in fields.items()}
    assert_bits_equal(read_ply(path), kept)
    write_ply(path, make_gaussians(**random_fields(0, 3)), overwrite=True)
    empty = read_ply(path)
    assert (empty.capacity, empty.sh_degree, empty.active.any()) == (1, 3, False)


BINARY = ("binary_little_endian", "binary_big_endian")
OTHER_TYPES = dict.fromkeys(("x", "y", "opacity"), "double") | {"nx": "int"}
OTHER_TYPES |= {f"rot_{i}": "uchar" for i in range(4)}


@settings(max_examples=40, deadline=None)
@given(
    order=st.randoms(use_true_random=False),
    degree=st.integers(0, 4),
    normals=st.booleans(),
    types=st.sampled_from([{}, OTHER_TYPES]),
    kind=st.sampled_from([*BINARY, "ascii"]),
    eol=st.sampled_from(["\n", "\r\n"]),
)
def test_any_order_types_and_encoding_read_the_same(
    tmp_path_factory, order, degree, normals, types, kind, eol
):
    fields = random_fields(3, degree)
    if types:
        fields["quats"] = np.float32([[1, 0, 0, 0], [0, 2, 0, 0], [3, 0, 0, 255]])
    table = table_of(fields, normals=normals) | {"extra": np.ones(3, np.float32)}
    items = list(table.items())
    order.shuffle(items)
    content = ply_file(dict(items), kind=kind, types=types, eol=eol)
    path = put(tmp_path_factory.mktemp("ply"), content)
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


WORDS = st.one_of(
    st.floats().map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.text("0123456789+-.eEinfatyINF_ x\uff11", min_size=1, max_size=6),
)
LINES = st.lists(st.lists(WORDS, max_size=5).map(" ".join), max_size=5)


@given(LINES, st.sampled_from(["\n", "\r\n", " \n"]), st.booleans())
@example(["1 2", "", " 3"], "\n", True)
@example(["1-2"], "\n", True)
@example(["1e", "nan(1)", "inf"], "\n", False)
@example(["1_0"], "\n", True)
@example(["\uff11"], "\n", True)
def test_bulk_parsing_agrees_with_python(lines, end, ended):
    text = end.join(lines) + end * ended
    raw, found = text.encode(), text.split("\n")
    words = find_words(np.frombuffer(raw, np.uint8))
    if not found[-1]:
        found = found[:-1]
    assert words.counts.tolist() == [len(line.split()) for line in found]
    assert words.first.tolist() == [0, *np.cumsum(words.counts)][: len(found)]
    assert [raw[at:].split()[0] for at in words.starts] == raw.split()
    if not text.split():
        return
    numbers = parse_numbers(np.frombuffer(raw, np.uint8), len(text.split()))
    try:
        expected = [parse_number(word) for word in text.split()]
    except ValueError:
        assert numbers is None
    else:
        np.testing.assert_array_equal(numbers, expected)


GOOD, ASCII = (
    ply_file(table_of(random_fields(3, 0)), kind=kind) for kind in (BINARY[0], "ascii")
)
COMMENT, COUNT = "comment made by a test", "vertex 3"
PACKED = ply_file({"packed_position": np.ones(3)}, types={"packed_position": "int"})


def changed(old: str, new: str, content: bytes = GOOD) -> bytes:
    """A file with another header."""
    return content.replace(old.encode(), new.encode())


def renamed(change) -> bytes:
    """A file of degree 1 with properties renamed, or removed where that is None."""
    table = {change(k): v for k, v in table_of(random_fields(3, 1)).items()}
    return ply_file({k: v for k, v in table.items() if k is not None})


BAD = [
    (b"ply\nend_header\n", "no 'format'"),
    (changed("binary_little", "binary_middle"), "line 2.*one format"),
    (changed("endian 1.0", "endian 2.0"), "line 2.*one format 1.0"),
    (changed(COMMENT, "format ascii 1.0"), r"line 3 \(byte 36\).*one format"),
    (changed("element vertex", "element corner"), "corner"),
    (changed("end_header", "element vertex 3\nend_header"), "declared twice"),
    (changed("float nx", "float x"), "property float x.*declared twice"),
    (changed(COUNT, "vertex"), "line 4.*expected"),
    (changed(COUNT, "vertex " + "9" * 5000), "line 4"),
    (changed(COUNT, f"vertex {2**63}", ASCII), "truncated.*at least"),
    (changed("property float x", "propertyfloat x"), "line 5"),
    (changed(COMMENT, ""), "line 3"),
    (changed(COMMENT, "property float a"), "line 3.*property float a.*'element"),
    (renamed(lambda k: k.replace("rest_4", "rest_40")), "properties f_rest_4;"),
    (
        renamed(lambda k: None if k[-2:] == "_8" else k),
        r"72\] properties f_rest.*got 8",
    ),
    (PACKED, "compressed PLY, got .* lacks .* vertex packed_rotation"),
    (ASCII[: ASCII.rindex(b" ")], r"vertex 2 \(byte \d+\): .* 17 .* got 16;"),
    # The last line is empty.
    (ASCII[: ASCII.rindex(b"\n", 0, -1)] + b"\n" + b" " * 99 + b"\n", "2 .* got 0;"),
]


@pytest.mark.parametrize("row", range(len(BAD)))
def test_damaged_files_are_rejected_at_once(tmp_path, row):
    content, message = BAD[row]
    path, start = put(tmp_path, content), time.perf_counter()
    rejects(rf"(?s)scene\.ply.*{message}", read_ply, path)
    assert time.perf_counter() - start < 1


def test_rows_that_are_not_finite_are_named_or_dropped(tmp_path):
    """They are written with a warning."""
    fields, path = random_fields(9, 1), tmp_path / "a.ply"
    fields["means"][1] = np.nan, np.inf, -0.0
    fields["sh"][4, 2, 1] = fields["logit_opacities"][7] = np.nan
    told = r"a\.ply: 3 of the Gaussians written"
    warned(told, save, path, make_gaussians(**fields))
    assert path.read_bytes() == standard(fields)
    message = (
        r"in 3 of 9 Gaussians .*means: 1, logit_opacities: 1, sh: 1.*"
        r"first: \[1, 4, 7\].*drop_nonfinite=True"
    )
    rejects(message, load, path)
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


@pytest.mark.parametrize("third", ["absent", "-inf", "given"])
def test_files_of_surfels(tmp_path, third):
    """A third scale that is absent or −inf is thin; the render mode is kept."""
    fields = random_fields(20, 0)
    table = table_of(fields)
    if third == "absent":
        del table["scale_2"]
    elif third == "-inf":
        table["scale_2"] = np.full(20, -np.inf, np.float32)
    content = ply_file(table)
    if third != "absent":
        line = b"comment SPLATRENDERMODE: 2DGS"
        content = content.replace(b"comment made by a test", line)
    path = put(tmp_path, content)
    assert render_mode(path) == "2dgs"
    read = load(path).params
    wanted = fields["log_scales"].copy()
    if third != "given":
        wanted[:, 2] = wanted[:, :2].min(1) - 7
    np.testing.assert_allclose(read.log_scales, wanted, rtol=1e-6)
    assert open_scene_source(path).config.primitive == "surfel"
    out = tmp_path / "out.ply"
    export_scene(path, out)
    assert render_mode(out) == "2dgs"
    assert b"comment SplatRenderMode: 2dgs\n" in out.read_bytes()
    np.testing.assert_array_equal(load(out).params.log_scales, read.log_scales)


def test_files_of_ellipsoids_have_no_render_mode(tmp_path):
    path = put(tmp_path, standard(random_fields(5, 1)))
    assert render_mode(path) is None
    assert open_scene_source(path).config == RasterConfig.compat()


@pytest.mark.filterwarnings("ignore:.*trained with antialiasing")
@pytest.mark.filterwarnings("ignore:.*Gaussians have")
@pytest.mark.parametrize("first", [".ply", ".spz"])
def test_the_mark_of_mip_splatting_is_kept_by_exports(tmp_path, first):
    """A comment of PLY, a flag of SPZ: drawn with the filter, and passed on."""
    plain, source = tmp_path / "plain.ply", tmp_path / f"source{first}"
    gaussians = load(put(tmp_path, standard(random_fields(5, 1))))
    if first == ".ply":
        write_ply(source, gaussians, mode="mip")
    else:
        write_spz(source, gaussians, mode="mip")
    write_ply(plain, gaussians)
    mip = RasterConfig(dilation=0.1, antialias=True)
    for suffix in (".ply", ".spz"):
        for start, config in ((source, mip), (plain, RasterConfig.compat())):
            out = tmp_path / f"{start.stem}-out{suffix}"
            export_scene(start, out)
            assert open_scene_source(out).config == config
            if suffix == ".spz":
                assert (formats.render_mode(out) == "mip") == (config == mip)
            fast = open_scene_source(out, raster=RasterConfig.fast()).config
            assert fast.dilation == config.dilation
            assert fast.alpha_max == RasterConfig.fast().alpha_max


def zero_quaternion(fields):
    fields["quats"][2] = 0


def activated(fields):
    fields["logit_opacities"] = 1 / (1 + np.exp(-fields["logit_opacities"]))
    fields["log_scales"] = np.exp(fields["log_scales"])


@pytest.mark.parametrize(
    ("change", "kind", "end", "message"),
    [
        (zero_quaternion, "ascii", b"\n", r"1 of 4 quaternions.*\[2\].*culled"),
        (activated, "ascii", b"\n", "looks like activated values"),
        (id, "ascii", b"\n12345", "text after the last element"),
        (id, "ascii", b"", "the last line has no newline"),
        (id, "binary_little_endian", b"12345", "5 bytes after the last element"),
    ],
)
def test_suspicious_contents_are_warned_about(tmp_path, change, kind, end, message):
    fields = random_fields(4, 0)
    change(fields)
    content = ply_file(table_of(fields), kind=kind)
    path = put(tmp_path, (content[:-1] if kind == "ascii" else content) + end)
    assert_bits_equal(warned(rf"scene\.ply: .*{message}", read_ply, path), fields)
