"""Small maps with closed forms, for the tests of what is asked of maps."""

import math

import torch
from torch import nn

from lardhm_torch import LardHilbertMap

F64 = torch.float64


class GaussianMap(nn.Module):
    """A map in a few lines: every cluster answers for every point."""

    def __init__(self, centers, scale_tril, weights, origin=None):
        super().__init__()
        self.centers = nn.Parameter(torch.as_tensor(centers, dtype=torch.float64), False)
        self.scale_tril = torch.as_tensor(scale_tril, dtype=torch.float64)
        self.weights = nn.Parameter(torch.as_tensor(weights, dtype=torch.float64), False)
        self.dim = self.centers.shape[1]
        self.origin = torch.zeros(self.dim).double() if origin is None else origin

    def log_odds(self, points):
        offsets = (points - self.origin)[..., None, :] - self.centers
        whitened = torch.linalg.solve_triangular(self.scale_tril, offsets[..., None], upper=False)
        return torch.exp(-0.5 * whitened.square().sum(dim=(-2, -1))) @ self.weights

    def forward(self, points):
        return torch.sigmoid(self.log_odds(points))


def ball(weight=6.0, sigma=0.3, dim=3, origin=None):
    return GaussianMap(torch.zeros(1, dim), sigma * torch.eye(dim)[None], [weight], origin)


def radius_where(log_odds, weight=6.0, sigma=0.3):
    """Distance from the center of `ball` at which it has these log-odds, in closed form."""
    return sigma * math.sqrt(2 * math.log(weight / log_odds))


def random_map(seed, dim=3, clusters=6):
    rng = torch.Generator().manual_seed(seed)
    factors = 0.2 * torch.randn(clusters, dim, dim, generator=rng).tril(-1)
    factors += torch.diag_embed(0.2 + torch.rand(clusters, dim, generator=rng))
    weights = 4 * torch.randn(clusters, generator=rng)
    return GaussianMap(2 * torch.randn(clusters, dim, generator=rng), factors, weights)


def wall(count=600, dim=3, seed=0, at=1.0):
    """Points of a wall at x = ``at`` and of the free space before it."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(2 * count, dim, generator=rng, dtype=F64) * 2
    points[:count, 0] = 1 + 0.02 * torch.randn(count, generator=rng, dtype=F64)
    points[count:, 0] *= 0.4
    points[:, 0] += at - 1
    labels = torch.zeros(2 * count)
    labels[:count] = 1
    return points, labels


def wall_map(dim=3, dtype=F64, **settings):
    return LardHilbertMap(dim, **settings).to(dtype).fit(*wall(dim=dim), num_clusters=40)


def same_map(first, second):
    ours, theirs = first.state_dict(), second.state_dict()
    return all(
        torch.equal(ours[k], theirs[k])
        if isinstance(ours[k], torch.Tensor)
        else ours[k] == theirs[k]
        for k in ours | theirs
    )
