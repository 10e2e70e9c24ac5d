"""GP implicit surface: the scene as the zero level of one function with thin-plate covariance."""

from __future__ import annotations

from torch import Tensor

from lardhm_torch.evaluation.baselines.gaussian_process import Hyperparameters, Kernel, thin_plate
from lardhm_torch.evaluation.baselines.gp_occupancy_map import GPOccupancyMap


class GPImplicitSurface(GPOccupancyMap):
    """Regression of -1 in free space and +1 at hits with the thin-plate covariance; exact, cubic.

    The thin plate has no lengthscale to learn: its R is the largest distance in the scene. The
    probability is that of a function above zero, so both GP references answer the same question.

    Args:
        seed: of the points that signal and noise are learned from.
        dtype: of the computation.

    Source: Williams & Fitzgibbon 2006, "Gaussian process implicit surfaces"; named in Guizilini &
    Ramos 2016, Section I.
    """

    kernel: Kernel = staticmethod(thin_plate)
    learns_lengthscale = False

    def start(self, local: Tensor) -> Hyperparameters:
        """The size of the scene, which no learning changes, and where signal and noise start."""
        one = local.new_tensor(1.0)
        size = (local.amax(dim=0) - local.amin(dim=0)).square().sum().sqrt()
        return Hyperparameters(size.clamp(min=1e-3), one, 0.1 * one)
