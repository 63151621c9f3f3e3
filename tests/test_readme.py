"""The README's code runs as it stands."""

import re
from pathlib import Path

import torch

from torchcloth.cli import main

README = Path(__file__).resolve().parents[1] / "README.md"


BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


def run(block: str) -> dict:
    scope: dict = {}
    exec(compile(block, "README.md", "exec"), scope)
    return scope


def test_the_layer():
    (block,) = (b for b in BLOCKS if "arm.motion" in b)
    scope = run(block)
    q = scope["q"]
    assert torch.isfinite(q.grad).all()
    assert float(q.grad.abs().max()) > 0
    assert scope["off"].item() < 2e-3, "of a centimetre"


def test_a_shirt_is_lifted():
    (block,) = (b for b in BLOCKS if "tc.meshes.shirt" in b)
    scope = run(block)
    frames, held = scope["frames"], scope["mesh"].places["left shoulder"]
    assert torch.isfinite(frames).all()
    torch.testing.assert_close(frames[-1, held, 2] - frames[0, held, 2], torch.full((len(held),), 0.04))
    assert float(frames[..., 2].min()) > -0.0061


def test_a_tension_machines_readings_are_fitted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (block,) = (b for b in BLOCKS if "fit_tension" in b)
    scope = run(block)
    assert scope["fit"].parameters["shear_modulus"].identifiable
    assert main(["predict", "nylon", "--angle", "30", "--out", "thirty"]) == 0
    assert "30" in capsys.readouterr().out


def test_every_block_is_run():
    runs = Path(__file__).read_text()
    chosen = re.findall(r'if "([^"]+)" in b\)', runs)
    assert [sum(word in block for word in chosen) for block in BLOCKS] == [1] * len(BLOCKS)


def test_the_own_recording_can_be_identified(tmp_path, monkeypatch, capsys):
    """What a reader does next: write it, then the command."""
    monkeypatch.chdir(tmp_path)
    (block,) = (b for b in BLOCKS if "rec.write" in b)
    run(block)
    assert main(["identify", "my_episode", "--out", "fit", "--fit", "air.normal", "--iterations", "1"]) == 0
    assert "null: carried rigidly" in capsys.readouterr().out
