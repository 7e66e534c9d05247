"""Files of `.ksplat`, written number by number after their description."""

import struct
from collections.abc import Mapping

import numpy as np

C0 = 0.28209479177387814
BLOCK, RANGE, SIZE = 5.0, 32767, 2  # edge of a bucket, its half in steps, its rows
SH_ENDS = (-2.0, 1.0)


def by_channel(sh) -> list[float]:
    """All of red, then green, then blue, of each degree."""
    bands = [sh[1:4], sh[4:9]]
    return [
        float(v) for band in bands for channel in np.transpose(band) for v in channel
    ]


def record(level: int, fields: Mapping[str, np.ndarray], row: int, center) -> bytes:
    """A Gaussian of linear scales, colours and opacities of 0 to 1."""
    mean, sh = fields["means"][row], by_channel(fields["sh"][row])
    half = "f" if level == 0 else "e"
    if level:
        steps = [round((x - c) * RANGE * 2 / BLOCK) for x, c in zip(mean, center)]
        data = struct.pack("<3H", *(RANGE + step for step in steps))
    else:
        data = struct.pack("<3f", *mean)
    data += struct.pack(f"<7{half}", *fields["scales"][row], *fields["quats"][row])
    data += bytes(round(255 * v) for v in fields["rgba"][row])
    if level < 2:
        return data + struct.pack(f"<{len(sh)}{half}", *sh)
    low, high = SH_ENDS
    return data + bytes(round(255 * (v - low) / (high - low)) for v in sh)


def section(level: int, fields: Mapping[str, np.ndarray]) -> tuple[bytes, bytes]:
    """Header and content of a section: one full bucket, the others with a row each."""
    count, bases = fields["sh"].shape[:2]
    rows = [[0, 1], *([row] for row in range(2, count))] if level else []
    centers = [np.float32(fields["means"][some].mean(0)) for some in rows]
    center_of = {row: c for some, c in zip(rows, centers) for row in some}
    partial = max(0, len(rows) - 1)
    content = struct.pack(f"<{partial}I", *[1] * partial)
    content += b"".join(struct.pack("<3f", *center) for center in centers)
    for row in range(count):
        content += record(level, fields, row, center_of.get(row))
    numbers = count, count, SIZE, len(rows), BLOCK, 12, RANGE if level else 1
    numbers += len(content), len(rows) - partial, partial, round(bases**0.5) - 1
    head = struct.pack("<IIIIfHxxIIIIH", *numbers)
    return head.ljust(1024, b"\0"), content


def ksplat_file(level: int, *sections: Mapping[str, np.ndarray]) -> bytes:
    """A file with a section for each of several scenes.

    Args:
      level: compression, 0 to 2.
      sections: arrays by name: "means", "scales", "quats", "sh" [N, K, 3], of which
        degree 0 is ignored, and "rgba" [N, 4].
    """
    count = sum(len(fields["means"]) for fields in sections)
    numbers = (
        0,
        1,
        len(sections),
        len(sections),
        count,
        count,
        level,
        *[0] * 3,
        *SH_ENDS,
    )
    head = struct.pack("<BBxxIIIIHxx3f2f", *numbers).ljust(4096, b"\0")
    parts = [section(level, fields) for fields in sections]
    return head + b"".join(h for h, _ in parts) + b"".join(c for _, c in parts)


def ksplat_fields(count: int, degree: int = 0, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-2, 2, (count, 3)),
        "scales": np.exp(rng.normal(-3, 1, (count, 3))),
        "quats": rng.normal(size=(count, 4)),
        "rgba": rng.integers(0, 256, (count, 4)) / 255,
        "sh": rng.uniform(*SH_ENDS, (count, (degree + 1) ** 2, 3)),
    }
