"""Tables of fabrics in the DiffCP paper (Zheng et al.): coefficients of variation of the parameters.

The mean parameters, whose units the paper does not state, are in ``materials.presets``, read as kPa at 1 mm thickness.
"""

from __future__ import annotations

FABRICS = {
    "cotton": "Cotton (A)",
    "artificial_silk": "Artificial Silk (B)",
    "wool": "Wool (C)",
    "polyester": "Polyester (D)",
    "coated_nylon": "Coated Nylon (E)",
}
SYMBOLS = {"E": "youngs_modulus", "ν": "poisson_ratio", "k": "contact_stiffness", "γ": "shear_stiffness"}
COV = {  # %, over ten trials
    "cotton": {"E": 0.384, "ν": 6.0, "k": 4.109, "γ": 8.498},
    "artificial_silk": {"E": 0.369, "ν": 1.081, "k": 6.148, "γ": 6.146},
    "wool": {"E": 7.932, "ν": 3.548, "k": 5.940, "γ": 17.829},
    "polyester": {"E": 0.461, "ν": 4.615, "k": 2.252, "γ": 10.902},
    "coated_nylon": {"E": 0.859, "ν": 10.0, "k": 13.823, "γ": 3.747},
}
CLAIM = "the estimated parameters can be applied to the fabric type differentiation"  # without a table or a number
