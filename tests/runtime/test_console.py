"""What a terminal is told; Ctrl-C while something goes on."""

import signal
import threading

import pytest

from gsjax.runtime.console import deferred_interrupt, escape_controls, note, one_line


@pytest.fixture(autouse=True)
def _as_it_was():
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def test_nothing_is_told_that_a_terminal_would_obey(capsys):
    codes = [*range(32), *range(127, 160), *range(0x202A, 0x202F)]
    text = "".join(map(chr, codes))
    kept = escape_controls(f"a{text}é∞\u200d\tb\n")
    assert kept.startswith("a\\x00\\x01")
    assert kept.endswith("é∞\u200d\tb\n")
    assert [letter for letter in kept if letter in text] == ["\t", "\n", "\t", "\n"]
    assert one_line("a\x1b[31m\n b\r\x9b2J") == r"a\x1b[31m b \x9b2J"
    note("\x1b[2J")
    assert capsys.readouterr().err == "gsjax: \\x1b[2J\n"


def test_what_is_too_long_keeps_both_its_ends():
    line = one_line(f"start {'x' * 10**6} end", 100)
    assert len(line) == 105
    assert line.startswith("start x")
    assert line.endswith("x end")
    assert one_line("x" * 100, 100) == "x" * 100


def test_once_asks_and_twice_stops(capsys):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with deferred_interrupt() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert "stopping after this step" in capsys.readouterr().err


def test_what_ignores_it_goes_on(capsys):
    """As a shell script starts what it puts in the background."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred_interrupt() as stopped:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        assert not stopped()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    assert not capsys.readouterr().err


def test_a_handler_that_python_does_not_know_stays(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patched:
        patched.setattr(signal, "getsignal", lambda _: None)
        with deferred_interrupt() as stopped:
            assert not stopped()
    assert signal.getsignal(signal.SIGINT) is before


def test_off_the_main_thread_nothing_changes():
    before, found = signal.getsignal(signal.SIGINT), []

    def work():
        with deferred_interrupt() as stopped:
            found.append((stopped(), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [(False, before)]
