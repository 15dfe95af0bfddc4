"""Read BVH as programs write it: any spelling, nodes above the hips, bones that stretch, several people in a file."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pasdedeux.errors import FormatError
from pasdedeux.formats.bvh import BVH, read_bvh, read_bvh_head
from pasdedeux.formats.registry import recognise_format
from tests.builders.bvh_rigs import Node, body_nodes, bvh_of, bvh_of_several, world_of_file
from tests.builders.rigs import SMALL_BVH
from tests.builders.source_samples import bvh_text

ABOVE = ["reference", "Armature", "joint_Root", "Bip01", "Solving:Hips_root"]


def below_root(text: str, person: int = 0) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the places (frame, 3) of the joints that are read, and those of a plain reading of the file."""
    source = read_bvh(text, person)
    positions, _ = source.to_motion(metres_per_unit=1.0, rate_hz=30.0).world()
    return {name: positions[:, at] for at, name in enumerate(source.skeleton.joint_names)}, world_of_file(text)


def moving(rng: np.random.Generator, nodes: list[Node], *, chain: int) -> np.ndarray:
    """Return rows (12, columns) in which every angle turns, and positions move of the first nodes alone."""
    rows = []
    for at, node in enumerate(nodes):
        for channel in node.channels:
            if channel.endswith("rotation"):
                rows.append(rng.normal(0.0, 25.0, 12))
            else:
                rest = node.offset["XYZ".index(channel[0])]
                rows.append(rest + rng.normal(0.0, 20.0, 12) if at <= chain else np.full(12, rest))
    return np.array(rows).T


@pytest.mark.parametrize("above", [0, 1, 2, 3])
@pytest.mark.parametrize("kinds", [(0,), (3,), (6,), (6, 0, 3), (3, 6, 6)])
def test_what_nodes_above_the_hips_do_is_composed_exactly(above: int, kinds: tuple[int, ...]) -> None:
    rng = np.random.default_rng(above)
    nodes = body_nodes(above=ABOVE[:above], kinds=kinds, rng=rng)
    text = bvh_of(nodes, moving(rng, nodes, chain=above))
    found, wanted = below_root(text)
    assert next(iter(found)) == "Hips"
    assert set(found) == set(wanted) - set(ABOVE)
    for name, places in found.items():
        np.testing.assert_allclose(places / 100, wanted[name] / 100, atol=1e-6)
    head = read_bvh_head(text).rest
    np.testing.assert_allclose(head.rest_offsets, read_bvh(text).rest_offsets, atol=1e-9)
    assert head.skeleton == read_bvh(text).skeleton


def test_a_node_turned_for_good_turns_the_rest_pose_too() -> None:
    text = SMALL_BVH.replace("ROOT Hips", "ROOT Armature { OFFSET 0 0 0 CHANNELS 1 Xrotation JOINT Hips", 1)
    text = re.sub(r"(?m)^(0 9\d .*)$", r"-90 \1", text.replace("}\nMOTION", "} }\nMOTION"))
    source = read_bvh(text)
    np.testing.assert_allclose(source.rest_offsets[source.skeleton.index("Spine")], (0, 0, -10), atol=1e-9)
    np.testing.assert_allclose(source.local_unitquat[0, 1:], [[0, 0, 0, 1]] * (source.skeleton.num_joints - 1))
    found, wanted = below_root(text)
    for name, places in found.items():
        np.testing.assert_allclose(places, wanted[name], atol=1e-9)


@pytest.mark.parametrize("beside", ["ik_foot_root", "camera", "prop"])
def test_what_hangs_beside_the_hips_is_left_out_and_said(beside: str) -> None:
    text = SMALL_BVH.replace(
        "ROOT Hips",
        f"ROOT root {{ OFFSET 0 0 0 CHANNELS 0 JOINT {beside} {{ OFFSET 1 0 0 CHANNELS 0 JOINT {beside}_l "
        "{ OFFSET 1 0 0 CHANNELS 0 } } JOINT Hips",
    ).replace("}\nMOTION", "} }\nMOTION")
    source = read_bvh(text)
    assert source.skeleton.joint_names[0] == "Hips"
    assert source.notes == (f"joint '{beside}' and 1 more beside 'Hips' left out",)


STRETCHED = SMALL_BVH.replace(
    "JOINT Spine1 { OFFSET 0 11 0 CHANNELS 0", "JOINT Spine1 { OFFSET 0 11 0 CHANNELS 1 Yposition"
)


def stretched(*lengths: float) -> str:
    head, _, rows = STRETCHED.partition("Frame Time: 0.0333333\n")
    rows = "\n".join(f"{row} {length}" for row, length in zip(rows.strip().split("\n"), lengths, strict=True))
    return f"{head}Frame Time: 0.0333333\n{rows}\n"


def test_a_bone_that_changes_by_millimetres_is_fixed_at_its_median_and_said() -> None:
    for source in (read_bvh(stretched(11.2, 11.3, 11.2, 11.2)), read_bvh_head(stretched(11.2, 11.3, 11.2, 11.2)).rest):
        assert source.rest_offsets[source.skeleton.index("Spine1"), 1] == 11.2
        (note,) = source.notes
        assert re.search(r"joint 'Spine1' moves by 0\.1 cm against its parent: fixed at the median", note)


@pytest.mark.parametrize("reader", [read_bvh, read_bvh_head])
def test_a_bone_that_stretches_is_refused_with_joint_frame_and_amount(reader: Callable[[str], object]) -> None:
    with pytest.raises(FormatError, match=r"frame 2: joint 'Spine1' moves by (5|4\.9)\S* cm against its parent"):
        reader(stretched(11, 11, 16, 11))


def test_position_channels_of_zeros_keep_the_offset() -> None:
    source = read_bvh(stretched(0, 0, 0, 0))
    assert source.rest_offsets[source.skeleton.index("Spine1"), 1] == 11
    assert source.notes == ()


@pytest.mark.parametrize("form", ["one root", "two roots", "two roots of the same names"])
def test_two_people_in_one_file_are_each_themselves(form: str) -> None:
    rng = np.random.default_rng(3)
    people = [body_nodes(above=[], kinds=(6,), rng=rng, prefix=prefix) for prefix in ("A:", "B:")]
    if form == "two roots of the same names":
        people = [body_nodes(above=[], kinds=(6,), rng=rng) for _ in range(2)]
    rows = [moving(rng, nodes, chain=0) for nodes in people]
    alone = [bvh_of(nodes, values) for nodes, values in zip(people, rows, strict=True)]
    text = bvh_of_several(alone, has_common_root=form == "one root")
    assert BVH.count_people(text.encode()) == 2
    for person in (0, 1):
        source = BVH.read_person(person, text.encode())
        assert "holds 2 people" in source.notes[0]
        wanted = list(world_of_file(alone[person]).values())
        found, _ = source.to_motion(metres_per_unit=1.0, rate_hz=1.0).world()
        np.testing.assert_allclose(found, np.stack(wanted, axis=1), atol=1e-6)
        assert BVH.read_head(text.encode(), number=person).rest.skeleton == source.skeleton


def on_a_line(text: str) -> str:
    tree, _, rows = text.partition("MOTION\n")
    return " ".join(tree.split()) + " MOTION " + rows.replace("\n", " ", 2)


SPELLINGS: dict[str, Callable[[str], str]] = {
    "as it is": lambda text: text,
    "lower case": lambda text: re.sub(
        r"\b(HIERARCHY|ROOT|JOINT|OFFSET|CHANNELS|MOTION|End Site|Frames|Frame Time|[XYZ](position|rotation))\b",
        lambda word: word[0].lower(),
        text,
    ),
    "tabs": lambda text: text.replace(" ", "\t").replace("End\tSite", "End Site").replace("Frame\tTime", "Frame Time"),
    "Windows, braces behind names": lambda text: re.sub(r"\n\s*\{", " {", text).replace("\n", "\r\n"),
    "old Mac": lambda text: text.replace("\n", "\r"),
    "hierarchy and MOTION on a line": on_a_line,
    "a comment before": lambda text: f"# written by hand\n// in a hurry\nExported 2024\n\n{text}",
    "comments inside": lambda text: re.sub("(OFFSET|Frames|Frame Time)", r"# a comment\n\1", text),
    "comments behind": lambda text: text.replace("{\n", "{ // a block\n").replace("\n", " # what it is\n", 1),
    "comments behind rows": lambda text: re.sub(r"(?m)^(-?\d.*)$", r"\1 # a frame", text),
    "a token a line": lambda text: re.sub(r"[ \t]+", "\n", text.replace("joint ", "joint_")),
    "the end of DOS": lambda text: text + "\x1a\0\0",
    "scientific": lambda text: re.sub(r"-?\d+\.\d+", lambda number: f"{float(number[0]):.12E}", text),
    "wrapped rows": lambda text: wrapped(text),
    "blank lines": lambda text: text.replace("\n", "\n \n"),
}


def wrapped(text: str) -> str:
    head, mark, rows = text.partition("Frame Time: ")
    first, *lines = rows.strip().split("\n")
    halves = [line.split() for line in lines]
    return head + mark + first + "\n" + "\n".join("\n".join((" ".join(row[:2]), " ".join(row[2:]))) for row in halves)


@st.composite
def hierarchies(draw: st.DrawFn) -> list[Node]:
    """Draw joints with 0, 1, 3 or 6 channels in any order; positions below the root are the joint's offset."""
    nodes = []
    for at in range(draw(st.integers(1, 7))):
        names = draw(st.permutations([f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ"]))
        kind = draw(st.sampled_from(["none", "one", "rotations", "all"])) if at else "all"
        turns = [name for name in names if name.endswith("rotation")]
        channels = {"none": [], "one": turns[:1], "rotations": turns, "all": names}[kind]
        offset = tuple(draw(st.floats(1, 9).map(lambda value: round(value, 3))) for _ in range(3))
        name = f"joint{draw(st.sampled_from([' ', '_']))}{at}"
        nodes.append(Node(name, draw(st.integers(0, at - 1)) if at else -1, offset, tuple(channels)))
    return nodes


@pytest.mark.parametrize("spelling", SPELLINGS)
@settings(max_examples=8)
@given(nodes=hierarchies(), seed=st.integers(0, 99))
def test_a_hierarchy_is_the_same_motion_in_every_spelling(nodes: list[Node], spelling: str, seed: int) -> None:
    text = bvh_of(nodes, moving(np.random.default_rng(seed), nodes, chain=0))
    spelled = SPELLINGS[spelling](text)
    assert recognise_format(spelled.encode()) is BVH
    source = read_bvh(spelled.encode())
    assert (source.rate_hz, source.notes) == (120.0, ())
    positions, _ = source.to_motion(metres_per_unit=1.0, rate_hz=120.0).world()
    wanted = {name.replace("joint ", "joint_"): places for name, places in world_of_file(text).items()}
    names = [name.replace("joint ", "joint_") for name in source.skeleton.joint_names]
    assert set(names) == set(wanted)
    np.testing.assert_allclose(positions, np.stack([wanted[name] for name in names], axis=1), atol=1e-6)


def test_the_plain_reading_agrees_with_a_hand_made_case() -> None:
    nodes = [Node("a", -1, (0, 0, 0), ("Xposition", "Zrotation")), Node("b", 0, (0, 2, 0), ())]
    places = world_of_file(bvh_of(nodes, np.array([[5.0, 90.0]])))
    np.testing.assert_allclose(places["b"], [[3.0, 0.0, 0.0]], atol=1e-12)
    assert Rotation.from_euler("Z", 90, degrees=True).apply([0, 2, 0])[0] == pytest.approx(-2)


@pytest.mark.parametrize("channels", ["Xscale Yscale Zscale", "Zscale"])
def test_scales_of_joints_are_read_where_they_are_1_and_refused_elsewhere(channels: str) -> None:
    scales = channels.split()
    text = SMALL_BVH.replace("CHANNELS 6 ", f"CHANNELS {6 + len(scales)} ").replace(
        "Yrotation", f"Yrotation {channels}"
    )
    head, _, rows = text.rpartition("Frame Time: 0.0333333\n")
    ones = [f"{row} {' '.join('1' for _ in scales)}" for row in rows.split("\n") if row]
    same, plain = read_bvh("\n".join([head + "Frame Time: 0.0333333", *ones])), read_bvh(SMALL_BVH)
    np.testing.assert_array_equal(same.root_translation, plain.root_translation)
    np.testing.assert_array_equal(same.local_unitquat, plain.local_unitquat)
    assert same.skeleton == plain.skeleton
    ones[2] = f"{ones[2].rpartition(' ')[0]} 1.2"
    with pytest.raises(FormatError, match=r"^frame 2: joint 'Hips' is scaled by 1.2; .*without scales$"):
        read_bvh("\n".join([head + "Frame Time: 0.0333333", *ones]))


def test_decimal_commas_are_points_where_no_number_has_a_point() -> None:
    plain = bvh_text()
    found, same = read_bvh(re.sub(r"(?<=\d)\.(?=\d)", ",", plain)), read_bvh(plain)
    np.testing.assert_array_equal(found.local_unitquat, same.local_unitquat)
    np.testing.assert_array_equal(found.rest_offsets, same.rest_offsets)
    assert (found.rate_hz, found.notes) == (same.rate_hz, (*same.notes, "its decimal commas are read as points"))
    last = max(at for at, letter in enumerate(plain) if letter == ".")
    with pytest.raises(FormatError, match=r"line \d+: .*'-?\d+,\d+' is not a number"):
        read_bvh(plain[:last] + "," + plain[last + 1 :])
