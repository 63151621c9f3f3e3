"""A force planted in part of the cloth for part of the time, on another mesh, is located."""

import pytest
import torch
from helpers import sheet_episodes

from torchcloth.diagnosis import build_base_model, estimate_missing_force, fit, measure_lack_of_fit, prepare_data
from torchcloth.diagnosis.unknown import missing_force as missing
from torchcloth.diagnosis.unknown.force_sensitivities import ForcePulses, differentiate_pulses
from torchcloth.effects import BodyForce
from torchcloth.episodes.replay import Frames, frames_from_rollout
from torchcloth.pose.objective import concatenate_windows

BEGIN, END = 6, 9  # frames of 0.05 s
PUSH = torch.tensor([0.0, 2.5, 0.0])  # m/s^2 on the lower left quarter: 0.5 Pa, a quarter of the weight
STRETCH = 0.15  # s


def quarter(uv):
    return (uv < 0.5 * sheet_episodes.SIDE_M).all(1)


def pushed_for_a_while(world, episode):
    """The world, with the force between two frames."""
    uv = torch.as_tensor(world.cloth.mesh.uv)
    force = {"planted": BodyForce(torch.where(quarter(uv)[:, None], PUSH, 0.0))}
    during = world.with_cloth(force).cloth
    state, parts = world.cloth.state(episode.initial), []
    for cloth, first, last in (
        (world.cloth, 0, BEGIN),
        (during, BEGIN, END),
        (world.cloth, END, len(episode.times) - 1),
    ):
        if first == 0:
            state = cloth.settle(state, episode.motion, start=float(episode.times[0]), duration=0.3)
        out = cloth(state, episode.motion, episode.times[first : last + 1])
        state = out.state
        parts.append(frames_from_rollout(out))
    return concatenate_windows(parts)


def fitted(recordings):
    model = build_base_model(recordings[0])
    setting = prepare_data(model, recordings)
    return fit(model, setting), setting


@pytest.fixture(scope="module")
def planted():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    still = lambda world: world  # noqa: E731
    recordings = [
        sheet_episodes.record_changed_world("slow", still, 0, pushed_for_a_while),
        sheet_episodes.record_changed_world("fast", still, 1),
    ]
    yield fitted(recordings)
    torch.set_default_dtype(before)


def test_it_is_found_there_and_then(planted):
    found, setting = planted
    answer = estimate_missing_force(found, setting, window=STRETCH)
    there, elsewhere = answer.motions
    window, vertex = there.strongest
    begin, end = BEGIN / sheet_episodes.FRAME_RATE_HZ, END / sheet_episodes.FRAME_RATE_HZ
    assert float(there.windows[window].mean()) == pytest.approx((begin + end) / 2, abs=STRETCH)
    assert bool(quarter(answer.uv)[vertex])
    force = there.force[window, vertex]
    assert float(force[1] / force.norm()) > 0.9
    assert float(there.certainty[window, vertex]) > 4
    total = answer.total(there)[window]
    assert float(total[1]) == pytest.approx(0.2 * float(PUSH[1]) * sheet_episodes.SIDE_M**2 / 4, rel=0.25)
    assert float(elsewhere.certainty.max()) < 0.5 * float(there.certainty.max())
    told = answer.as_dict()["motions"]
    assert [t["is_significant"] for t in told] == [True, False]
    assert max(told[0]["at"]) < 0.5 * sheet_episodes.SIDE_M


def test_the_fit_lacks_there_and_not_in_the_other_motion(planted):
    found, setting = planted
    lacking = {(row.motion, row.kind): row.is_significant for row in measure_lack_of_fit(found, setting.motions)}
    assert lacking["slow", "points"]
    assert not lacking["fast", "points"]


def test_pushes_are_those_of_a_body_force(planted):
    """A constant push from the first frame on, against finite differences of a simulation with that force."""
    found, setting = planted
    world, episode = found.model.build_world(), setting.episodes[0]
    last, count = len(episode.times) - 1, len(setting.rest_positions)
    push = torch.zeros(2, 1, count, 3)
    push[:, 0, :, 1] = 1.0
    frames, moved = differentiate_pulses(world, episode, ForcePulses([(0, 5), (5, last)], push))
    step = 1e-3
    beside = world.with_cloth({"more": BodyForce(step * push[0, 0])}).simulate_observed(episode)
    difference = (beside.x - frames.x) / step
    assert torch.allclose(moved.x[0], difference, atol=1e-2 * float(difference.abs().max()))


@pytest.mark.parametrize("at_once", [1, 10**6])
def test_memory_does_not_change_what_is_asked(planted, monkeypatch, at_once):
    """One direction at a time, and some."""
    found, setting = planted
    e = setting.episodes[0]
    x = e.initial.expand(len(e.times), -1, -1).clone()
    moved = Frames(torch.randn(7, *x.shape), torch.randn(7, *x.shape), {}, torch.zeros(7, len(x)))
    frames = Frames(x, torch.zeros_like(x), {}, x.new_zeros(len(x)))
    plain = missing.whiten_with_force(found, setting, 0, frames, moved, 100)
    monkeypatch.setattr(missing, "MAX_SLOPES_AT_ONCE", at_once)
    assert all(map(torch.equal, missing.whiten_with_force(found, setting, 0, frames, moved, 100), plain))


@pytest.mark.parametrize("size", [1e30, torch.nan])
def test_where_pushes_grow_without_end_nothing_is_asked(planted, monkeypatch, size):
    """Of one motion that is unstable from half a second on; what the other says is as it was."""
    found, setting = planted
    usual, unstable = missing.differentiate_pulses, setting.episodes[1]

    def growing(world, episode, *rest):
        frames, moved = usual(world, episode, *rest)
        late = (episode.times - episode.times[0] > 0.5)[:, None, None]
        return frames, moved if episode is not unstable else moved._replace(x=torch.where(late, size, moved.x))

    plain = estimate_missing_force(found, setting, window=STRETCH)
    monkeypatch.setattr(missing, "differentiate_pulses", growing)
    answer = estimate_missing_force(found, setting, window=STRETCH)
    assert [part.unstable_from for part in answer.motions] == [None, pytest.approx(0.4)]
    assert answer.motions[0].force == pytest.approx(plain.motions[0].force, rel=0.05, abs=0.02 * answer.weight)
    assert bool(answer.motions[1].force.isfinite().all())
    late = answer.motions[1].windows[:, 0] > 0.5
    assert float(answer.motions[1].certainty[late].max()) < 1e-6
    assert [m["unstable_from"] for m in answer.as_dict()["motions"]] == [None, pytest.approx(0.4)]


def test_slopes_of_any_size_have_a_posterior():
    """Information over more orders than numbers have digits; where it is tame, the textbook's formula."""
    rng = torch.Generator().manual_seed(0)
    slopes = torch.randn(40, 12, generator=rng, dtype=torch.float64)
    value = torch.randn(40, generator=rng, dtype=torch.float64)
    known, sizes = torch.full((3,), 4.0, dtype=torch.float64), torch.full((9,), 0.7, dtype=torch.float64)
    information, asked = slopes.mT @ slopes, slopes.mT @ value
    found = missing._solve_posterior(information, asked, known, sizes)
    precision = information + torch.diag(torch.cat([known, sizes**-2]))
    assert found.covariance == pytest.approx(torch.linalg.inv(precision).numpy(), rel=1e-9, abs=1e-12)
    assert found.mean == pytest.approx((-torch.linalg.solve(precision, asked)).numpy(), rel=1e-9)
    fewer = torch.cat([1e9 * slopes[:, :1], 1e9 * slopes[:, :1] + 1e-9 * slopes[:, 1:2], slopes[:, 2:]], 1)
    wild = missing._solve_posterior(fewer.mT @ fewer, fewer.mT @ value, known, 1e3 * sizes)
    assert bool(wild.mean.isfinite().all() and wild.log_likelihood.isfinite())
    assert bool((wild.covariance.diagonal() > 0).all())
    with pytest.raises(torch.linalg.LinAlgError):
        torch.linalg.cholesky(fewer.mT @ fewer + torch.diag(torch.cat([known, (1e3 * sizes) ** -2])))


@pytest.mark.parametrize(("other", "pressure"), [(-4.0, 5.0), (4.0, (5.0**3 + 4.0**3) / (5.0**2 + 4.0**2))])
def test_two_forces_are_told_at_one_of_them(other, pressure):
    """Half way between them there is none; what pushes the other way is no part of it."""
    u = torch.linspace(0.0, 0.2, 20).double()
    uv = torch.cartesian_prod(u, u)
    force = torch.zeros(1, len(uv), 3).double()
    force[0, :, 1] = torch.where(uv[:, 0] < 0.05, 5.0, torch.where(uv[:, 0] > 0.15, other, 0.0))
    part = missing.MotionForce(
        "swing", torch.tensor([[0.0, 0.2]]), force, torch.full_like(force, 0.2), torch.zeros_like(force), None
    )
    area = torch.full((len(uv),), 1e-4).double()
    (told,) = missing.MissingForce([part], 1.0, 2.0, uv, torch.zeros(0, 3), area).as_dict()["motions"]
    assert told["pressure"] == pytest.approx([0.0, pressure, 0.0])
    assert told["at"][0] < 0.05
