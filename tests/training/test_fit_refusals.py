"""Wrong input: one line, exit code 2, nothing written; episodes dealt without padding."""

import json
from dataclasses import replace

import pytest
from torch import nn

pytest.importorskip("lightning")

from torchcloth import recordings as rec
from torchcloth.training.fit.command import main
from torchcloth.training.fit.config import load
from torchcloth.training.fit.data import ShuffledEpisodeSampler

PAIR = "{in1_features: 2, in2_features: 2, out_features: 1}"
SEVEN, TWO = "{in_features: 7, out_features: 1}", "{input_size: 2, hidden_size: 1}"
LESS = "{in_features: -2, out_features: 1}"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["optimizer.stepz=3"],
            "config: optimizer.stepz; got an unknown key; expected one of learning_rate, steps, half_life",
        ),
        (["optimiser.steps=3"], "config: optimiser; got an unknown key"),
        (["optimizer.steps=many"], "config: optimizer.steps; got 'many'; expected a whole number"),
        (["optimizer.steps=0"], "config: optimizer.steps; got 0; expected at least 1"),
        (["optimizer.learning_rate=-1"], "config: optimizer.learning_rate; got -1.0"),
        (
            ["optimizer.learning_rate=.inf"],
            "config: optimizer.learning_rate; got inf; expected more than 0, and finite",
        ),
        (["learn.roughness=.inf"], "config: learn.roughness; got inf; expected at least 0, and finite"),
        (["steps"], "override; got 'steps'; expected KEY=VALUE"),
        (["data.train.0=mine"], "override; got data.train.0; expected nothing inside of 'train'"),
        (["out.x=1"], "override; got out.x"),
        (["data.train=[]"], "config: data.train; got no episodes"),
        (["data.train=nowhere"], "nowhere does not exist"),
        (["data.train=nowhere/*"], "got no folder that matches nowhere/*"),
        (["data.train=example:bimanual_swing", "data.val={held}"], "held: another cloth"),
        (
            ["data.val={trained}"],
            "config: data.val; got {trained}, which is in data.train, too; expected episodes that",
        ),
        (["data.val_motion=fling"], "config: data.val_motion; got 'fling'; expected one of data.train: shake"),
        (["data.per_step=4"], "config: data.per_step; got 4; expected at most 3"),
        (["learn.parameters=[stiffness]"], "parameter to fit; got 'stiffness'; expected one of"),
        (["learn.parameters=[]"], "config: learn; got no name"),
        (["learn.fields=[air.normal]", "learn.parameters=[]"], "got a field of air.normal"),
        (["model.start.youngs=1"], "config: model.start; got 'youngs'"),
        (["model.start.youngs_modulus=-1"], "youngs_modulus; got -1 Pa"),
        (["model.precision=float16"], "config: model.precision; got 'float16'; expected float64 or float32"),
        (["loss.chamfer=1"], "config: loss.chamfer; got unknown; expected one of points,"),
        (["loss.points=0"], "config: loss.points; got 0.0; expected a scale > 0"),
        (["loss={markers: 0.001}"], "nothing to compare with"),
        (["learn.network={module: no.Net, outputs: [poisson_ratio]}"], "config: learn.network; got no.Net (No module"),
        (
            [
                "learn.network={module: torch.nn.Identity, outputs: [youngs_modulus, poisson_ratio]}",
                "learn.parameters=[]",
            ],
            "config: learn.network; got a network without any; expected some parameter that may change",
        ),
        (
            [
                "learn.network={module: helpers.user_networks.BatchNormNetwork, outputs: [poisson_ratio]}",
                "run.processes=2",
            ],
            "config: learn.network; got layers with running statistics, on several processes",
        ),
        (["out=~nosuchuser/x"], "config: out; got ~nosuchuser/x"),
        (["learn.network={module: torch.nn.Softmax, outputs: [poisson_ratio]}"], "torch.nn.Softmax: output; got ["),
        (
            [f"learn.network={{module: torch.nn.Linear, arguments: {SEVEN}, outputs: [poisson_ratio]}}"],
            "torch.nn.Linear: forward; got RuntimeError: mat1 and mat2 shapes cannot be multiplied",
        ),
        (
            [f"learn.network={{module: torch.nn.Linear, arguments: {LESS}, outputs: [poisson_ratio]}}"],
            "config: learn.network; got torch.nn.Linear (",
        ),
        (
            [f"learn.network={{module: torch.nn.LSTM, arguments: {TWO}, outputs: [poisson_ratio]}}"],
            "output; got tuple; exp",
        ),
        (
            [f"learn.network={{module: torch.nn.Bilinear, arguments: {PAIR}, outputs: [poisson_ratio]}}"],
            "torch.nn.Bilinear: forward; got TypeError: ",
        ),
        (["data.train={kilometres}"], "expected points of the cloth, in metres"),
        (["run.loggers=[wandb]"], "config: run.loggers; got 'wandb'; expected csv or tensorboard"),
        (["run.processes=4"], "config: run.processes; got 4; expected at most 3, the episodes at a step"),
        (["--resume"], "--resume; got no "),
    ],
)
@pytest.mark.filterwarnings("ignore:Implicit dimension choice for softmax")
def test_one_line(config, episodes, tmp_path, capsys, options, words):
    path, wrong = config(), tmp_path / "kilometres"
    if "{kilometres}" in options[0]:
        seen = rec.read(episodes / "ep_0")
        rec.write(replace(seen, points=replace(seen.points, xyz=1e-3 * seen.points.xyz)), wrong)
    places = {"{held}": str(episodes / "held"), "{trained}": str(episodes / "ep_1"), "{kilometres}": str(wrong)}
    for name, place in places.items():
        options, words = [option.replace(name, place) for option in options], words.replace(name, place)
    assert main(["--config", path, *options]) == 2
    message = capsys.readouterr().err
    assert message.startswith("fit: ")
    assert words in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("content", [None, "a: [", "3", "learn: 3", "out: x", "out: x\nout: y"])
def test_a_file_that_is_no_config(tmp_path, capsys, content):
    path = tmp_path / "config.yaml"
    if content is not None:
        path.write_text(content)
    assert main(["--config", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert [f.name for f in tmp_path.iterdir()] in ([], ["config.yaml"])


def test_a_config_runs_no_code(tmp_path, capsys):
    """YAML can name functions to call, unless it is loaded safely."""
    path = tmp_path / "config.yaml"
    path.write_text(f"out: !!python/object/apply:os.mkdir ['{tmp_path / 'called'}']\n")
    assert main(["--config", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "called").exists()


def test_another_problem_is_not_resumed(config, episodes, capsys):
    path = config(optimizer={"steps": 1})
    assert main(["--config", path]) == 0
    moved = [f"data.train=[{episodes}/ep_0,{episodes}/ep_1]", f"data.val={episodes}/ep_2"]
    changed = (
        ["optimizer.learning_rate=0.2"],
        ["model.start.youngs_modulus=5e4"],
        [f"data.train={episodes}/ep_0"],
        moved,
    )
    for other in changed:
        assert main(["--config", path, "--resume", *other]) == 2
        assert "a checkpoint of another run" in capsys.readouterr().err


def test_fewer_steps_than_were_done_are_refused(config, capsys):
    path = config(optimizer={"steps": 2})
    assert main(["--config", path]) == 0
    capsys.readouterr()
    assert main(["--config", path, "--resume", "optimizer.steps=1"]) == 2
    assert "config: optimizer.steps; got 1; expected at least 2, the steps already done" in capsys.readouterr().err


@pytest.mark.parametrize(
    "damage",
    [lambda content_bytes: content_bytes[: len(content_bytes) // 2], lambda _: b"", lambda _: b"no checkpoint"],
)
def test_a_damaged_checkpoint_is_not_resumed(config, tmp_path, capsys, damage):
    path = config(optimizer={"steps": 1})
    assert main(["--config", path]) == 0
    (checkpoint,) = tmp_path.rglob("last.ckpt")
    checkpoint.write_bytes(damage(checkpoint.read_bytes()))
    capsys.readouterr()
    assert main(["--config", path, "--resume"]) == 2
    message = capsys.readouterr().err
    assert "which is damaged" in message
    assert message.count("\n") == 1


def test_a_network_whose_code_has_changed_is_not_resumed(config, tmp_path, capsys, monkeypatch):
    """Its weights have the same shapes."""
    code = "import torch\n\n\nclass Own(torch.nn.Linear):\n    def __init__(self):\n        super().__init__(2, 1)\n"
    (tmp_path / "own_net.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    path = config(learn={"network": {"module": "own_net.Own", "outputs": ["poisson_ratio"]}}, optimizer={"steps": 1})
    assert main(["--config", path]) == 0
    (tmp_path / "own_net.py").write_text(code + "\n    def forward(self, x):\n        return 2 * super().forward(x)\n")
    assert main(["--config", path, "--resume", "optimizer.steps=2"]) == 2
    assert "another" in capsys.readouterr().err


class Flat(nn.Linear):
    def __init__(self):
        super().__init__(2, 1)


class Deep(nn.Sequential):
    def __init__(self):
        super().__init__(nn.Linear(2, 3), nn.Linear(3, 1))


def test_a_network_that_has_changed_is_not_resumed(config, capsys, monkeypatch):
    network = {"module": "helpers.user_networks.Wavy", "outputs": ["poisson_ratio"]}
    monkeypatch.setattr("helpers.user_networks.Wavy", Flat, raising=False)
    path = config(optimizer={"steps": 1}, learn={"network": network})
    assert main(["--config", path]) == 0
    monkeypatch.setattr("helpers.user_networks.Wavy", Deep)
    assert main(["--config", path, "--resume"]) == 2
    assert "got learned.network.0.bias of shape none; expected (3,): the model" in capsys.readouterr().err


def test_the_shipped_config_is_read():
    config = load("demo", ["optimizer.learning_rate=2e-1", "model.start.air.normal=1e0"])
    assert config.data.train == ["example:bimanual_swing"]
    assert config.optimizer.learning_rate == 0.2
    assert config.model.start == {"air.normal": 1.0}
    assert json.dumps(config.loss) == '{"points": 0.001}'


@pytest.mark.parametrize(("count", "per_step", "world"), [(5, 2, 2), (3, 3, 2), (7, 4, 3)])
def test_episodes_are_dealt_once_each(count, per_step, world):
    """Together the processes have what one has; every pass has every episode once; passes differ."""
    together, alone = [], []
    for step in range(2 * count):
        deals = [ShuffledEpisodeSampler(count, per_step, 1, lambda: step, rank, world) for rank in range(world)]  # noqa: B023
        shares = [share for deal in deals for share in deal]
        assert max(map(len, shares)) - min(map(len, shares)) <= 1
        together += sorted(e for share in shares for e in share)
        alone += next(iter(ShuffledEpisodeSampler(count, per_step, 1, lambda: step)))  # noqa: B023
    assert sorted(together) == sorted(alone)
    passes = [alone[i : i + count] for i in range(0, len(alone), count)]
    assert all(sorted(p) == list(range(count)) for p in passes)
    assert per_step == count or len({tuple(p) for p in passes}) > 1


def test_more_processes_than_the_config_says_are_refused(config, capsys, monkeypatch):
    """Four that torchrun starts would each write the same files."""
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert main(["--config", config()]) == 2
    assert "run.processes x run.nodes; got 1, started as one of 4 processes (WORLD_SIZE)" in capsys.readouterr().err


def test_more_processes_than_the_config_says_are_refused_of_srun_too(config, capsys, monkeypatch):
    for name, value in {"SLURM_NTASKS": "4", "SLURM_PROCID": "3", "SLURM_JOB_NAME": "fit"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert main(["--config", config()]) == 2
    assert "got 1, started as one of 4 processes (SLURM_NTASKS)" in capsys.readouterr().err
    monkeypatch.setenv("SLURM_NTASKS", "2")
    assert main(["--config", config(), "run.processes=2"]) == 2
    assert "srun; got --ntasks=2 alone; expected --ntasks-per-node=2" in capsys.readouterr().err


def test_seeds_have_an_end(config, capsys):
    assert main(["--config", config(), "run.seed=99999999999999999"]) == 2
    assert "config: run.seed; got 99999999999999999; expected below 2^32" in capsys.readouterr().err
