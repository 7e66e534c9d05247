"""PLY files: what is written comes back, what is damaged is refused by name."""

import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, grow, make_gaussians, select
from gsjax.io.formats import load, save
from gsjax.io.numerals import BLOCK
from gsjax.io.ply import read_ply, write_ply
from gsjax.runs.export import export_scene

GUITAR = Path(__file__).resolve().parents[3] / "shared" / "data" / "guitar/guitar.ply"
FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def random_fields(count: int, degree: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3)]
    return {
        name: rng.normal(-1, 2, (count, *shape)).astype(np.float32)
        for name, shape in zip(FIELDS, shapes)
    }


def table_of(fields: dict[str, np.ndarray], *, normals=True) -> dict[str, np.ndarray]:
    """Columns in the standard order, written out apart from the library's own."""
    count, bases = fields["sh"].shape[:2]
    table = {name: fields["means"][:, i] for i, name in enumerate("xyz")}
    if normals:
        table |= {name: np.zeros(count, np.float32) for name in ("nx", "ny", "nz")}
    for channel in range(3):
        table[f"f_dc_{channel}"] = fields["sh"][:, 0, channel]
    index = 0
    for channel in range(3):
        for basis in range(1, bases):
            table[f"f_rest_{index}"] = fields["sh"][:, basis, channel]
            index += 1
    table["opacity"] = fields["logit_opacities"]
    for i in range(3):
        table[f"scale_{i}"] = fields["log_scales"][:, i]
    for i in range(4):
        table[f"rot_{i}"] = fields["quats"][:, i]
    return table


def encode(
    table: dict[str, np.ndarray],
    *,
    kind: str = "binary_little_endian",
    types: dict[str, str] | None = None,
    eol: str = "\n",
    before: tuple[str, bytes] = ("", b""),
    after: tuple[str, bytes] = ("", b""),
) -> bytes:
    """A PLY file; ``before`` and ``after`` are header lines and body of elements."""
    count = len(next(iter(table.values())))
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}
    types = dict.fromkeys(table, "float") | (types or {})
    lines = ["ply", f"format {kind} 1.0", "comment made by a test"]
    lines += before[0].splitlines() + [f"element vertex {count}"]
    lines += [f"property {types[name]} {name}" for name in table]
    lines += after[0].splitlines() + ["end_header", ""]
    header = eol.join(lines).encode()
    if kind == "ascii":
        rows = zip(*(table[name] for name in table))
        text = "".join(" ".join(repr(float(v)) for v in row) + eol for row in rows)
        return header + before[1] + text.encode() + after[1]
    order = "<" if kind == "binary_little_endian" else ">"
    dtype = [(name, order + codes[types[name]]) for name in table]
    body = np.zeros(count, dtype)
    for name, column in table.items():
        body[name] = column
    return header + before[1] + body.tobytes() + after[1]


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


# --- what is written comes back ---


@pytest.mark.parametrize("degree", range(5))
def test_round_trip_is_bit_exact(tmp_path, degree):
    fields = random_fields(17, degree)
    path = tmp_path / "scene.PLY"
    save(path, make_gaussians(**fields))
    assert_bits_equal(load(path), fields)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.PLY"]


def test_written_bytes_are_the_standard_layout(tmp_path):
    fields = random_fields(5, 2)
    write_ply(tmp_path / "a.ply", make_gaussians(**fields))
    wanted = encode(table_of(fields)).replace(b"comment made by a test\n", b"")
    assert (tmp_path / "a.ply").read_bytes() == wanted


@pytest.mark.parametrize("count", [1, 40_000])
def test_far_means_come_back_bit_by_bit(tmp_path, count):
    fields = random_fields(count, 0)
    near, origin = fields["means"], np.asarray([4e6, -5e6, 123.456])
    path = tmp_path / "a.ply"
    with jax.enable_x64(True):
        far = fields | {"means": near + origin}
        save(path, make_gaussians(**far))
        back = np.asarray(load(path).params.means)
    assert back.tobytes() == far["means"].tobytes()
    assert np.abs(back - origin - near).max() < 1e-8
    kinds = [line.split()[1:] for line in path.read_bytes().split(b"\n")[3:20]]
    wide = [name for kind, name in kinds if kind == b"double"]
    assert wide == [b"x", b"y", b"z"]


def test_float64_that_float32_holds_is_written_as_the_standard_layout(tmp_path):
    fields = random_fields(7, 1)
    fields["means"][3] = np.nan, np.inf, -0.0
    with jax.enable_x64(True):
        wide = make_gaussians(**{k: v.astype(np.float64) for k, v in fields.items()})
        assert wide.params.means.dtype == np.float64
        with pytest.warns(UserWarning, match="1 of the Gaussians"):
            save(tmp_path / "a.ply", wide)
    assert (tmp_path / "a.ply").read_bytes() == encode(table_of(fields)).replace(
        b"comment made by a test\n", b""
    )


def test_means_that_float32_moves_are_told(tmp_path):
    fields = random_fields(50, 0)
    fields["log_scales"][:] = -3
    near = tmp_path / "near.ply"
    shifted = {"near": 0.1, "far": 1e6}
    with jax.enable_x64(True):
        for name, by in shifted.items():
            moved = fields | {"means": fields["means"].astype(np.float64) + by}
            save(tmp_path / f"{name}.ply", make_gaussians(**moved))
    with jax.enable_x64(False):
        assert load(near).params.means.dtype == np.float32
        wanted = r"far\.ply: \d+ of 50 .*float32 moves them, by up to 0\.03.*x64"
        with pytest.warns(UserWarning, match=wanted):
            means = np.asarray(load(tmp_path / "far.ply").params.means)
    np.testing.assert_allclose(means, fields["means"] + 1e6, rtol=1e-7)


def test_an_export_loses_nothing(tmp_path):
    fields = random_fields(5, 0)
    first, second = tmp_path / "a.ply", tmp_path / "b.ply"
    with jax.enable_x64(True):
        far = fields["means"] + np.asarray([1e7, 0, 0.1])
        save(first, make_gaussians(**fields | {"means": far}))
    assert export_scene(first, second) == (5, 5)
    assert second.read_bytes() == first.read_bytes()


def test_more_rows_than_a_piece(tmp_path):
    fields = random_fields(40_000, 0)
    write_ply(tmp_path / "a.ply", make_gaussians(**fields))
    assert_bits_equal(read_ply(tmp_path / "a.ply"), fields)


def test_only_active_slots_are_written_in_order(tmp_path):
    fields = random_fields(6, 1)
    keep = np.asarray([True, False, True, True, False, True])
    gaussians = grow(select(make_gaussians(**fields), jnp.asarray(keep)), 10)
    write_ply(tmp_path / "a.ply", gaussians)
    kept = {name: array[keep] for name, array in fields.items()}
    assert_bits_equal(read_ply(tmp_path / "a.ply"), kept)


def test_no_gaussians_round_trip(tmp_path):
    write_ply(tmp_path / "a.ply", make_gaussians(**random_fields(0, 3)))
    gaussians = read_ply(tmp_path / "a.ply")
    assert (gaussians.capacity, gaussians.sh_degree) == (1, 3)
    assert not gaussians.active.any()


def test_existing_file_is_replaced_only_when_asked(tmp_path):
    first, second = random_fields(2, 0, 1), random_fields(3, 0, 2)
    path = tmp_path / "a.ply"
    save(path, make_gaussians(**first))
    with pytest.raises(InputError, match=r"a\.ply: exists.*overwrite=True"):
        save(path, make_gaussians(**second))
    assert_bits_equal(load(path), first)
    save(path, make_gaussians(**second), overwrite=True)
    assert_bits_equal(load(path), second)


def test_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    fields = random_fields(2, 0)
    save(path, make_gaussians(**fields))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"a\.ply: cannot be written: No space"):
        save(path, make_gaussians(**random_fields(3, 0)), overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]
    assert_bits_equal(load(path), fields)


def test_bad_targets(tmp_path):
    gaussians = make_gaussians(**random_fields(1, 0))
    with pytest.raises(InputError, match=r"none.* is missing; create it"):
        save(tmp_path / "none" / "a.ply", gaussians)
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError, match=r"folder\.ply: is a folder"):
        save(tmp_path / "folder.ply", gaussians, overwrite=True)
    for call in (load, lambda path: save(path, gaussians)):
        with pytest.raises(InputError, match=r"a\.obj: .*'\.obj'.*known: \.ply"):
            call(tmp_path / "a.obj")


def test_values_not_finite_are_written_with_a_warning(tmp_path):
    fields = random_fields(4, 0)
    fields["means"][2, 1] = np.nan
    with pytest.warns(UserWarning, match=r"a\.ply: 1 of the Gaussians written"):
        save(tmp_path / "a.ply", make_gaussians(**fields))
    with pytest.raises(InputError, match="drop_nonfinite"):
        load(tmp_path / "a.ply")


# --- every form of the same file ---


@settings(max_examples=20, deadline=None)
@given(
    order=st.randoms(use_true_random=False),
    degree=st.integers(0, 4),
    normals=st.booleans(),
    kind=st.sampled_from(["binary_little_endian", "binary_big_endian", "ascii"]),
    eol=st.sampled_from(["\n", "\r\n"]),
)
def test_any_order_and_form_reads_the_same(
    tmp_path_factory, order, degree, normals, kind, eol
):
    fields = random_fields(3, degree)
    table = table_of(fields, normals=normals) | {"extra": np.ones(3, np.float32)}
    items = list(table.items())
    order.shuffle(items)
    content = encode(dict(items), kind=kind, eol=eol)
    path = put(tmp_path_factory.mktemp("ply"), content)
    assert_bits_equal(read_ply(path), fields)


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian"])
def test_other_scalar_types(tmp_path, kind):
    fields = random_fields(4, 0)
    fields["quats"] = np.asarray([[1, 0, 0, 0], [0, 2, 0, 0]] * 2, np.float32)
    types = dict.fromkeys(("x", "y", "opacity"), "double")
    types |= {f"rot_{i}": "uchar" for i in range(4)} | {"nx": "int"}
    path = put(tmp_path, encode(table_of(fields), kind=kind, types=types))
    assert_bits_equal(read_ply(path), fields)


def test_double_beyond_float32_is_not_finite(tmp_path):
    table = {k: v.astype(np.float64) for k, v in table_of(random_fields(3, 0)).items()}
    table["x"][1] = np.nan
    table["y"][2] = np.inf
    path = put(tmp_path, encode(table, types=dict.fromkeys(table, "double")))
    with pytest.raises(InputError, match=r"2 of 3 .*means: 2.*\[1, 2\]"):
        read_ply(path)


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_other_elements_before_and_after(tmp_path, kind):
    fields = random_fields(3, 1)
    chunk = "element chunk 2\nproperty float a\nproperty uchar b"
    face = "element face 1\nproperty list uchar int vertex_indices"
    ascii_body, binary_body = b"1.0 2\n3.0 4\n", bytes(10)
    scalars = ascii_body if kind == "ascii" else binary_body
    lists = b"3 0 1 2\n" if kind == "ascii" else b"\3" + bytes(12)
    for after in ((chunk, scalars), (face, lists)):
        element = encode(
            table_of(fields),
            kind=kind,
            before=(chunk.replace("chunk", "first"), scalars),
            after=after,
        )
        assert_bits_equal(read_ply(put(tmp_path, element)), fields)
    content = encode(table_of(fields), kind=kind, before=(face, lists))
    with pytest.raises(InputError, match=r"element face has a list.*before vertex"):
        read_ply(put(tmp_path, content))


@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_text_in_many_blocks(tmp_path, eol):
    fields = random_fields(5_000, 0)
    after = ("element extra 2\nproperty int a", f"1{eol}2{eol}".encode())
    content = encode(table_of(fields), kind="ascii", eol=eol, after=after)
    assert len(content) > 3 * BLOCK
    assert_bits_equal(read_ply(put(tmp_path, content)), fields)
    start = content.index(b"end_header") + len("end_header" + eol)
    lines = content[start:].split(eol.encode())
    for at in (0, 2_345, 4_999):
        before = start + sum(len(line) + len(eol) for line in lines[:at])
        bad = content[:before] + b"x" + content[before:]
        wanted = rf"vertex {at} \(byte {before}\): could not convert string .*'x"
        with pytest.raises(InputError, match=wanted):
            read_ply(put(tmp_path, bad))


@pytest.mark.parametrize("degree", [0, 3])
def test_agrees_with_plyfile(tmp_path, degree):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed")
    fields = random_fields(7, degree)
    write_ply(tmp_path / "a.ply", make_gaussians(**fields))
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    wanted = table_of(fields)
    assert list(vertex.dtype.names) == list(wanted)
    for name, column in wanted.items():
        np.testing.assert_array_equal(vertex[name], column)
    for text, order in ((True, "="), (False, ">"), (False, "<")):
        element = plyfile.PlyElement.describe(np.asarray(vertex), "vertex")
        data = plyfile.PlyData([element], text=text, byte_order=order)
        data.write(str(tmp_path / "b.ply"))
        gaussians = read_ply(tmp_path / "b.ply")
        for name in FIELDS:
            found = np.asarray(getattr(gaussians.params, name))
            np.testing.assert_allclose(found, fields[name], rtol=1e-6 * text)


@pytest.mark.skipif(not GUITAR.is_file(), reason="../shared/data/guitar is absent")
def test_guitar():
    # Its exporter stored opacities of exactly 1 as a logit of +inf.
    with pytest.warns(UserWarning, match=r"guitar\.ply: 667 opacities") as caught:
        gaussians = load(GUITAR)
    assert len(caught) == 1
    assert (gaussians.capacity, gaussians.sh_degree) == (90854, 0)
    assert gaussians.active.all()
    norms = np.linalg.norm(np.asarray(gaussians.params.quats), axis=1)
    assert np.median(norms) == pytest.approx(1, abs=0.5)
    assert np.median(np.asarray(gaussians.params.log_scales)) < 0


# --- what is damaged is refused ---


def test_every_truncation_is_refused_quickly(tmp_path):
    content = encode(table_of(random_fields(3, 0)))
    path = tmp_path / "scene.ply"
    for size in range(len(content)):
        path.write_bytes(content[:size])
        start = time.perf_counter()
        with pytest.raises(InputError, match=r"scene\.ply"):
            read_ply(path)
        assert time.perf_counter() - start < 1, size
    assert read_ply(put(tmp_path, content)).capacity == 3


def test_truncated_ascii(tmp_path):
    content = encode(table_of(random_fields(3, 0)), kind="ascii")
    with pytest.warns(UserWarning, match="the last line has no end"):
        read_ply(put(tmp_path, content[:-1]))
    short = content[: content.rindex(b" ")]
    with pytest.raises(InputError, match=r"vertex 2 \(byte \d+\): found 16 .* 17"):
        read_ply(put(tmp_path, short))
    wrong = content[: content.rindex(b" ")] + b" one\n"
    with pytest.raises(InputError, match=r"vertex 2 .*'?one'?.*pass numbers"):
        read_ply(put(tmp_path, wrong))


GOOD = encode(table_of(random_fields(3, 0)))
BAD_FILES = {
    "empty": (b"", "byte 0: found b''"),
    "other magic": (b"solid stl\n", "byte 0.*solid"),
    "png": (b"\x89PNG\r\n\x1a\n" + bytes(100), "byte 0.*PNG"),
    "zeros": (bytes(5000), "byte 0"),
    "no end_header": (b"ply\n" + b"comment x\n" * 300_000, "no line 'end_header'"),
    "nothing between": (b"ply\nend_header\n", "no 'format'"),
    "no format": (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "'format'"),
    "format": (GOOD.replace(b"binary_little", b"binary_middle"), "line 2.*one format"),
    "version": (GOOD.replace(b"endian 1.0", b"endian 2.0"), "line 2.*one format, 1.0"),
    "format twice": (
        GOOD.replace(b"comment made", b"format ascii 1.0\ncomment made"),
        r"line 3 \(byte 36\).*one format",
    ),
    "no vertex": (GOOD.replace(b"element vertex", b"element corner"), "corner"),
    "vertex twice": (
        GOOD.replace(b"end_header", b"element vertex 3\nend_header"),
        "declared twice",
    ),
    "property twice": (
        GOOD.replace(b"float nx", b"float x"),
        "property float x.*declared twice",
    ),
    "negative count": (GOOD.replace(b"vertex 3", b"vertex -3"), "line 4.*-3.*wanted"),
    "no count": (GOOD.replace(b"vertex 3", b"vertex"), "line 4.*wanted"),
    "fractional count": (GOOD.replace(b"vertex 3", b"vertex 3.5"), "line 4.*wanted"),
    "2**63 vertices": (
        GOOD.replace(b"vertex 3", b"vertex %d" % 2**63),
        rf"truncated.*{68 * 2**63} bytes.*204 are there",
    ),
    "many digits": (GOOD.replace(b"vertex 3", b"vertex " + b"9" * 5000), "line 4"),
    "one more vertex": (
        GOOD.replace(b"vertex 3", b"vertex 4"),
        "truncated.*272 bytes.*204 are there",
    ),
    "2**63 ascii": (
        GOOD.replace(b"vertex 3", b"vertex %d" % 2**63).replace(
            b"binary_little_endian", b"ascii"
        ),
        "truncated.*at least",
    ),
    "unknown type": (GOOD.replace(b"float x", b"half x"), "half x.*unknown type"),
    "malformed": (GOOD.replace(b"property float x", b"propertyfloat x"), "line 5"),
    "blank line": (GOOD.replace(b"comment made by a test", b""), "line 3"),
    "property first": (
        GOOD.replace(b"comment made by a test", b"property float a"),
        "line 3.*property float a.*'element",
    ),
    "list in vertex": (
        GOOD.replace(b"property float nx", b"property list uchar int nx"),
        r"list properties \['nx'\]",
    ),
    "missing": (
        GOOD.replace(b"float rot_3", b"float a").replace(b"float opacity", b"float b"),
        "lacks the properties opacity, rot_3;",
    ),
    "f_rest gap": (
        encode(
            {
                k.replace("rest_4", "rest_40"): v
                for k, v in table_of(random_fields(3, 1)).items()
            }
        ),
        "lacks the properties f_rest_4;",
    ),
    "f_rest count": (
        encode(
            {k: v for k, v in table_of(random_fields(3, 1)).items() if k[-2:] != "_8"}
        ),
        r"8 properties f_rest.*\[0, 9, 24, 45, 72\]",
    ),
    "point cloud": (
        encode({n: np.ones(3) for n in ("x", "y", "z", "red", "green", "blue")}),
        "is a point cloud.*not a Gaussian PLY",
    ),
    "compressed": (
        encode({"packed_position": np.ones(3)}, types={"packed_position": "int"}),
        "compressed",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files(tmp_path, name):
    content, wanted = BAD_FILES[name]
    path = put(tmp_path, content)
    start = time.perf_counter()
    with pytest.raises(InputError, match=rf"(?s)scene\.ply.*{wanted}"):
        read_ply(path)
    assert time.perf_counter() - start < 1


def test_missing_file_folder_and_pipe(tmp_path):
    with pytest.raises(InputError, match=r"none\.ply: cannot be read: No such file"):
        load(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError, match=r"folder\.ply: not a regular file"):
        load(tmp_path / "folder.ply")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.ply")
        with pytest.raises(InputError, match=r"pipe\.ply: not a regular file"):
            load(tmp_path / "pipe.ply")


def test_rows_not_finite_are_named_or_dropped(tmp_path):
    fields = random_fields(9, 1)
    fields["means"][1, 2] = np.inf
    fields["sh"][4, 3, 1] = np.nan
    fields["logit_opacities"][7] = np.nan
    path = put(tmp_path, encode(table_of(fields)))
    wanted = (
        r"3 of 9 Gaussians .*means: 1, logit_opacities: 1, sh: 1.*"
        r"first: \[1, 4, 7\].*drop_nonfinite=True"
    )
    with pytest.raises(InputError, match=wanted):
        read_ply(path)
    with pytest.warns(UserWarning, match=r"3 of 9 .* dropped"):
        gaussians = read_ply(path, drop_nonfinite=True)
    kept = {k: v[[0, 2, 3, 5, 6, 8]] for k, v in fields.items()}
    assert_bits_equal(gaussians, kept)


def test_infinite_opacities_are_clamped(tmp_path):
    fields = random_fields(4, 0)
    fields["logit_opacities"][:2] = np.inf, -np.inf
    path = put(tmp_path, encode(table_of(fields)))
    with pytest.warns(UserWarning, match="2 opacities of ±inf"):
        found = np.asarray(read_ply(path).params.logit_opacities, np.float64)
    probabilities = 1 / (1 + np.exp(-found[:2]))
    np.testing.assert_allclose(probabilities, [1 - 2.0**-23, 2.0**-23], rtol=1e-6)
    slopes = jax.vmap(jax.grad(jax.nn.sigmoid))(jnp.float32(found[:2]))
    assert np.all(np.asarray(slopes) > 0)  # or training could never change them
    np.testing.assert_array_equal(found[2:], fields["logit_opacities"][2:])


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    """Scales √(s² + σ²), and as much to be seen of each: opacity × Π s / Π scales."""
    fields, rng = random_fields(50, 1), np.random.default_rng(1)
    table = table_of(fields)
    sigmas = table["filter_3D"] = np.exp(rng.normal(-1, 2, 50)).astype(np.float32)
    sigmas[:4] = 0
    fields["logit_opacities"][2:6] = 60, -60, 60, -60
    read = read_ply(put(tmp_path, encode(table))).params
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


def test_zero_quaternions_are_warned_of(tmp_path):
    fields = random_fields(4, 0)
    fields["quats"][2] = 0
    path = put(tmp_path, encode(table_of(fields)))
    with pytest.warns(UserWarning, match=r"1 of 4 quaternions.*\[2\].*culled"):
        assert_bits_equal(read_ply(path), fields)


def test_activated_values_are_warned_of(tmp_path):
    fields = random_fields(20, 0)
    fields["logit_opacities"] = 1 / (1 + np.exp(-fields["logit_opacities"]))
    fields["log_scales"] = np.exp(fields["log_scales"])
    path = put(tmp_path, encode(table_of(fields)))
    with pytest.warns(UserWarning, match="looks like activated values"):
        assert_bits_equal(read_ply(path), fields)


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_trailing_bytes_are_warned_of(tmp_path, kind):
    fields = random_fields(3, 0)
    path = put(tmp_path, encode(table_of(fields), kind=kind) + b"12345")
    with pytest.warns(UserWarning, match=r"scene\.ply: .*after the last element"):
        assert_bits_equal(read_ply(path), fields)
