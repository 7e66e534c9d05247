"""Numbers written as text, many at a time: plain ASCII numerals and white space.

A list of Python's strings or numbers takes twenty times the text. So text is taken in
blocks of bounded size, and a block as arrays. Axis legend: W words, L lines.
"""

import warnings
from typing import NamedTuple

import numpy as np

# Characters of a block, beyond the longest line that is wanted.
BLOCK = 1 << 18
_NEWLINE, _SPACE = 10, 32
_WHITE = b" \t\n\r\v\f"
# "nan" and "infinity" too; not the underscores and the digits of other scripts that
# Python's float takes.
_PLAIN = np.isin(np.arange(256), [*b"0123456789+-.eEinfatyINFATY", *_WHITE])
_DIGIT = np.isin(np.arange(256), [*b"0123456789"])


class Words(NamedTuple):
    """Where the words and lines of a block stand.

    Attributes:
      starts: [W] at which byte each word begins.
      first: [L] which word is the first of each line, if it has any.
      counts: [L] how many words it has.
      ends: [L] at which byte it ends.
    """

    starts: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    ends: np.ndarray


def find_words(block: np.ndarray) -> Words:
    """Words and lines of a block.

    Args:
      block: uint8; a last line without an end counts as one.
    """
    inked = block > _SPACE
    starts = np.flatnonzero(inked & ~np.append(False, inked)[:-1])
    ends = np.flatnonzero(block == _NEWLINE)
    if len(block) and block[-1] != _NEWLINE:
        ends = np.append(ends, len(block))
    upto = np.searchsorted(starts, ends)
    counts = np.diff(upto, prepend=0)
    return Words(starts, upto - counts, counts, ends)


def parse_numbers(block: np.ndarray, count: int) -> np.ndarray | None:
    """[W] float64, of all words of a block, as Python's float reads them.

    Args:
      block: uint8.
      count: W, at least 1.

    Returns:
      The numbers; None if there are not as many, or a word is none.
    """
    if not _PLAIN[block].all():
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # as old NumPy tells what it cannot read
            values = np.fromstring(block.tobytes(), np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    return values if len(values) == count else None


def other_than_digits(block: np.ndarray) -> np.ndarray:
    """[len(block) + 1] how many bytes before each are neither digits nor white."""
    other = (block > _SPACE) & ~_DIGIT[block]
    return np.concatenate([[0], np.cumsum(other, dtype=np.int32)])


def parse_number(word: str) -> float:
    """One number.

    Raises:
      ValueError: if it is none, or is not written in ASCII.
    """
    if "_" in word or not word.isascii():
        raise ValueError(f"could not convert {word[:40]!r} to a number")
    return float(word)
