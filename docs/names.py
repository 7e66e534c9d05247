"""Entries of docstrings for several names at once, "near, far: …", as one name each.

An extension of griffe, which would take what follows the first space for a type, and
for names that it does not know would give the type of the entry before.
"""

import re

import griffe

_HEAD = re.compile(r"^ +\*{0,2}\w+(?:, \w+)+(?=: )", re.M)


class SeveralNames(griffe.Extension):
    """Holds such names together by spaces that do not break, with the type of all."""

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        """Called for each object, once all were read."""
        if obj.docstring is not None:
            obj.docstring.value = _HEAD.sub(
                lambda head: _as_one(head[0], obj), obj.docstring.value
            )


def _as_one(head: str, obj: griffe.Object) -> str:
    """The names as one, and "(their type)": nothing in the brackets if they differ."""
    kinds = [_kind(name, obj) for name in re.findall(r"\w+", head)]
    joined = head.replace(", ", ",\u00a0")
    if None in kinds:  # errors that are raised: they are the type
        return joined
    return f"{joined} ({kinds[0] if len(set(kinds)) == 1 else ''})"


def _kind(name: str, obj: griffe.Object) -> str | None:
    """The annotation of an attribute or argument, "" without; None if it is neither."""
    for known in (obj.members, getattr(obj, "parameters", ())):
        if name in known:
            return str(getattr(known[name], "annotation", None) or "")
    return None
