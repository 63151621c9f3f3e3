"""An episode that says how far apart layers rest: contact in the cloth that every command builds of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.diagnosis import build_base_model, read_model, save_model
from torchcloth.diagnosis.causes.fabric import change_moduli
from torchcloth.episodes.recorded_cloth import build_cloth
from torchcloth.episodes.world import World
from torchcloth.errors import RecordingError
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

GAP_M = 0.012
PLAIN = sheet_episodes.make_episode(resolution=(13, 13))


def with_layers(**nominal):
    """Return the episode with layers that touch, and with further values of its data sheet."""
    cloth = replace(PLAIN.cloth, layer_gap=GAP_M, nominal={**PLAIN.cloth.nominal, **nominal})
    return replace(PLAIN, cloth=cloth)


def test_layers_touch_only_where_the_episode_says_so():
    assert build_cloth(PLAIN).contact is None
    cloth = build_cloth(with_layers())
    assert cloth.contact == tc.Contact.with_gap(GAP_M)
    stiffness = float(cloth.material.contact_stiffness.value) * cloth.material.thickness
    assert stiffness == pytest.approx(100.0)  # N/m
    assert float(cloth.material.shear_stiffness.value) * cloth.material.thickness == pytest.approx(stiffness / 4)


def test_the_data_sheet_may_know_contact_and_friction_of_layers():
    material = build_cloth(with_layers(contact_stiffness=4e4, shear_stiffness=5e3, cone=0.5)).material
    names = ("contact_stiffness", "shear_stiffness", "cone")
    assert [float(getattr(material, name).value) for name in names] == pytest.approx([4e4, 5e3, 0.5])


def test_a_gap_at_which_layers_cannot_meet_is_refused():
    """Reported by a reader: on a small sheet the gap did nothing, and nothing said so."""
    with pytest.raises(RecordingError, match=r"layer_gap; got 60 mm, at which layers of this cloth cannot meet"):
        build_cloth(replace(PLAIN, cloth=replace(PLAIN.cloth, layer_gap=0.06)))


@pytest.mark.parametrize("changes", [{"weft": 0.2}, {"stiffening": 5.0}])
def test_a_cause_in_the_fabric_leaves_the_contact_of_layers_alone(changes):
    cloth = build_cloth(with_layers(contact_stiffness=4e4, cone=0.5))
    other = change_moduli(World(cloth), **changes).cloth
    assert other.contact == cloth.contact
    for name in cloth.material.contact_parameters:
        assert float(getattr(other.material, name).value) == float(getattr(cloth.material, name).value)


def test_a_model_file_keeps_the_contact_of_layers(tmp_path):
    recording = with_layers(cone=0.5)
    path = save_model(tmp_path / "layers.tcm", build_base_model(recording), recording)
    for scene in (None, PLAIN):  # the file's own scene, and that of an episode which says nothing of layers
        cloth = read_model(path, scene).model.build_world().cloth
        assert cloth.contact == tc.Contact.with_gap(GAP_M)
        assert float(cloth.material.cone.value) == pytest.approx(0.5)


def test_a_fold_lies_on_the_layer_below():
    """An edge is carried over and laid down. Without a gap the upper layer falls through to the table."""
    size, gap = 0.3, 0.014
    mesh = tc.meshes.rectangle(size, size, resolution=(15, 15))
    held, above = (np.nonzero(mesh.vertices[:, 0] < limit)[0] for limit in (1e-9, 0.3 * size))
    t = np.linspace(0, 1.4, 57)
    turned = np.pi * np.clip(t / 1.0, 0, 1)
    path = np.column_stack([0.135 * (1 - np.cos(turned)), 0 * t, 0.14 * np.sin(turned) + gap * np.clip(t, 0, 1)])
    hand = rec.GripperMotion(t, path, np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool))
    fold = rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=0.15,
            layer_gap=gap,
            vertices=mesh.vertices,
            faces=mesh.faces,
            uv=mesh.uv,
            nominal={"bending_stiffness": 1e-5, "bending_damping_time": 5e-3},
        ),
        provenance="synthetic: torchcloth",
        grippers={"hand": hand},
        grasps={"hand": rec.GraspInfo(vertices=held)},
        colliders={"table": rec.Collider(np.zeros(3), np.array([0.0, 0, 1]), 0.4)},
        air_density=1.2,
    )
    heights = []
    for recording in (fold, replace(fold, cloth=replace(fold.cloth, layer_gap=None))):
        cloth = build_cloth(recording)
        with torch.no_grad():
            out = cloth(cloth.state(cloth.rest_state().x + 1e-4), replay(recording), times=[0.0, 1.4])
        heights.append(out.x[-1, above, 2])
    assert float(heights[0].min()) > 0.6 * gap
    assert float(heights[1].min()) < 0.2 * gap
