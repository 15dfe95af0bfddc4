"""Read parameters of SMPL, SMPL-H and SMPL-X, and fit betas to lengths of bones."""

import io
import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.registry import MOTION_FORMATS, recognise_format
from pasdedeux.formats.rigs.guess import guess_up_axis
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.formats.smpl import JOINTS, read_body_model, read_smpl
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import find_layout
from tests.builders.body_models import NUM_BETAS, amass, body_model, npz, parents_of


def posed_plainly(kind: str, data: bytes, model: bytes) -> np.ndarray:
    """Return joints (frame, J, 3) by the equations: vertices, regressor, chain of transforms, translation."""
    given, body = np.load(io.BytesIO(data)), np.load(io.BytesIO(model), allow_pickle=False)
    vertices = body["v_template"] + body["shapedirs"] @ given["betas"]
    rest, parents = body["J_regressor"] @ vertices, parents_of(kind)
    found = []
    for pose, trans in zip(given["poses"].reshape(-1, len(parents), 3), given["trans"], strict=True):
        chain: list[np.ndarray] = []
        for joint, parent in enumerate(parents):
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_rotvec(pose[joint]).as_matrix()
            matrix[:3, 3] = rest[joint] - rest[parent] if parent >= 0 else rest[joint]
            chain.append(chain[parent] @ matrix if parent >= 0 else matrix)
        found.append([matrix[:3, 3] + trans for matrix in chain])
    return np.array(found)


@pytest.mark.parametrize("kind", JOINTS)
@pytest.mark.parametrize("is_z_up", [True, False])
def test_joints_are_those_of_the_equations_upright_and_known_as_body22(kind: str, is_z_up: bool) -> None:
    data, model = amass(kind, is_z_up=is_z_up), body_model(kind)
    source = read_smpl(data, model)
    axis = guess_up_axis(source).axis
    assert axis == ("z" if is_z_up else "y")
    motion = source.to_motion(metres_per_unit=1.0, rate_hz=30.0, up_axis=axis)
    wanted = posed_plainly(kind, data, model)
    upright = wanted[..., [0, 2, 1]] * [1.0, 1.0, -1.0] if is_z_up else wanted
    np.testing.assert_allclose(motion.world()[0], upright, atol=1e-9)
    layout = find_layout(motion.skeleton, motion.rest_offsets_m)
    poses = derive_working_poses(motion, layout)
    places = [motion.skeleton.index(name) for name in BODY22.joint_names]
    np.testing.assert_allclose(poses.body22_m, upright[:, places], atol=1e-9)
    # At rest everybody stands along Y and faces +Z, whichever axis points up in the file.
    rest = dict(zip(BODY22.joint_names, poses.body22_rest_m, strict=True))
    assert rest["head"][1] > 0.5
    assert rest["left_toe"][2] - rest["left_ankle"][2] > 0.05
    assert rest["left_wrist"][0] > 0.5


def test_parameters_of_two_and_in_parts_are_the_same_people() -> None:
    model, both, wholes = body_model("SMPL-X"), {}, []
    for person, seed in ((1, 0), (2, 1)):
        alone = np.load(io.BytesIO(amass("SMPL-X", seed=seed)))
        poses = alone["poses"].copy()
        poses[:, 66:75] = 0.0
        both |= {
            f"person{person}_root_orient": poses[:, :3].astype(np.float32),
            f"person{person}_pose_body": poses[:, 3:66].reshape(12, 21, 3),
            f"person{person}_pose_lhand": poses[:, 75:120].reshape(12, 15, 3),
            f"person{person}_pose_rhand": poses[:, 120:].reshape(12, 15, 3),
            f"person{person}_trans": alone["trans"],
            f"person{person}_betas": np.tile(alone["betas"], (12, 1)),
        }
        wholes.append(read_smpl(amass("SMPL-X", seed=seed, poses=poses), model))
    data = npz(**both, mocap_framerate=30)
    assert recognise_format(data).name == "smpl"
    for part, whole in zip(MOTION_FORMATS["smpl"].read_people(data, model), wholes, strict=True):
        np.testing.assert_allclose(part.local_unitquat, whole.local_unitquat, atol=1e-6)
        np.testing.assert_allclose(part.root_translation, whole.root_translation, atol=1e-9)
        np.testing.assert_allclose(part.rest_offsets, whole.rest_offsets, atol=1e-9)
        assert part.rate_hz == 30.0


def test_betas_are_found_again_from_the_lengths_of_bones() -> None:
    model = read_body_model(body_model())
    betas = np.array([0.8, -1.2, 0.5, 1.5])
    lengths = bone_lengths(model.skeleton, model.rest_m(betas))
    wanted = {name: lengths[model.skeleton.index(name)] for name in BODY22.joint_names[1:]}
    found, misfit = model.fit_betas(wanted)
    np.testing.assert_allclose(found, betas, atol=1e-3)
    assert max(map(abs, misfit.values())) < 1e-5
    # No betas give one arm half its length: the misfit says so.
    _, misfit = model.fit_betas(wanted | {"left_elbow": 0.5 * wanted["left_elbow"]})
    assert misfit["left_elbow"] > 0.05


BAD: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "another kind": ({"kind": "SMPL-X"}, {"kind": "SMPL-H"}, "parameters of SMPL-X; the body model is SMPL-H"),
    "no kind": ({"poses": np.zeros((12, 10))}, {}, "parameters of no known kind"),
    "no betas": ({"betas": None}, {}, "array 'betas' of floats"),
    "more betas": ({"betas": np.ones(NUM_BETAS + 2)}, {}, "have 6 betas, the body model has 4"),
    "no translation": ({"trans": np.zeros((3, 3))}, {}, "array 'trans' of floats, shape (12, 3)"),
    "a model of dogs": ({}, {"J_regressor": np.zeros((35, 156))}, "has 35 joints; allowed: SMPL 24"),
    "no shapes": ({}, {"shapedirs": np.zeros((3, 3))}, "array 'shapedirs'"),
    "not finite": ({"trans": np.full((12, 3), np.nan)}, {}, "frame 0: a parameter is not finite"),
}


@pytest.mark.parametrize("how", BAD)
def test_what_does_not_fit_is_refused_in_a_sentence(how: str) -> None:
    parameters, model, sentence = BAD[how]
    with pytest.raises(InputError, match=re.escape(sentence)):
        read_smpl(amass(**parameters), body_model(**model))


def test_a_body_model_is_no_motion_and_a_pickle_is_never_opened() -> None:
    with pytest.raises(FormatError, match="the body model of files of the format 'smpl', not a motion itself"):
        recognise_format(body_model())
    with pytest.raises(FormatError, match="this is a pickle"):
        read_body_model(b"\x80\x04\x95")
