"""The rules of the house, read from the code and from traced programs."""

import ast
import inspect
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
from conftest import LIGHT, camera_of, frustum_points, gaussians_at

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
    "raster densify",
    "io planning",
    "data",
    "init sfm synthetic",
    "train",
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


def module_name(path: Path) -> str:
    return ".".join(part for part in path.with_suffix("").parts if part != "__init__")


@cache
def imports() -> set[tuple[str, str]]:
    """Return (importer, imported) modules of the package, also those within functions.

    The public names in `gsjax` itself are left out: they are imported lazily.
    """
    found = set()
    for path, tree in trees():
        importer = module_name(path)
        for node in ast.walk(tree) if importer != "gsjax" else ():
            targets = []
            if isinstance(node, ast.ImportFrom) and node.module:
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                targets = [name if is_module(name) else node.module for name in inner]
            elif isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            found |= {(importer, t) for t in targets if t.startswith("gsjax.")}
    return found


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").exists()


def package_of(module: str) -> str:
    return module.split(".")[1]


def test_packages():
    entries = {path.stem for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert entries == set(FLOOR)
    assert len(entries) <= 22


def test_imports_run_downward():
    pairs = {(a, b) for a, b in imports() if package_of(a) != package_of(b)}
    assert len(pairs) > 100
    upward = [(a, b) for a, b in pairs if FLOOR[package_of(a)] <= FLOOR[package_of(b)]]
    assert not upward


def test_no_circular_imports():
    graph: dict[str, set[str]] = {}
    for importer, imported in imports():
        graph.setdefault(importer, set()).add(imported)
    done, path = set(), []

    def visit(module):
        assert module not in path, f"circle: {[*path, module]}"
        if module not in done:
            path.append(module)
            for other in graph.get(module, ()):
                visit(other)
            path.pop()
            done.add(module)

    for module in list(graph):
        visit(module)
    assert len(done) > 100


@pytest.mark.parametrize(
    ("folder", "hidden"),
    [
        ("raster.lists", "raster.primitives raster.compositing gaussians cameras"),
        ("raster.compositing", "raster.primitives gaussians cameras"),
    ],
)
def test_lists_see_footprints_and_compositing_sees_splats(folder, hidden):
    prefixes = tuple(f"gsjax.{name}" for name in hidden.split())
    seen = [(a, b) for a, b in imports() if a.startswith(f"gsjax.{folder}")]
    assert seen
    assert not [pair for pair in seen if pair[1].startswith(prefixes)]


def test_one_module_asks_for_the_backend():
    asking = {p for p, text in sources("gsjax").items() if "default_backend" in text}
    assert asking == {Path("gsjax/runtime/devices.py")}


def test_no_private_jax():
    files = sources("gsjax", "tests", "benchmarks", "notebooks", "docs")
    private = "jax." + "_src"
    assert not [path for path, text in files.items() if private in text]


def docstrings() -> Iterator[tuple[str, str]]:
    """Yield where each docstring is, and its text."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for path, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, kinds) and (text := ast.get_docstring(node)):
                yield f"{path}:{getattr(node, 'lineno', 1)}", text


def test_docstrings_begin_with_a_verb_or_a_noun():
    begins = re.compile(r"(What|Of|Whose|Whether|Where|How)\b")
    assert not [place for place, text in docstrings() if begins.match(text)]


def test_nothing_is_wanted():
    files = sources("gsjax")
    for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        files[path.relative_to(ROOT)] = path.read_text(encoding="utf-8")
    wanted = re.compile(r"\b(is|are)\s+wanted\b")
    assert not [path for path, text in files.items() if wanted.search(text)]


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 170


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    for path, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                yield f"{module_name(path)}.{node.name}", node


# Each extension point of `fit` is an argument, passed by keyword.
MANY_PARAMETERS = {"gsjax.train.loop.fit"}
# The nested loops of one kernel share their values.
LONG = {
    "gsjax.raster.compositing.fused.composite_fused",
    "gsjax.raster.compositing.fused_vjp.backward",
}


def test_functions_take_few_parameters():
    def count(node):
        arguments = node.args
        return len(arguments.posonlyargs + arguments.args + arguments.kwonlyargs)

    many = {name for name, node in functions() if count(node) > 8}
    assert many <= MANY_PARAMETERS


def test_functions_are_short():
    """At most 65 lines of code; docstrings and decorators do not count."""

    def lines(node):
        body = node.body[ast.get_docstring(node) is not None :] or node.body
        return (node.end_lineno or 0) - body[0].lineno + 1

    assert {name for name, node in functions() if lines(node) > 65} <= LONG


def test_the_rasteriser_has_few_doors():
    doors = {"render", "exact", "types", "reference", "memory_estimate"}
    doors |= {"argument_checks", "tile_render"}  # messages; `device_count`
    inside = ("gsjax.raster", "gsjax.stress")  # the latter examines every stage
    outside = {
        b
        for a, b in imports()
        if b.startswith("gsjax.raster.") and not a.startswith(inside)
    }
    assert outside
    assert outside <= {f"gsjax.raster.{name}" for name in doors}


def test_importing_is_light():
    heavy = ("jax", "numpy", "cv2", "pycolmap", "tyro", "scipy", "matplotlib", "viser")
    code = f"import gsjax, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_imports_are_declared():
    """Dependencies of dependencies do not count."""
    packages = {"cv2": "opencv-contrib-python-headless"}
    # Each comes with a dependency, and is used together with that alone; `zstandard` is
    # JAX's optional one.
    brought = {"IPython", "rich", "zstandard"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"], *project["optional-dependencies"]["viewer"]]
    declared = {re.split("[^A-Za-z0-9_-]", line)[0] for line in lines}
    found = set()
    for _, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.split(".")[0])
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


def traced(degree: int, outputs) -> str:
    scene = gaussians_at(
        frustum_points(np.random.default_rng(0), 16), 0.1, 0.5, degree=degree
    )
    config = RasterConfig(**LIGHT, outputs=outputs)
    render = jax.make_jaxpr(lambda g, c: gsjax.render(g, c, config))
    return str(render(scene, camera_of()))


def test_static_choices_cost_nothing_when_not_taken():
    """Neither higher harmonics nor unused outputs are part of a program."""
    basis = "0.4886025"  # the constant of degree 1
    everything = ("rgb", "alpha", "depth", "median_depth")
    whole = traced(0, everything)
    assert basis in traced(1, ("rgb",))
    assert basis not in whole
    for left_out in ("rgb", "depth", "median_depth"):
        fewer = tuple(name for name in everything if name != left_out)
        assert len(traced(0, fewer)) < len(whole)


def test_another_camera_does_not_recompile():
    scene = gaussians_at(frustum_points(np.random.default_rng(0), 16), 0.1, 0.5)
    config = RasterConfig(**LIGHT, outputs=("alpha",))
    render = jax.jit(lambda scene, camera: gsjax.render(scene, camera, config))
    for eye in ((0, 0, -3), (1, 2, 3), (5, 0, 0)):
        render(scene, camera_of(viewmat=gsjax.look_at(eye, (0, 0, 0))))
    assert render._cache_size() == 1
