"""Care of JAX's folder of compiled programs: its size, and truncated files."""

import stat
import zlib
from pathlib import Path

_ZSTD, _ZLIB = b"\x28\xb5\x2f\xfd", b"\x78"


def remove_oldest(folder: Path, limit: int) -> None:
    """Remove the files written longest ago until at most ``limit`` bytes are left."""
    files = [(path, path.stat()) for path in folder.iterdir() if path.is_file()]
    total = sum(found.st_size for _, found in files)
    for path, found in sorted(files, key=lambda file: file[1].st_mtime):
        if total <= limit:
            return
        path.unlink(missing_ok=True)
        total -= found.st_size


def remove_truncated(folder: Path) -> None:
    """Remove programs that a killed process or a full disk truncated.

    JAX (0.10.2) writes programs in place and never overwrites them: it would warn and
    compile anew at every start. Complete files are made read-only and not checked
    again. A program that another process is writing may be removed as well; the next
    start compiles it.
    """
    for path in folder.glob("*-cache"):
        try:
            if not path.stat().st_mode & stat.S_IWUSR:
                continue
            if is_complete(path.read_bytes()):
                path.chmod(0o444)
            else:
                path.unlink()
        except OSError:  # removed meanwhile, or owned by another user
            continue


def is_complete(program: bytes) -> bool:
    """Return whether a compressed program can be decompressed; True if unknown."""
    if len(program) <= len(_ZSTD) or not any(program):
        return False
    try:
        if program.startswith(_ZSTD):
            import zstandard  # which wrote it, as an optional dependency of JAX

            zstandard.ZstdDecompressor().decompress(program)
        elif program.startswith(_ZLIB):
            zlib.decompress(program)
    except ImportError:
        return True
    except Exception as error:
        if isinstance(error, MemoryError):
            raise
        return False
    return True
