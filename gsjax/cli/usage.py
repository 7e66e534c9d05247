"""What is wrong with a command line, in one line: tyro's boxes read and put shortly."""

import re
from collections.abc import Collection, Mapping
from dataclasses import fields
from difflib import get_close_matches

from gsjax.runtime.console import one_line

_ALONE = ("--help", "--version")  # options without a command


def explained(told: str, argv: list[str], commands: Mapping[str, type]) -> str:
    """One line for a line of arguments that tyro refused.

    Args:
      told: what tyro printed.
      argv: the arguments.
      commands: dataclasses that hold the options, by the commands' names.
    """
    command, lines = argv[0], _unframed(told)
    if command not in commands:
        return f"{_unknown_command(command, commands)}; see gsjax --help"
    names = [f.name.replace("_", "-") for f in fields(commands[command])]
    parts = [_unknown_option(word, names) for word in _unrecognized(lines)]
    parts += [f"{option} is missing" for option in _missing(lines)]
    return f"{'; '.join(parts) or _plain(lines)}; see gsjax {command} --help"


def _unframed(text: str) -> list[str]:
    """Lines without colours and frames; what parts them is an empty one."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    lines = [re.sub(r"^ ?[│|] ?|\s*[│|]?\s*$", "", line) for line in text.splitlines()]
    return ["" if re.match(r"\s*([╭╰─]|\+-|-{3})", line) else line for line in lines]


def _section(lines: list[str], title: str) -> list[str]:
    """What follows a title, less its indent, up to an empty line; the first is what
    stands behind it.
    """
    for index, line in enumerate(lines):
        before, found, behind = line.partition(title)
        if found and not before.strip():
            rest = [behind, *(x[len(before) :] for x in lines[index + 1 :])]
            end = next((n for n, x in enumerate(rest) if n and not x), len(rest))
            return rest[:end]
    return []


def _unrecognized(lines: list[str]) -> list[str]:
    """Options that do not exist, or if all do, words that nothing was expected for."""
    elsewhere = _section(lines, "Unrecognized or misplaced options:")  # of a command
    found = " ".join(_section(lines, "Unrecognized options:") or elsewhere)
    text = re.sub(r"\(applied to [^)]*\)", "", found)
    words = [word for word in re.split(r"[,\s]+", text) if word]
    return [word for word in words if word.startswith("-")] or words


def _unknown_option(word: str, names: list[str]) -> str:
    if not word.startswith("-"):
        return f"{word}: not expected"
    like = get_close_matches(word.lstrip("-"), names, 1, 0.7)
    return f"{word}: no such option" + (f" (did you mean --{like[0]}?)" if like else "")


def _unknown_command(word: str, commands: Mapping[str, type]) -> str:
    """What stands first, where only a command, or one of `_ALONE` alone, may."""
    if word in _ALONE:
        return f"{word}: alone, or behind a command"
    if word.startswith("-"):
        like = get_close_matches(word, _ALONE, 1, 0.7)
        hint = f" (did you mean {like[0]}?)" if like else ""
        return f"{word}: no such option without a command{hint}"
    return f"{word or repr(word)}: no such command ({_hint(word, commands)})"


def _missing(lines: list[str]) -> list[str]:
    """Options that are required: those with four spaces before them, not their help."""
    found = _section(lines, "Missing from gsjax")[1:]
    return [x.strip() for x in found if re.match(r" {4}\S", x)]


def _plain(lines: list[str]) -> str:
    """All of it, without advice."""
    text = "\n".join(line.strip() for line in lines)
    parts = [one_line(part) for part in text.split("\n\n")]
    advice = ("For full helptext", "Argument helptext")
    parts = [part for part in parts if part and not part.startswith(advice)]
    return _shortened("; ".join(parts)).rstrip(".") or "wrong usage"


def _shortened(text: str) -> str:
    """Of a value that cannot be, only what it is and what is wanted."""
    choice = re.search(
        r"invalid choice '(.*)' for argument '(.+)'\. Exp.*\((.*)\)", text
    )
    if choice is not None:
        value, option, listed = choice.groups()
        there = re.findall(r"'([^']*)'", listed)
        return f"{option} {value}: no such choice ({_hint(value, there)})"
    missing = re.search(r"Missing value for argument \W*?(-[\w-]+)", text)
    if missing is not None:
        return f"{missing[1]}: a value is wanted"
    why = r"(?:literal for (int)\(\) with base 10|convert string to (float)): (.+)"
    found = re.search(rf"Error parsing (\S+): .*{why}", text)
    if found is None:
        return text
    option, whole, _, value = found.groups()
    return f"{option} {value}: a {'whole ' if whole else ''}number is wanted"


def _hint(word: str, there: Collection[str]) -> str:
    """What may have been meant, or else what there is."""
    like = get_close_matches(word.lower(), there, 1) if len(word) > 2 else []
    return f"did you mean {like[0]}?" if like else f"there are {', '.join(there)}"
