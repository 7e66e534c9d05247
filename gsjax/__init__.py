"""3D Gaussian splatting in pure JAX: exact, differentiable, tiled.

Public names are loaded on first use, so importing gsjax does not import JAX. The import
prepares the process for rendering on CPUs; see `gsjax.runtime.setup.prepare_process`.
"""

import sys
import typing
from importlib import import_module
from importlib.util import find_spec

from gsjax.runtime.setup import prepare_process

if typing.TYPE_CHECKING:  # the same names as in `_PUBLIC`
    from gsjax.cameras.camera import Camera as Camera
    from gsjax.cameras.camera import look_at as look_at
    from gsjax.cameras.camera import make_camera as make_camera
    from gsjax.cameras.camera import resize_camera as resize_camera
    from gsjax.cameras.camera import stack_cameras as stack_cameras
    from gsjax.cameras.lenses import Lens as Lens
    from gsjax.compression.compress import compress as compress
    from gsjax.compression.types import CompressedScene as CompressedScene
    from gsjax.data.arrays import make_dataset as make_dataset
    from gsjax.data.dataset import load_dataset as load_dataset
    from gsjax.data.photos import load_photos as load_photos
    from gsjax.data.splits import split_views as split_views
    from gsjax.densify.types import Strategy as Strategy
    from gsjax.densify.types import apply_edit as apply_edit
    from gsjax.errors import CapacityError as CapacityError
    from gsjax.errors import DivergedError as DivergedError
    from gsjax.errors import GsjaxError as GsjaxError
    from gsjax.errors import InputError as InputError
    from gsjax.gaussians import GaussianParams as GaussianParams
    from gsjax.gaussians import Gaussians as Gaussians
    from gsjax.gaussians import capacity_bucket as capacity_bucket
    from gsjax.gaussians import compact as compact
    from gsjax.gaussians import concatenate as concatenate
    from gsjax.gaussians import grow as grow
    from gsjax.gaussians import make_gaussians as make_gaussians
    from gsjax.gaussians import num_active as num_active
    from gsjax.gaussians import select as select
    from gsjax.gaussians import with_sh_degree as with_sh_degree
    from gsjax.init.gaussians import init_gaussians as init_gaussians
    from gsjax.io.formats import load as load
    from gsjax.io.formats import save as save
    from gsjax.planning.plan import plan as plan
    from gsjax.planning.types import Plan as Plan
    from gsjax.raster.exact import exact_config as exact_config
    from gsjax.raster.exact import render_exact as render_exact
    from gsjax.raster.reference import reference_render as reference_render
    from gsjax.raster.render import render as render
    from gsjax.raster.types import RasterConfig as RasterConfig
    from gsjax.raster.types import Render as Render
    from gsjax.runtime.devices import use_all_cores as use_all_cores
    from gsjax.train.config import TrainConfig as TrainConfig
    from gsjax.train.config import preset as preset
    from gsjax.train.depth_loss import depth_loss as depth_loss
    from gsjax.train.depth_loss import depth_term as depth_term
    from gsjax.train.evaluation import evaluate as evaluate
    from gsjax.train.evaluation import summarise as summarise
    from gsjax.train.loop import Hooks as Hooks
    from gsjax.train.loop import fit as fit
    from gsjax.train.loop import subset as subset
    from gsjax.train.losses import LossTerm as LossTerm
    from gsjax.train.models import Model as Model
    from gsjax.train.models import ModelParams as ModelParams
    from gsjax.train.state import init_state as init_state
    from gsjax.train.state import load_state as load_state
    from gsjax.train.state import save_state as save_state
    from gsjax.train.step import make_train_step as make_train_step
    from gsjax.viewer import notebook as notebook
    from gsjax.viewer.notebook import save_movie as save_movie
    from gsjax.viewer.notebook import save_png as save_png

_PUBLIC = {
    "cameras.camera": "Camera look_at make_camera resize_camera stack_cameras",
    "cameras.lenses": "Lens",
    "compression.compress": "compress",
    "compression.types": "CompressedScene",
    "data.arrays": "make_dataset",
    "data.dataset": "load_dataset",
    "data.photos": "load_photos",
    "data.splits": "split_views",
    "densify.types": "Strategy apply_edit",
    "errors": "CapacityError DivergedError GsjaxError InputError",
    "gaussians": "GaussianParams Gaussians capacity_bucket compact concatenate grow "
    "make_gaussians num_active select with_sh_degree",
    "init.gaussians": "init_gaussians",
    "io.formats": "load save",
    "planning.plan": "plan",
    "planning.types": "Plan",
    "raster.exact": "exact_config render_exact",
    "raster.reference": "reference_render",
    "raster.render": "render",
    "raster.types": "RasterConfig Render",
    "runtime.devices": "use_all_cores",
    "train.config": "TrainConfig preset",
    "train.depth_loss": "depth_loss depth_term",
    "train.evaluation": "evaluate summarise",
    "train.loop": "Hooks fit subset",
    "train.losses": "LossTerm",
    "train.models": "Model ModelParams",
    "train.state": "init_state load_state save_state",
    "train.step": "make_train_step",
    "viewer": "notebook",
    "viewer.notebook": "save_movie save_png",
}
_MODULES = {name: module for module, names in _PUBLIC.items() for name in names.split()}
__all__ = list(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name in _MODULES:
        if "ipykernel" in sys.modules:  # a notebook: attach the display methods
            import_module("gsjax.viewer.notebook")
        module = import_module(f"gsjax.{_MODULES[name]}")
        if not hasattr(module, name):  # a submodule
            import_module(f"{module.__name__}.{name}")
        return globals().setdefault(name, getattr(module, name))
    if not name.startswith("_") and find_spec(f"gsjax.{name}"):
        return import_module(f"gsjax.{name}")
    raise AttributeError(f"module 'gsjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


prepare_process()
