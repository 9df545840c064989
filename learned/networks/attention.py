"""From features to what a pose is read off: the paper's gate, and what its table 4 compares it with."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn


class Attention(nn.Module):
    """``i = σ(W_i x + b_i)``, ``g = tanh(W_g x + b_g)``, ``o = σ(W_o x + b_o)``, ``out = o ∘ tanh(i ∘ g)``.

    UnDeepLIO, formula (6): an LSTM's cell without its past. Features ``(B, F)`` to ``(B, F)``, each within ±1.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.input_gate = nn.Linear(features, features)
        self.candidate = nn.Linear(features, features)
        self.output_gate = nn.Linear(features, features)

    def forward(self, x: Tensor) -> Tensor:
        """The gated features."""
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
        """The transformed features."""
        return torch.tanh(self.second(torch.tanh(self.first(x))))


def make_head(kind: Literal["attention", "mlp"], features: int) -> nn.Module:
    """The module of a :class:`hybridlio.learned.settings.NetworkSettings` ``head``."""
    return Attention(features) if kind == "attention" else Mlp(features)
