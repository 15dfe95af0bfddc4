"""Check skeletons and joint mappings."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22, OP14, PAIR17, WORKING_SKELETONS, JointMap, Skeleton
from pasdedeux.skeletons.mapping import weighted_points


@pytest.mark.parametrize("skeleton", WORKING_SKELETONS.values(), ids=lambda skeleton: skeleton.name)
def test_order_visits_every_parent_before_its_children(skeleton: Skeleton) -> None:
    seen: set[int] = set()
    for joint in skeleton.order:
        parent = skeleton.parents[joint]
        assert parent == -1 or parent in seen
        seen.add(joint)
    assert seen == set(range(skeleton.num_joints))


@pytest.mark.parametrize("skeleton", WORKING_SKELETONS.values(), ids=lambda skeleton: skeleton.name)
def test_mirroring_twice_is_the_identity_and_keeps_the_tree(skeleton: Skeleton) -> None:
    mirror = np.array(skeleton.mirror)
    assert (mirror[mirror] == np.arange(skeleton.num_joints)).all()
    for parent, child in skeleton.bones:
        assert skeleton.parents[mirror[child]] == mirror[parent]
    assert sum(mirror != np.arange(skeleton.num_joints)) == 2 * sum("left_" in name for name in skeleton.joint_names)


def test_an_unknown_joint_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="joint 'hipp' is not in skeleton 'pair17'; known joints: pelvis, spine"):
        PAIR17.index("hipp")


@pytest.mark.parametrize(
    ("names", "parents", "message"),
    [
        (("a", "a"), (-1, 0), "unique"),
        (("a", "b"), (-1, -1), "exactly one root"),
        (("a", "b"), (-1, 5), "outside"),
        (("a", "b", "c"), (-1, 2, 1), "cycle"),
        (("a",), (-1, 0), "1 joint names but 2 parents"),
    ],
)
def test_a_broken_tree_is_refused(names: tuple[str, ...], parents: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Skeleton(name="broken", joint_names=names, parents=parents)


def _two_joints() -> Skeleton:
    return Skeleton(name="two", joint_names=("low", "high"), parents=(-1, 0))


def test_weighted_points_are_to_the_last_bit_the_product_with_all_weights() -> None:
    generator = np.random.default_rng(0)
    weight = np.where(generator.random((5, 9)) < 0.3, generator.random((5, 9)), 0.0)
    weight[0] = 0.0
    for shape in ((9, 3), (20, 9, 3), (2, 7, 9, 3), (0, 9, 3)):
        points = generator.normal(size=shape)
        np.testing.assert_array_equal(weighted_points(weight, points), np.einsum("ts,...sd->...td", weight, points))


def test_a_mapping_takes_weighted_means_of_source_joints() -> None:
    mapping = JointMap(name="m", target=_two_joints(), table={"low": "a", "high": {"a": 0.25, "b": 0.75}})
    positions = np.array([[[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]])
    derived = mapping.positions(positions, ["a", "b"])
    assert np.allclose(derived, [[[0, 0, 0], [0, 3, 0]]])
    assert mapping.carrier("high") == "b"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"low": "a"}, "no source for high"),
        ({"low": "a", "high": {"a": 0.5}}, "sum to 0.5"),
        ({"low": "a", "high": "a", "top": "a"}, "joint 'top' is not in skeleton 'two'"),
    ],
)
def test_a_mapping_that_does_not_fit_its_target_is_refused(table: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        JointMap(name="m", target=_two_joints(), table=table)


def test_a_mapping_names_the_source_joint_it_misses() -> None:
    mapping = JointMap(name="m", target=_two_joints(), table={"low": "a", "high": "b"})
    with pytest.raises(InputError, match="joint 'b' is not in the source; known joints: a, c"):
        mapping.matrix(["a", "c"])


@pytest.mark.parametrize("skeleton", [PAIR17, OP14, BODY22], ids=lambda skeleton: skeleton.name)
def test_limbs_are_chains_and_left_ones_mirror_right_ones(skeleton: Skeleton) -> None:
    for root, middle, end in skeleton.limbs:
        assert skeleton.parents[end] == middle
        assert skeleton.parents[middle] == root
    for left, right in (skeleton.arms, skeleton.legs):
        assert [skeleton.mirror[joint] for joint in left] == right
        assert all(skeleton.joint_names[joint].startswith("left_") for joint in left)
