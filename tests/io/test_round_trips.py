"""Writing and reading loses at most half a step of a format, and a second time nothing.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.gaussians import make_gaussians
from gsjax.io.morton import morton_order
from gsjax.io.packed_ply import write_packed_ply
from gsjax.io.splat import write_splat
from gsjax.io.spz import write_spz

pytestmark = [
    pytest.mark.usefixtures("float32"),
    pytest.mark.filterwarnings("ignore:.*Gaussians have"),
    pytest.mark.filterwarnings("ignore:.*colours are out of"),
    pytest.mark.filterwarnings("ignore:.*are left out"),
    pytest.mark.filterwarnings("ignore:.*most programs reject"),
]
C0 = 0.28209479177387814
Fields = dict[str, np.ndarray]


def random_scene(count: int, degree: int, seed: int) -> Fields:
    """Plausible values: norms and signs of quaternions are anything."""
    rng = np.random.default_rng(seed)
    norms = np.exp(rng.normal(0, 1, (count, 1)))
    return {
        "means": rng.normal(0, 3, (count, 3)),
        "quats": rng.normal(size=(count, 4)) * norms,
        "log_scales": rng.normal(-4, 1.5, (count, 3)),
        "logit_opacities": rng.normal(0, 4, count),
        "sh": rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)),
    }


def extreme_scene(degree: int) -> Fields:
    """Ends of ranges and beyond, and ties of the components of quaternions."""
    fields = random_scene(60, degree, 5)
    fields["means"][:6] = 900 * np.concatenate([np.eye(3), -np.eye(3)])
    fields["log_scales"][:4] = [[-12], [5], [-25], [9]]
    fields["logit_opacities"][:4] = -np.inf, np.inf, -12, 12
    fields["sh"][:4] = np.reshape([-6, 6, 0, 3.5], (4, 1, 1))
    signs = np.indices((3, 3, 3, 3)).reshape(4, -1).T - 1.0
    signs = np.delete(signs, len(signs) // 2, axis=0)  # zero
    fields["quats"] = np.resize(signs[::-1], (60, 4))
    return fields


def scenes(degree: int) -> dict[str, Fields]:
    flat, one = random_scene(300, degree, 1), random_scene(1, degree, 2)
    flat["means"][:, 2] = 0.25
    same = {name: np.repeat(array, 5, axis=0) for name, array in one.items()}
    chunks = {f"{n} rows": random_scene(n, degree, n) for n in (256, 257, 700)}
    extreme = extreme_scene(degree)
    return {"one": one, "same": same, "flat": flat, "extreme": extreme, **chunks}


# For each format: the values that it can represent, in the order of the file, and half
# of a step of each.


def clipped(fields: Fields, most: dict[str, tuple[float, float]]) -> Fields:
    limits = ((name, *most.get(name, (-np.inf, np.inf))) for name in fields)
    return {name: np.clip(fields[name], low, high) for name, low, high in limits}


def of_spz(fields: Fields) -> tuple[Fields, Fields]:
    values = clipped(
        fields, {"log_scales": (-10, 255 / 16 - 10), "sh": (-1, 127 / 128)}
    )
    values["sh"][:, 0] = np.clip(fields["sh"][:, 0], -10 / 3, 10 / 3)
    most = np.abs(fields["means"]).max()
    fraction = min(20, np.floor(np.log2((2**23 - 1) / most)))
    sh = np.full(fields["sh"].shape[1:], 1 / 32)
    sh[:4], sh[0] = 1 / 64, 0.5 / 255 / 0.15
    return values, {
        "means": 0.5 * 2.0**-fraction,
        "log_scales": np.asarray(1 / 32),
        "opacities": np.asarray(0.5 / 255),
        "sh": sh,
    }


def of_packed_ply(fields: Fields) -> tuple[Fields, Fields]:
    order = morton_order(fields["means"].astype(np.float32))
    values = clipped(fields, {"log_scales": (-20, 20)})
    values["sh"][:, 1:] = np.clip(values["sh"][:, 1:], -4, 4)
    values = {name: array[order] for name, array in values.items()}
    count = len(order)

    def steps(array: np.ndarray, levels) -> np.ndarray:
        """[N, 3], half a step of the chunk of each row."""
        parts = [array[k : k + 256] for k in range(0, count, 256)]
        ranges = [np.ptp(part, axis=0) / levels / 2 for part in parts]
        return np.repeat(ranges, 256, axis=0)[:count]

    sh = np.full(fields["sh"].shape, 1 / 64)
    sh[:, 0] = steps(values["sh"][:, 0], 255)
    levels = np.asarray([2047, 1023, 2047])
    return values, {
        "means": steps(values["means"], levels),
        "log_scales": steps(values["log_scales"], levels),
        "opacities": np.asarray(0.5 / 255),
        "sh": sh,
    }


def of_splat(fields: Fields) -> tuple[Fields, Fields]:
    covered = fields["log_scales"].astype(np.float32).astype(np.float64).sum(1)
    covered -= np.logaddexp(0, -fields["logit_opacities"].astype(np.float32))
    values = clipped(fields, {"sh": (-0.5 / C0, 0.5 / C0)})
    values["sh"] = values["sh"][:, :1]
    order = np.argsort(-covered, kind="stable")
    return {name: array[order] for name, array in values.items()}, {
        "means": np.asarray(0.0),
        "log_scales": np.asarray(0.0),
        "opacities": np.asarray(0.5 / 255),
        "sh": np.asarray(0.5 / 255 / C0),
    }


class Case(NamedTuple):
    """A writer and its losses.

    Attributes:
      suffix: end of the file's name.
      save: writes a file.
      losses: returns representable values and half steps.
      angle: greatest error of a rotation, in degrees.
      degrees: SH degrees.
    """

    suffix: str
    save: Callable
    losses: Callable[[Fields], tuple[Fields, Fields]]
    angle: float
    degrees: tuple[int, ...]


SPZ = Case(".spz", write_spz, of_spz, 0.25, (1, 4))
CASES = {
    "spz": SPZ,
    "spz 3": SPZ._replace(save=partial(write_spz, version=3), degrees=(3,)),
    "packed": Case(".compressed.ply", write_packed_ply, of_packed_ply, 0.25, (0, 3)),
    "splat": Case(".splat", write_splat, of_splat, 0.9, (1,)),
}
ROWS = [(name, degree) for name, case in CASES.items() for degree in case.degrees]


def opacities(logits) -> np.ndarray:
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def angles(quats, others) -> np.ndarray:
    """Return the angles [N] in degrees between rotations."""
    a, b = (Rotation.from_quat(np.roll(q, -1, axis=1)) for q in (quats, others))
    return np.degrees((a * b.inv()).magnitude())


def arrays_of(gaussians: gsjax.Gaussians) -> Fields:
    found = {k: np.asarray(v, np.float64) for k, v in vars(gaussians.params).items()}
    return found | {"opacities": opacities(found["logit_opacities"])}


def assert_within(found: Fields, expected: Fields, half_steps: Fields, angle: float):
    for name, half in half_steps.items():
        error = np.abs(found[name] - expected[name])
        rounding = 3e-7 * (1 + np.abs(expected[name]))  # of float32
        assert (error <= half * (1 + 1e-6) + rounding).all(), (name, error.max())
    assert angles(found["quats"], expected["quats"]).max() < angle


@pytest.mark.parametrize(("name", "degree"), ROWS)
def test_files_lose_at_most_half_a_step(tmp_path, name, degree, report):
    case = CASES[name]
    path, again = (tmp_path / f"{stem}{case.suffix}" for stem in ("a", "b"))
    worst = 0.0
    for fields in scenes(degree).values():
        case.save(path, make_gaussians(**fields), overwrite=True)
        once = gsjax.load(path)
        found, (expected, half_steps) = arrays_of(once), case.losses(fields)
        expected["opacities"] = opacities(expected["logit_opacities"])
        assert found["sh"].shape == expected["sh"].shape
        assert_within(found, expected, half_steps, case.angle)
        worst = max(worst, angles(found["quats"], expected["quats"]).max())
        case.save(again, once, overwrite=True)
        twice = arrays_of(gsjax.load(again))
        if len(found["means"]) > 256 and name == "packed":
            continue  # rows may change their chunk, and with it their steps
        assert_same(sorted_rows(twice), sorted_rows(found), case)
    report(f"{name} {degree}: rotations in degrees", worst, case.angle)


def sorted_rows(fields: Fields) -> Fields:
    """Order the rows by their values, rounded."""
    keys = np.concatenate([fields["means"], fields["log_scales"]], axis=1)
    order = np.lexsort(np.round(keys, 4).T)
    return {name: array[order] for name, array in fields.items()}


def assert_same(found: Fields, expected: Fields, case: Case) -> None:
    """Equal but for the rounding of float32; bytes of `.splat` are no unit numbers."""
    for name in ("means", "log_scales", "opacities", "sh"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6, atol=1e-6)
    limit = case.angle if case.suffix == ".splat" else 1e-3
    assert angles(found["quats"], expected["quats"]).max() < limit


@pytest.mark.parametrize("name", ["spz", "spz 3", "packed"])
def test_a_second_file_of_one_chunk_has_the_same_bits(tmp_path, name):
    """Rows of a compressed PLY may change their order within the chunk."""
    case, count = CASES[name], 200
    paths = [tmp_path / f"{k}{case.suffix}" for k in range(2)]
    case.save(paths[0], make_gaussians(**random_scene(count, 0, 3)))
    case.save(paths[1], gsjax.load(paths[0]))
    first, second = (path.read_bytes() for path in paths)
    if name == "packed":
        rows = [
            np.frombuffer(b[-16 * count :], "4<u4").tolist() for b in (first, second)
        ]
        assert sorted(rows[0]) == sorted(rows[1])
        first, second = (one[: -16 * count] for one in (first, second))
        # Bounds of colours are the nearest float32 to what was read.
        first, second = (one[: one.index(b"end_header")] for one in (first, second))
    assert first == second
