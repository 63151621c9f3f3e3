"""Runs of the fit: what they learn, and that they go on bit for bit."""

import csv
import json
import re
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("lightning")

from lightning.pytorch.callbacks import Callback

import torchcloth as tc
import torchcloth.training.fit.run as run
from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput
from torchcloth.training.fit.command import main
from torchcloth.training.fit.config import Learn, Network, load
from torchcloth.training.fit.learned_cloth import LearnedCloth
from torchcloth.training.fit.module import FitModule

NETWORK = {
    "module": "helpers.user_networks.SmallNetwork",
    "outputs": ["youngs_modulus"],
    "arguments": {"width": 3, "drop": 0.3},
}
EVERYTHING = {"parameters": ["air.normal"], "fields": ["areal_density"], "network": NETWORK, "roughness": 0.1}


class Stopped(Exception):
    """Power went."""


class Stop(Callback):
    """In the middle of a step: after the gradients of its first episode."""

    def __init__(self, step):
        self.step = step

    def on_after_backward(self, trainer, pl_module):
        if trainer.global_step == self.step:
            raise Stopped


def stop_at(monkeypatch, step):
    """The next runs end in step ``step``."""
    content_bytes = run._trainer

    def trainer(*args):
        made = content_bytes(*args)
        made.callbacks.append(Stop(step))
        return made

    monkeypatch.setattr(run, "_trainer", trainer)


def state(folder):
    """Weights, optimiser, schedule and history of the last checkpoint."""
    content = torch.load(folder / "last.ckpt", weights_only=True)
    return [content[key] for key in ("state_dict", "optimizer_states", "lr_schedulers", "history")]


def same(one, two):
    """Bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, two)
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(two) and all(map(same, one, two))
    return one == two


def test_it_learns_the_fabric(config, tmp_path):
    """The points lie on the true sheet: E goes from 80 kPa towards 40, and loads back without the data."""
    optimizer = {"learning_rate": 0.15, "steps": 20, "half_life": 6}
    path = config(learn={"parameters": ["youngs_modulus"]}, optimizer=optimizer)
    assert main(["--config", path]) == 0
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    entry = content["parameters"]["youngs_modulus"]
    assert (entry["initial"], entry["unit"]) == (pytest.approx(8e4), "Pa")
    assert entry["value"] == pytest.approx(4e4, rel=0.05)
    assert content["train"]["loss_after"] < 0.05 * content["train"]["loss_before"]
    assert "without error bars" in content["remark"]
    assert f"youngs_modulus={entry['value']:.6g}" in content["identify_command"]
    assert [entry["step"] for entry in content["history"]] == list(range(20))
    cloth = FitModule.load_from_checkpoint(tmp_path / "out" / "last.ckpt").cloth()
    assert float(cloth.material.youngs_modulus.value.detach()) == entry["value"]


def test_figures_before_are_of_all_episodes_or_missing(config, episodes, tmp_path):
    """The first step of a part of them told of that part, beside the end's of all."""
    data = {"train": str(episodes / "ep_*")}
    for per_step, has_loss_before in ((0, True), (2, False)):
        out = tmp_path / f"of-{per_step}"
        assert main(["--config", config(data={**data, "per_step": per_step}), f"out={out}"]) == 0
        assert ("loss_before" in json.loads((out / "fit.json").read_text())["train"]) == has_loss_before


@pytest.mark.parametrize("step", [1, 3])  # in the midst of a shuffle, and at the beginning of one
def test_resuming_is_bit_for_bit(config, episodes, tmp_path, monkeypatch, step):
    """Stopped within any step: shuffled episodes, dropout, schedule, a scalar, a field and a network."""
    data = {"train": str(episodes / "ep_*"), "per_step": 2}
    path = config(learn=EVERYTHING, optimizer={"steps": 4, "half_life": 3}, data=data)
    content_bytes = run.fit(load(path, [f"out={tmp_path / 'whole'}"]))
    with monkeypatch.context() as patch:
        stop_at(patch, step)
        with pytest.raises(Stopped):
            run.fit(load(path))
    assert len(torch.load(tmp_path / "out" / "last.ckpt", weights_only=True)["history"]) == step
    resumed = run.fit(load(path), resume=True)
    assert same(state(tmp_path / "whole"), state(tmp_path / "out"))
    assert same(content_bytes.learned.values(), resumed.learned.values())
    assert not torch.equal(content_bytes.learned.values()["areal_density"], torch.full((32,), 0.3))


def test_a_gradient_that_is_no_number_is_not_followed(config, tmp_path, capsys):
    """The checkpoint is from the step before, and can be gone on from."""
    path = config(
        learn={"network": {"module": "helpers.user_networks.NanGradientNetwork", "outputs": ["youngs_modulus"]}},
        optimizer={"steps": 4},
    )
    for again in ([], ["--resume"]):
        assert main(["--config", path, *again]) == 2
        assert "gradient of step 2; got numbers that are not finite" in capsys.readouterr().err
        weights, _, _, history = state(tmp_path / "out")
        assert len(history) == 1
        assert all(bool(value.isfinite().all()) for value in weights.values())


@pytest.mark.filterwarnings("ignore:Attribute .description. removed from hparams")  # the disk fails on purpose
def test_a_checkpoint_is_there_whole_or_as_before(config, tmp_path, monkeypatch):
    path = config(optimizer={"steps": 1})
    assert main(["--config", path]) == 0
    before, usual = state(tmp_path / "out"), Path.write_bytes

    def fails(file, content):
        usual(file, bytes(content)[:200])
        raise OSError("the disk is full")

    monkeypatch.setattr(Path, "write_bytes", fails)
    assert main(["--config", path, "--resume", "optimizer.steps=2"]) == 2
    assert same(state(tmp_path / "out"), before)
    assert not [f for f in (tmp_path / "out").iterdir() if f.name.startswith(".")]


def test_a_run_anew_leaves_no_result_of_the_run_before(config, tmp_path, monkeypatch):
    path = config(learn=EVERYTHING)
    assert main(["--config", path]) == 0
    assert {f.name for f in (tmp_path / "out").glob("fi*")} == {"fit.json", "fields.npz"}
    stop_at(monkeypatch, 1)
    with pytest.raises(Stopped):
        run.fit(load(path))
    assert not list((tmp_path / "out").glob("fi*"))


def test_out_may_be_somebodys_home(config, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    path = config(optimizer={"steps": 1})
    assert main(["--config", path, "out=~/mine"]) == 0
    assert {"fit.json", "last.ckpt"} <= {f.name for f in (tmp_path / "mine").iterdir()}
    assert main(["--config", path, "out=~/mine", "--resume", "optimizer.steps=2"]) == 0
    assert not (tmp_path / "~").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="signals of POSIX")
def test_slurm_leaves_resuming_to_the_user(config, tmp_path, monkeypatch):
    """Lightning's own checkpoint, upon SLURM's signal, was taken up by every later run in the folder."""
    for name, value in {
        "NTASKS": "1",
        "NTASKS_PER_NODE": "1",
        "JOB_NAME": "fit",
        "PROCID": "0",
        "LOCALID": "0",
    }.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    handlers, usual = [], FitModule.training_step

    def watched(self, *args):
        handlers.append(signal.getsignal(signal.SIGUSR1))
        return usual(self, *args)

    monkeypatch.setattr(FitModule, "training_step", watched)
    assert main(["--config", config(optimizer={"steps": 2})]) == 0
    assert handlers == [signal.SIG_DFL, signal.SIG_DFL]
    assert len(json.loads((tmp_path / "out" / "fit.json").read_text())["history"]) == 2


def test_warnings_of_episodes_are_reported(config, episodes, tmp_path, capsys):
    seen = rec.read(episodes / "ep_0")
    open_ = {name: replace(hand, closed=np.zeros_like(hand.closed)) for name, hand in seen.grippers.items()}
    rec.write(replace(seen, grippers=open_), tmp_path / "open")
    capsys.readouterr()
    assert main(["--config", config(), f"data.train={tmp_path / 'open'}"]) == 2
    assert "open: nothing holds the cloth; got grippers that are never closed" in capsys.readouterr().err
    sets = f"data.train={episodes / 'ep_1'}", f"data.val={tmp_path / 'open'}"  # a prediction may be of cloth let go
    assert main(["--config", config(optimizer={"steps": 1}), *sets]) == 0
    assert "open: no gripper is ever closed" in json.loads((tmp_path / "out" / "fit.json").read_text())["warnings"][0]
    assert "warning: open: no gripper is ever closed" in capsys.readouterr().out


def test_a_loaded_module_leaves_the_callers_random_numbers(config, tmp_path):
    run.fit(load(config(learn=EVERYTHING, optimizer={"steps": 1})))
    torch.manual_seed(3)
    before = torch.get_rng_state()
    FitModule.load_from_checkpoint(tmp_path / "out" / "last.ckpt")
    assert torch.equal(torch.get_rng_state(), before)


def test_options_stand_in_any_order(config, tmp_path):
    assert main(["--config", config(), f"out={tmp_path / 'there'}", "--resume", "optimizer.steps=1"]) == 2
    assert main(["optimizer.steps=1", "--config", config(), f"out={tmp_path / 'there'}"]) == 0
    assert (tmp_path / "there" / "fit.json").is_file()


def test_more_steps_after_the_end(config, tmp_path):
    """A finished run goes on with more steps as if it had been asked for them at once."""
    path = config()
    run.fit(load(path))
    run.fit(load(path, ["optimizer.steps=4"]), resume=True)
    run.fit(load(path, ["optimizer.steps=4", f"out={tmp_path / 'whole'}"]))
    assert same(state(tmp_path / "whole"), state(tmp_path / "out"))


def test_a_network_loads_back(config, tmp_path):
    """With the field that it gives, in a cloth that simulates."""
    learn = {"network": {**NETWORK, "arguments": {"width": 3}}}
    module = run.fit(load(config(learn=learn)))
    cloth = FitModule.load_from_checkpoint(tmp_path / "out" / "last.ckpt").cloth()
    assert torch.equal(cloth.material.youngs_modulus.value, module.learned.values()["youngs_modulus"])
    assert cloth.material.youngs_modulus.value.shape == (32,)
    assert cloth.stable_step() > 0
    assert (tmp_path / "out" / "fields.npz").is_file()
    assert (
        json.loads((tmp_path / "out" / "fit.json").read_text())["identify_command"] is None
    )  # no number to start from


@pytest.mark.parametrize("name", ["os.system", "torch.hub.load", "torch.nn.functional.relu"])
def test_nothing_but_a_module_class_is_called(config, tmp_path, monkeypatch, name):
    """Neither from YAML nor from a checkpoint, which anybody may have written."""
    path = config(learn={"network": NETWORK}, optimizer={"steps": 1})
    assert main(["--config", path]) == 0
    checkpoint = torch.load(tmp_path / "out" / "last.ckpt", weights_only=True)
    checkpoint["hyper_parameters"]["config"]["learn"]["network"] |= {"module": name, "arguments": {"command": "date"}}
    torch.save(checkpoint, tmp_path / "bad.ckpt")
    called = []
    monkeypatch.setattr(name, lambda *_, **options: called.append(options))
    with pytest.raises(InvalidInput, match=re.escape(name)):
        FitModule.load_from_checkpoint(tmp_path / "bad.ckpt")
    assert main(["--config", path, f"learn.network.module={name}", "optimizer.steps=2"]) == 2
    assert not called


def test_a_checkpoint_imports_nothing(config, tmp_path, monkeypatch):
    """A class is imported before, or given."""
    assert main(["--config", config(learn={"network": NETWORK}, optimizer={"steps": 1})]) == 0
    network_class = sys.modules["helpers.user_networks"].SmallNetwork
    monkeypatch.delitem(sys.modules, "helpers.user_networks")
    with pytest.raises(InvalidInput, match="SmallNetwork, which is not imported"):
        FitModule.load_from_checkpoint(tmp_path / "out" / "last.ckpt")
    assert "helpers.user_networks" not in sys.modules
    FitModule.load_from_checkpoint(tmp_path / "out" / "last.ckpt", network_class=network_class)


def test_a_checkpoint_with_objects_is_refused(config, tmp_path):
    """Also below torch 2.6, where Lightning would unpickle them."""
    assert main(["--config", config(optimizer={"steps": 1})]) == 0
    checkpoint = torch.load(tmp_path / "out" / "last.ckpt", weights_only=True)
    torch.save({**checkpoint, "extra": Touch(tmp_path / "called")}, tmp_path / "bad.ckpt")
    with pytest.raises(InvalidInput, match="holds more than tensors"):
        FitModule.load_from_checkpoint(tmp_path / "bad.ckpt")
    assert not (tmp_path / "called").exists()


class Touch:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_validation_is_held_out(config, episodes, tmp_path):
    """By ``split.motion``; its figures are in the result and do not move the fit."""
    everything = f"[{episodes}/*]"
    path = config()
    run.fit(load(path, [f"data.train={everything}", "data.val_motion=other"]))
    held = json.loads((tmp_path / "out" / "fit.json").read_text())
    alone = run.fit(load(path, [f"out={tmp_path / 'alone'}"]))
    assert (held["train"]["episodes"], held["val"]["episodes"]) == (3, 1)
    assert held["val"]["chamfer_after"] > 0
    assert held["parameters"]["youngs_modulus"]["value"] == float(alone.learned.values()["youngs_modulus"])


@pytest.mark.parametrize("loss", ["chamfer_to_surface", "chamfer_to_vertices"])
def test_every_loss_has_a_gradient(config, loss):
    module = run.fit(load(config(loss={loss: 1e-3}, optimizer={"steps": 1})))
    assert float(module.learned.values()["youngs_modulus"]) != pytest.approx(8e4, rel=1e-3)


def test_a_network_cannot_make_a_cone_negative():
    mesh = tc.meshes.rectangle(0.2, 0.2, triangles=18)
    cloth = tc.Cloth(mesh, tc.materials.AEP.preset("cotton"), 0.15, contact=tc.Contact(0.05))
    network = Network("torch.nn.Linear", ["cone"], {"in_features": 2, "out_features": 1})
    learned = LearnedCloth(cloth, Learn(network=network))
    with torch.no_grad():
        learned.network.weight.zero_()
        learned.network.bias.fill_(-1.0)
    assert float(learned.values()["cone"].max()) == 0.0


def test_what_is_left_is_no_validation(config, episodes, tmp_path):
    """A log of validation ends with the last step's; the training set's figures stood there."""
    data = {"train": [str(episodes / "ep_0")], "val": [str(episodes / "ep_1")]}
    for name, entry in (("with", data), ("without", {**data, "val": []})):
        path = config(data=entry, optimizer={"steps": 2}, run={"loggers": ["csv"]})
        assert main(["--config", path, f"out={tmp_path / name}"]) == 0
        (log,) = (tmp_path / name).rglob("metrics.csv")
        with log.open() as file:
            seen = [row["val/loss"] for row in csv.DictReader(file) if row.get("val/loss")]
        assert len(seen) == (2 if entry["val"] else 0)
        content = json.loads((tmp_path / name / "fit.json").read_text())
        assert content["train"]["loss_after"] > 0


def test_the_command_for_errors_takes_the_same_steps(config, tmp_path):
    path = config(learn={"parameters": ["youngs_modulus"]}, optimizer={"steps": 1}, model={"dt": 2e-4})
    assert main(["--config", path]) == 0
    assert json.loads((tmp_path / "out" / "fit.json").read_text())["identify_command"].endswith("--dt 0.0002")


def test_globs_find_folders(config, episodes, tmp_path):
    """``simulate`` leaves pictures beside its episodes."""
    shutil.copytree(episodes / "ep_0", tmp_path / "own" / "ep_0")
    (tmp_path / "own" / "ep_0.gif").write_bytes(b"GIF89a")
    assert main(["--config", config(data={"train": [f"{tmp_path}/own/*"]}, optimizer={"steps": 1})]) == 0


def test_a_stopped_run_promises_only_its_own_checkpoint(config, monkeypatch, capsys):
    path = config(optimizer={"steps": 1})
    assert main(["--config", path]) == 0
    stopped = lambda *_: (_ for _ in ()).throw(KeyboardInterrupt)  # noqa: E731
    monkeypatch.setattr(run, "fit", stopped)
    for options, promised in ((["--resume"], True), (["optimizer.learning_rate=0.2"], False)):
        assert main(["--config", path, *options]) == 130
        assert ("continues after" in capsys.readouterr().err) == promised
