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


def test_the_own_recording_can_be_identified(tmp_path, monkeypatch, capsys):
    """What a reader does next: write it, then the command."""
    monkeypatch.chdir(tmp_path)
    (block,) = (b for b in BLOCKS if "rec.write" in b)
    run(block)
    assert main(["identify", "my_episode", "--out", "fit", "--fit", "air.normal", "--iterations", "1"]) == 0
    assert "null: carried rigidly" in capsys.readouterr().out
