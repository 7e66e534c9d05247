"""The rules of the house, read from the code and from traced programs."""

import ast
import inspect
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from conftest import ALL, LIGHT, camera_of, frustum_points, gaussians_at, run_python

import gsjax
from gsjax import RasterConfig

PACKAGE = Path(gsjax.__file__).parent
ROOT = PACKAGE.parent
# The packages, floor by floor: a module imports from lower floors and from its own
# package only.
FLOORS = (
    "errors",
    "runtime",
    "math",
    "gaussians cameras",
    "raster densify mesh",
    "io planning",
    "data",
    "init sfm synthetic",
    "train",
    "compression",
    "plots",
    "runs",
    "viewer",
    "bench stress",
    "cli",
    "__init__ __main__",
)
FLOOR = {name: floor for floor, row in enumerate(FLOORS) for name in row.split()}


def sources(*folders: str) -> dict[Path, str]:
    """Return the text of every Python file below folders of the repository."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT): path.read_text(encoding="utf-8") for path in paths}


@cache
def trees() -> list[tuple[Path, ast.AST]]:
    """Return the parsed modules of the package."""
    return [(path, ast.parse(text)) for path, text in sources("gsjax").items()]


def nodes(*kinds: type) -> Iterator[tuple[Path, Any]]:
    """Yield the nodes of these kinds in the package."""
    for path, tree in trees():
        yield from ((path, n) for n in ast.walk(tree) if isinstance(n, kinds))


def module_name(path: Path) -> str:
    return ".".join(part for part in path.with_suffix("").parts if part != "__init__")


@cache
def imports() -> set[tuple[str, str]]:
    """Return (importer, imported) modules of the package, also those within functions.

    The public names in `gsjax` itself are left out: they are imported lazily.
    """
    found = set()
    for path, node in nodes(ast.Import, ast.ImportFrom):
        names = [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            inner = [f"{node.module}.{name}" for name in names]
            names = [name if is_module(name) else str(node.module) for name in inner]
        found |= {(module_name(path), n) for n in names if n.startswith("gsjax.")}
    return {pair for pair in found if pair[0] != "gsjax"}


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").exists()


def test_imports_run_downward():
    entries = {path.stem for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert entries == set(FLOOR)
    assert len(entries) <= 24
    found = [(a, b, a.split(".")[1], b.split(".")[1]) for a, b in imports()]
    pairs = [(a, b, FLOOR[of], FLOOR[to]) for a, b, of, to in found if of != to]
    assert len(pairs) > 100
    assert not [pair for pair in pairs if pair[2] <= pair[3]]


def test_no_circular_imports():
    graph: dict[str, set[str]] = {}
    for importer, imported in imports():
        graph.setdefault(importer, set()).add(imported)
    order = TopologicalSorter(graph).static_order()  # raises if there is a circle
    assert len(list(order)) > 100


def seen_by(package: str) -> set[str]:
    """Return the modules that those of a package import."""
    found = {b for a, b in imports() if a.startswith(f"gsjax.{package}")}
    assert found
    return found


def test_lists_see_footprints_and_compositing_sees_splats():
    hidden = ("gsjax.raster.primitives", "gsjax.gaussians", "gsjax.cameras")
    seen = seen_by("raster.lists")
    assert not [b for b in seen if b.startswith((*hidden, "gsjax.raster.compositing"))]
    assert not [b for b in seen_by("raster.compositing") if b.startswith(hidden)]


def test_one_module_asks_for_the_backend():
    asking = {p for p, text in sources("gsjax").items() if "default_backend" in text}
    assert asking == {Path("gsjax/runtime/devices.py")}


def test_no_private_jax():
    files = sources("gsjax", "tests", "benchmarks", "notebooks", "docs")
    private = "jax." + "_src"
    assert not [path for path, text in files.items() if private in text]


def test_docstrings_begin_with_a_verb_or_a_noun():
    begins = re.compile(r"(What|Of|Whose|Whether|Where|How)\b")
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [(path, ast.get_docstring(node) or "") for path, node in nodes(*kinds)]
    assert not [found for found in texts if begins.match(found[1])]


def test_nothing_is_wanted():
    files = sources("gsjax")
    for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        files[path.relative_to(ROOT)] = path.read_text(encoding="utf-8")
    wanted = re.compile(r"\b(is|are)\s+wanted\b")
    assert not [path for path, text in files.items() if wanted.search(text)]


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 170


# Each extension point of `fit` is an argument, passed by keyword.
MANY_PARAMETERS = {"gsjax.train.loop.fit"}
# The nested loops of one kernel share their values.
LONG = {
    "gsjax.raster.compositing.fused.composite_fused",
    "gsjax.raster.compositing.fused_vjp.backward",
    "gsjax.raster.compositing.fused_window.composite_window",
    "gsjax.raster.compositing.fused_window_vjp.backward",
}


def test_functions_are_short_and_take_few_parameters():
    """At most 65 lines of code; docstrings and decorators do not count."""
    many, long = set(), set()
    for path, node in nodes(ast.FunctionDef):
        name, given = f"{module_name(path)}.{node.name}", node.args
        if len(given.posonlyargs + given.args + given.kwonlyargs) > 8:
            many.add(name)
        body = node.body[ast.get_docstring(node) is not None :] or node.body
        if (node.end_lineno or 0) - body[0].lineno + 1 > 65:
            long.add(name)
    assert many <= MANY_PARAMETERS
    assert long <= LONG


def test_the_rasteriser_has_few_doors():
    doors = {"render", "exact", "types", "reference", "memory_estimate"}
    doors |= {"argument_checks", "tile_render"}  # messages; `device_count`
    doors |= {"sampling"}  # places between pixels, for `gsjax bench`
    doors |= {"contribution"}  # importance of Gaussians, for compression
    inside = ("gsjax.raster", "gsjax.stress")  # the latter examines every stage
    used = {b for a, b in imports() if not a.startswith(inside)}
    used = {name for name in used if name.startswith("gsjax.raster.")}
    assert used
    assert used <= {f"gsjax.raster.{name}" for name in doors}


def test_importing_is_light():
    heavy = ("jax", "numpy", "cv2", "pycolmap", "tyro", "scipy", "matplotlib", "viser")
    code = f"import gsjax, sys; print([m for m in {heavy} if m in sys.modules])"
    assert run_python("-c", code).stdout.strip() == "[]"


def test_imports_are_declared():
    """Dependencies of dependencies do not count."""
    packages = {"cv2": "opencv-contrib-python-headless"}
    packages |= {"PIL": "pillow", "pillow_heif": "pillow-heif"}
    # Each comes with a dependency, and is used together with that alone: viser brings
    # `rich` and `msgspec`.
    brought = {"IPython", "msgspec", "rich"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"]]
    lines += [*extras["viewer"], *extras["movies"], *extras["heic"]]
    declared = {re.split("[^A-Za-z0-9_-]", line)[0] for line in lines}
    found = {str(node.module).split(".")[0] for _, node in nodes(ast.ImportFrom)}
    for _, node in nodes(ast.Import):
        found |= {alias.name.split(".")[0] for alias in node.names}
    found -= {*sys.stdlib_module_names, "gsjax", *brought}
    assert {packages.get(name, name) for name in found} == declared


def test_public_names_are_loaded_on_use():
    """The names for type checkers are those at run time."""
    tree = ast.parse(Path(gsjax.__file__).read_text())
    typed = {
        alias.asname: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname
    }
    assert sorted(typed) == sorted(gsjax.__all__)
    assert set(typed) <= set(dir(gsjax))
    for name, module in typed.items():
        value = getattr(gsjax, name)
        assert value is getattr(sys.modules[module], name)
        assert inspect.ismodule(value) or value.__module__.startswith("gsjax.")
    assert gsjax.data.splits.split_views is gsjax.split_views
    with pytest.raises(AttributeError, match="module 'gsjax' has no attribute 'rend'"):
        _ = gsjax.rend


def sixteen(degree=3):
    points = frustum_points(np.random.default_rng(0), 16)
    return gaussians_at(points, 0.1, 0.5, degree=degree)


def traced(degree: int, outputs) -> str:
    config = RasterConfig(**LIGHT, outputs=outputs)
    render = jax.make_jaxpr(lambda g, c: gsjax.render(g, c, config))
    return str(render(sixteen(degree), camera_of()))


def test_static_choices_cost_nothing_when_not_taken():
    """Neither higher harmonics nor unused outputs are part of a program."""
    basis = "0.4886025"  # the constant of degree 1
    whole = traced(0, ALL)
    assert basis in traced(1, ("rgb",))
    assert basis not in whole
    for left_out in ("rgb", "depth", "median_depth"):
        fewer = tuple(name for name in ALL if name != left_out)
        assert len(traced(0, fewer)) < len(whole)


def test_another_camera_does_not_recompile():
    config = RasterConfig(**LIGHT, outputs=("alpha",))
    render = jax.jit(lambda scene, camera: gsjax.render(scene, camera, config))
    for eye in ((0, 0, -3), (1, 2, 3), (5, 0, 0)):
        render(sixteen(), camera_of(viewmat=gsjax.look_at(eye, (0, 0, 0))))
    assert render._cache_size() == 1
