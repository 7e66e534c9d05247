"""SOG scenes, decoded and made without the code of the package.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TEXTURES = ("means_l", "means_u", "quats", "scales", "sh0")


def contents(path: Path) -> dict[str, bytes]:
    """Return the files of a bundle, or of the folder of a meta.json."""
    if path.suffix == ".sog":
        with zipfile.ZipFile(path) as archive:
            methods = {entry.compress_type for entry in archive.infolist()}
            assert methods == {zipfile.ZIP_STORED}
            return {name: archive.read(name) for name in archive.namelist()}
    return {file.name: file.read_bytes() for file in path.parent.iterdir()}


def texels(data: bytes) -> np.ndarray:
    """Return the pixels [H, W, 4] of a WebP."""
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))


def webp(pixels: np.ndarray, **options) -> bytes:
    """Return [H, W, 4] uint8 as a WebP, by default an exact one."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(
        buffer, "WEBP", **{"lossless": True, "exact": True, **options}
    )
    return buffer.getvalue()


def texture(rows: np.ndarray, **options) -> bytes:
    """Return rows [N, 4] as a square texture."""
    side = math.ceil(math.sqrt(len(rows)))
    pixels = np.zeros((side * side, 4), np.uint8)
    pixels[: len(rows)] = rows
    return webp(pixels.reshape(side, side, 4), **options)


def decoded(files: dict[str, bytes]) -> dict[str, np.ndarray]:
    """Return the values of version 2: float64, opacities for logits."""
    meta = json.loads(files["meta.json"])
    assert meta["version"] == 2
    count = meta["count"]

    def rows(name: str) -> np.ndarray:
        pixels = texels(files[name])
        height, width, _ = pixels.shape
        assert (width, height) == (
            4 * math.ceil(math.sqrt(count) / 4),
            4 * math.ceil(count / width / 4),
        )
        assert not pixels.reshape(-1, 4)[count:, :3].any()
        return pixels.reshape(-1, 4)[:count].astype(int)

    low, high = (rows(name)[:, :3] for name in meta["means"]["files"])
    bounds = [np.asarray(meta["means"][key]) for key in ("mins", "maxs")]
    extent = np.where(bounds[1] == bounds[0], 1, bounds[1] - bounds[0])
    logs = bounds[0] + extent * (low + 256 * high) / 65535
    quats = np.zeros((count, 4))
    for quat, (*codes, tag) in zip(quats, rows(meta["quats"]["files"][0])):
        others = [k for k in range(4) if k != tag - 252]
        assert len(others) == 3
        quat[others] = (np.asarray(codes) / 255 * 2 - 1) / math.sqrt(2)
        quat[tag - 252] = math.sqrt(max(0, 1 - quat @ quat))
    scales, sh0 = (
        np.asarray(meta[k]["codebook"], np.float32) for k in ("scales", "sh0")
    )
    assert len(scales) == len(sh0) == 256
    colors = rows(meta["sh0"]["files"][0])
    found = {
        "logs": logs,
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "quats": quats,
        "log_scales": scales[rows(meta["scales"]["files"][0])[:, :3]],
        "opacities": colors[:, 3] / 255,
        "sh": sh0[colors[:, :3]][:, None],
    }
    if "shN" in meta:
        found["sh"] = np.concatenate([found["sh"], _harmonics(meta, files, rows)], 1)
    return found


def _harmonics(meta: dict[str, Any], files, rows: Callable) -> np.ndarray:
    """Return the coefficients [N, K - 1, 3]."""
    harmonics = meta["shN"]
    codebook = np.asarray(harmonics["codebook"], np.float32)
    size = {1: 3, 2: 8, 3: 15}[harmonics["bands"]]
    palette, labels = harmonics["files"]
    pixels, labels = texels(files[palette]), rows(labels)
    assert pixels.shape[1] == 64 * size
    assert pixels.shape[0] == math.ceil(harmonics["count"] / 64)
    found = np.empty((len(labels), size, 3))
    for row, (low, high, *_) in zip(found, labels):
        label = low + 256 * high
        assert label < harmonics["count"]
        at = label % 64 * size
        row[:] = codebook[pixels[label // 64, at : at + size, :3]]
    return found


def bundle(files: dict[str, bytes]) -> bytes:
    """Return a .sog archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def older_scene(degree: int, seed: int = 0) -> tuple[bytes, dict[str, np.ndarray]]:
    """Return a .sog file of version 1 with random bytes, and its values.

    The values are float64, named as the arguments of `gsjax.make_gaussians`.
    """
    rng, count = np.random.default_rng(seed), 70
    size = {0: 0, 1: 3, 2: 8, 3: 15}[degree]
    raw = {name: rng.integers(0, 256, (count, 4)).astype(np.uint8) for name in TEXTURES}
    raw["quats"][:, 3] = 252 + np.arange(count) % 4
    raw["quats"][:, :3] = rng.integers(90, 166, (count, 3))
    meta: dict[str, Any] = {name: {"files": [f"{name}.webp"]} for name in TEXTURES[2:]}
    meta["means"] = {"shape": [count, 3], "files": ["means_l.webp", "means_u.webp"]}
    for name, width in (("means", 3), ("scales", 3), ("sh0", 4)):
        bounds = np.sort(rng.normal(0, 2, (2, width)), axis=0)
        meta[name] |= {"mins": bounds[0].tolist(), "maxs": bounds[1].tolist()}

    def lerp(name: str, share: np.ndarray) -> np.ndarray:
        low, high = (np.asarray(meta[name][key]) for key in ("mins", "maxs"))
        return low + (high - low) * share

    words = raw["means_l"][:, :3] + 256 * raw["means_u"][:, :3].astype(int)
    logs, colors = lerp("means", words / 65535), lerp("sh0", raw["sh0"] / 255)
    quats = np.zeros((count, 4))
    for quat, (*codes, tag) in zip(quats, raw["quats"].tolist()):
        others = [k for k in range(4) if k != tag - 252]
        quat[others] = (np.asarray(codes) / 255 * 2 - 1) / math.sqrt(2)
        quat[tag - 252] = math.sqrt(1 - quat @ quat)
    files = {f"{name}.webp": texture(rows) for name, rows in raw.items()}
    sh = colors[:, None, :3]
    if degree:
        palette = rng.integers(0, 256, (3, 64 * size, 4)).astype(np.uint8)
        labels = rng.integers(0, 192, (count, 4)).astype(np.uint8)
        labels[:, 1] = 0
        names = ["palette.webp", "labels.webp"]
        meta["shN"] = {"mins": -0.75, "maxs": 1.5, "quantization": 8, "files": names}
        files |= {names[0]: webp(palette), names[1]: texture(labels)}
        entries = palette.reshape(192, size, 4)[labels[:, 0], :, :3]
        sh = np.concatenate([sh, -0.75 + 2.25 * entries / 255], axis=1)
    files["meta.json"] = json.dumps(meta).encode()
    return bundle(files), {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "quats": quats,
        "log_scales": lerp("scales", raw["scales"][:, :3] / 255),
        "logit_opacities": colors[:, 3],
        "sh": sh,
    }
