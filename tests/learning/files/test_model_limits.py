"""Limits of model files and checkpoints."""

from typing import NamedTuple

import numpy as np
import pytest

from knode_cosserat._files.limits import VARIABLE
from knode_cosserat.learning.files import container, unpacking
from tests.limits import Readers, assert_limited

READERS = Readers()
TITLE = container.Title("test", 1)


class Thing(NamedTuple):
    """An object of a file."""

    x: int


def contained():
    writer = container.Writer()
    things = writer.value([Thing(k) for k in range(5)], "things", {"Thing": Thing})
    values = writer.value(np.arange(9.0), "values", {})
    return writer.file(TITLE, {"things": things, "values": values})


@READERS
def model_size(folder, patch):
    patch.setattr(container, "MOST_HEADER", 0)
    patch.setattr(container, "MOST_ARRAYS", 100)
    path = folder / "model"
    path.write_bytes(bytes(500))
    return lambda: container.read(path)


@READERS
def model_header(folder, patch):
    data = contained()
    patch.setattr(unpacking, "MOST_HEADER", 100)
    return lambda: unpacking.Reader(data, TITLE)


@READERS
def model_objects(folder, patch):
    data = contained()
    patch.setattr(unpacking, "MOST_OBJECTS", 4)

    def read():
        opened = unpacking.Reader(data, TITLE)
        return opened.value(opened.header["things"], "things", {"Thing": Thing})

    return read


@READERS
def objects_of_a_written_model(folder, patch):
    patch.setattr(container, "MOST_OBJECTS", 4)
    return contained


@READERS
def header_of_a_written_model(folder, patch):
    patch.setattr(container, "MOST_HEADER", 100)
    return contained


@READERS
def arrays_of_a_written_model(folder, patch):
    patch.setattr(container, "MOST_ARRAYS", 71)
    return contained


@pytest.mark.parametrize("name", READERS)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(name, tmp_path, monkeypatch):
    assert_limited(READERS[name], tmp_path, monkeypatch)


def test_the_setting_changes_no_byte_of_a_file(monkeypatch):
    data = contained()
    monkeypatch.setenv(VARIABLE, "3")
    assert contained() == data
