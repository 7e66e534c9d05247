"""Allow docstring entries for several names at once, such as "near, far: …".

An extension of griffe. Without it, griffe reads what follows the first space as a type,
and gives names that it does not know the type of the entry before.
"""

import re

import griffe

_HEAD = re.compile(r"^ +\*{0,2}\w+(?:, \w+)+(?=: )", re.MULTILINE)


class SeveralNames(griffe.Extension):
    """Join such names by non-breaking spaces and add their common type."""

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        """Rewrite the docstring of an object; griffe calls this for each."""
        if obj.docstring is not None:
            obj.docstring.value = _HEAD.sub(
                lambda head: _as_one(head[0], obj), obj.docstring.value
            )


def _as_one(head: str, obj: griffe.Object) -> str:
    """Return the joined names with "(type)", or "()" if their types differ."""
    kinds = [_kind(name, obj) for name in re.findall(r"\w+", head)]
    joined = head.replace(", ", ",\u00a0")
    if None in kinds:  # names of exceptions: they are the type
        return joined
    return f"{joined} ({kinds[0] if len(set(kinds)) == 1 else ''})"


def _kind(name: str, obj: griffe.Object) -> str | None:
    """Return the annotation of an attribute or argument; None if it is neither."""
    for known in (obj.members, getattr(obj, "parameters", ())):
        if name in known:
            return str(getattr(known[name], "annotation", None) or "")
    return None
