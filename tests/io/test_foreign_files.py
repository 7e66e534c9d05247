"""Files that other programs wrote, compared with the values that others read in them.

The files, their writers and the decoders are described beside them, in
../shared/data/formats/README.md.
"""

import json
import time
import tracemalloc
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from conftest import DATA
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.errors import InputError
from gsjax.io import formats
from gsjax.io.spz import read_spz

pytestmark = pytest.mark.usefixtures("float32")
FOLDER = DATA / "formats"
SUFFIXES = (".compressed.ply", ".spz", ".splat", ".ksplat")


class Foreign(NamedTuple):
    """A file, and the arrays that hold its values.

    Attributes:
      file: path below the folder.
      frame: axes to read it in, where its writer and the file do not say.
      values: the file whose arrays apply; itself if empty.
      axes: "_rdf" if those arrays are chosen that are turned to the axes of PLY files.
    """

    file: str
    frame: str = ""
    values: str = ""
    axes: str = ""


def foreign_files() -> list[Foreign]:
    sh3, sh1, misc = "synthetic/sh3/sh3", "synthetic/sh1/sh1", "synthetic/misc/"
    extreme, mip = "synthetic/extreme/extreme", "synthetic/extreme_mip/extreme_mip"
    names = (sh3, sh1, extreme, mip, f"{misc}one", f"{misc}flat", "guitar/guitar")
    rows = [Foreign(f"{name}.compressed.ply") for name in names]
    rows += [Foreign(f"{name}.splat") for name in (sh3, sh1, extreme, *names[4:6])]
    rows += [Foreign(f"{name}.ply2splat.splat") for name in (sh3, extreme)]
    levels = (sh3, 1), (sh3, 2), (sh1, 1), *((extreme, level) for level in range(3))
    rows += [Foreign(f"{name}.l{level}.ksplat") for name, level in levels]
    # splat-transform does not turn the axes.
    rows += [Foreign(f"{name}.st.v4.spz", "rdf") for name in names]
    for name in (extreme, mip):
        rows.append(Foreign(f"{name}.st.v3.spz", "rdf", f"{name}.st.v4.spz"))
    for name in (sh3, extreme, mip):
        v4 = f"{name}.niantic.v4.spz"
        rows += [Foreign(f"{name}.niantic.v2.spz", "", "", "_rdf")]
        rows += [Foreign(f"{name}.niantic.v3.spz", "", v4, "_rdf")]
    for name in (sh3, sh1, extreme, mip):
        rows += [Foreign(f"{name}.niantic.v4.spz", "", "", "_rdf")]
        rows += [Foreign(f"{name}.niantic.v4.spz", "rdf")]
    stored = ("deg4.niantic.v4", "overflow.niantic.v4", "fractional8.gsply.v3")
    rows += [
        Foreign(f"{misc}{n}.spz", "rdf") for n in (*stored, "fractional8.gsply.v4")
    ]
    base, recorded = f"{mip}.niantic.v4.spz", f"{misc}ext_orbit_and_coordsys_RDF.v4.spz"
    rows += [Foreign(f"{misc}ext_unknown_vendor.v4.spz", "", base, "_rdf")]
    # The axes that a file records take precedence.
    return [*rows, *(Foreign(recorded, frame, base) for frame in ("", "rub", "rdf"))]


FILES = foreign_files()
BAD = (
    "compressed_ply_too_few_chunks_for_vertices.compressed.ply",
    "compressed_ply_truncated_vertices.compressed.ply",
    "ksplat_huge_section_count.ksplat",
    "ksplat_truncated.ksplat",
    "ply_huge_vertex_count_4000000000.ply",
    "ply_nan_in_7_rows_valid_structure.ply",
    "ply_truncated_body.ply",
    "splat_nan_position_negative_scale.splat",
    "splat_size_not_multiple_of_32.splat",
    "spz_v3_gzip_bomb_60MB_after_40_gaussians.spz",
    "spz_v3_gzip_truncated.spz",
    "spz_v4_huge_count_4294967295.spz",
    "spz_v4_toc_claims_2pow40_bytes.spz",
    "spz_v4_truncated_last_stream.spz",
    "spz_v4_wrong_magic.spz",
)


def place(name: str) -> Path:
    """Return the path of a file, or skip where the data are absent."""
    if not FOLDER.is_dir():
        pytest.skip(f"{name} is absent (../shared/data/formats)")
    return FOLDER / name


def matrices(quats) -> np.ndarray:
    w, *xyz = np.asarray(quats, np.float64).T
    return Rotation.from_quat(np.stack([*xyz, w], -1)).as_matrix()


def opacities(logits) -> np.ndarray:
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def expected_arrays(row: Foreign) -> tuple[dict[str, np.ndarray], dict]:
    """Return the values of a file by name, with "order" and "rows", and its notes."""
    path = place(f"{row.values or row.file}.expected.npz")
    arrays = dict(np.load(path))
    notes = json.loads(str(arrays.pop("info")))
    if "v2" in row.file:  # which has only what differs from version 4
        other = Foreign(row.file.replace("v2", "v4"), row.frame, "", row.axes)
        arrays = expected_arrays(other)[0] | arrays
    for name in ("means", "quats", "sh"):
        arrays[name] = arrays.get(name + row.axes, arrays[name])
    # The first viewer's reading, which its writers invert.
    arrays["quats"] = arrays.get("quats_b128", arrays["quats"])
    return arrays, notes


def load(row: Foreign) -> gsjax.Gaussians:
    path = place(row.file)
    return read_spz(path, frame=row.frame) if row.frame else gsjax.load(path)


@pytest.mark.filterwarnings("ignore:.*trained with antialiasing")
@pytest.mark.filterwarnings("ignore:.*extensions of type 0x12340001 are ignored")
@pytest.mark.parametrize("row", FILES, ids=lambda row: f"{row.file}-{row.frame}")
def test_values_are_those_that_others_read(row):
    expected, notes = expected_arrays(row)
    rows = expected.get("rows", slice(None))
    params = load(row).params
    found = {name: np.asarray(array)[rows] for name, array in vars(params).items()}
    for name, bound in (("means", 1e-6), ("log_scales", 2e-6), ("sh", 1e-6)):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-7, atol=bound)
    # The bytes 0 and 255 stand for a quarter of a step within.
    shares = (opacities(one["logit_opacities"]) for one in (found, expected))
    np.testing.assert_allclose(*shares, atol=0.2501 / 255, rtol=0)
    # Of these no other reading of quaternions in bytes is given.
    coarse = row.file.endswith(".splat") and "quats_b128" not in expected
    turns = (matrices(one["quats"]) for one in (found, expected))
    np.testing.assert_allclose(*turns, atol=0.02 if coarse else 3e-5)
    source = place(row.file).parent / notes.get("source", "none")
    if source.exists() and row.axes == "_rdf" * ("niantic" in row.file):
        means = np.asarray(gsjax.load(source).params.means)
        error = np.abs(np.asarray(params.means) - means[expected["order"]]).max()
        assert error <= notes["max_error_vs_source"]["means_abs"] * 1.001 + 1e-6


def test_no_file_is_left_out():
    folder = place(".")
    found = {str(path.relative_to(folder)) for path in folder.rglob("*.*")}
    ours = {name for name in found if name.endswith(SUFFIXES)}
    assert {row.file for row in FILES} == {n for n in ours if not n.startswith("bad/")}
    assert {name for name in BAD if name.endswith(SUFFIXES)} == {
        name.removeprefix("bad/") for name in ours if name.startswith("bad/")
    }


@pytest.mark.parametrize(
    "name", [row.file for row in FILES if row.file.startswith("synthetic/extreme")]
)
def test_render_modes_of_other_programs(name):
    can_record = name.endswith((".compressed.ply", ".spz"))
    expected = "mip" if "extreme_mip" in name and can_record else None
    assert formats.render_mode(place(name)) == expected


@pytest.mark.filterwarnings("ignore:.*opacities of ±inf")
@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_rejected_quickly_and_cheaply(name):
    path = place(f"bad/{name}")
    tracemalloc.start()
    begun = time.perf_counter()
    try:
        with pytest.raises(InputError, match=name):
            gsjax.load(path)
    finally:
        taken, peak = time.perf_counter() - begun, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert taken < 1
    assert peak < 64e6
