"""Which photographs are learnt from, and which are kept to measure with."""

import difflib
from collections.abc import Sequence
from pathlib import PurePosixPath

from gsjax.data.types import View
from gsjax.errors import InputError
from gsjax.runtime.settings import whole

_EVERY = 8


def split_views(
    views: Sequence[View], every: int | None = None, test_names: Sequence[str] = ()
) -> tuple[list[int], list[int]]:
    """Indices of the views to train with, and of those to test with.

    Names that are given win; else a distance that is given; else the dataset's own
    test views, if it names any; else every 8th view in the order of names, the first
    included, is for testing, as in the papers of the field.

    Args:
      views: all views.
      every: distance of test views in the order of names; 0 for none. None leaves it
        to the dataset, else 8.
      test_names: name, or names, of test views; the part behind the last "/" is enough
        where no other view has it.

    Raises:
      InputError: on an unknown or ambiguous name, an ``every`` that is negative or not
        whole, or if there is no view, or none is left to train with.
    """
    if not views:
        raise InputError("there are no views to split; at least one is wanted")
    every = None if every is None else whole("every", every)
    if every is not None and every < 0:
        raise InputError(f"every {every}: 0 (no test views) or more is wanted")
    if test_names:
        test_names = [test_names] if isinstance(test_names, str) else test_names
        test = {_index_of(views, name) for name in test_names}
    elif every is None and any(view.split == "test" for view in views):
        test = {index for index, view in enumerate(views) if view.split == "test"}
    else:
        every = _EVERY if every is None else every
        order = sorted(range(len(views)), key=lambda index: views[index].name)
        # A lone view is trained with: there is nothing to hold it against.
        test = set(order[::every]) if every and len(views) > 1 else set()
    train = [index for index in range(len(views)) if index not in test]
    if not train:
        raise InputError(
            f"all {len(views)} views are test views; leave some to train with: name "
            "fewer, or choose a larger distance between them (--test-every)"
        )
    return train, sorted(test)


def _index_of(views: Sequence[View], name: str) -> int:
    wholes = [index for index, view in enumerate(views) if view.name == name]
    lasts = [i for i, view in enumerate(views) if PurePosixPath(view.name).name == name]
    found = wholes or lasts
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(views[index].name for index in found[:5])
        raise InputError(f"test view {name!r} may be any of {names}; name one in full")
    names = [view.name for view in views]
    near = difflib.get_close_matches(name, names, n=5, cutoff=0.5)
    raise InputError(
        f"no view is called {name!r}; "
        + (f"near it are {', '.join(near)}" if near else f"names are like {names[:3]}")
    )
