"""Goals and results of a compression."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.compression.parts import part_path
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.planning.types import Reason
from gsjax.runtime.files import write_file

NOMINAL_PSNR = 30.0  # of a scene whose photographs are not given, dB


class Goal(NamedTuple):
    """Goal of a compression; exactly one limit is set, for all files together.

    Attributes:
      max_loss: largest loss of PSNR on the held-out pictures, dB.
      max_size: largest size of the file, bytes.
      max_error: largest error of a colour against the scene before, in (0, 1).
      parts: number of files. Each holds other Gaussians, the first the most important
        tenth, which already shows the scene; see `gsjax.compression.parts`.
    """

    max_loss: float | None = None
    max_size: int | None = None
    max_error: float | None = None
    parts: int = 1

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are set, by name."""
        limits = self._asdict()
        del limits["parts"]
        return {name: float(v) for name, v in limits.items() if v is not None}

    def check(self) -> None:
        """Raise `InputError` unless one limit is set, and the numbers are positive."""
        given = self.limits
        if len(given) != 1:
            names = ", ".join(given) or "none"
            remedy = "set one of max_loss, max_size and max_error"
            raise InputError(f"goal: expected one goal, got {names}; {remedy}")
        ((name, value),) = given.items()
        if not 0 < value < np.inf:
            raise InputError(f"{name}: expected a positive number, got {value}")
        if self.parts < 1:
            raise InputError(f"parts: expected at least 1, got {self.parts}")


class HeldOut(NamedTuple):
    """Pictures on which the loss is measured.

    Attributes:
      cameras: single cameras, V of them.
      photos: photographs [H, W, 3] in [0, 1] of the same cameras over the background;
        or None.
      valid: [H, W] bool, the pixels that count, or None for all, of each camera; or
        None.
    """

    cameras: Sequence[Camera]
    photos: Sequence[np.ndarray] | None = None
    valid: Sequence[np.ndarray | None] | None = None


class Quality(NamedTuple):
    """Quality of a scene on held-out pictures; means over the pictures.

    Attributes:
      psnr, ssim: against the photographs, in dB and at most 1; None without them.
      psnr_before, ssim_before: against the pictures of the scene before compression;
        infinite and 1 for that scene itself.
      largest_error: largest error of a colour against those pictures.
      seconds: mean time to draw a picture; NaN if it was not measured.
    """

    psnr: float | None
    ssim: float | None
    psnr_before: float
    ssim_before: float
    largest_error: float
    seconds: float

    def loss(self, before: "Quality") -> float:
        """Return the loss of PSNR in dB.

        Without photographs it is an estimate: the error adds to that of a scene which
        matches its photographs at 30 dB.
        """
        if self.psnr is not None and before.psnr is not None:
            return before.psnr - self.psnr
        return 10 * float(np.log10(1 + 10 ** ((NOMINAL_PSNR - self.psnr_before) / 10)))


class CompressedScene(NamedTuple):
    """Result of `compress`.

    Attributes:
      gaussians: the scene as the files hold it, read back.
      files: the bytes of each file.
      suffix: its format, such as ".sog".
      before, after: quality on the held-out pictures.
      size_before: bytes of the scene as a PLY.
      reasons: one for each decision.
    """

    gaussians: Gaussians
    files: tuple[bytes, ...]
    suffix: str
    before: Quality
    after: Quality
    size_before: int
    reasons: tuple[Reason, ...]

    @property
    def loss(self) -> float:
        """Loss of PSNR in dB, see `Quality.loss`."""
        return self.after.loss(self.before)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(map(len, self.files))

    def save(self, path: Path) -> list[Path]:
        """Write the files, each complete or not at all; return their paths.

        One has the given path; the parts of ``scene.sog`` are ``scene-1.sog``, ….
        """
        count = len(self.files)
        paths = [part_path(Path(path), k + 1, count) for k in range(count)]
        for one, data in zip(paths, self.files):
            write_file(one, data, durable=True)
        return paths

    def lines(self) -> list[str]:
        """Return a table of size and quality, then the reasons, one a line."""
        rows = [("", "size", "PSNR", "SSIM", "largest error", "time to draw")]
        for name, size, quality in (
            ("before", self.size_before, self.before),
            ("after", self.size, self.after),
        ):
            photos = quality.psnr is not None
            rows.append(
                (
                    name,
                    f"{size / 1e6:.2f} MB",
                    f"{quality.psnr:.2f} dB" if photos else "–",
                    f"{quality.ssim:.4f}" if photos else "–",
                    f"{255 * quality.largest_error:.1f}/255",
                    f"{1e3 * quality.seconds:.0f} ms",
                )
            )
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(f"{v:<{w}}" for v, w in zip(row, widths)) for row in rows]
        ratio = self.size_before / self.size
        kind = "" if self.before.psnr is not None else ", an estimate without photos"
        lines.append(f"{ratio:.1f} times smaller, {self.loss:.3f} dB lost{kind}")
        lines.append(
            f"against the scene before: {self.after.psnr_before:.2f} dB, SSIM "
            f"{self.after.ssim_before:.4f}"
        )
        return lines + [f"{reason.what}: {reason.why}" for reason in self.reasons]
