"""What CUDA graphs gain, and from how many scenes on: ``python -m torchcloth.benchmarks.graphs``.

The same cloths and motion on the fused engine (CPU), and on a device by the reference's substeps, launched one by one
and as graphs. All must agree, or nothing is printed. No machine of ours had a device yet.
"""

from __future__ import annotations

import argparse

import torch

from torchcloth.engine.choice import Setting

from .paths import LIKE, motion, seconds, sheet

WAYS: dict[str, tuple[str, Setting]] = {
    "fused, CPU": ("cpu", "fused"),
    "one by one": ("cuda", "reference"),
    "graphs": ("cuda", "auto"),
}
AGREE = 1e-4  # m, in float32


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1, 32, 256], metavar="N", help="at a time")
    parser.add_argument("--frames", type=int, default=15, help="at 30 Hz")
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    for name, least in (("scenes", min(options.scenes)), ("frames", options.frames), ("repeats", options.repeats)):
        if least < 1:
            parser.error(f"--{name}: got {least}, expected 1 or more")
    if not torch.cuda.is_available():
        parser.error("got no CUDA device, expected one; `torchcloth bench` measures the engine on the CPU")
    times = [k / 30 for k in range(options.frames + 1)]
    rows = []
    for scenes in options.scenes:
        ends, slopes = [], []
        for name, (device, engine) in WAYS.items():
            cloth = sheet(engine, python=False).to(device)
            state = cloth.rest_state().map(lambda t, n=scenes: t.expand(n, *t.shape).clone())
            driven = motion(times[-1])

            def forward(cloth=cloth, state=state, driven=driven):
                with torch.no_grad():
                    return cloth(state, driven, times).x[..., -1, :, :].cpu()  # waits for the device

            def gradient(cloth=cloth, state=state, driven=driven):
                cloth.zero_grad()
                cloth(state, driven, times).x.square().mean().backward()
                return cloth.get_parameter("areal_density.raw").grad.cpu()  # type: ignore[union-attr]

            value, end = seconds(forward, options.repeats)
            ends.append(end)
            slope, along = seconds(gradient, options.repeats)
            slopes.append(along)
            rows.append((scenes, name, value, slope))
            substeps = sum(cloth.plan(state, driven, times, None).counts)
        for end, along in zip(ends[1:], slopes[1:], strict=True):
            torch.testing.assert_close(end, ends[0], rtol=0, atol=AGREE)
            torch.testing.assert_close(along, slopes[0], rtol=LIKE, atol=0)
    print(f"{substeps} substeps of 800 triangles, {torch.get_default_dtype()}, {torch.cuda.get_device_name()}\n")
    print("| scenes | path | forward | gradient | a substep and scene |\n|---|---|---|---|---|")
    for scenes, name, value, slope in rows:
        print(f"| {scenes} | {name} | {value:.3f} s | {slope:.3f} s | {1e6 * value / substeps / scenes:.1f} us |")


if __name__ == "__main__":
    main()
