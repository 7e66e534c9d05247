"""Settings: numbers become Python's; errors name the class, the field and the range."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from captures import rejects

from gsjax import RasterConfig
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.train.config import Level, TrainConfig
from gsjax.train.optimiser import Rates

KINDS = [RasterConfig, AdaptiveSettings, McmcSettings, TrainConfig]
RATES = TrainConfig().rates


@pytest.mark.parametrize("kind", KINDS)
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


def test_other_numbers_and_none_are_accepted():
    for seven in (np.uint8(7), np.asarray(7), 7.0, np.float32(7)):
        found = McmcSettings(every=seven).every
        assert (found, type(found)) == (7, int)
    for half in (np.float32(0.5), Fraction(1, 2)):
        found = McmcSettings(initial_scale=half).initial_scale
        assert (found, type(found)) == (0.5, float)
    assert RasterConfig(visible_capacity=None).visible_capacity is None
    assert TrainConfig(max_size=None).max_size is None
    assert type(Level(0, np.int32(2)).divisor) is int
    zero = Rates((0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)
    assert TrainConfig(rates=zero).rates == zero


NO_NUMBERS = [np.nan, np.inf, -np.inf, "7", True, [7], 7j, jnp.ones(2)]
WRONG = {
    int: ("a whole number", [7.5, *NO_NUMBERS]),
    float: ("a finite number", NO_NUMBERS),
    bool: ("True or False", [1, 0.0, "yes", None]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_values_of_other_types_are_rejected(kind):
    for name, value in vars(kind()).items():
        expected, others = WRONG.get(type(value), ("", []))
        for other in others:
            message = rf"^{kind.__name__}\.{name}: expected {expected}, got "
            rejects(message, kind, **{name: other})


@pytest.mark.parametrize(
    ("kind", "name", "value", "expected"),
    [
        (RasterConfig, "pair_capacity", "100", "a whole number"),
        (RasterConfig, "pair_capacity", 0, r"a number in \[1, 1073741824\)"),
        (RasterConfig, "visible_capacity", 10.5, "a whole number"),
        (RasterConfig, "tile_size", None, "a whole number"),
        (RasterConfig, "dilation", None, "a finite number"),
        (RasterConfig, "alpha_max", 1e-9, r"a number in \(0\.0039.*, 1\]"),
        (RasterConfig, "stop_rule", "never", "one of before, after"),
        (RasterConfig, "outputs", (), "a tuple of rgb, features, normals, alpha"),
        (RasterConfig, "outputs", ["rgb"], "a tuple of rgb, features"),
        (TrainConfig, "max_size", 7, r"a number in \[8, inf\)"),
        (TrainConfig, "pose_rate", -1e-3, r"a number in \[0, inf\)"),
        (TrainConfig, "levels", (), "increasing starts"),
    ],
    ids=str,
)
def test_errors_name_the_field_and_the_range(kind, name, value, expected):
    rejects(rf"{kind.__name__}\.{name}: expected {expected}", kind, **{name: value})


@pytest.mark.parametrize(
    ("strategy", "kind"), [("adaptive", AdaptiveSettings), ("mcmc", McmcSettings)]
)
def test_settings_of_the_strategy_in_use(strategy, kind):
    for name, value in (("initial_opacity", 1.0), ("initial_scale", 0)):
        changes = {"strategy": strategy, strategy: kind(**{name: value})}
        rejects(rf"TrainConfig\.{strategy}'s {name}: ", TrainConfig, **changes)
    rejects(r"Level\.divisor: ", Level, 0.0, 1.5)


@pytest.mark.parametrize(
    "changes",
    [
        {"means": (-1e-3, 1e-3)},
        {"means": (1e-3, 0.0)},  # no geometric path
        {"means": (np.inf, 1e-3)},
        {"quats": -1e-3},
        {"log_scales": np.nan},
        {"sh_dc": "fast"},
        {"cooling": 0.0},
        {"cooling": 1.5},
        {"cooling_from": 1.0},
        {"cooling_from": -0.1},
    ],
    ids=str,
)
def test_invalid_rates(changes):
    rejects(r"(TrainConfig\.r|R)ates", TrainConfig, rates=RATES._replace(**changes))
