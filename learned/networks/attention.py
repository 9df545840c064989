"""Network heads between features and pose: the paper's attention gate, and the MLP of its table 4."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn


class Attention(nn.Module):
    """``i = σ(W_i x + b_i)``, ``g = tanh(W_g x + b_g)``, ``o = σ(W_o x + b_o)``, ``out = o ∘ tanh(i ∘ g)``.

    UnDeepLIO, formula (6): an LSTM cell without recurrence. Features ``(B, F)`` to ``(B, F)``, each within ±1.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.input_gate = nn.Linear(features, features)
        self.candidate = nn.Linear(features, features)
        self.output_gate = nn.Linear(features, features)

    def forward(self, x: Tensor) -> Tensor:
        """Return the gated features."""
        i = torch.sigmoid(self.input_gate(x))
        g = torch.tanh(self.candidate(x))
        o = torch.sigmoid(self.output_gate(x))
        return o * torch.tanh(i * g)


class Mlp(nn.Module):
    """``tanh(W₂ tanh(W₁x + b₁) + b₂)``: UnDeepLIO, formula (12). Features ``(B, F)`` to ``(B, F)``."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = nn.Linear(features, features)
        self.second = nn.Linear(features, features)

    def forward(self, x: Tensor) -> Tensor:
        """Return the transformed features."""
        return torch.tanh(self.second(torch.tanh(self.first(x))))


def make_head(kind: Literal["attention", "mlp"], features: int) -> nn.Module:
    """Return the module for ``head`` of :class:`hybridlio.learned.settings.NetworkSettings`."""
    return Attention(features) if kind == "attention" else Mlp(features)
