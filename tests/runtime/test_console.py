"""Lines on a terminal, and handlers of Ctrl-C that are not replaced."""

import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from gsjax.runtime.console import deferred_interrupt, escape_controls, note, one_line


@pytest.fixture(autouse=True)
def _restore_handler():
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def test_lines_have_no_control_characters_and_are_shortened_in_the_middle(capsys):
    codes = [*range(32), *range(127, 160), *range(0x202A, 0x202F)]
    text = "".join(map(chr, codes))
    escaped = escape_controls(f"a{text}é∞\u200d\tb\n")
    assert escaped.startswith("a\\x00\\x01")
    assert escaped.endswith("é∞\u200d\tb\n")
    assert [letter for letter in escaped if letter in text] == ["\t", "\n", "\t", "\n"]
    assert one_line("a\x1b[31m\n b\r\x9b2J") == r"a\x1b[31m b \x9b2J"
    note("\x1b[2J")
    assert capsys.readouterr().err == "gsjax: \\x1b[2J\n"
    line = one_line(f"start {'x' * 10**6} end", 100)
    assert len(line) == 105
    assert line.startswith("start x")
    assert line.endswith("x end")
    assert one_line("x" * 100, 100) == "x" * 100


def within() -> tuple:
    """Return the flag and the handler of Ctrl-C while it is deferred."""
    with deferred_interrupt() as stopped:
        return stopped(), signal.getsignal(signal.SIGINT)


def test_handlers_of_others_stay(monkeypatch):
    """Ctrl-C may be ignored, as shells do for background processes, or not Python's."""
    ours = signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    assert within() == (False, signal.SIG_IGN)
    signal.signal(signal.SIGINT, ours)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(within).result() == (False, ours)
    with monkeypatch.context() as patched:
        patched.setattr(signal, "getsignal", lambda _: None)
        assert within() == (False, None)
    assert signal.getsignal(signal.SIGINT) is ours
    assert within()[1] is not ours
    assert signal.getsignal(signal.SIGINT) is ours
