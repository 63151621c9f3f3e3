"""MuJoCo's two-dimensional flex as it is: explicit, Saint Venant-Kirchhoff triangles, no contact, no gradients."""

import mujoco
import numpy as np

from ..cases import AREAL_DENSITY_KG_PER_M2, MATERIAL, SUBSTEP_S
from ..contestant import Contestant, Outcome, Task, Unsupported
from .arrays import GRAVITY_Z_M_PER_S2, THICKNESS_M

XML = """<mujoco>
  <option timestep="{dt}" integrator="Euler" gravity="0 0 {gravity}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <size memory="64M"/>
  <worldbody>
    <flexcomp name="cloth" type="direct" dim="2" dof="full" mass="1" radius="0.001" point="{points}" element="{faces}">
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <elasticity young="{youngs}" poisson="{poisson}" thickness="{thickness}" damping="0" elastic2d="stretch"/>
    </flexcomp>
  </worldbody>
</mujoco>"""


class MuJoCo(Contestant):
    """Forward only, in float64."""

    def __init__(self, threads: int) -> None:
        pass

    def prepare(self, task: Task):
        """Build a model of the scene."""
        if task.quantity != "forward" or task.batch:
            raise Unsupported("MuJoCo has no derivatives through a flex but finite differences, and no batches of it")
        case = task.build_case()
        mesh, shift = case.mesh, case.displacements(task.substeps)
        xml = XML.format(
            dt=SUBSTEP_S,
            gravity=GRAVITY_Z_M_PER_S2,
            points=" ".join(f"{value:.9g}" for value in mesh.vertices.ravel()),
            faces=" ".join(map(str, mesh.faces.ravel())),
            youngs=MATERIAL["youngs_modulus"],
            poisson=MATERIAL["poisson_ratio"],
            thickness=THICKNESS_M,
        )
        model = mujoco.MjModel.from_xml_string(xml)
        model.body_mass[1:] = AREAL_DENSITY_KG_PER_M2 * mesh.vertex_area  # flexcomp gives all points the same mass
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        # views of MuJoCo's memory: slide joints, so that qpos is each vertex's displacement
        q, v = data.qpos.reshape(-1, 3), data.qvel.reshape(-1, 3)
        gripped, places = case.gripped_vertices, np.cumsum(shift, axis=0)

        def run() -> Outcome:
            mujoco.mj_resetData(model, data)
            for k in range(task.substeps):
                mujoco.mj_step(model, data)
                q[gripped], v[gripped] = places[k], shift[k] / SUBSTEP_S
            return Outcome(mesh.vertices + q)

        return run
