"""What a CUDA device gains, and from how many scenes on: ``python -m torchcloth.benchmarks.devices``.

The fused engine runs the same cloths and motion on the processor and on the device. The reference's substeps run them
on the device too, captured in CUDA graphs and launched one by one. A result that does not agree with the first ends the
program.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch

import torchcloth as tc
from torchcloth import cloth as layer
from torchcloth.engine.dispatch import EngineChoice, Setting

from .paths import MAX_RELATIVE_SLOPE_DIFFERENCE, motion, seconds, sheet


class SimulationPath(NamedTuple):
    """How a cloth is simulated.

    Attributes:
        device: of the tensors.
        engine: setting of the cloth.
        uses_cuda_graphs: the reference in CUDA graphs, even where the fused engine could run.
    """

    device: str
    engine: Setting
    uses_cuda_graphs: bool = False


PATHS = {
    "fused, CPU": SimulationPath("cpu", "fused"),
    "fused, CUDA": SimulationPath("cuda", "fused"),
    "reference, CUDA, graphs": SimulationPath("cuda", "auto", uses_cuda_graphs=True),
    "reference, CUDA, one by one": SimulationPath("cuda", "reference"),
}
MAX_POSITION_DIFFERENCE_M = 1e-3  # in float32; rounding errors grow where cloth wrinkles


def main() -> None:
    """Print the table of all paths and devices."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1, 32, 256], metavar="N", help="at a time")
    parser.add_argument(
        "--frames",
        type=int,
        help="at 30 Hz, by default 8, folded 1: in longer runs cloth wrinkles and rounding errors grow",
    )
    parser.add_argument("--repeats", type=int, default=2)
    names = list(PATHS)
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=names, metavar="PATH", help=f"of {names}")
    contact = parser.add_mutually_exclusive_group()
    contact.add_argument("--contact", action="store_true", help="with contact, although no layers meet")
    contact.add_argument("--folded", action="store_true", help="with contact, one half on the other")
    options = parser.parse_args()
    options.frames = (1 if options.folded else 8) if options.frames is None else options.frames
    for name, least in (("scenes", min(options.scenes)), ("frames", options.frames), ("repeats", options.repeats)):
        if least < 1:
            parser.error(f"--{name}: got {least}, expected 1 or more")
    if not torch.cuda.is_available():
        parser.error("got no CUDA device, expected one; `torchcloth bench` measures the engine on the CPU")
    times = [k / 30 for k in range(options.frames + 1)]
    contact = "folded, with" if options.folded else "with" if options.contact else "without"
    print(
        f"800 triangles {contact} contact, {torch.get_default_dtype()}, {torch.cuda.get_device_name()}, "
        f"{torch.get_num_threads()} thread(s)\n"
    )
    print(
        "| scenes | path | substeps | forward | gradient | a substep and scene |\n|---|---|---|---|---|---|", flush=True
    )
    for scenes in options.scenes:
        first = None
        for name in options.paths:
            way = _measure(PATHS[name], scenes, times, options)
            first = first or way
            torch.testing.assert_close(way.end, first.end, rtol=0, atol=MAX_POSITION_DIFFERENCE_M)
            torch.testing.assert_close(way.slope, first.slope, rtol=MAX_RELATIVE_SLOPE_DIFFERENCE, atol=0)
            each = 1e6 * way.forward / way.substeps / scenes
            cells = f"{way.substeps} | {way.forward:.3f} s | {way.gradient:.3f} s | {each:.2f} us"
            print(f"| {scenes} | {name} | {cells} |", flush=True)


class PathResult(NamedTuple):
    """Times and results of one path.

    Attributes:
        forward: s.
        gradient: s, with the forward run.
        end: positions at the end.
        slope: a gradient.
        substeps: of the simulation.
    """

    forward: float
    gradient: float
    end: torch.Tensor
    slope: torch.Tensor
    substeps: int


def _measure(way: SimulationPath, scenes: int, times: list[float], options: argparse.Namespace) -> PathResult:
    contact = tc.Contact() if options.contact or options.folded else None
    cloth = sheet(way.engine, python=False, contact=contact).to(way.device)
    state = folded(cloth) if options.folded else cloth.rest_state()
    state = state.map(lambda t: t.expand(scenes, *t.shape).clone())
    driven = motion(times[-1])

    def forward() -> torch.Tensor:
        with torch.no_grad():
            return cloth(state, driven, times).x[..., -1, :, :].cpu()  # waits for the device

    def gradient() -> torch.Tensor:
        cloth.zero_grad()
        cloth(state, driven, times).x.square().mean().backward()
        return cloth.get_parameter("areal_density.raw").grad.cpu()  # type: ignore[union-attr]

    with force_cuda_graphs() if way.uses_cuda_graphs else torch.enable_grad():
        value, end = seconds(forward, options.repeats)
        slope, along = seconds(gradient, options.repeats)
        substeps = sum(cloth.schedule(state, driven, times, None).counts)
    return PathResult(value, slope, end, along, substeps)


def folded(cloth: tc.Cloth) -> tc.ClothState:
    """Return a state with the right half over the left one, nearer than layers rest."""
    x, grid = cloth.rest_state().x.clone(), cloth.contact_grid()
    if grid is None:
        raise ValueError("no contact, no layers")
    middle = x[:, 0].mean()
    right = x[:, 0] > middle + 1e-6
    x[right, 0] = 2 * middle - x[right, 0]
    x[right, 2] += 1.3 * grid.spacing
    return cloth.state(x)


@contextmanager
def force_cuda_graphs() -> Iterator[None]:
    """Make the reference run in CUDA graphs instead of the fused engine, within the context."""
    original = layer.choose_engine
    layer.choose_engine = lambda *_: EngineChoice(None, "for comparison", uses_cuda_graphs=True)
    try:
        yield
    finally:
        layer.choose_engine = original


if __name__ == "__main__":
    main()
