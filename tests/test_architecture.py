"""The house rules, read from the code and from the compiled programs."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from conftest import LIGHT, camera_of, frustum_points, gaussians_at

import gsjax
from gsjax import RasterConfig

PACKAGE = Path(gsjax.__file__).parent
FLOORS = {
    0: (
        *("errors", "files", "numerics", "rotations", "settings", "sh"),
        *("devices", "programs", "machine", "memory", "loops", "transposed"),
    ),
    1: ("gaussians", "cameras", "distortion"),
    2: ("raster", "densify", "losses", "metrics", "optim", "window"),
    3: ("io", "scene", "images", "movies", "sheets", "curves"),
}  # what is not named here is a program, floor 4


def floor_of(module: str) -> int:
    room = module.split(".")[1] if "." in module else ""
    return next((n for n, rooms in FLOORS.items() if room in rooms), 4)


def imports() -> list[tuple[str, str]]:
    """(importer, imported) modules within the package, wherever they stand."""
    found = []
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(p for p in parts if p != "__init__")
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                targets = [node.module]
                for alias in node.names:
                    inner = PACKAGE.parent.joinpath(*node.module.split("."), alias.name)
                    if inner.with_suffix(".py").exists():
                        targets = [f"{node.module}.{alias.name}"]
            elif isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            else:
                continue
            found += [(name, t) for t in targets if t.split(".")[0] == "gsjax"]
    return found


def test_imports_run_downward():
    pairs = [(a, b) for a, b in imports() if a != "gsjax"]
    assert len(pairs) > 30
    upward = [(a, b) for a, b in pairs if b != "gsjax" and floor_of(b) > floor_of(a)]
    assert not upward


def test_no_circles():
    graph: dict[str, set[str]] = {}
    for importer, imported in imports():
        if importer != "gsjax" and imported != "gsjax":
            graph.setdefault(importer, set()).add(imported)
    done, path = set(), []

    def visit(module):
        assert module not in path, f"circle: {[*path, module]}"
        if module in done:
            return
        path.append(module)
        for other in graph.get(module, ()):
            visit(other)
        path.pop()
        done.add(module)

    for module in list(graph):
        visit(module)
    assert len(done) > 15


def test_the_rasteriser_has_one_door():
    doors = {"gsjax.raster." + name for name in ("render", "types", "reference")}
    inside = ("gsjax.raster", "gsjax.stress")  # the latter examines every stage
    outside = {
        b
        for a, b in imports()
        if b.startswith("gsjax.raster.") and not a.startswith(inside)
    }
    assert outside
    assert outside <= doors


def test_importing_is_light():
    heavy = ("jax", "cv2", "pycolmap", "tyro", "scipy.spatial", "matplotlib", "viser")
    code = f"import gsjax, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_what_is_imported_is_declared():
    """Not left to what another package happens to bring along."""
    packages = {"cv2": "opencv-contrib-python-headless"}
    brought = {"IPython": "a notebook", "rich": "viser"}  # in these alone it is used
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"], *project["optional-dependencies"]["viewer"]]
    declared = {re.split("[^A-Za-z0-9_-]", line)[0] for line in lines}
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.split(".")[0])
    found -= {*sys.stdlib_module_names, "gsjax", *brought}
    assert {packages.get(name, name) for name in found} == declared


def test_public_names_come_when_asked_for():
    names = [name for name in vars(gsjax.public) if not name.startswith("_")]
    assert set(names) <= set(dir(gsjax))
    starred: dict[str, object] = {}
    exec("from gsjax import *", starred)
    for name in names:
        assert starred[name] is getattr(gsjax, name) is getattr(gsjax.public, name)
    assert gsjax.__all__ == names
    assert gsjax.data.splits.split_views is gsjax.split_views
    with pytest.raises(AttributeError, match="module 'gsjax' has no attribute 'rend'"):
        _ = gsjax.rend


def program(degree: int, outputs) -> str:
    scene = gaussians_at(
        frustum_points(np.random.default_rng(0), 16), 0.1, 0.5, degree=degree
    )
    config = RasterConfig(**LIGHT, outputs=outputs)
    return str(jax.make_jaxpr(lambda g, c: gsjax.render(g, c, config))(
        scene, camera_of()
    ))  # fmt: skip


def test_degree_0_has_no_basis_and_no_direction():
    basis = "0.4886025"  # the constant of degree 1, which every higher one has
    assert basis in program(1, ("rgb",))
    assert basis in program(3, ("rgb",))
    assert basis not in program(0, ("rgb",))


@pytest.mark.parametrize("left_out", ["rgb", "depth", "median_depth"])
def test_what_is_not_asked_for_is_not_in_the_program(left_out):
    everything = ("rgb", "alpha", "depth", "median_depth")
    fewer = tuple(o for o in everything if o != left_out)
    assert len(program(0, fewer)) < len(program(0, everything))


def test_another_camera_does_not_recompile():
    scene = gaussians_at(frustum_points(np.random.default_rng(0), 16), 0.1, 0.5)
    config = RasterConfig(**LIGHT, outputs=("alpha",))
    # A function of its own: JAX counts what other tests compiled of `gsjax.render` too.
    render = jax.jit(lambda scene, camera: gsjax.render(scene, camera, config))
    for eye in ((0, 0, -3), (1, 2, 3), (5, 0, 0)):
        render(scene, camera_of(viewmat=gsjax.look_at(eye, (0, 0, 0))))
    assert render._cache_size() == 1
