"""Threads share the work of batches and directions, and change no bit of the results; within a scene, the last ones."""

import os
import signal
import subprocess
import sys

import pytest
import torch
from helpers.engine_agreement import check_agreement, make_moving_hand, make_moving_state
from helpers.engine_cloths import make_opening_motion, make_perturbed_state, make_sheet

import torchcloth as tc
from torchcloth.engine import execution

SCENES, TIMES = 3, [0.0, 0.01, 0.02]


@pytest.fixture
def cloth():
    return tc.Cloth(
        tc.meshes.rectangle(0.2, 0.2, triangles=72),
        tc.materials.AEP(6e4),
        0.15,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(), "bending": tc.effects.Bending(1e-5)},
        contact=tc.Contact(everywhere=True),
    )


@pytest.fixture
def threads():
    """Sets their number; as before in the end."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def all_alike(threads, run):
    """Twice with one thread and twice with two."""
    results = []
    for count in (1, 1, 2, 2):
        threads(count)
        results.append(run())
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_values_and_gradients(cloth, threads):
    noise = torch.randn(SCENES, len(cloth.mesh.vertices), 3, generator=torch.Generator().manual_seed(0))
    parameters = [p for p in cloth.parameters() if p.requires_grad]

    def results():
        x = (cloth.rest_state().x + 1e-3 * noise.to(cloth.rest_state().x)).requires_grad_()
        end = cloth(cloth.state(x), times=TIMES).x[:, -1]
        grads = torch.autograd.grad((end**2).sum(), [x, *parameters], allow_unused=True)
        return [end.detach(), *(g for g in grads if g is not None)]

    all_alike(threads, results)


@pytest.mark.parametrize("count", [12, 16])  # eight at a time, and four for what is left: each thread has some
def test_tangents(cloth, threads, count):
    eye = torch.eye(count, 2, dtype=cloth.rest_state().x.dtype)
    along = tc.Directions({"material.youngs_modulus.raw": eye[:, 0].clone(), "areal_density.raw": eye[:, 1].clone()})

    def results():
        rollout, moved = cloth.sensitivities(cloth.rest_state(), times=TIMES, along=along)
        return [rollout.x, moved.x]

    all_alike(threads, results)


@pytest.mark.usefixtures("team")
def test_a_team_agrees_with_the_reference():
    """With contact: test_contact.py."""
    cloth = make_sheet(n=9)
    check_agreement(cloth, {"left": make_moving_hand(0.01), "right": make_moving_hand(0.01)}, make_moving_state(cloth))


@pytest.mark.usefixtures("team")
@pytest.mark.parametrize("contact", [None, tc.Contact(everywhere=True)])
def test_a_team_repeats_itself_bit_by_bit(contact):
    """Of 300 substeps it does some together and some alone."""
    cloth = make_sheet(n=9, contact=contact)
    state, motion = make_perturbed_state(cloth), make_opening_motion(0.03)
    runs = [_all(cloth, state, motion) for _ in range(3)]
    assert all(torch.equal(a, b) for other in runs[1:] for a, b in zip(runs[0], other, strict=True))


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="needs Linux to count threads")
@pytest.mark.usefixtures("team")
def test_helpers_stay_for_the_next_call_and_a_fork_does_without_them():
    cloth = make_sheet(n=9)
    state, motion = make_perturbed_state(cloth), make_opening_motion(0.03)

    def run() -> torch.Tensor:
        with torch.no_grad():
            return cloth(state, motion, [0.0, 0.03], dt=1e-4).x

    first = run()
    threads = thread_count()
    assert all(torch.equal(run(), first) for _ in range(3))
    assert thread_count() == threads
    child = os.fork()
    if child == 0:
        signal.alarm(30)  # ends what waits for a thread that only the parent has
        os._exit(0 if torch.equal(run(), first) else 1)
    assert os.waitpid(child, 0)[1] == 0


HIRING = """
import os, torch, torchcloth as tc
from torchcloth.engine import execution
torch.set_num_threads(3)
execution.MIN_OPS_PER_THREAD = 1e-9
mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(9, 9))
cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"gravity": tc.effects.Gravity()}, contact=None, engine="fused")
for end, dt in ((2e-5, 1e-5), (0.01, 1e-4)):  # too short for a second thread, and not
    with torch.no_grad():
        cloth(cloth.rest_state(), times=[0.0, end], dt=dt)
    print(len(os.listdir("/proc/self/task")))
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="needs Linux to count threads")
def test_who_is_wanted_is_hired_where_there_are_cores():
    """Without helpers the tests of a team would hold, too."""
    before, after = subprocess.run([sys.executable, "-c", HIRING], capture_output=True, text=True).stdout.split()
    assert int(after) - int(before) == min(2, len(os.sched_getaffinity(0)) - 1)


def thread_count() -> int:
    """Threads of this process, whoever began them."""
    return len(os.listdir("/proc/self/task"))


def _all(cloth, state, motion) -> list[torch.Tensor]:
    x = state.x.clone().requires_grad_()
    end = cloth(state._replace(x=x), motion, [0.0, 0.03], dt=1e-4).x
    parameters = [p for p in cloth.parameters() if p.requires_grad]
    grads = torch.autograd.grad((end**2).sum(), [x, *parameters], allow_unused=True)
    along = tc.Directions({"material.youngs_modulus.raw": torch.ones(1)})
    moved = cloth.sensitivities(state, motion, [0.0, 0.03], along=along, dt=1e-4)[1].x
    return [end.detach(), moved, *(g for g in grads if g is not None)]


@pytest.mark.parametrize("contact", [None, tc.Contact(everywhere=True)])
def test_threads_change_what_a_scene_does_by_rounding_only(contact, monkeypatch):
    cloth = make_sheet(n=9, contact=contact)
    state, motion = make_perturbed_state(cloth), make_opening_motion(0.03)
    results = []
    for threads in (1, 2):
        monkeypatch.setattr(execution, "MIN_OPS_PER_THREAD", 1e-9)
        torch.set_num_threads(threads)
        results.append(_all(cloth, state, motion)[:3])  # positions, their tangents, gradient by positions
    torch.set_num_threads(1)
    assert not all(torch.equal(a, b) for a, b in zip(*results, strict=True))  # sums have another order
    for a, b in zip(*results, strict=True):
        assert float((a - b).norm()) <= 1e-8 * float(a.norm())
