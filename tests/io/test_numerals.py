"""Numbers written as text are parsed in bulk exactly as Python's float reads them."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gsjax.io.numerals import find_words, other_than_digits, parse_number, parse_numbers

WORDS = st.one_of(
    st.floats().map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.text("0123456789+-.eEinfatyINF_ x\uff11", min_size=1, max_size=6),
)
LINES = st.lists(st.lists(WORDS, max_size=5).map(" ".join), max_size=5)


def as_bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)


def one_by_one(words: list[str]) -> list[float] | None:
    try:
        return [parse_number(word) for word in words]
    except ValueError:
        return None


@given(LINES, st.sampled_from(["\n", "\r\n", " \n"]), st.booleans())
@example(["1 2", "", " 3"], "\n", True)
@example(["1-2"], "\n", True)
@example(["1e", "nan(1)", "inf"], "\n", False)
def test_bulk_parsing_agrees_with_python(lines, end, ended):
    text = end.join(lines) + end * ended
    words = find_words(as_bytes(text))
    found = text.split("\n")
    if not found[-1]:
        found = found[:-1]
    assert words.counts.tolist() == [len(line.split()) for line in found]
    assert words.first.tolist() == [0, *np.cumsum(words.counts)][: len(found)]
    inked = [text.encode()[at:].split()[0] for at in words.starts]
    assert all(a.startswith(b) for a, b in zip(inked, map(str.encode, text.split())))
    if not text.split():
        return
    numbers = parse_numbers(as_bytes(text), len(text.split()))
    expected = one_by_one(text.split())
    if expected is None:
        assert numbers is None
    else:
        np.testing.assert_array_equal(numbers, expected)


def test_other_words_are_rejected_and_counted():
    for word in ("1_0", "\uff11", "", "x", "1e", "0x1", "nan(1)"):
        with pytest.raises(ValueError, match="could not convert"):
            parse_number(word)
    other = other_than_digits(as_bytes("12 3.5\n7a"))
    assert other.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1, 2]
