"""Bundle adjustment."""

from __future__ import annotations

import pycolmap


def adjust(model: pycolmap.Reconstruction, lens: bool = True) -> None:
    """Bundle adjustment with a soft L1 loss, in place; lenses are adjusted too unless `lens` is false."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = 1e-7
    options.ceres.solver_options.max_num_iterations = 60
    pycolmap.bundle_adjustment(model, options)
