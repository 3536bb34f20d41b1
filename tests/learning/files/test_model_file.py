import logging
import os
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import given, settings

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.engine.machine_code import MachineCode
from knode_cosserat.io import container
from knode_cosserat.learning import knode
from knode_cosserat.learning.knode import KNODE, About, ModelFileError, decoded_model, load_model
from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.structured.residual import Structured
from tests.learning.files.made import (
    MODELS,
    ROBOT,
    STRING,
    TENSIONS,
    YOURS,
    Bag,
    Odd,
    Pull,
    assert_same,
    fails,
    network,
)

# round trips


@pytest.mark.parametrize("name", MODELS)
def test_models_come_back_the_same(tmp_path, name):
    model = MODELS[name]
    model.save(tmp_path / "model")
    assert os.listdir(tmp_path) == ["model"]
    loaded_model = load_model(str(tmp_path / "model"), residuals=YOURS)
    assert_same(loaded_model, model)
    assert loaded_model.nodes == 5
    loaded_model.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "model").read_bytes()


def test_the_classes_inside_a_users_residual_come_back():
    data = MODELS["a user's"].to_bytes()
    odd = decoded_model(data, "model", residuals=YOURS).residual.options[0]
    assert isinstance(odd, Odd) and odd.power == 2


def bits(value):
    """A value in a form in which equal means the same, arrays and types included."""
    if isinstance(value, np.ndarray | np.generic):
        return type(value), value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, list | tuple):
        return type(value), [bits(part) for part in value]
    if isinstance(value, dict):
        return [(key, bits(part)) for key, part in value.items()]
    return type(value), repr(value)


_ARRAYS = st.builds(
    lambda kind, shape, seed: (
        np.frombuffer(np.random.default_rng(seed).bytes(16 * int(np.prod(shape))), kind)
        .reshape(*shape, -1)
        .copy()
    ),
    st.sampled_from(["<f8", ">f8", "<f4", "<i8", "<u2", "|i1", "<c16"]),
    st.sampled_from([(2,), (4, 2), (2, 1, 4)]),
    st.integers(0, 99),
)
_FACTS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | _ARRAYS | st.just(np.float32(0.1)),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text(max_size=3) | st.just("$array"), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=40, deadline=None)
@given(st.dictionaries(st.text(max_size=5), _FACTS, max_size=3))
def test_what_is_known_of_a_model_comes_back_the_same(facts):
    model = KNODE(ROBOT, network(), About(facts))
    found = decoded_model(model.to_bytes(), "model").about.facts
    assert bits(found) == bits(facts)


def test_a_loss_history_comes_back(tmp_path):
    loss = np.random.default_rng(0).random((5, 1000))
    facts = {"loss": loss, "data": [{"sha256": "ab" * 32, "rows": (0, 30)}]}
    KNODE(ROBOT, network(), About(facts)).save(tmp_path / "model")
    found = load_model(tmp_path / "model").about.facts
    assert np.array_equal(found["loss"], loss) and found["loss"].flags.writeable
    assert found["data"] == facts["data"]


@pytest.mark.campaign
def test_a_loaded_model_simulates_the_same_with_the_same_program(tmp_path, caplog, monkeypatch):
    model, made, of = MODELS["jax arrays"], [], MachineCode.of
    monkeypatch.setattr(MachineCode, "of", lambda *given, **how: made.append(given) or of(*given, **how))
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        truth = kc.simulate(model, TENSIONS, 0.05)
        assert made
        model.save(tmp_path / "model")
        loaded_model = load_model(tmp_path / "model")
        caplog.clear()
        made.clear()
        prediction = kc.simulate(loaded_model, TENSIONS, 0.05)
        assert not made and "Compiling" not in caplog.text
    assert truth.all_valid
    bare = kc.simulate(ROBOT, TENSIONS, 0.05)
    assert np.abs(truth.y - bare.y).max() > 1e-6
    for name in ("y", "z", "result", "residual", "iterations"):
        assert np.array_equal(getattr(prediction, name), getattr(truth, name)), name


def test_a_model_of_512_units_is_small_and_quick(tmp_path):
    model = KNODE(ROBOT, network(hidden=512))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(model.residual))
    model.save(tmp_path / "model")
    assert os.path.getsize(tmp_path / "model") < 8 * numbers + 12_000
    assert_same(load_model(tmp_path / "model"), model)


# knowledge that no robot file can name


def test_a_users_knowledge_is_asked_for(tmp_path):
    model = KNODE(STRING, network(STRING))
    path = tmp_path / "model"
    model.save(path)
    with fails("model: its nominal model is a HangingString", "load_model(path, knowledge=…)"):
        load_model(path)
    assert_same(load_model(path, knowledge=STRING), model)
    with fails("the nominal model given is a TendonRobot; the model was saved with a HangingString"):
        load_model(path, knowledge=ROBOT)
    with fails("the nominal model given has other nodes", "9, not 5"):
        load_model(path, knowledge=STRING.replace(nodes=9))
    with fails("the nominal model given has other density", "0.2, not 0.1"):
        load_model(path, knowledge=STRING.replace(density=0.2))


def test_a_users_knowledge_of_another_layout_is_turned_down(tmp_path, monkeypatch):
    path = tmp_path / "model"
    KNODE(STRING, network(STRING)).save(path)
    longer = kc.robots.Layout(*HangingString.y_layout.fields, ("angle", 1, "rad", "angle"))
    monkeypatch.setattr(HangingString, "y_layout", longer)
    with fails("the nominal model given has other y", "angle", "not"):
        load_model(path, knowledge=STRING)


def test_knowledge_that_is_given_though_the_file_has_it(tmp_path):
    path = tmp_path / "model"
    MODELS["network"].save(path)
    assert_same(load_model(path, knowledge=ROBOT), MODELS["network"])
    with fails("other youngs_modulus", "not 3333333333.3"):
        load_model(path, knowledge=ROBOT.replace(youngs_modulus=1e9))
    with fails("the nominal model given is a HangingString"):
        load_model(path, knowledge=STRING)


# classes


def test_a_users_residual_has_to_be_told(tmp_path):
    path = tmp_path / "model"
    MODELS["a user's"].save(path)
    with fails("model: residual", "'Pull', which is not known here; load it with residuals=[Pull]"):
        load_model(path)
    with fails("residual.bag", "'Bag'"):
        load_model(path, residuals=[Pull])
    with pytest.raises(ValueError, match="residuals holds 'nothing'; allowed is a list, each a class"):
        load_model(path, residuals=["nothing"])
    with fails("int'> cannot be in a model file"):
        load_model(path, residuals=[int])


def test_a_class_of_a_name_that_is_taken(tmp_path):
    MODELS["network"].save(tmp_path / "model")
    other = type("Network", (Pull,), {"__module__": "yours"})
    with fails("there is another class Network already", "call yours otherwise"):
        load_model(tmp_path / "model", residuals=[other])
    with fails("Network", "that name is taken"):
        KNODE(ROBOT, other(0.1)).save(tmp_path / "other")
    assert os.listdir(tmp_path) == ["model"]


def test_a_class_that_has_changed_since(tmp_path):
    path = tmp_path / "model"
    KNODE(ROBOT, Pull(0.1)).save(path)
    fields = {"force": Any, "bag": Any, "options": Any}

    def changed(**more):
        body = {"__annotations__": {**fields, **more}, "balance": Pull.balance}
        body["options"] = eqx.field(static=True)
        return body

    same = type(Pull)("Pull", (Residual,), changed() | {"__module__": "a.notebook"})
    later = type(Pull)("Pull", (Residual,), changed(gain=Any) | {"gain": 1.0})
    wanting = type(Pull)("Pull", (Residual,), changed(gain=Any))
    assert load_model(path, residuals=[same, Bag, Odd]).residual.force.tolist() == [0.1] * 3
    assert load_model(path, residuals=[later, Bag, Odd]).residual.gain == 1.0
    with fails("residual, a Pull, does not have a field 'gain'"):
        load_model(path, residuals=[wanting, Bag, Odd])
    del fields["bag"]
    with fails("residual, a Pull, has a field 'bag'; there are force, options"):
        load_model(path, residuals=[type(Pull)("Pull", (Residual,), changed()), Bag, Odd])


def test_loading_asks_nothing_of_pickle_or_eval():
    for module in (knode, container):
        source = Path(module.__file__).read_text(encoding="utf-8")
        assert not re.search(r"\b(pickle|eval|exec|import_module|__import__)\b", source)


# what cannot be saved


def test_what_cannot_be_saved(tmp_path):
    model = MODELS["network"]
    with fails("model: cannot be written: No such file or directory"):
        model.save(tmp_path / "no" / "model")
    (tmp_path / "folder").mkdir()
    with fails("folder: cannot be written"):
        model.save(tmp_path / "folder")
    with fails("a batch of models cannot be written to one file"):
        jax.tree.map(lambda *leaves: np.stack(leaves), model, model).save(tmp_path / "model")
    with pytest.raises(ModelFileError, match="inside jit"):
        jax.grad(lambda x: KNODE(ROBOT, Structured(x, None, None, None)).save(tmp_path / "model") or x)(0.1)
    loop = []
    loop.append(loop)
    for facts, parts in (
        ({"f": abs}, "about.f is a builtin_function_or_method; allowed is numbers, text"),
        ({"a": [{"b": {1: 2}}]}, "about.a[0].b has the key 1; allowed is text"),
        ({"a": np.array(["text"])}, "about.a is a ndarray of <U4; allowed is an array of numbers"),
        ({"a": np.array([None])}, "about.a is a ndarray"),
        ({"a": np.ma.array([1.0], mask=[True])}, "about.a is a MaskedArray"),
        ({"a": jax.random.key(0)}, "about.a is a "),
        ({"a": loop}, "its facts are nested too deep, or contain themselves"),
        ({"a": 10**5000}, "it has a number that cannot be written"),
    ):
        with fails("model: ", parts):
            KNODE(ROBOT, network(), About(facts)).save(tmp_path / "model")
    with fails("residual.bag.label is a function"):
        bag = Bag(None, lambda x: x)
        KNODE(ROBOT, eqx.tree_at(lambda pull: pull.bag, Pull(0.1), bag)).save(tmp_path / "model")
    assert os.listdir(tmp_path) == ["folder"]


def test_a_crash_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "model"
    MODELS["network"].save(path)
    before = path.read_bytes()

    def crash(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", crash)
    with fails("model: cannot be written: No space left on device"):
        MODELS["structured"].save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["model"]
