"""Entries of docstrings for several names at once, "near, far: …", as one name each.

An extension of griffe, which would take what follows the first space for a type.
"""

import re

import griffe

_HEAD = re.compile(r"^ +\*{0,2}\w+(?:, \w+)+(?=: )", re.M)


class SeveralNames(griffe.Extension):
    """Holds such names together by spaces that do not break."""

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        """Called for each object that was read."""
        if obj.docstring is not None:
            obj.docstring.value = _HEAD.sub(
                lambda head: head[0].replace(", ", ",\u00a0"), obj.docstring.value
            )
