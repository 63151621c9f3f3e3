"""Whether layers of cloth are near each other, on a device: what ``self_contact.near_layers`` finds, in a kernel."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from ...model import Model
from ...transfer import Grid
from .runs import kernels
from .source import prelude

TEXT = """
// Centres of triangles that are far from each other along the cloth, and near in space.
KERNEL near(const R* x, const int* corners, const unsigned char* apart, R* centres, int* found, int vertices,
            int triangles, double reach) {
    const R* own = x + Count(SCENE) * vertices * 3;
    R* centre = centres + Count(SCENE) * triangles * 3;
    for (int t = T; t < triangles; t += THREADS)
        for (int k = 0; k < 3; k++)
            centre[3 * t + k] = (own[3 * corners[t] + k] + own[3 * corners[t + triangles] + k] +
                                 own[3 * corners[t + 2 * triangles] + k]) / R(3);
    SYNC();
    const R least = R(reach) * R(reach);
    for (int t = T; t < triangles; t += THREADS) {
        const R a = centre[3 * t], b = centre[3 * t + 1], c = centre[3 * t + 2];
        for (int u = 0; u < t; u++) {
            const R d = centre[3 * u] - a, e = centre[3 * u + 1] - b, f = centre[3 * u + 2] - c;
            if (d * d + e * e + f * f < least && apart[Count(t) * triangles + u]) found[SCENE] = 1;
        }
    }
}
"""


class LayerSearch:
    """Of a cloth.

    Raises:
        Unbuilt: no compiler for the device.
    """

    def __init__(self, model: Model, grid: Grid) -> None:
        self._apart, self._reach = grid.apart, grid.reach
        self._corners = model.geometry.corners.view(3, -1).int().contiguous()
        text = prelude(model.mass.dtype) + TEXT
        self._kernels = None if grid.apart is None else kernels(text, model.mass.device)

    def any_near(self, x: Tensor) -> bool:
        """Whether any are, in any scene, at positions [..., V, 3]."""
        if self._kernels is None or self._apart is None:  # which triangles are apart is not known
            return True
        x = x.detach().contiguous()
        triangles, scenes = self._corners.shape[1], x.shape[:-2].numel()
        centres, found = x.new_empty(scenes, triangles, 3), x.new_zeros(scenes, dtype=torch.int32)
        pointers = (ctypes.c_void_p(t.data_ptr()) for t in (x, self._corners, self._apart, centres, found))
        counts = ctypes.c_int(x.shape[-2]), ctypes.c_int(triangles), ctypes.c_double(self._reach)
        self._kernels.launch("near", scenes, 0, [*pointers, *counts])
        return bool(found.any())
