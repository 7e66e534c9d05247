"""Training and test views: their order of precedence, names, and bad arguments."""

from dataclasses import replace

import pytest
from captures import dataset_of_views, rejects, with_names

from gsjax.data.splits import split_views

NAMES = [f"img_{n:02d}.jpg" for n in range(20)]


def views_of(names, splits=None):
    views = with_names(dataset_of_views(len(names)), names).views
    return [replace(v, split=s) for v, s in zip(views, splits or [None] * len(names))]


SPLIT = views_of(NAMES[:4], ["train", "test", "train", "test"])
FOLDERS = views_of(["a/1.png", "a/2.png", "b/1.png", "1.png"])


@pytest.mark.parametrize(
    ("views", "options", "test"),
    [
        (views_of(NAMES), {}, [0, 8, 16]),
        (views_of(NAMES), {"every": 0}, []),
        (views_of(NAMES[::-1]), {}, [3, 11, 19]),  # in the order of names
        (views_of(NAMES[:1]), {}, []),
        (views_of(NAMES[:2]), {}, [0]),
        (SPLIT, {}, [1, 3]),
        (SPLIT, {"every": 3}, [0, 3]),
        (SPLIT, {"every": 0}, []),
        (SPLIT, {"test_names": [NAMES[0]]}, [0]),
        # A dataset without test views, as one without any split.
        (views_of(NAMES, ["train"] * 20), {}, [0, 8, 16]),
        (views_of(NAMES, ["train"] * 19 + [None]), {"every": 5}, [0, 5, 10, 15]),
        (views_of(NAMES), {"test_names": NAMES[5:7]}, [5, 6]),
        (views_of(NAMES), {"test_names": NAMES[5]}, [5]),  # not its letters
        (FOLDERS, {"test_names": ["2.png"]}, [1]),
        (FOLDERS, {"test_names": ["1.png", "b/1.png"]}, [2, 3]),
    ],
)
def test_splits(views, options, test):
    train = [index for index in range(len(views)) if index not in test]
    assert split_views(views, **options) == (train, test)


@pytest.mark.parametrize(
    ("views", "options", "expected"),
    [
        (FOLDERS[:3], {"test_names": ["1.png"]}, r"ambiguous among a/1\.png, b/1\.png"),
        (views_of(NAMES), {"test_names": ["img_5.jpg"]}, r"pass one of .*img_05\.jpg"),
        (views_of(NAMES), {"test_names": ["xyz"]}, r"20 such as img_00\.jpg"),
        (views_of(NAMES), {"every": -1}, "every: expected 0 .* got -1"),
        (views_of(NAMES), {"every": 1}, "all 20 views are test views"),
        (views_of(NAMES), {"every": 2.5}, "every.*2.5"),
        ([], {}, "views: expected at least one"),
    ],
)
def test_bad_splits(views, options, expected):
    rejects(expected, split_views, views, **options)
