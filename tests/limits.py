"""Check that a refusal names the setting of the limits, and that the setting allows the same file."""

import pytest

from knode_cosserat import KnodeCosseratError
from knode_cosserat._files.limits import MORE, VARIABLE, LimitSettingError


class Readers(dict):
    """Readers by name, added as a decorator.

    Each takes a folder and a monkeypatch, and returns a function that reads a file above a limit, but not
    above ten times the limit.
    """

    def __call__(self, function):
        self[function.__name__] = function
        return function


def limit_size(patch, module, path):
    """Set the largest file of a module to one byte less than a file has."""
    patch.setattr(module, "LARGEST_FILE", path.stat().st_size - 1)


def limited(file, module, limits):
    """Return a reader for `assert_limited`: of a file, with limits of a module.

    `file` takes a folder, and returns the path and a function that reads it. A limit of None is one byte
    less than the file has.
    """

    def reader(folder, patch):
        path, read = file(folder)
        for name, value in limits.items():
            patch.setattr(module, name, path.stat().st_size - 1 if value is None else value)
        return read

    return reader


def assert_limited(reader, folder, monkeypatch):
    """Assert that a file is refused, and read with ten times the limits."""
    monkeypatch.delenv(VARIABLE, raising=False)
    read = reader(folder, monkeypatch)
    with pytest.raises(KnodeCosseratError) as refused:
        read()
    message = str(refused.value)
    assert message.endswith(MORE) and VARIABLE in MORE and "\n" not in message
    monkeypatch.setenv(VARIABLE, "10")
    read()
    monkeypatch.setenv(VARIABLE, "ten")
    with pytest.raises(LimitSettingError, match=f"^{VARIABLE} must be a finite number above 0 "):
        read()
