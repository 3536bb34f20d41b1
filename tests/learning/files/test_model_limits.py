"""Limits of model files and checkpoints."""

from typing import NamedTuple

import numpy as np
import pytest

from knode_cosserat._files.limits import VARIABLE
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.io import container
from tests.limits import Readers, assert_limited

READERS = Readers()


class ProbeError(KnodeCosseratError, ValueError):
    """An error of the files here."""

    code = "probe"


KIND = container.Kind("knode-cosserat test", 1, ProbeError)
CLASSES = {}


class Thing(NamedTuple):
    """An object of a file."""

    x: int


CLASSES["Thing"] = Thing


def contained():
    facts = {"things": [Thing(k) for k in range(5)], "values": np.arange(9.0)}
    return container.encode(KIND, facts, classes=CLASSES)


def decoded(data):
    return lambda: container.decode(data, KIND, "it", CLASSES)


@READERS
def file_size(folder, patch):
    path = folder / "it"
    path.write_bytes(contained())
    patch.setattr(container, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: container.read(path, KIND, CLASSES)


@READERS
def file_facts(folder, patch):
    data = contained()
    patch.setattr(container, "MOST_FACTS", 100)
    return decoded(data)


@READERS
def file_objects(folder, patch):
    data = contained()
    patch.setattr(container, "MOST_OBJECTS", 4)
    return decoded(data)


@READERS
def file_expansion(folder, patch):
    data = contained()
    patch.setattr(container, "EXPANSION", 0)
    patch.setattr(container, "ALLOWANCE", 71)
    return decoded(data)


@READERS
def objects_of_a_written_file(folder, patch):
    patch.setattr(container, "MOST_OBJECTS", 4)
    return contained


@READERS
def facts_of_a_written_file(folder, patch):
    patch.setattr(container, "MOST_FACTS", 100)
    return contained


@READERS
def size_of_a_written_file(folder, patch):
    size = len(contained())
    patch.setattr(container, "LARGEST_FILE", size - 1)
    return contained


@pytest.mark.parametrize("name", READERS)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(name, tmp_path, monkeypatch):
    assert_limited(READERS[name], tmp_path, monkeypatch)


def test_the_setting_changes_no_byte_of_a_file(monkeypatch):
    data = contained()
    monkeypatch.setenv(VARIABLE, "3")
    assert contained() == data
