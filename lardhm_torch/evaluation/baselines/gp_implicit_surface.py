"""GP implicit surface: the surface as the zero level set of a function with thin-plate covariance."""

from __future__ import annotations

from torch import Tensor

from lardhm_torch.evaluation.baselines.gaussian_process import Hyperparameters, Kernel, thin_plate
from lardhm_torch.evaluation.baselines.gp_occupancy_map import GPOccupancyMap


class GPImplicitSurface(GPOccupancyMap):
    """Exact regression of -1 in free space and +1 at hits with thin-plate covariance; cubic cost.

    The lengthscale is not learned: R is the largest distance in the scene. The probability is that
    of a function value above zero, so that both GP baselines estimate the same quantity.

    Args:
        seed: random seed for the points from which signal and noise are learned.
        dtype: of the computation.

    Source: Williams & Fitzgibbon 2006, "Gaussian process implicit surfaces"; named in Guizilini &
    Ramos 2016, Section I.
    """

    kernel: Kernel = staticmethod(thin_plate)
    learns_lengthscale = False

    def start(self, local: Tensor) -> Hyperparameters:
        """Size of the scene, which stays fixed, and initial signal and noise."""
        one = local.new_tensor(1.0)
        size = (local.amax(dim=0) - local.amin(dim=0)).square().sum().sqrt()
        return Hyperparameters(size.clamp(min=1e-3), one, 0.1 * one)
