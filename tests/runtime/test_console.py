"""Lines on a terminal, and Ctrl-C during a step."""

import signal
import threading

import pytest

from gsjax.runtime.console import deferred_interrupt, escape_controls, note, one_line


@pytest.fixture(autouse=True)
def _restore_handler():
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def test_control_characters_are_escaped(capsys):
    codes = [*range(32), *range(127, 160), *range(0x202A, 0x202F)]
    text = "".join(map(chr, codes))
    escaped = escape_controls(f"a{text}é∞\u200d\tb\n")
    assert escaped.startswith("a\\x00\\x01")
    assert escaped.endswith("é∞\u200d\tb\n")
    assert [letter for letter in escaped if letter in text] == ["\t", "\n", "\t", "\n"]
    assert one_line("a\x1b[31m\n b\r\x9b2J") == r"a\x1b[31m b \x9b2J"
    note("\x1b[2J")
    assert capsys.readouterr().err == "gsjax: \\x1b[2J\n"


def test_long_lines_keep_both_ends():
    line = one_line(f"start {'x' * 10**6} end", 100)
    assert len(line) == 105
    assert line.startswith("start x")
    assert line.endswith("x end")
    assert one_line("x" * 100, 100) == "x" * 100


def test_the_first_ctrl_c_sets_a_flag_and_the_second_interrupts(capsys):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with deferred_interrupt() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert "stopping after this step" in capsys.readouterr().err


def test_ignored_and_foreign_handlers_stay(monkeypatch):
    """A shell starts background processes with Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred_interrupt() as stopped:
        signal.raise_signal(signal.SIGINT)
        assert not stopped()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    with monkeypatch.context() as patched:
        patched.setattr(signal, "getsignal", lambda _: None)  # not Python's
        with deferred_interrupt() as stopped:
            assert not stopped()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_other_threads_leave_the_handler_alone():
    before, found = signal.getsignal(signal.SIGINT), []

    def work():
        with deferred_interrupt() as stopped:
            found.append((stopped(), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [(False, before)]
