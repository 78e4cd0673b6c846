"""The paper's own numbers, to stand beside ours (mean, standard deviation). Its other results are figures without numbers."""

_CASES = ("FLC", "FLT", "FRC", "MRC", "MLT", "HLT", "HLC", "HRT", "HRC")


def _row(*pairs: tuple[float, float]) -> dict[str, tuple[float, float]]:
    return dict(zip(_CASES, pairs, strict=True))


# Table "Damage test results on the hexapodal robot": quantity -> method -> joint whose motor is dead -> (mean, deviation).
DAMAGE = {
    "distance_m": {
        "rma": _row((1.83, 0.77), (2.56, 2.11), (5.52, 2.95), (13.36, 3.25), (13.83, 2.31), (2.36, 1.53), (4.41, 2.39),
                    (3.95, 1.63), (4.33, 2.04)),
        "roam": _row((1.78, 1.41), (2.26, 1.21), (15.18, 3.17), (14.19, 2.81), (13.91, 3.28), (8.16, 3.19), (4.29, 2.17),
                     (4.18, 2.47), (3.28, 2.19)),
        "module-pe": _row((4.28, 2.93), (3.39, 1.26), (14.38, 2.78), (15.06, 2.90), (11.75, 2.84), (14.60, 2.76),
                          (1.90, 0.84), (13.32, 3.50), (3.89, 2.59)),
        "rolt": _row((14.28, 2.93), (13.39, 2.26), (14.68, 3.78), (16.06, 2.10), (15.15, 2.84), (12.56, 3.26),
                     (12.60, 2.74), (15.32, 1.50), (13.89, 2.64)),
    },
    "fall_time_s": {
        "rma": _row((2.31, 0.89), (3.56, 2.81), (7.52, 4.35), (20, 0), (20, 0), (3.45, 2.13), (4.64, 2.89), (5.15, 2.67),
                    (6.74, 3.0)),
        "roam": _row((2.26, 1.31), (3.17, 0.81), (20, 0), (20, 0), (20, 0), (11.16, 4.28), (6.29, 3.17), (4.18, 3.47),
                     (2.28, 11.19)),
        "module-pe": _row((5.98, 3.53), (4.51, 1.67), (20, 0), (20, 0), (20, 0), (20, 0), (2.87, 2.31), (20, 0), (4.49, 2.34)),
        "rolt": _row(*[(20, 0)] * 9),
    },
}  # fmt: skip

# Table "Real-world Experiments": a physical Go1, 10 s. The paper does not say how many trials.
REAL_WORLD = {
    "distance_m": {
        "rma": {"weaken": (0.0, 0.0), "box": (0.4, 0.1), "skates": (1.2, 0.1)},
        "rolt": {"weaken": (2.8, 0.2), "box": (1.5, 0.3), "skates": (4.8, 0.2)},
    },
}
