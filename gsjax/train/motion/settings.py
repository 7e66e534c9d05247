"""Settings of the motion models."""

from dataclasses import dataclass

from gsjax.runtime.settings import convert_fields, require_ranges

MOTIONS = ("none", "field", "trajectories")


@dataclass(frozen=True)
class TrajectorySettings:
    """Settings of `gsjax.train.motion.trajectories`.

    Attributes:
      path_degree, turn_degree, shade_degree: degrees of the polynomials in time of the
        mean, the quaternion and the colour; 0 keeps one constant.
      fades: give each Gaussian a time at which it is most opaque, and a duration.
      start: share of the steps after which the Gaussians begin to move.
      freeze: share of the steps after which those that do not move are kept still.
      path_rate: learning rate of the paths, as a multiple of that of the means.
      turn_rate, shade_rate, fade_rate: learning rates of the other parameters.
      rigidity: weight in the loss of `trajectories.roughness`, the mean difference of
        the motions of neighbours.
      stillness: pull towards no motion, see `gsjax.train.optimiser.scale_by_rate`.

    Raises:
      InputError: if a setting is out of range.
    """

    path_degree: int = 5
    turn_degree: int = 4
    shade_degree: int = 2
    fades: bool = True
    start: float = 0.0
    freeze: float = 0.3
    path_rate: float = 3.0
    turn_rate: float = 0.006
    shade_rate: float = 0.01
    fade_rate: float = 0.02
    rigidity: float = 1.0
    stillness: float = 0.1

    def __post_init__(self):
        convert_fields(self)
        degrees = ("path_degree", "turn_degree", "shade_degree")
        rates = ("path_rate", "turn_rate", "shade_rate", "fade_rate")
        require_ranges(self, {
            **dict.fromkeys(degrees, "[0, 16]"),
            **dict.fromkeys(rates, "[0, inf)"),
            **dict.fromkeys(("rigidity", "stillness"), "[0, inf)"),
            **dict.fromkeys(("start", "freeze"), "[0, 1]"),
        })  # fmt: skip


@dataclass(frozen=True)
class FieldSettings:
    """Settings of `gsjax.train.motion.field`.

    Attributes:
      channels: numbers in each cell of the planes of a level.
      cells: cells along each side of the box, of the finest level.
      levels: number of levels, each with a quarter of the cells of the one before, and
        a third of the times: motion is found where it is smooth, and continued in time.
      times: cells along time, of the finest level.
      width: width of the decoder's hidden layers.
      start: share of the steps after which the Gaussians begin to move.
      unroll: share of the steps during which views are drawn up to a time that grows
        from the first: what moves is followed, from where it was found. 0 draws from
        all times at once.
      freeze: share of the steps after which those that do not move are kept still.
      plane_rate, decoder_rate: learning rates at the start; they fall to a fiftieth.
      smoothness: weight of the total variation of the planes.
      time_smoothness: weight of the second differences in time.
      stillness: pull of the planes of time towards no motion, see
        `gsjax.train.optimiser.scale_by_rate`.

    Raises:
      InputError: if a setting is out of range.
    """

    channels: int = 8
    cells: int = 64
    levels: int = 3
    times: int = 25
    width: int = 32
    start: float = 0.0
    unroll: float = 0.4
    freeze: float = 0.5
    plane_rate: float = 0.02
    decoder_rate: float = 0.0016
    smoothness: float = 1e-4
    time_smoothness: float = 0.01
    stillness: float = 0.02

    def __post_init__(self):
        convert_fields(self)
        weights = ("smoothness", "time_smoothness", "stillness")
        require_ranges(self, {
            **dict.fromkeys(("channels", "width"), "[1, 1024]"),
            "levels": "[1, 4]",
            **dict.fromkeys(("cells", "times"), "[3, 1024]"),
            **dict.fromkeys(("plane_rate", "decoder_rate"), "[0, inf)"),
            **dict.fromkeys(weights, "[0, inf)"),
            **dict.fromkeys(("start", "freeze", "unroll"), "[0, 1]"),
        })  # fmt: skip
