"""Building blocks that several networks share."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.settings import NetworkSettings


class CircularConv(nn.Module):
    """A square convolution, circular along columns and zero-padded along rows. Use a bias only if no norm follows."""

    def __init__(
        self, inputs: int, outputs: int, size: int, stride: tuple[int, int], bias: bool = False, dilation: int = 1
    ) -> None:
        super().__init__()
        self.reach = size // 2 * dilation
        self.conv = nn.Conv2d(inputs, outputs, size, stride, (self.reach, 0), dilation, bias=bias)
        nn.init.kaiming_normal_(self.conv.weight, nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to ``(B, outputs, ⌈H/stride⌉, ⌈W/stride⌉)``."""
        return self.conv(functional.pad(x, (self.reach, self.reach, 0, 0), mode="circular"))  # type: ignore[no-any-return]


def rotation_matrix(three: Tensor, settings: NetworkSettings) -> Tensor:
    """Return rotations ``(B, 3, 3)`` from three network outputs: Euler angles or a rotation vector (rad)."""
    return se3.so3_exp(three) if settings.rotation == "log" else se3.euler_to_rotation(three)
