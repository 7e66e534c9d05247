"""Settings: numbers become Python's, what is none is refused by class and field."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax import InputError, RasterConfig
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.runtime.settings import number, whole
from gsjax.train.config import Level, TrainConfig
from gsjax.train.optimiser import Rates

CLASSES = (RasterConfig, AdaptiveSettings, McmcSettings, TrainConfig)


@pytest.mark.parametrize(
    "value", [7, np.int64(7), np.uint8(7), np.asarray(7), 7.0, np.float32(7)], ids=repr
)
def test_whole_numbers(value):
    found = whole("x", value)
    assert found == 7
    assert type(found) is int


@pytest.mark.parametrize(
    "value", [7.5, np.nan, np.inf, "7", None, True, np.True_, [7], 7j], ids=repr
)
def test_no_whole_numbers(value):
    with pytest.raises(InputError, match=r"^x: expected a whole number"):
        whole("x", value)


@pytest.mark.parametrize(
    "value", [0.5, np.float64(0.5), np.float32(0.5), Fraction(1, 2)], ids=repr
)
def test_numbers(value):
    found = number("x", value)
    assert found == 0.5
    assert type(found) is float


@pytest.mark.parametrize(
    "value", [np.nan, -np.inf, "0.5", None, True, [0.5], 0.5j], ids=repr
)
def test_no_numbers(value):
    with pytest.raises(InputError, match=r"^x: expected a finite number"):
        number("x", value)


@pytest.mark.parametrize("kind", CLASSES)
def test_numbers_of_numpy_become_those_of_python(kind):
    """A float64 of NumPy would widen a program of float32; and all hash alike."""
    plain = kind()
    given = {
        name: np.asarray(value)[()]
        for name, value in vars(plain).items()
        if type(value) in (int, float, bool)
    }
    assert len(given) > 4
    found = kind(**given)
    assert found == plain
    for name, value in vars(plain).items():
        assert type(getattr(found, name)) is type(value), name


@pytest.mark.parametrize(
    ("kind", "name", "value", "told"),
    [
        (RasterConfig, "tile_size", 8.5, "a whole number"),
        (RasterConfig, "tile_size", True, "a whole number"),
        (RasterConfig, "pair_capacity", "100", "a whole number"),
        (RasterConfig, "visible_capacity", 10.5, "a whole number"),
        (RasterConfig, "transmittance_min", "0", "a finite number"),
        (RasterConfig, "dilation", None, "a finite number"),
        (RasterConfig, "antialias", 1, "True or False"),
        (RasterConfig, "absgrad", "yes", "True or False"),
        (AdaptiveSettings, "every", 1.5, "a whole number"),
        (AdaptiveSettings, "threshold", np.nan, "a finite number"),
        (McmcSettings, "max_gaussians", 10.5, "a whole number"),
        (McmcSettings, "growth", "fast", "a finite number"),
        (TrainConfig, "steps", 100.5, "a whole number"),
        (TrainConfig, "max_size", 99.5, "a whole number"),
        (TrainConfig, "ssim_weight", None, "a finite number"),
        (TrainConfig, "refine_poses", 2, "True or False"),
    ],
    ids=str,
)
def test_what_is_of_another_kind(kind, name, value, told):
    with pytest.raises(InputError, match=rf"{kind.__name__}\.{name} = .*: {told}"):
        kind(**{name: value})


def test_an_array_is_no_number():
    with pytest.raises(InputError, match=r"RasterConfig\.stop = "):
        RasterConfig(transmittance_min=jnp.ones(2))  # pyright: ignore


def test_none_stays_where_it_may_be():
    assert RasterConfig(visible_capacity=None).visible_capacity is None
    assert TrainConfig(max_size=None).max_size is None


def test_levels():
    with pytest.raises(InputError, match=r"Level\.divisor = 1\.5"):
        Level(0.0, 1.5)  # pyright: ignore
    assert type(Level(0, np.int32(2)).divisor) is int


RATES = TrainConfig().rates


@pytest.mark.parametrize(
    "rates",
    [
        RATES._replace(means=(-1e-3, 1e-3)),
        RATES._replace(means=(1e-3, 0.0)),  # on no geometric path
        RATES._replace(means=(np.inf, 1e-3)),
        RATES._replace(quats=-1e-3),
        RATES._replace(logit_opacities=np.inf),
        RATES._replace(log_scales=np.nan),
        RATES._replace(sh_dc="fast"),
        RATES._replace(cooling=0.0),
        RATES._replace(cooling=1.5),
        RATES._replace(cooling_from=1.0),
        RATES._replace(cooling_from=-0.1),
    ],
    ids=str,
)
def test_rates(rates):
    with pytest.raises(InputError, match=r"(TrainConfig\.r|R)ates"):
        TrainConfig(rates=rates)


def test_rates_that_do_nothing_are_none():
    still = Rates((0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)
    assert TrainConfig(rates=still).rates == still
    wide = RATES._replace(quats=np.float64(1e-3))
    assert type(TrainConfig(rates=wide).rates.quats) is float


@pytest.mark.parametrize("name", ["pose_rate", "intrinsics_rate", "exposure_rate"])
@pytest.mark.parametrize("value", [-1e-3, np.inf])
def test_rates_of_corrections(name, value):
    with pytest.raises(InputError, match=rf"TrainConfig\.{name} = "):
        TrainConfig(**{name: value})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"strategy": "best"}, "strategy"),
        (
            {"strategy": "mcmc", "mcmc": McmcSettings(initial_opacity=1.0)},
            "mcmc's initial_opacity",
        ),
        (
            {"strategy": "adaptive", "adaptive": AdaptiveSettings(initial_scale=0)},
            "adaptive's initial_scale",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_of_a_strategy(changes, named):
    with pytest.raises(InputError, match=rf"TrainConfig\.{named} = "):
        TrainConfig(**changes)
