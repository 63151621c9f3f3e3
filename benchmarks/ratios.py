"""Ratios between timings."""

from __future__ import annotations

from collections.abc import Mapping

from .suite import Record

CONVENTIONS = {
    "seconds": "median over samples of one whole run; what a ratio compares took turns in one round",
    "substeps": "of 1.6e-4 s; ms_per_substep is seconds by substeps, of all scenes of a batch together",
    "ratios *_vs_taichi, *_vs_warp, *_vs_newton, *_vs_mujoco, *_vs_eager": "time of the other over torchcloth's: above "
    "1, torchcloth is faster",
    "ratios tangents8_vs_forward, gradient_vs_forward, batch8_vs_batch1, batch32_vs_batch1": "costs: time over that of "
    "one forward run of the same substeps; a gradient is forward and backward",
    "ratios linear_*": "time per triangle (per substep) at the largest over that at 800 triangles (250 substeps)",
    "forward_vs_taichi, _warp, _eager, forward_everywhere_*, gradient_vs_forward_1s": "1 s in 6250 substeps and 25 "
    "frames; all others but linear_*, gradients and tangents too, are of one frame of 250 substeps, where what a call "
    "costs however short it is shows",
    "forward_vs_*, gradient_vs_*, forward_250_vs_* taichi, warp": "the standard case: torchcloth's own contact, in "
    "which a sheet far from other layers needs no grid, beside theirs, of the same particles, grid and steps",
    "*everywhere*": "every triangle of torchcloth's uses the grid too, the same grid work as theirs but that they "
    "clear all nodes of a box about the scene; ours takes 800 contact points through it, theirs 441 vertices and 800 "
    "elements",
    "newton, mujoco": "sheet-800, without contact, like theirs; MuJoCo computes in float64; Newton's "
    "contact is on in forward_contact_vs_newton, case standard",
    "gradient": "of the mean squared end position by initial positions, Young's modulus and (torchcloth) the poses",
    "prepare_seconds": "building, compiling and a first run; Taichi and Warp keep compiled code between calls",
    "limits": "flops and bytes that the standard case needs at least, in torchcloth's scheme, against this machine's "
    "rates with the threads asked for",
    "threads": "the reference runs with one thread, which is faster for small tensors; Warp has one on the CPU",
    "memory": "MiB (2^20 bytes) above the process after a brief run of the same scene",
}


def ratios(records: Mapping[str, Record], engine: str) -> dict[str, float]:
    """Return all ratios that the records allow; ``engine`` is torchcloth's fastest."""
    result = {}
    for name, (above, below) in ratio_keys(engine).items():
        if above in records and below in records:
            result[name] = records[above]["seconds"] / records[below]["seconds"]
    growth = _growth(records, engine)
    return {name: float(f"{value:.4g}") for name, value in (result | growth).items()}


def ratio_keys(engine: str) -> dict[str, tuple[str, str]]:
    """Return (key of the numerator, key of the denominator) by the name of the ratio."""
    equal, default, lone = "standard-everywhere", "standard", "sheet-800"
    short, result = ("forward_250", "forward"), {}  # the name of a ratio, and what is measured
    for name, quantity, label in (("forward", "forward", ".1s"), ("gradient", "gradient", ""), (*short, "")):
        for peer in ("taichi", "warp"):
            above = f"{quantity}.{equal}{label}.{peer}"
            result[f"{name}_vs_{peer}"] = (above, f"{quantity}.{default}{label}.{engine}")
            result[f"{name}_everywhere_vs_{peer}"] = (above, f"{quantity}.{equal}{label}.{engine}")
    for quantity in ("forward", "gradient"):
        for peer in ("newton", "mujoco"):
            result[f"{quantity}_vs_{peer}"] = (f"{quantity}.{lone}.{peer}", f"{quantity}.{lone}.{engine}")
    result["forward_contact_vs_newton"] = (f"forward.{default}.newton", f"forward.{default}.{engine}")
    result["forward_vs_eager"] = (f"forward.{default}.1s.reference", f"forward.{default}.1s.{engine}")
    result["gradient_vs_forward_1s"] = (f"gradient.{default}.1s.{engine}", f"forward.{default}.1s.{engine}")
    for name, quantity in (short, ("gradient", "gradient"), ("tangents8", "tangents8")):
        for case, suffix in ((equal, "_everywhere"), (default, ""), ("garment", "_garment")):
            result[f"{name}{suffix}_vs_eager"] = (f"{quantity}.{case}.reference", f"{quantity}.{case}.{engine}")
    for case, suffix in ((equal, "_everywhere"), (default, ""), ("standard-usual", "_usual"), ("garment", "_garment")):
        for quantity in ("tangents8", "gradient"):
            result[f"{quantity}_vs_forward{suffix}"] = (f"{quantity}.{case}.{engine}", f"forward.{case}.{engine}")
    one = f"forward.{default}.batch-1.{engine}"
    for size in (8, 32):
        result[f"batch{size}_vs_batch1"] = (f"forward.{default}.batch-{size}.{engine}", one)
    return result


def _growth(records: Mapping[str, Record], engine: str) -> dict[str, float]:
    """Cost per triangle and per substep at large sizes over that at small ones; 1 if it is proportional."""
    result = {}
    sizes = [r for key, r in records.items() if key.startswith("forward.sheet-") and key.endswith(f".size.{engine}")]
    if len(sizes) > 1:
        middle = min(sizes, key=lambda r: abs(r["triangles"] - 800))
        largest = max(sizes, key=lambda r: r["triangles"])
        each = [r["seconds"] / r["triangles"] for r in (largest, middle)]
        result["linear_in_triangles"] = each[0] / each[1]
    lengths = [r for key, r in records.items() if ".steps-" in key and key.endswith(engine)]
    steps = sorted((r["substeps"], r["seconds"]) for r in lengths)
    if len(steps) > 1:
        result["linear_in_substeps"] = steps[-1][1] / steps[-1][0] / (steps[0][1] / steps[0][0])
    return result
