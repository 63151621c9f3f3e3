"""Ratios, counts and the command."""

import itertools
import json
import mmap
import subprocess
import sys

import numpy as np
import pytest

from torchcloth.benchmarks import contestants, limits, report
from torchcloth.benchmarks.cases import engines, make_case
from torchcloth.benchmarks.contestant import Outcome, Task
from torchcloth.benchmarks.measure import Timing, peak, resident_mebibytes, sample
from torchcloth.benchmarks.ratios import CONVENTIONS, ratio_keys, ratios
from torchcloth.benchmarks.suite import Bench, BenchPlan, Entry, PreparedRun, measurement_rounds
from torchcloth.benchmarks.worker import ContestantFailed

ISSUE = (
    "forward_vs_taichi",
    "forward_vs_warp",
    "forward_vs_eager",
    "gradient_vs_taichi",
    "gradient_vs_warp",
    "tangents8_vs_forward",
    "gradient_vs_forward",
    "batch8_vs_batch1",
)


@pytest.fixture
def made_up():
    """A record for every entry of the full plan: so many seconds as the contestant's name has letters."""
    plan = BenchPlan(("fused", "reference"), tuple(contestants.PEERS))
    result = {}
    for entry in itertools.chain(*measurement_rounds(plan)):
        for name in entry.names:
            task = entry.task
            size = {"substeps": task.substeps, "triangles": task.build_case().triangles, "batch": task.batch}
            result[entry.key(name)] = size | {"seconds": float(len(name)), "ms_per_substep": 1.0}
    return result


def test_ratios_come_from_the_cases(made_up):
    made_up["tangents8.standard.fused"]["seconds"] = 15.0
    made_up["forward.standard.batch-8.fused"]["seconds"] = 20.0
    result = ratios(made_up, "fused")
    assert set(ISSUE) <= set(result)
    assert result["forward_vs_taichi"] == result["forward_250_everywhere_vs_taichi"] == 6 / 5
    assert result["gradient_vs_warp"] == 4 / 5
    assert result["forward_vs_eager"] == 9 / 5
    assert result["tangents8_vs_forward"] == 3.0
    assert result["batch8_vs_batch1"] == 4.0
    assert result["linear_in_triangles"] == pytest.approx(800 / 20_000, rel=1e-3)
    assert result["linear_in_substeps"] == pytest.approx(0.1)


def test_without_peers_their_ratios_are_left_out(made_up):
    result = ratios({key: r for key, r in made_up.items() if not key.endswith("warp")}, "fused")
    assert not any("warp" in name for name in result)
    assert "forward_vs_taichi" in result


def test_conventions_speak_of_ratios_that_exist(made_up):
    result = ratios(made_up, "fused")
    for name in ("tangents8_vs_forward", "gradient_vs_forward", "batch8_vs_batch1"):
        assert name in result
        assert any(name in convention for convention in CONVENTIONS)


def test_entries_have_keys_of_their_own():
    for fast in (False, True):
        plan = BenchPlan(("fused", "reference"), tuple(contestants.PEERS), fast=fast)
        keys = [entry.key(name) for entry in itertools.chain(*measurement_rounds(plan)) for name in entry.names]
        assert len(keys) == len(set(keys))


def test_a_ratio_is_of_one_round():
    plan = BenchPlan(("fused", "reference"), tuple(contestants.PEERS))
    of = {e.key(name): k for k, entries in enumerate(measurement_rounds(plan)) for e in entries for name in e.names}
    for name, (above, below) in ratio_keys("fused").items():
        assert of[above] == of[below], name


class Ready:
    """A worker that has computed something."""

    threads = 1
    prepare = lambda self, task: 0.1  # noqa: E731
    forget = close = lambda self: None

    def __init__(self, outcome, ends_in=None):
        self.outcome, self.ends_in = outcome, ends_in

    def sample(self, task, shortest):
        if task.quantity == self.ends_in:
            raise ContestantFailed("killed")
        return 1.0

    def result(self, task):
        return (self.outcome,)


def test_who_ends_leaves_the_round_and_nobody_else_does():
    x = Task("standard", "forward", 20, small=True).build_case().mesh.vertices + np.array([0.0, 0.0, -1e-4])
    right = Outcome(x, 1.0, np.ones_like(x), 1.0)
    bench = Bench(BenchPlan(("fused", "reference"), samples=2))
    bench._workers.update(fused=Ready(right, ends_in="gradient"), reference=Ready(right))
    entries = [Entry(Task("standard", q, 20, small=True), ("fused", "reference")) for q in ("forward", "gradient")]
    bench.measure(entries)
    assert set(bench.records) == {entry.key("reference") for entry in entries}
    assert bench.notes == {
        entries[0].key("fused"): "fused ended in another task of this round",
        entries[1].key("fused"): "killed",
    }
    assert set(bench._workers) == {"reference"}


@pytest.mark.parametrize("question", ["result", "forget"])
def test_who_ends_after_its_last_sample_takes_nobody_along(question):
    x = Task("standard", "forward", 20, small=True).build_case().mesh.vertices + np.array([0.0, 0.0, -1e-4])
    right = Outcome(x, 1.0, np.ones_like(x), 1.0)
    bench, entry = (
        Bench(BenchPlan(("fused", "reference"))),
        Entry(Task("standard", "forward", 20, small=True), ("fused", "reference")),
    )
    dying = Ready(right)

    def ends(*task):
        raise ContestantFailed("killed")

    setattr(dying, question, ends)
    bench._workers.update(fused=dying, reference=Ready(right))
    bench.measure([entry])
    dropped = {entry.key("fused")} if question == "result" else set()
    assert set(bench.notes) == dropped
    assert set(bench.records) == {entry.key(name) for name in entry.names} - dropped
    assert set(bench._workers) == {"reference"}


@pytest.mark.parametrize(
    ("broken", "counted"), [("fused", {"reference"}), ("reference", {"fused"}), ("", {"fused", "reference"})]
)
def test_who_is_wrong_is_not_counted_and_condemns_nobody(broken, counted):
    """Whoever comes first."""
    task = Task("standard", "gradient", 20, small=True)
    x = task.build_case().mesh.vertices + np.array([0.0, 0.0, -1e-4])
    right = Outcome(x, 1.0, np.ones_like(x), 1.0)
    wrong = Outcome(np.full_like(x, np.nan), 1.0, np.ones_like(x), 1.0)
    bench, entry = Bench(BenchPlan(("fused", "reference"))), Entry(task, ("fused", "reference"))
    bench._record_valid(
        entry, {n: PreparedRun(Ready(wrong if n == broken else right), 0.0, [1.0]) for n in entry.names}
    )
    assert set(bench.records) == {entry.key(name) for name in counted}
    assert len(bench.notes) == 2 - len(counted)


def test_the_fused_engine_is_held_against_the_reference():
    task = Task("standard", "gradient", 20, small=True)
    x = task.build_case().mesh.vertices + np.array([0.0, 0.0, -1e-4])
    right, other = Outcome(x, 1.0, np.ones_like(x), 1.0), Outcome(x, 1.0, -7 * np.ones_like(x), 1.0)
    bench, entry = Bench(BenchPlan(("fused", "reference"))), Entry(task, ("fused", "reference"))
    bench._record_valid(
        entry, {"fused": PreparedRun(Ready(other), 0.0, [1.0]), "reference": PreparedRun(Ready(right), 0.0, [1.0])}
    )
    assert set(bench.records) == {entry.key("reference")}
    assert "derivative by positions" in bench.notes[entry.key("fused")]


def test_samples_are_seconds_of_one_run():
    runs = []
    seconds, last = sample(lambda: runs.append(len(runs)) or len(runs), shortest=0.01)
    assert len(runs) > 1
    assert seconds * len(runs) >= 0.01 * (1 - 1e-9)
    assert last == len(runs)
    assert Timing.of([3.0, 1.0, 2.0]) == Timing(2.0, 1.0, 3)


def test_memory_is_seen():
    """Pages of its own: a heap may hold on to what an earlier test freed, and hand out resident pages."""
    before = resident_mebibytes()
    with mmap.mmap(-1, 64 * 2**20) as block:
        block[:: mmap.PAGESIZE] = b"x" * len(block[:: mmap.PAGESIZE])
        assert resident_mebibytes() - before == pytest.approx(64, abs=8)
        assert peak() >= resident_mebibytes() - 1


def test_limits_of_this_machine():
    result = limits.measure(1)
    assert 1e9 < result.bytes_per_second < 1e12
    assert 1e9 < result.flops_per_second < 1e12
    case = make_case("standard-everywhere")
    counts, alone = limits.count_operations(case, 800), limits.count_operations(case, 0)
    assert counts.flops > 5 * alone.flops
    distance = result.distance(counts, 1e-3)
    assert distance["times_the_limit"] == pytest.approx(1.0 / max(distance["arithmetic_ms"], distance["memory_ms"]))


def test_the_plot(made_up, tmp_path):
    path = report.plot({"cases": made_up}, tmp_path / "new")
    assert path is not None
    assert path.read_bytes().startswith(b"\x89PNG")
    assert report.plot({"cases": {}}, tmp_path) is None


def call(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "torchcloth.cli", "bench", *map(str, arguments)], capture_output=True, text=True
    )


@pytest.mark.slow
def test_the_command_says_one_object(tmp_path):
    done = call("--fast", "--json", "--threads", 1, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    result = json.loads(line)
    assert {"machine", "cases", "ratios", "conventions", "limits", "notes", "missing_peers", "schema"} == set(result)
    assert result["notes"] == {}
    best = engines()[0]
    for quantity in ("forward", "gradient", "tangents8"):
        record = result["cases"][f"{quantity}.standard-everywhere.{best}"]
        assert {"seconds", "substeps", "triangles", "ms_per_substep"} <= set(record)
        assert record["ms_per_substep"] == pytest.approx(1e3 * record["seconds"] / record["substeps"])
    assert {"forward_vs_eager", "tangents8_vs_forward", "gradient_vs_forward", "batch8_vs_batch1"} <= set(
        result["ratios"]
    )
    assert result["cases"][f"startup.gradient.{best}"]["seconds"] > 0
    assert result["cases"][f"memory.gradient.garment.{best}"]["peak_mebibytes"] >= 0
    assert json.loads((tmp_path / "out" / "bench.json").read_text()) == result


def test_wrong_arguments_are_one_line(tmp_path):
    (tmp_path / "file").touch()
    for arguments in (("--threads", 0), ("--out", tmp_path / "file")):
        done = call("--fast", *arguments)
        assert done.returncode == 2
        assert done.stderr.startswith("torchcloth: ")
        assert done.stderr.count("\n") == 1


def test_a_missing_peer_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(contestants, "find_spec", lambda name: None)
    assert set(contestants.missing_peers()) == set(contestants.PEERS)
    assert "pip install warp-lang" in contestants.missing_peers()["warp"]
