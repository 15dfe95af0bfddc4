from __future__ import annotations

import pickle

import pytest

from storage_schema import errors

NAMES = sorted(name for name in vars(errors) if not name.startswith("_") and isinstance(getattr(errors, name), type))


@pytest.mark.parametrize("name", NAMES)
def test_every_error_survives_pickling_and_has_one_root(name: str) -> None:
    error = getattr(errors, name)("what was found, where, what is allowed")
    copy = pickle.loads(pickle.dumps(error))
    assert isinstance(error, errors.StorageError)
    assert type(copy) is type(error)
    assert str(copy) == str(error)


def test_errors_that_a_user_can_put_right_say_so() -> None:
    assert {name for name in NAMES if getattr(errors, name).is_input} == {
        "NewerSchema",
        "NotAStore",
        "OlderSchema",
        "UnknownReference",
        "BadName",
        "DatasetExists",
    }
