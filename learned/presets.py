"""Recipes by name: the paper's set-up, the shipped ones, and the rows of the paper's tables.

Source: UnDeepLIO, "Implementation Details" and "Ablation Study". Sizes that the paper does not state (LSTMs, encoder,
number of epochs) are the defaults of :mod:`hybridlio.learned.settings`, the same in every row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.errors import ConfigError
from hybridlio.learned.settings import LossSettings, NetworkSettings, OptimiserSettings, Recipe

PAPER = Recipe("paper", NetworkSettings(), LossSettings(normal_thin_m=0.0), OptimiserSettings())
"""The paper's set-up: shared weights in siamese parts, Euler angles, one pass, summed loss, Adam with halved steps.

Where the text can hardly be meant as printed, ``paper-element-wise`` and ``paper-rows-as-printed`` follow it literally.
"""


DEFAULT = Recipe(
    "default",
    NetworkSettings(
        siamese="twins",
        rotation="log",
        imu_hidden=32,
        imu_layers=1,
        velocity=True,
        mean_rate=True,
        encoder=False,
        projective_steps=4,
        vertex_scale_m=20.0,
        output_scale=0.02,
    ),
    LossSettings(
        kernel_m=0.03,
        max_distance_m=1.0,
        reduction="mean",
        matched_at="answer",
        initial_weight=0.1,
        target_weight=1.0,
        keep_ground=True,
    ),
    OptimiserSettings(
        epochs=8,
        batch=8,
        learning_rate=2e-3,
        schedule="cosine",
        clip_norm=1.0,
        initial_noise_rad=0.004,
        initial_noise_m=0.08,
        velocity_noise_m_s=0.1,
    ),
)
"""The shipped method: LSTMs correct a prediction from velocity and mean angular velocity, and a siamese encoder of both
maps weighs the points of a registration between them; the paper regresses the residual from pooled features.

Each departure from ``paper``, and what it is worth, is in docs/concepts/one_loss.md.
"""

PUBLISHED = Recipe(
    "published",
    NetworkSettings(
        rotation="log",
        geometry=MapGeometry(3.0, -23.0, 52, 360),
        imu_hidden=32,
        imu_layers=1,
        velocity=True,
        mean_rate=True,
        stem=16,
        stem_stride=(2, 4),
        stages=(24, 32, 64),
        blocks=1,
        normalisation="group",
        features=64,
        iterations=2,
        remap_gradient=False,
        distance="gradient",
        vertex_scale_m=20.0,
        residual_scale=1.0,
        output_scale=0.1,
    ),
    replace(DEFAULT.loss, target_weight=LossSettings().target_weight),
    replace(
        DEFAULT.optimiser,
        epochs=24,
        batch=16,
        mirrored=0.5,
        swapped=0.25,
        points=2048,
        balanced=0.8,
    ),
)
"""The published method without any registration step, reduced so that a CPU can train it: siamese LSTMs, a siamese
ResNet encoder of vertex and normal maps, pooling, attention and ``T = δT·T̂``, trained by the paper's loss alone.

docs/concepts/one_loss.md lists each departure from ``paper``.
"""

_ENCODER: Mapping[str, Any] = MappingProxyType(
    {
        "encoder": True,
        "stem": 16,
        "stem_stride": (4, 4),
        "stages": (16, 32),
        "blocks": 1,
        "normalisation": "group",
        "features": 32,
        "distance": "gradient",
    }
)


def _default_with(name: str, loss: Mapping[str, Any] = MappingProxyType({}), **network: Any) -> Recipe:
    changed = replace(DEFAULT.network, **network), replace(DEFAULT.loss, **loss)
    return Recipe(f"default-{name}", *changed, DEFAULT.optimiser)


DEPARTURES = (
    DEFAULT,
    _default_with("without-velocity", velocity=False),
    _default_with("without-mean-rate", mean_rate=False),
    _default_with("euler", rotation="euler"),
    _default_with("one-step", projective_steps=1),
    _default_with("two-steps", projective_steps=2),
    _default_with("three-steps", projective_steps=3),
    _default_with("kernel-alone", weight_channels=0),
    _default_with("and-encoder", **_ENCODER),
    _default_with("encoder-alone", projective_steps=0, **_ENCODER),
    _default_with("without-ground", {"keep_ground": False}),
    _default_with("without-target", {"target_weight": 0.0}),
    _default_with("without-limit", {"max_distance_m": float("inf")}),
    _default_with("matched-at-each", {"matched_at": "each"}),
    _default_with("geman-mcclure", {"kernel": "geman-mcclure", "kernel_m": 0.1}),
    replace(
        DEFAULT,
        name="default-unshaken",
        optimiser=replace(DEFAULT.optimiser, initial_noise_rad=0.0, initial_noise_m=0.0),
    ),
    replace(DEFAULT, name="default-halved", optimiser=replace(DEFAULT.optimiser, schedule="step")),
)
"""``default``, and ``default`` without one of its departures from ``paper`` or with one more."""

_ONLY_PO2PL = {"lambda_": 0.0}
_ONLY_PL2PL = {"alpha": 0.0}


@dataclass(frozen=True)
class Changes:
    """The settings in which a row of the paper's tables differs from its method.

    Attributes:
        network, loss: changed settings by name.
    """

    network: Mapping[str, Any]
    loss: Mapping[str, Any]

    def of(self, recipe: Recipe, name: str) -> Recipe:
        """Return a recipe with these changes, under a name."""
        network, loss = replace(recipe.network, **self.network), replace(recipe.loss, **self.loss)
        return replace(recipe, name=name, network=network, loss=loss)


def _changes(loss: Mapping[str, Any] = MappingProxyType({}), **network: Any) -> Changes:
    return Changes(network, loss)


ROWS: Mapping[str, Changes] = MappingProxyType(
    {
        "paper": _changes(),
        "imu-feature": _changes(imu="feature"),
        "no-imu": _changes(imu="none"),
        "normals-joined": _changes(normals="joined"),
        "normals-none": _changes(normals="none", distance="none"),
        "no-imu-normals-joined": _changes(imu="none", normals="joined"),
        "no-imu-normals-none": _changes(imu="none", normals="none", distance="none"),
        "mlp": _changes(head="mlp"),
        "no-imu-mlp": _changes(imu="none", head="mlp"),
        "without-plane-to-plane": _changes(_ONLY_PO2PL),
        "no-imu-without-plane-to-plane": _changes(_ONLY_PO2PL, imu="none"),
        "without-point-to-plane": _changes(_ONLY_PL2PL),
        "no-imu-without-point-to-plane": _changes(_ONLY_PL2PL, imu="none"),
        "same-pixel": _changes({"matching": "same-pixel"}),
        "no-imu-same-pixel": _changes({"matching": "same-pixel"}, imu="none"),
        "cho": _changes({"matching": "same-pixel", **_ONLY_PO2PL}, imu="none", normals="joined", head="mlp"),
        "nubert": _changes({"matching": "nearest-projected"}, imu="none", normals="none", distance="none", head="mlp"),
    }
)
"""What each row of the paper's tables 1 to 5 changes in the method, by the name of its preset."""

_ALL = (
    PAPER,
    PUBLISHED,
    *DEPARTURES,
    _changes({"product": "element-wise"}).of(PAPER, "paper-element-wise"),
    _changes(geometry=MapGeometry(23.0, -3.0, 52, 720)).of(PAPER, "paper-rows-as-printed"),
    _changes({"normal_thin_m": 0.2}).of(PAPER, "paper-thinned-normals"),
    *(changes.of(PAPER, name) for name, changes in ROWS.items() if name != "paper"),
)

PRESETS: Mapping[str, Recipe] = MappingProxyType({recipe.name: recipe for recipe in _ALL})
"""Every preset by name.

``cho`` and ``nubert`` are the two predecessors as the paper describes them, with this encoder: the first matches the
same pixel and minimises the distance to planes only; the second sees vertices only, matches nearest neighbours among
the projected points and minimises both terms. ``without-point-to-plane`` gives translations no gradient, because the
difference of normals does not depend on them.
"""

BASES: Mapping[str, Recipe] = MappingProxyType({recipe.name: recipe for recipe in (PAPER, PUBLISHED)})
"""The methods that rows of the paper's tables can be variants of."""


def preset(name: str) -> Recipe:
    """Return the recipe of a preset.

    Raises:
        ConfigError: the preset is unknown; lists the known ones.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


def row_of(base: str, row: str) -> Recipe:
    """Return the recipe of a row of the paper's tables as a variant of ``paper`` or ``published``.

    A row without normals has no distances to planes either, whatever the base.

    Raises:
        ConfigError: the base or the row is unknown; lists the known ones.
    """
    if base not in BASES:
        raise ConfigError(f"unknown base {base!r}; choose one of {', '.join(BASES)}")
    if row not in ROWS:
        raise ConfigError(f"unknown row {row!r}; choose one of {', '.join(ROWS)}")
    return ROWS[row].of(BASES[base], row)
