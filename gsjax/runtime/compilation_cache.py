"""The folder of compiled programs that JAX keeps: not too large, and of whole files."""

import stat
import zlib
from pathlib import Path

_ZSTD, _ZLIB = b"\x28\xb5\x2f\xfd", b"\x78"


def remove_oldest(folder: Path, most: int) -> None:
    """Remove the files longest not written until ``most`` bytes are left."""
    files = [(path, path.stat()) for path in folder.iterdir() if path.is_file()]
    total = sum(found.st_size for _, found in files)
    for path, found in sorted(files, key=lambda file: file[1].st_mtime):
        if total <= most:
            return
        path.unlink(missing_ok=True)
        total -= found.st_size


def remove_truncated(folder: Path) -> None:
    """Remove programs that a kill or a full disk cut off.

    JAX (0.10.2) writes them in place, and never again where a file is: it would warn
    of what is torn, and compile anew, at every start. What is found whole is made
    read-only, and not looked at again. One that another process is just writing may
    be removed too; the next start compiles it.
    """
    for path in folder.glob("*-cache"):
        try:
            if not path.stat().st_mode & stat.S_IWUSR:
                continue
            if is_whole(path.read_bytes()):
                path.chmod(0o444)
            else:
                path.unlink()
        except OSError:  # another process was first, or it is another's file
            continue


def is_whole(program: bytes) -> bool:
    """Whether a compressed program goes on to its end; of another kind, it may."""
    if len(program) <= len(_ZSTD) or not any(program):
        return False
    if program.startswith(_ZSTD):
        return _zstd_ends(program)
    if program.startswith(_ZLIB):
        try:
            zlib.decompress(program)
        except zlib.error:
            return False
    return True


def _zstd_ends(frame: bytes) -> bool:
    """By the lengths of its blocks (RFC 8878, 3.1.1); they are not decompressed."""
    flags = frame[4]
    single = flags >> 5 & 1  # segment: without a byte for the size of a window
    dictionary, size = (0, 1, 2, 4)[flags & 3], (single, 2, 4, 8)[flags >> 6]
    at = 5 + (1 - single) + dictionary + size
    while at + 3 <= len(frame):
        header = int.from_bytes(frame[at : at + 3], "little")
        last, kind, length = header & 1, header >> 1 & 3, header >> 3
        at += 3 + (1 if kind == 1 else length)  # kind 1: one byte, repeated
        if last:
            checksum = 4 * (flags >> 2 & 1)
            return at + checksum <= len(frame)
    return False
