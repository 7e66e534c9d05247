"""Numbers written as text, parsed in blocks: ASCII numerals and white space only.

Lists of Python strings or numbers take twenty times the memory of the text, so a block
of bounded size is parsed into arrays at once. Axis legend: W words, L lines.
"""

import warnings
from typing import NamedTuple

import numpy as np

# Characters of a block, without the longest line.
BLOCK = 1 << 18
_NEWLINE, _SPACE = 10, 32
_WHITE = b" \t\n\r\v\f"
# "nan" and "infinity" too, but not the underscores and digits of other scripts that
# Python's float accepts.
_PLAIN = np.isin(np.arange(256), [*b"0123456789+-.eEinfatyINFATY", *_WHITE])
_DIGIT = np.isin(np.arange(256), [*b"0123456789"])


class Words(NamedTuple):
    """Words and lines of a block.

    Attributes:
      starts: [W] byte at which each word begins.
      first, counts: [L] index of the first word of each line, and number of words.
      ends: [L] byte at which the line ends.
    """

    starts: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    ends: np.ndarray


def find_words(block: np.ndarray) -> Words:
    """Find the words and lines of a uint8 block; the last line may lack its newline."""
    inked = block > _SPACE
    starts = np.flatnonzero(inked & ~np.append(False, inked)[:-1])
    ends = np.flatnonzero(block == _NEWLINE)
    if len(block) and block[-1] != _NEWLINE:
        ends = np.append(ends, len(block))
    upto = np.searchsorted(starts, ends)
    counts = np.diff(upto, prepend=0)
    return Words(starts, upto - counts, counts, ends)


def parse_numbers(block: np.ndarray, count: int) -> np.ndarray | None:
    """Parse all words of a uint8 block as Python's float does, to [W] float64.

    The result is None if there are not ``count`` ≥ 1 words or one is not a number.
    """
    if not _PLAIN[block].all():
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # older NumPy warns of invalid text
            values = np.fromstring(block.tobytes(), np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    return values if len(values) == count else None


def other_than_digits(block: np.ndarray) -> np.ndarray:
    """Count the bytes before each that are no digit or space, [len(block) + 1]."""
    other = (block > _SPACE) & ~_DIGIT[block]
    return np.concatenate([[0], np.cumsum(other, dtype=np.int32)])


def parse_number(word: str) -> float:
    """Parse one number; raise ValueError if it is not a number in ASCII."""
    if "_" in word or not word.isascii():
        raise ValueError(f"could not convert {word[:40]!r} to a number")
    return float(word)
