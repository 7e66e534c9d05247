"""3D Gaussian splatting in pure JAX: exact, differentiable, tiled.

The names are those of `gsjax.public`, each loaded when it is first asked for. So
importing a module of gsjax does not import JAX, and the command line has begun, and
answers to Ctrl-C, before that does.
"""

import typing

if typing.TYPE_CHECKING:
    from gsjax.public import *  # noqa: F403
else:

    def __getattr__(name: str):
        from importlib import import_module
        from importlib.util import find_spec

        if name == "__all__":
            public = import_module("gsjax.public")
            return [each for each in vars(public) if not each.startswith("_")]
        if not name.startswith("_"):
            # A module first: what imports it may be half imported itself.
            if find_spec(f"gsjax.{name}"):
                return import_module(f"gsjax.{name}")
            public = import_module("gsjax.public")
            if hasattr(public, name):
                return globals().setdefault(name, getattr(public, name))
        raise AttributeError(f"module 'gsjax' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__getattr__("__all__")})
