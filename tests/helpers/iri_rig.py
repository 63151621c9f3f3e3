"""A small synthetic copy of the layout of the IRI swings and carries, with known times of frames."""

import numpy as np

from torchcloth.training.validation.realdata.swings import SHEET_SIDE_M

TRUE_LAG_S, TRUE_JITTER_STD_S = 0.21, 0.03
EDGE_OFFSET_M = np.array([-0.005, -0.03, 0.09])  # in the tool's axes
TOOL_QUAT_XYZW = np.array([0.5, 0.5, 0.0, 0.0]) * 2**0.5  # points down, as the WAM's


def make_run(seed=0, size=8, duration=9.0, noise_m=1e-3):
    """Return a run whose cloth hangs straight below its edge, and the true times of its frames; the first has none.

    The tool stands for a second, moves at up to 0.8 m/s until two seconds before the end, and stands again.
    """
    draw = np.random.default_rng(seed)
    t_tool = np.arange(0, duration, 0.05)

    moving = duration - 3
    cycles = moving / 3

    def tool(t):
        s = np.clip((t - 1) / moving, 0, 1)
        blend = s**2 * (3 - 2 * s)
        return np.stack(
            [0.02 * blend, -0.4 + 0.2 * np.sin(2 * np.pi * cycles * blend), 0.35 + 0.05 * np.sin(2 * np.pi * blend)],
            axis=-1,
        )

    stamps = np.cumsum(np.clip(0.1 + 0.03 * draw.normal(size=int((duration - 0.3) / 0.1)), 0.05, None))
    before = np.concatenate([[np.nan], stamps[:-1]])
    taken = before - TRUE_LAG_S + TRUE_JITTER_STD_S * draw.normal(size=len(stamps))
    taken[0] = stamps[0] - 0.3
    edge = tool(taken) + np.array([EDGE_OFFSET_M[1], EDGE_OFFSET_M[0], -EDGE_OFFSET_M[2]])  # x and y exchanged, z down
    along, down = np.linspace(-0.5, 0.5, size) * SHEET_SIDE_M, np.linspace(-1, 0, size) * SHEET_SIDE_M
    grid = np.stack(np.broadcast_arrays(along[:, None], 0.0, down[None]), axis=-1)
    mesh = edge[:, None, None] + grid + noise_m * draw.normal(size=(len(edge), size, size, 3))
    run = {
        "t_mesh_s": stamps,
        "mesh_base_m": mesh,
        "t_tcp_s": t_tool,
        "tcp_pos_m": tool(t_tool),
        "tcp_quat_xyzw": np.tile(TOOL_QUAT_XYZW, (len(t_tool), 1)),
    }
    return run, taken
