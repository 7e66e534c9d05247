"""Split of the views of a dataset into training and test views."""

import difflib
from collections.abc import Sequence
from pathlib import PurePosixPath

from gsjax.data.image_files import natural_order
from gsjax.data.types import View, unexpected
from gsjax.errors import InputError
from gsjax.runtime.settings import as_int

_EVERY = 8


def split_views(
    views: Sequence[View], every: int | None = None, test_names: Sequence[str] = ()
) -> tuple[list[int], list[int]]:
    """Return the indices of the training views and of the test views.

    The test views are, in order of precedence: the given names; every ``every``-th view
    in the order of names, the first included, as is usual in the literature with 8; the
    dataset's own test views, if it names any; one of 8 views, spread evenly and
    away from the ends of the order, which no other photograph surrounds.

    Args:
      views: all views.
      every: distance of test views in the order of names; 0 for none. None leaves the
        choice to the dataset, else to the order.
      test_names: name or names of test views; the part after the last "/" suffices if
        it is unique.

    Raises:
      InputError: if a name is unknown or ambiguous, ``every`` is negative or not whole,
        there is no view, or no view is left to train with.
    """
    if not views:
        raise unexpected("views", "at least one to split", "none", "pass a dataset's")
    every = None if every is None else as_int("every", every)
    if every is not None and every < 0:
        raise unexpected("every", "0 (no test views) or more", every, "pass 8")
    if test_names:
        test_names = [test_names] if isinstance(test_names, str) else test_names
        test = {_index_of(views, name) for name in test_names}
    elif every is None and any(view.split == "test" for view in views):
        test = {index for index, view in enumerate(views) if view.split == "test"}
    else:
        test = set(_inner(views) if every is None else _at_distance(views, every))
    train = [index for index in range(len(views)) if index not in test]
    if not train:
        raise InputError(
            f"all {len(views)} views are test views, none is left to train with; name "
            "fewer, or choose a larger distance between them (--test-every)"
        )
    return train, sorted(test)


def _at_distance(views: Sequence[View], every: int) -> list[int]:
    """Return the first and every ``every``-th after it; none for 0, or of one view."""
    order = sorted(range(len(views)), key=lambda index: views[index].name)
    return order[::every] if every and len(views) > 1 else []


def _inner(views: Sequence[View]) -> list[int]:
    """Return one of 8, in the middles of parts of equal length."""
    order = sorted(
        range(len(views)), key=lambda index: natural_order(views[index].name)
    )
    count = -(-len(order) // _EVERY) if len(order) > 1 else 0
    return [order[(2 * i + 1) * len(order) // (2 * count)] for i in range(count)]


def _index_of(views: Sequence[View], name: str) -> int:
    wholes = [index for index, view in enumerate(views) if view.name == name]
    lasts = [i for i, view in enumerate(views) if PurePosixPath(view.name).name == name]
    found = wholes or lasts
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(views[index].name for index in found[:5])
        raise InputError(
            f"test view {name!r}: ambiguous among {names}; name one in full"
        )
    names = [view.name for view in views]
    near = difflib.get_close_matches(name, names, n=5, cutoff=0.5)
    raise InputError(
        f"test view {name!r}: no view has this name; pass one of "
        + (", ".join(near) if near else f"{len(names)} such as {', '.join(names[:3])}")
    )
