"""The paper's garment tables (Zheng et al., DiffCP), as printed there without units of E, k and gamma."""

from __future__ import annotations

# Parameter -> garment -> (mean, CoV [%]).
PARAMETERS = {
    "youngs_modulus": {"dress": (129.32, 11.0), "trousers": (638.73, 8.4), "shirt": (328.77, 8.4)},
    "poisson_ratio": {"dress": (0.121, 10.7), "trousers": (0.071, 9.9), "shirt": (0.103, 10.7)},
    "contact_stiffness": {"dress": (5495.34, 11.4), "trousers": (9498.36, 7.2), "shirt": (2301.56, 12.3)},
    "shear_stiffness": {"dress": (350.88, 18.6), "trousers": (733.46, 16.7), "shirt": (149.43, 24.8)},
}

# Mean Chamfer distance and CoV [%]. The paper's stop rule "below 1.5cm" implies metres.
CHAMFER = {
    "cover": (0.017143, 21.37),
    "drag": (0.016957, 23.16),
    "fling": (0.014176, 30.28),
    "dress": (0.023448, 17.09),
    "trousers": (0.015000, 37.01),
    "shirt": (0.009829, 23.63),
}

# Grand mean and pooled variance of the Chamfer distance.
FACTORS = {"speed": (0.0160, 7.14e-5), "grip": (0.0162, 8.74e-5), "posture": (0.0161, 8.12e-5)}
