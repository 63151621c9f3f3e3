"""Whether a search that did not converge ended near enough to say something.

Where it ended at the noise, only flat directions are left, and their errors are widened by the way that is left. Where
it ended far off, slopes of there say nothing about the optimum, and errors made of them are far too small.
"""

from __future__ import annotations

import math

from . import levenberg_marquardt
from .box_qp import bounded
from .linearity import Checked
from .objective import Objective

OFF = 1.3  # of the sensor's noise: searches cut short ended at 0.3 to 1.2 (errors that held), or at 1.4 to 6
FAR = 10.0  # standard deviations of a prior, beyond which nothing is looked for
LOST = 10.0  # standard errors: likewise 0.1 to 4, seldom up to 17, or 12 to 100


def astray(objective: Objective, checked: Checked) -> str:
    """Why the end of an unfinished search is no estimate; empty where it may be one.

    By the residual where the noise of what was used is known, else by how far the slopes would go on.

    Args:
        objective: of the frames that told it.
        checked: where it ended.
    """
    seen = objective.episodes if objective.uses("points", "markers") else []
    noise = max((e.noise for e in seen if e.noise), default=math.nan)
    times = objective.figures(checked.final.raw).rms / noise
    if math.isfinite(times):
        return f"the residual is {times:.1f} times the sensor noise" if times > OFF else ""
    if checked.covariance is not None:  # its slopes are not all that told it
        return ""
    left = way_left(objective.problem(), checked.final)
    return f"its slopes lead {left:.0f} standard errors farther" if left > LOST else ""


def way_left(problem: levenberg_marquardt.Problem, at: levenberg_marquardt.Iterate) -> float:
    """Standard errors to where the slopes put the minimum, by how much lower the cost would be there."""
    gradient, hessian = levenberg_marquardt.normal_equations(problem, at)
    low, high = (problem.clip(at.raw + sign * FAR * problem.prior_std) - at.raw for sign in (-1, 1))
    step = bounded(hessian, -gradient, low, high)
    return max(0.0, -float(2 * gradient @ step + step @ hessian @ step)) ** 0.5
