"""A file of UTF-8 text, read in pieces of bounded size, whatever is in it."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from gsjax.errors import InputError
from gsjax.io.numerals import BLOCK
from gsjax.runtime.files import reading


class TextFile:
    """Text on its way; see `open_text`.

    Attributes:
      path: of the file.
      number: of the line that was read last.
      last: the piece that was.
    """

    def __init__(self, path: Path, file: TextIO):
        self.path, self.number, self.last = path, 0, "\n"
        self._file = file

    def where(self) -> str:
        """The line that was read last, for messages."""
        return f"{self.path}: line {self.number}"

    def lines(self, most: int) -> Iterator[str]:
        """Lines, comments and blank ones too, without their ends.

        Raises:
          InputError: if one has more than ``most`` characters.
        """
        while line := self._take(self._file.readline(most + 1)):
            self.number += 1
            if len(line) > most:
                raise too_long(self.where(), most)
            yield line.strip()

    def pass_line(self) -> tuple[int, str] | None:
        """How many words the next line has, which may be of any length, and the last 40
        characters of the last of them; None at the end of the file."""
        piece = self._take(self._file.readline(BLOCK))
        if not piece:
            return None
        self.number += 1
        count, last, end = 0, "", " "
        while piece:
            words = piece.split()
            joined = not (piece[0].isspace() or end.isspace())  # it began before
            if words:
                begun = last if joined and len(words) == 1 else ""
                last = (begun + words[-1])[-40:]
            count, end = count + len(words) - joined, piece[-1]
            piece = "" if end == "\n" else self._take(self._file.readline(BLOCK))
        return count, last

    def blocks(self, most: int) -> Iterator[str]:
        """Whole lines, several at a time; ``number`` is that of the last one before.

        Raises:
          InputError: if one has more than ``most`` characters, or some more.
        """
        while block := self._file.read(BLOCK):
            rest = self._file.readline(most)
            block = self._take(block + rest)
            if len(rest) == most and not rest.endswith("\n"):
                self.number += block.count("\n") + 1
                raise too_long(self.where(), most)
            yield block
            self.number += block.count("\n")

    def most_lines(self, least: int) -> int:
        """How many lines of at least so many bytes the file has room for, and ends."""
        ends = 1
        with self.path.open("rb") as file:
            while piece := file.read(BLOCK):
                ends += piece.count(b"\n") + piece.count(b"\r")
            return min(ends, file.tell() // least + 1)

    def _take(self, text: str) -> str:
        self.last = text or self.last
        return text


@contextmanager
def open_text(path: Path, wanted: str) -> Iterator[TextFile]:
    """A text to be read whole; if its last line has no end, that is warned of.

    Args:
      path: of the file.
      wanted: what to pass instead, for the message.

    Raises:
      InputError: as `reading`, and if it is not UTF-8.
    """
    text = None
    try:
        with reading(path, wanted), path.open(encoding="utf-8-sig") as file:
            text = TextFile(path, file)
            yield text
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: after line {text.number if text else 0}: not UTF-8 text; the "
            "file is damaged, or a binary one with the wrong suffix: export or copy it "
            "again"
        ) from error
    if not text.last.endswith("\n"):
        warnings.warn(
            f"{path}: the last line has no end; the file may be truncated: export or "
            "copy it again",
            UserWarning,
            stacklevel=4,
        )


def too_long(where: str, most: int) -> InputError:
    """The error of a line that no record has."""
    return InputError(
        f"{where}: a line of more than {most} characters, which no such record has; "
        "the file is damaged, or another one: export or copy it again"
    )
