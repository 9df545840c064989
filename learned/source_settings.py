"""Settings of the learned sources at run time. Importing them loads no PyTorch: the configuration holds them."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive, check_setting

SHIPPED = "shipped"
"""Value of ``weights`` that selects the weights shipped with the package."""


@dataclass(frozen=True)
class LstmSettings:
    """Settings of the LSTM initial pose.

    Attributes:
        weights: path of a weights file whose network has ``imu="initial-pose"``, or ``shipped``.
        device: PyTorch device name; ``auto`` is a GPU if available, else the CPU.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    weights: str = SHIPPED
    device: str = "auto"


@dataclass(frozen=True)
class NetworkResidualSettings:
    """Settings of the residual network and of its covariance.

    Attributes:
        weights: path of a weights file, or ``shipped``.
        device: PyTorch device name; ``auto`` is a GPU if available, else the CPU.
        iterations: how often the residual is asked for, each time with the maps moved by the answer before; 0 is as
            often as in training.
        min_cells: a scan with fewer cells with normals in either map is bridged by the initial pose.
        min_matched: a scan with a smaller share (0 to 1) of matched points is bridged, too.
        covariance_scale: factor on the covariance, because residuals are correlated.
        refine_steps: maximum number of Gauss-Newton steps on the loss, taken if its minimum is farther from the
            network's answer than noise explains; 0 never changes the answer.
        kernel_m, max_distance_m: kernel width and matching limit of the robust loss that evaluates the answer.
        start_speeds_m_s: candidate forward speeds, compared by the loss, if the initial translation is uncertain.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    weights: str = SHIPPED
    device: str = "auto"
    iterations: int = 0
    min_cells: int = 500
    min_matched: float = 0.3
    covariance_scale: float = 2.0
    refine_steps: int = 2
    kernel_m: float = 0.1
    max_distance_m: float = 1.0
    start_speeds_m_s: tuple[float, ...] = (0.0, -5.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)

    def __post_init__(self) -> None:
        check_positive(self, "min_cells", "covariance_scale", "kernel_m", "max_distance_m")
        check_not_negative(self, "iterations", "refine_steps")
        check_fraction(self, "min_matched")
        check_setting(self, "start_speeds_m_s", len(self.start_speeds_m_s) > 0, "a list of one number or more")
