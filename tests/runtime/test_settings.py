"""Settings: numbers become Python's; errors name the class, the field and the range."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax import InputError, RasterConfig
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.runtime.settings import as_float, as_int
from gsjax.train.config import Level, TrainConfig
from gsjax.train.optimiser import Rates

RATES = TrainConfig().rates


@pytest.mark.parametrize(
    ("convert", "values", "expected"),
    [
        (as_int, [7, np.int64(7), np.uint8(7), np.asarray(7), 7.0, np.float32(7)], 7),
        (as_float, [0.5, np.float64(0.5), np.float32(0.5), Fraction(1, 2)], 0.5),
    ],
)
def test_numbers_are_converted(convert, values, expected):
    for value in values:
        found = convert("x", value)
        assert found == expected
        assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("convert", "message", "values"),
    [
        (as_int, "a whole number", [7.5, np.nan, np.inf, "7", None, True, [7], 7j]),
        (as_float, "a finite number", [np.nan, -np.inf, "0.5", None, True, [0.5]]),
    ],
)
def test_other_values_are_rejected(convert, message, values):
    for value in values:
        with pytest.raises(InputError, match=rf"^x: expected {message}, got "):
            convert("x", value)


@pytest.mark.parametrize(
    "kind", [RasterConfig, AdaptiveSettings, McmcSettings, TrainConfig]
)
def test_numpy_scalars_become_python_numbers(kind):
    """A float64 of NumPy would promote a float32 program; and hashes must agree."""
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
    ("kind", "name", "value", "expected"),
    [
        (RasterConfig, "tile_size", 8.5, "a whole number"),
        (RasterConfig, "tile_size", True, "a whole number"),
        (RasterConfig, "pair_capacity", "100", "a whole number"),
        (RasterConfig, "pair_capacity", 0, r"a number in \[1, 1073741824\)"),
        (RasterConfig, "visible_capacity", 10.5, "a whole number"),
        (RasterConfig, "transmittance_min", "0", "a finite number"),
        (RasterConfig, "transmittance_min", jnp.ones(2), "a finite number"),
        (RasterConfig, "alpha_min", 1, r"a number in \(0, 1\)"),
        (RasterConfig, "alpha_max", 1e-9, r"a number in \(0\.0039.*, 1\]"),
        (RasterConfig, "stop_rule", "never", "one of before, after"),
        (RasterConfig, "outputs", (), "a tuple of rgb, alpha, depth, median_depth"),
        (RasterConfig, "outputs", ["rgb"], "a tuple of rgb, alpha"),
        (RasterConfig, "dilation", None, "a finite number"),
        (RasterConfig, "antialias", 1, "True or False"),
        (AdaptiveSettings, "every", 1.5, "a whole number"),
        (AdaptiveSettings, "threshold", np.nan, "a finite number"),
        (McmcSettings, "max_gaussians", 10.5, "a whole number"),
        (McmcSettings, "growth", 0.5, r"a number in \[1, inf\)"),
        (TrainConfig, "steps", 100.5, "a whole number"),
        (TrainConfig, "max_size", 7, r"a number in \[8, inf\)"),
        (TrainConfig, "ssim_weight", None, "a finite number"),
        (TrainConfig, "refine_poses", 2, "True or False"),
        (TrainConfig, "pose_rate", -1e-3, r"a number in \[0, inf\)"),
        (TrainConfig, "exposure_rate", np.inf, "a finite number"),
        (TrainConfig, "strategy", "best", "one of adaptive, mcmc"),
        (TrainConfig, "levels", (), "increasing starts"),
    ],
    ids=str,
)
def test_errors_name_the_field_and_the_range(kind, name, value, expected):
    with pytest.raises(
        InputError, match=rf"{kind.__name__}\.{name}: expected {expected}"
    ):
        kind(**{name: value})


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
def test_settings_of_the_strategy_in_use(strategy):
    kind = {"adaptive": AdaptiveSettings, "mcmc": McmcSettings}[strategy]
    for name, value in (("initial_opacity", 1.0), ("initial_scale", 0)):
        with pytest.raises(InputError, match=rf"TrainConfig\.{strategy}'s {name}: "):
            TrainConfig(strategy=strategy, **{strategy: kind(**{name: value})})


def test_optional_and_nested_numbers():
    assert RasterConfig(visible_capacity=None).visible_capacity is None
    assert TrainConfig(max_size=None).max_size is None
    assert type(Level(0, np.int32(2)).divisor) is int
    with pytest.raises(InputError, match=r"Level\.divisor: "):
        Level(0.0, 1.5)  # pyright: ignore


@pytest.mark.parametrize(
    "rates",
    [
        RATES._replace(means=(-1e-3, 1e-3)),
        RATES._replace(means=(1e-3, 0.0)),  # no geometric path
        RATES._replace(means=(np.inf, 1e-3)),
        RATES._replace(quats=-1e-3),
        RATES._replace(log_scales=np.nan),
        RATES._replace(sh_dc="fast"),
        RATES._replace(cooling=0.0),
        RATES._replace(cooling=1.5),
        RATES._replace(cooling_from=1.0),
        RATES._replace(cooling_from=-0.1),
    ],
    ids=str,
)
def test_invalid_rates(rates):
    with pytest.raises(InputError, match=r"(TrainConfig\.r|R)ates"):
        TrainConfig(rates=rates)


def test_zero_rates_are_valid():
    zero = Rates((0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)
    assert TrainConfig(rates=zero).rates == zero
