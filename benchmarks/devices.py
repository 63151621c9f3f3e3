"""What a CUDA device gains, and from how many scenes on: ``python -m torchcloth.benchmarks.devices``.

The same cloths and motion on the fused engine, on the processor and on the device, and there by the reference's
substeps, captured as graphs and launched one by one. All must agree, or nothing is printed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch

import torchcloth as tc
from torchcloth import cloth as layer
from torchcloth.engine.choice import Choice, Setting

from .paths import LIKE, motion, seconds, sheet


class Way(NamedTuple):
    """How a cloth is simulated."""

    device: str
    engine: Setting
    captured: bool = False  # even where the engine could


WAYS = {
    "fused, CPU": Way("cpu", "fused"),
    "fused, CUDA": Way("cuda", "fused"),
    "reference, CUDA, graphs": Way("cuda", "auto", captured=True),
    "reference, CUDA, one by one": Way("cuda", "reference"),
}
AGREE = 1e-4  # m, in float32


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1, 32, 256], metavar="N", help="at a time")
    parser.add_argument("--frames", type=int, default=15, help="at 30 Hz")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), metavar="WAY", help=f"of {list(WAYS)}")
    parser.add_argument("--contact", action="store_true", help="with contact, though no layers meet")
    options = parser.parse_args()
    for name, least in (("scenes", min(options.scenes)), ("frames", options.frames), ("repeats", options.repeats)):
        if least < 1:
            parser.error(f"--{name}: got {least}, expected 1 or more")
    if not torch.cuda.is_available():
        parser.error("got no CUDA device, expected one; `torchcloth bench` measures the engine on the CPU")
    times = [k / 30 for k in range(options.frames + 1)]
    rows = []
    for scenes in options.scenes:
        found = {name: _measured(WAYS[name], scenes, times, options) for name in options.ways}
        first, *others = found.values()
        for other in others:
            torch.testing.assert_close(other.end, first.end, rtol=0, atol=AGREE)
            torch.testing.assert_close(other.slope, first.slope, rtol=LIKE, atol=0)
        rows += [(scenes, name, way.forward, way.gradient) for name, way in found.items()]
        substeps = first.substeps
    contact = "with" if options.contact else "without"
    print(
        f"{substeps} substeps of 800 triangles {contact} contact, {torch.get_default_dtype()}, "
        f"{torch.cuda.get_device_name()}, {torch.get_num_threads()} thread(s)\n"
    )
    print("| scenes | path | forward | gradient | a substep and scene |\n|---|---|---|---|---|")
    for scenes, name, value, slope in rows:
        print(f"| {scenes} | {name} | {value:.3f} s | {slope:.3f} s | {1e6 * value / substeps / scenes:.2f} us |")


class Measured(NamedTuple):
    """What one way gave, and what it took."""

    forward: float  # s
    gradient: float  # s, with the forward run
    end: torch.Tensor
    slope: torch.Tensor
    substeps: int


def _measured(way: Way, scenes: int, times: list[float], options: argparse.Namespace) -> Measured:
    cloth = sheet(way.engine, python=False, contact=tc.Contact() if options.contact else None).to(way.device)
    state = cloth.rest_state().map(lambda t: t.expand(scenes, *t.shape).clone())
    driven = motion(times[-1])

    def forward() -> torch.Tensor:
        with torch.no_grad():
            return cloth(state, driven, times).x[..., -1, :, :].cpu()  # waits for the device

    def gradient() -> torch.Tensor:
        cloth.zero_grad()
        cloth(state, driven, times).x.square().mean().backward()
        return cloth.get_parameter("areal_density.raw").grad.cpu()  # type: ignore[union-attr]

    with only_captured() if way.captured else torch.enable_grad():
        value, end = seconds(forward, options.repeats)
        slope, along = seconds(gradient, options.repeats)
        substeps = sum(cloth.plan(state, driven, times, None).counts)
    return Measured(value, slope, end, along, substeps)


@contextmanager
def only_captured() -> Iterator[None]:
    """On a device, without the engine."""
    usual = layer.choose
    layer.choose = lambda *_: Choice(None, "for comparison", captured=True)
    try:
        yield
    finally:
        layer.choose = usual


if __name__ == "__main__":
    main()
