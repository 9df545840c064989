"""Choices among the settings of a simulated drive, by name."""

from __future__ import annotations

from typing import Literal

Scene = Literal["town", "corridor", "field"]
Driving = Literal["calm", "hard"]
