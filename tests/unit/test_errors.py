"""Errors say what, what was expected, what was there, what to do."""

import pickle

import pytest

from dtprob.errors import DtprobError, InputError, check_choice, nearest, unknown_name


def test_the_sentence():
    error = InputError("a.npz: channel", "5 axes", "4", "Add the snapshot axis.")
    assert str(error) == "a.npz: channel: expected 5 axes, got 4. Add the snapshot axis."
    assert isinstance(error, DtprobError)
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
    assert again.remedy == error.remedy


def test_nearest():
    assert nearest("laplas", ["laplace", "nuts"]) == "laplace"
    assert nearest("NUTS", ["laplace", "nuts"]) == "nuts"
    assert nearest("xyz", ["laplace", "nuts"]) is None


def test_unknown_name_asks_or_lists():
    assert str(unknown_name("[engine]", "nut", ["nuts", "laplace"], "engine")) == (
        "[engine]: expected one of the engines laplace, nuts, got 'nut'. Did you mean 'nuts'?"
    )
    for kind, kinds in [
        ("key", "keys"),
        ("effect family", "effect families"),
        ("kind of traffic", "kinds of traffic"),
    ]:
        assert f"one of the {kinds} a," in str(unknown_name("x", "a1", ["a", "b"], kind))
    assert str(unknown_name("x", "q", [], "option")) == "x: expected no options, got 'q'. Leave it out."
    assert str(unknown_name("x", "q", [f"n{i}" for i in range(100, 130)])).count(",") == 17


def test_a_choice_that_is_none_is_answered_by_the_nearest() -> None:
    check_choice("phase", "coherent", ("coherent", "none"))
    with pytest.raises(
        InputError,
        match=r"phase: expected one of the choices coherent, none, got 'Coherent'\. Did you mean 'coherent'",
    ):
        check_choice("phase", "Coherent", ("coherent", "none"))
