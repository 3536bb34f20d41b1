import copy
import dataclasses
import json
import os
import re
import tracemalloc

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings

from knode_cosserat.learning.files import container, model_file
from knode_cosserat.learning.files.model_file import ModelFileError, load_model
from knode_cosserat.learning.knode import KNODE, About
from tests.learning.files.made import (
    MODELS,
    ROBOT,
    fails,
    network,
)

# files that are not right

BYTES = model_file.encoded(KNODE(ROBOT, network(), About({"loss": np.arange(9.0)})), "model")
STRUCTURED = model_file.encoded(MODELS["structured"], "model")


def forged(data, edit, arrays=None):
    """A file with another header (and arrays), but with the right checksum and sizes."""
    first, second, body = data.split(b"\n", 2)
    size = int(second.split()[1])
    header = json.loads(body[:size])
    header = edit(header) or header
    text, arrays = json.dumps(header).encode(), body[size:] if arrays is None else arrays
    sizes = f" {len(text)} {len(arrays)}\n".encode()
    return first + b"\n" + container.checksum(first + b"\n", sizes, text + arrays) + sizes + text + arrays


def test_files_that_are_something_else(tmp_path):
    with fails("nothing: no such file"):
        load_model(tmp_path / "nothing")
    with fails(str(tmp_path), "this is a folder"):
        load_model(tmp_path)
    with fails("no such file"):
        load_model("a\0b")
    os.mkfifo(tmp_path / "pipe")
    with fails("pipe: not a file"):
        load_model(tmp_path / "pipe")
    for content in (
        b"",
        b"\x89HDF\r\n\x1a\n",
        b"format: 1\nkind: tendon-robot\n",
        b"\x80\x04K\x01.",
        b"\n" * 99,
    ):
        (tmp_path / "other").write_bytes(content)
        with fails("other: not a file of the kind 'knode-cosserat model'"):
            load_model(tmp_path / "other")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(2**42)
    with fails("sparse: it has 4398046511104 bytes; allowed are"):
        load_model(tmp_path / "sparse")


def test_newer_versions():
    newer = re.sub(rb"^(.*) format 1, package [^\n]*", rb"\1 format 2, package 9.1", BYTES)
    with fails("model: its format is 2; allowed is 1", "knode-cosserat 9.1"):
        model_file.decoded_model(newer, "model")


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_truncated_files(data):
    length = data.draw(st.integers(1, len(BYTES) - 1) | st.integers(1, 200))
    with fails("model: truncated"):
        model_file.decoded_model(BYTES[:length], "model")


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_damaged_files(data):
    content = bytearray(BYTES)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 200))
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    assume(bytes(content) != BYTES)
    with fails("model: "):
        model_file.decoded_model(bytes(content), "model")


def test_added_and_swapped_bytes():
    with fails("model: damaged"):
        model_file.decoded_model(BYTES + b"\0", "model")
    other = model_file.encoded(KNODE(ROBOT, network(seed=1), About({"loss": np.arange(9.0)})), "model")
    assert len(other) == len(BYTES)
    with fails("model: damaged: its content does not have the checksum"):
        model_file.decoded_model(BYTES[:300] + other[300:], "model")


def places(value, path=()):
    """The paths of everything in a header."""
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        yield from places(part, (*path, key))


def changed(header, path, new):
    *way, last = path
    inner = header
    for key in way:
        inner = inner[key]
    if new is None and isinstance(inner, dict):
        del inner[last]
    else:
        inner[last] = new


_HOSTILE = st.sampled_from(
    [
        None, True, -1, 0, 3, 2**31, 2**62, 10**400, -0.5, float("nan"), "", "os.system", "n\new", [], {},
        ["<f8", [2**40]], ["<f8", [2**62, 2**62]], ["|O", [1]], ["<f8", [-1]], ["<f8", [0, 2**62]],
        {"$array": 0}, {"$array": 2**70}, {"$array": "0"}, {"$scalar": 0}, {"$tuple": 3}, {"$dict": [[1, 2]]},
        {"$class": "Network", "fields": {}}, {"$class": "Structured"}, {"$class": "os.system", "fields": {}},
        {"$class": "Term", "fields": {"name": "u", "start": 0, "stop": 2**50, "form": "linear", "scale": 0}},
        {"$class": "BDFAlpha", "fields": {"alpha": 9}}, {"$": 1},
    ]
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(["network", "structured"]), st.data())
def test_forged_headers_give_an_error_or_a_model(kind, data):
    def edit(header):
        for _ in range(data.draw(st.integers(1, 2))):
            path = data.draw(st.sampled_from(list(places(header))[1:]))
            changed(header, path, copy.deepcopy(data.draw(_HOSTILE)))

    try:
        found = model_file.decoded_model(forged(STRUCTURED if kind == "structured" else BYTES, edit), "model")
    except ModelFileError as error:
        assert "\n" not in str(error) and len(str(error)) < 700  # noqa: PT017 - not every one is wrong
    else:
        assert type(found) is KNODE


def test_an_array_in_the_place_of_a_constant_spoils_nothing():
    """JAX compares models with those that it has seen; an array there has no truth value."""

    def edit(header):
        header["residual"]["fields"]["convex"] = {"$array": 0}

    with fails("residual.convex is a ndarray; allowed is a constant"):
        model_file.decoded_model(forged(BYTES, edit), "model")
    assert type(model_file.decoded_model(BYTES, "model")) is KNODE


@pytest.mark.parametrize(
    ("entry", "parts"),
    [
        (["<f8", [2**45]], ["array 0", "not understood"]),
        (["<f8", [2**20, 2**6]], ["array 0", "larger than what is there"]),
        (["<f8", [0, 2**40]], ["array 0", "not understood"]),
        (["<f8", [-3, 28]], ["array 0", "not understood"]),
        (["|O", [3, 28]], ["array 0", "not understood"]),
        (["<f8", [3, 27]], ["its arrays are", "bytes by its header, but"]),
    ],
)
def test_arrays_that_are_larger_than_the_file(entry, parts):
    content = forged(BYTES, lambda header: header["arrays"].__setitem__(0, entry))
    tracemalloc.start()
    try:
        with fails("model: ", *parts):
            model_file.decoded_model(content, "model")
        assert tracemalloc.get_traced_memory()[1] < 20 * len(BYTES) + 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("depth", [500, 100_000])
def test_headers_that_are_nested_without_end(depth):
    nested = ("[" * depth + "]" * depth).encode()
    marker = b'"deep"'
    with_marker = forged(BYTES, lambda header: header["about"].__setitem__("x", "deep"))
    first, _, body = with_marker.split(b"\n", 2)
    size = body.index(b'}, "arrays"') if b'}, "arrays"' in body else None
    assert size is not None and marker in body
    header_end = int(with_marker.split(b"\n", 2)[1].split()[1])
    text, arrays = body[:header_end].replace(marker, nested), body[header_end:]
    sizes = f" {len(text)} {len(arrays)}\n".encode()
    content = first + b"\n" + container.checksum(first + b"\n", sizes, text + arrays) + sizes + text + arrays
    with fails("model: "):
        model_file.decoded_model(content, "model")


def test_headers_and_robots_that_are_too_long(tmp_path):
    with fails("its header takes", "allowed is 4194304"):
        model_file.decoded_model(forged(BYTES, lambda h: h["about"].__setitem__("x", "a" * 2**22)), "model")
    with fails("keep long lists of numbers as arrays"):
        KNODE(ROBOT, network(), About({"loss": [0.1] * 2**20})).save(tmp_path / "model")
    with fails("its robot file has", "allowed is 100000"):
        model_file.decoded_model(
            forged(BYTES, lambda h: h["knowledge"].__setitem__("robot", "#" * 2**20)), "model"
        )
    many = {
        "$tuple": [{"$class": "Term", "fields": dict.fromkeys(("name", "start", "stop", "form", "scale"))}]
    }
    many["$tuple"] *= 10_000
    with fails("more than 5000 objects"):
        model_file.decoded_model(forged(BYTES, lambda h: h["about"].__setitem__("x", many)), "model")


def test_robots_that_are_not_right():
    def edit(header):
        header["knowledge"]["robot"] = header["knowledge"]["robot"].replace("length: 0.635", "length: -1.0")

    with fails("model: its robot file: length must be between 0.001 and 20 m (got -1.0)"):
        model_file.decoded_model(forged(BYTES, edit), "model")


def test_shapes_that_do_not_fit_together(tmp_path):
    net = network()
    for change in (
        {"input_weights": np.zeros((3, 27))},
        {"output_weights": np.zeros((24, 3))},
        {"output_biases": np.zeros(24)},
        {"input_mean": np.zeros((28, 28))},
        {"input_biases": "text"},
        {"output_scale": None},
        {"c0": np.zeros(())},
    ):
        with fails("model: residual and knowledge do not fit together: "):
            KNODE(ROBOT, dataclasses.replace(net, **change)).save(tmp_path / "model")
    assert os.listdir(tmp_path) == []
    six_tendons = ROBOT.replace(tendon_angles=np.arange(6.0))
    text = model_file.encoded(KNODE(six_tendons, network(six_tendons)), "model")
    assert decoded(text).control_size == 6

    def fewer(header):
        header["arrays"][:2] = [["<f8", [4, 21]], ["<f8", [3]]]

    with fails("model: residual and knowledge do not fit together: "):
        model_file.decoded_model(forged(BYTES, fewer), "model")
    with fails("model: its residual is a Load; allowed is a Residual"):
        model_file.decoded_model(
            forged(BYTES, lambda h: h["residual"].update({"$class": "Load", "fields": {"material": None,
                                                                                       "ambient": None}})),
            "model",
        )  # fmt: skip

    def impossible(header):
        header["arrays"] = [["<f8", []]]
        header["residual"] = {
            "$class": "Structured",
            "fields": {"stretch": {"$array": 0}, "stress": None, "load": None, "tip_load": None},
        }
        header["about"] = {}

    assert decoded(forged(BYTES, impossible, np.float64(0.1).tobytes())).length == 0.635 * 1.1
    with fails("model: residual and knowledge do not fit together: length must be between"):
        model_file.decoded_model(forged(BYTES, impossible, np.float64(-2.0).tobytes()), "model")


def decoded(content):
    return model_file.decoded_model(content, "model")
