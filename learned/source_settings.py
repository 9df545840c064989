"""Settings of the learned sources at run time. Importing them loads no PyTorch: the configuration holds them."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive, check_setting

SHIPPED = "shipped"
"""In place of a path: the weights that come with the package."""


@dataclass(frozen=True)
class LstmSettings:
    """How the LSTMs' initial poses are made.

    Attributes:
        weights: path of a weights file whose network has ``imu="initial-pose"``, or ``shipped``.
        device: where it computes, as PyTorch names it; ``auto`` is a GPU where there is one.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    weights: str = SHIPPED
    device: str = "auto"


@dataclass(frozen=True)
class NetworkResidualSettings:
    """How the residual network's answer is made and weighed.

    Attributes:
        weights: path of a weights file, or ``shipped``.
        device: where it computes, as PyTorch names it; ``auto`` is a GPU where there is one.
        min_cells: with fewer cells that have a normal in either map a scan is bridged by the initial pose.
        min_matched: with a smaller share of points matched, too.
        covariance_scale: how much larger the covariance is than independent residuals would make it.
        refine_steps: at most so many Gauss-Newton steps down the loss where its minimum is farther from the network's
            answer than noise explains; 0 always leaves the answer.
        kernel_m, max_distance_m: of the robust loss that weighs the answer.
        start_speeds_m_s: forward speeds tried, by the loss, where the initial pose is unsure of the translation.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    weights: str = SHIPPED
    device: str = "auto"
    min_cells: int = 500
    min_matched: float = 0.3
    covariance_scale: float = 2.0
    refine_steps: int = 2
    kernel_m: float = 0.1
    max_distance_m: float = 1.0
    start_speeds_m_s: tuple[float, ...] = (0.0, -5.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)

    def __post_init__(self) -> None:
        check_positive(self, "min_cells", "covariance_scale", "kernel_m", "max_distance_m")
        check_not_negative(self, "refine_steps")
        check_fraction(self, "min_matched")
        check_setting(self, "start_speeds_m_s", len(self.start_speeds_m_s) > 0, "a list of one number or more")
