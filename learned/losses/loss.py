"""The unsupervised loss: point-to-plane plus plane-to-plane, and its Gauss-Newton Hessian.

Source: UnDeepLIO, "Loss Function": ``L = α L_po2pl + λ L_pl2pl``, ``L_po2pl = Σ |n_k · (p̄_{k+1} − p_k)|``,
``L_pl2pl = Σ ‖n̄_{k+1} − n_k‖²``. The paper's overall formula prints po2pl twice, which is a slip. It calls the product
element-wise, which is an option; the default is the dot product, which is the distance to a plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hybridlio.learned.losses.correspondences import Matches
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.settings import LossSettings


@dataclass(frozen=True, eq=False)
class LossValue:
    """The loss of each pair of a batch.

    Attributes:
        total: ``(B,)`` the minimised value, with its gradient.
        po2pl_m: ``(B,)`` mean distance to the matched planes, after the kernel, in metres.
        pl2pl: ``(B,)`` mean squared difference of normals.
        matched: ``(B,)`` share of points with a match.
    """

    total: Tensor
    po2pl_m: Tensor
    pl2pl: Tensor
    matched: Tensor


@dataclass(frozen=True, eq=False)
class GaussNewton:
    """Quadratic approximation of the loss for a right perturbation ``T·Exp(ξ)``, rotation first.

    Attributes:
        gradient: ``(B, 6)``.
        hessian: ``(B, 6, 6)``, positive semi-definite, because second derivatives of residuals are left out.
        information: ``(B, 6, 6)``, the Hessian scaled so that a match without residual has the weight 1. Divided by the
            variance of the residuals it is the inverse of a covariance.
        sigma_m: ``(B,)`` robust standard deviation of the distances to the planes.
    """

    gradient: Tensor
    hessian: Tensor
    information: Tensor
    sigma_m: Tensor


def loss(matches: Matches, pose: Tensor, settings: LossSettings) -> LossValue:
    """Return the loss of poses ``T_k_k1`` ``(B, 4, 4)`` for fixed matches."""
    weight = matches.weight
    distances = _distances(matches, se3.transform(pose, matches.source), settings)
    po2pl = (weight * _kernel(distances, settings).sum(-1)).sum(1)
    both = _with_both_normals(matches)
    difference = se3.rotate(pose, matches.source_normals) - matches.target_normals
    pl2pl = (both * difference.square().sum(-1)).sum(1)
    count, count_both = weight.sum(1).clamp(min=1), both.sum(1).clamp(min=1)
    mean_po2pl, mean_pl2pl = po2pl / count, pl2pl / count_both
    if settings.reduction == "mean":
        po2pl, pl2pl = mean_po2pl, mean_pl2pl
    total = settings.alpha * po2pl + settings.lambda_ * pl2pl
    return LossValue(total, mean_po2pl.detach(), mean_pl2pl.detach(), matches.share)


def gauss_newton(matches: Matches, pose: Tensor, settings: LossSettings) -> GaussNewton:
    """Return gradient and Gauss-Newton Hessian of the summed loss for fixed matches.

    Within ``kernel_m`` of a plane ``l1`` counts as ``huber``, since an absolute value has no second derivative at 0.
    """
    with torch.no_grad():
        R = pose[:, :3, :3]
        distances = _distances(matches, se3.transform(pose, matches.source), settings)
        ((of_rotation, of_translation), curvature) = _jacobians(matches, R, settings), _curvature(distances, settings)
        J = torch.cat([of_rotation, of_translation], dim=-1).flatten(1, 2)
        weights = curvature * matches.weight[..., None]
        weighted = (J * weights.flatten(1)[..., None]).transpose(1, 2)
        H = settings.alpha * (weighted @ J)
        g = settings.alpha * (weighted @ distances.flatten(1)[..., None])[..., 0]
        # d(R Exp(ω) n)/dω = −R [n]×: the sum of its squares is |n|²·1 − n nᵀ, of its products with d that of n × Rᵀd
        n, both = matches.source_normals, _with_both_normals(matches)[..., None]
        in_source = (se3.rotate(pose, n) - matches.target_normals) @ R
        outer = (n * both).transpose(1, 2) @ n
        sizes = outer.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
        H[:, :3, :3] += 2 * settings.lambda_ * (sizes * torch.eye(3, dtype=R.dtype, device=R.device) - outer)
        g[:, :3] += 2 * settings.lambda_ * (both * torch.linalg.cross(n, in_source)).sum(1)
        spread = (weights * distances.square()).sum((1, 2)) / weights.sum((1, 2)).clamp(min=1e-12)
        at_zero = _curvature(torch.zeros_like(distances[:1, :1, :1]), settings)
        information = H / (at_zero.item() * (settings.alpha or 1.0))
    return GaussNewton(g, H, information, spread.sqrt())


def _distances(matches: Matches, moved: Tensor, settings: LossSettings) -> Tensor:
    """Return signed distances to the planes ``(B, N, 1)``, or their components by axis ``(B, N, 3)``."""
    product = matches.target_normals * (moved - matches.target)
    return product.sum(-1, keepdim=True) if settings.product == "dot" else product


def _jacobians(matches: Matches, R: Tensor, settings: LossSettings) -> tuple[Tensor, Tensor]:
    """Return derivatives ``(B, N, 1 or 3, 3)`` of the distances by rotation and translation of a right perturbation."""
    in_source = matches.target_normals @ R  # rows n·R
    if settings.product == "dot":
        # n·R(ω × p + v) = (p × nR)·ω + nR·v
        return torch.linalg.cross(matches.source, in_source)[..., None, :], in_source[..., None, :]
    rows = matches.target_normals[..., None] * R[:, None]
    return -rows @ se3.hat(matches.source), rows


def _with_both_normals(matches: Matches) -> Tensor:
    return matches.weight * matches.source_normals.any(-1)


def _kernel(distances: Tensor, settings: LossSettings) -> Tensor:
    """Return the cost of distances, in metres."""
    k, size = settings.kernel_m, distances.abs()
    if settings.kernel == "l1":
        return size
    squared = distances.square()
    if settings.kernel == "huber":
        return torch.where(size < k, squared / (2 * k), size - k / 2)
    return k * squared / (k * k + squared)


def _curvature(distances: Tensor, settings: LossSettings) -> Tensor:
    """Return ``ρ'(r)/r``, the weight of iteratively reweighted least squares."""
    k = settings.kernel_m
    if settings.kernel == "geman-mcclure":
        return 2 * k**3 / (k * k + distances.square()).square()
    return 1 / distances.abs().clamp(min=k)
