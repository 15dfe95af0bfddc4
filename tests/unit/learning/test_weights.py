"""Files of trained models: a round trip gives the same model, and other files are refused with one sentence."""

import contextlib
import json
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from pasdedeux.augmentation import Source, uniform_variations
from pasdedeux.errors import InputError
from pasdedeux.learning.baselines import NaiveFkModel
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.model import Training, TrainingItem, VariantRequest
from pasdedeux.learning.registry import Weights, describe_model, load_model, model_arrays, read_weights, write_weights
from pasdedeux.learning.ridge_adapted import RidgeAdaptedModel
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(6), 30.0, "sway")
SCALES = [variation.bone_scale for variation in uniform_variations([0.9, 1.1], ["A"])]
ITEMS = [TrainingItem("v", VariantRequest("sway", TAKE, scale), TAKE.positions_m * scale[0, 1]) for scale in SCALES]
RIDGE = RidgeScaleModel.train(Training(lambda: iter(ITEMS))).model
MODEL = RidgeAdaptedModel.train(Training(lambda: iter(ITEMS), start=RIDGE)).model
DATA = write_weights(Weights(MODEL, {"sway": "digest"}))
WHAT = describe_model(MODEL).model_dump()


def _forged(change: dict[str, np.ndarray], **said: object) -> bytes:
    """Return the file with other arrays or other metadata."""
    words: dict[str, object] = {"description": WHAT, "joints": ",".join(BODY22.joint_names), "takes": {}} | said
    return bytes(save(load(DATA) | change, metadata={"pasdedeux": json.dumps(words)}))


def test_a_model_comes_back_from_its_file_with_what_it_is_built_on_and_the_bytes_are_the_same() -> None:
    again = read_weights(DATA, "w")
    assert again.takes == {"sway": "digest"}
    request = ITEMS[0].request
    np.testing.assert_array_equal(again.model.predict(request), MODEL.predict(request))
    assert write_weights(again) == DATA
    refined = MeshRefineModel(MeshRefineModel(NaiveFkModel(), 1), 2)
    assert describe_model(load_model(describe_model(refined), model_arrays(refined))) == describe_model(refined)
    assert {name: a.tobytes() for name, a in model_arrays(again.model).items()} == {
        name: a.tobytes() for name, a in model_arrays(MODEL).items()
    }


def _nested(depth: int) -> dict[str, object]:
    """Return the description of models that build on each other."""
    found: dict[str, object] = {"model": "copy"}
    for _ in range(depth):
        found = {"model": "mesh_refine", "config": {"num_iterations": 1}, "built_on": found}
    return found


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "no weights of a model"),
        (DATA[:-7], "no weights of a model"),
        (pickle.dumps({"mix": np.eye(44)}), "no weights of a model"),
        ((2**62).to_bytes(8, "little") + DATA[8:], "no weights of a model"),
        (bytes(save({"mix": np.eye(44)})), "no weights of a model"),
        (bytes(save({"mix": np.eye(44)}, metadata={"pasdedeux": "[" * 100_000})), "no weights of a model"),
        (
            _forged({}, version=2, layout={"of": "tomorrow"}),
            "weights of format version 2, from a newer pasdedeux; this one reads up to 1",
        ),
        (_forged({}, layout={"of": "tomorrow"}), "no weights of a model"),
        (_forged({}, joints="hips,head"), "another topology, 2 joints: hips,head"),
        (_forged({}, description={"model": "oracle"}), "model 'oracle' is not known"),
        (
            _forged({"built_on/mix": np.eye(36)}),
            r"'take/sway' has shape \(5, 6, 2, 22, 3\), not \(5, 6, 2, 18, 3\): weights of another",
        ),
        (_forged({"built_on/take/sway": np.ones((5, 6, 2, 18, 3))}), "'take/sway' has shape"),
        (_forged({"built_on/mix": np.full((44, 44), np.nan)}), "'mix' has a value that is not finite"),
        (_forged({"more": np.array([1, 1])}), "is of int64, not float32 or float64"),
        (_forged({}, description={"model": "ridge_adapted"}), "the ridge_scale that it builds on is missing"),
        (_forged({}, description=_nested(300)), "no weights of a model"),
        (
            _forged({}, description=_nested(1) | {"config": {"num_iterations": 10**12}}),
            "its settings do not fit: num_iterations: ",
        ),
    ],
)
def test_what_is_no_model_of_ours_ends_with_one_sentence_that_names_the_file(data: bytes, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as found:
        read_weights(data, "w.safetensors")
    assert str(found.value).startswith("w.safetensors: ")
    assert "\n" not in str(found.value)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_whatever_is_changed_in_the_head_of_a_file_it_is_read_or_refused(data: st.DataObject) -> None:
    size = 8 + int.from_bytes(DATA[:8], "little")
    place, byte = data.draw(st.integers(0, size - 1)), data.draw(st.integers(0, 255))
    with contextlib.suppress(InputError):
        assert read_weights(DATA[:place] + bytes([byte]) + DATA[place + 1 :], "w").model.name == "ridge_adapted"


def test_a_take_that_a_model_does_not_know_is_another_whatever_its_name() -> None:
    with pytest.raises(InputError, match="learned take sway with 6 frames, asked for 4"):
        load_model(describe_model(RIDGE), model_arrays(RIDGE)).predict(
            VariantRequest("sway", TAKE.take_frames(slice(0, 4)), SCALES[0])
        )
