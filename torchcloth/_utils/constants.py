"""Physical and statistical constants. Each stands here once; every other module imports it."""

from __future__ import annotations

STANDARD_GRAVITY_M_PER_S2 = 9.81  # rounded from 9.80665 (CGPM 1901)
STANDARD_AIR_DENSITY_KG_PER_M3 = 1.204  # dry air at 20 degrees Celsius and 101 325 Pa
Z_95 = 1.95996  # half width of a two-sided 95 % interval of the normal distribution, in standard deviations
