"""NumPy arrays from a pickle, read without running any code of the file.

A pickle is a program that may call any function by name. Three measures restrict it to data:

- Names are looked up in a table of this module. The table has NumPy's constructors of arrays only. Its
  entries are stand-ins that take the arguments of NumPy's own functions and check them.
- The program is scanned before it runs (`pickletools`): its pieces must lie within the file, and its memory
  must not exceed the file's size by more than a fixed allowance.
- The size of an array's data must match its shape and number format. Objects, records, texts and scalars of
  NumPy are refused.

The result is an array of float64, made from arrays and nested lists or tuples of them.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.limits import MORE, LimitSettingError, scaled_limit
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat.recordings.findings import RecordingError

#: largest size of a file (bytes), and largest count of numbers in it
LARGEST_FILE, MOST_NUMBERS = 1 << 28, 1 << 27
#: largest depth of nested lists
DEEPEST = 6
#: number formats of arrays, as NumPy's pickles name them
FORMATS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
#: memory slots that a pickle may use beyond its own size
SPARE_PLACES = 1 << 16
TOO_MANY = "too many numbers"


class _RefusedError(Exception):
    """Error for content that is not an array of numbers."""


class _Name:
    """Stand-in for a function or class that a pickle names; it has no state to be changed."""

    def __init__(self, call: Callable[..., Any]):
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise _RefusedError("a function with a state")


class _Format:
    """Number format: stand-in for an object of `numpy.dtype`."""

    def __init__(self, code: Any, *_: Any):
        if code not in FORMATS:
            raise _RefusedError(f"an array of format {code!r}; accepted are {', '.join(FORMATS)}")
        self.dtype = np.dtype(f"<{code}")

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
            raise _RefusedError("a number format with an unknown state")
        if any(part is not None for part in state[2:5]):
            raise _RefusedError("an array of records")
        self.dtype = self.dtype.newbyteorder(">" if state[1] == ">" else "<")


class _Array:
    """Array filled by its state: stand-in for one of `numpy.core.multiarray._reconstruct`."""

    values: np.ndarray[Any, Any] | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise _RefusedError("an array with an unknown state")
        _, shape, kind, fortran, raw = state
        self.fill(raw, kind, shape, "F" if fortran else "C")

    def fill(self, raw: Any, kind: Any, shape: Any, order: Any) -> _Array:
        """Set the values from bytes after checking their number against shape and format."""
        if not isinstance(raw, bytes | bytearray) or not isinstance(kind, _Format):
            raise _RefusedError("an array of objects")
        shape = (shape,) if isinstance(shape, int) else shape
        if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise _RefusedError("an array with an impossible shape")
        if max(shape, default=0) > scaled_limit(MOST_NUMBERS):
            raise _RefusedError(TOO_MANY)
        if len(shape) > DEEPEST or math.prod(shape) * kind.dtype.itemsize != len(raw):
            raise _RefusedError("an array with more or fewer bytes than its shape says")
        values = np.frombuffer(bytes(raw), kind.dtype)
        self.values = values.reshape(shape, order="F" if order == "F" else "C")
        return self


def _array_class(*_: Any) -> None:
    raise _RefusedError("an array made by its class")


def _reconstruct(kind: Any, *_: Any) -> _Array:
    if not isinstance(kind, _Name) or kind._call is not _array_class:
        raise _RefusedError("an array of another class than numpy.ndarray")
    return _Array()


def _from_buffer(raw: Any, kind: Any, shape: Any, order: Any = "C", *_: Any) -> _Array:
    return _Array().fill(raw, kind, shape, order)


def _encoded(text: Any, encoding: Any = "latin1") -> bytes:
    """Return the bytes that old protocols write as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _RefusedError("a text that does not stand for bytes")
    return text.encode("latin1")


_NAMES: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _array_class,
    ("numpy", "dtype"): _Format,
    ("_codecs", "encode"): _encoded,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _reconstruct for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _from_buffer for core in ("core", "_core")},
}


class _Reader(pickle.Unpickler):
    """Unpickler restricted to the names in the table."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _NAMES:
            raise _RefusedError(f"the name {module}.{name}")
        return _Name(_NAMES[module, name])


def read_pickled_array(path: str | Path) -> Float[np.ndarray, "..."]:
    """Return the numbers of a pickle as one array, without running any code of the file.

    Arrays of real numbers are accepted, and lists or tuples (nested up to 6 deep) of arrays or numbers that
    form one array, in any protocol.

    Raises:
        RecordingError: the file cannot be read, or is not such a pickle; one line with the reason.
    """
    path = Path(path)
    accepted = "accepted are NumPy arrays of numbers, and lists of them"
    try:
        data = read_bytes(path, LARGEST_FILE)
        _scan(data)
        values = _numbers(_Reader(io.BytesIO(data)).load(), [scaled_limit(MOST_NUMBERS)], DEEPEST)
        return np.asarray(values, dtype=float)
    except LimitSettingError:
        raise
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None
    except _RefusedError as error:
        more = f"; {MORE}" if str(error) == TOO_MANY else ""
        raise RecordingError(f"{path}: the pickle holds {error}; {accepted}{more}") from None
    # the unpickler raises various errors on a damaged program
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{path}: not a pickle of arrays ({reason[:120]}); {accepted}") from None


def _scan(data: bytes) -> None:
    """Check the program's pieces before it runs."""
    for operation, argument, _ in pickletools.genops(data):
        stores = operation.name in ("PUT", "BINPUT", "LONG_BINPUT")
        if stores and int(argument or 0) > len(data) + SPARE_PLACES:
            raise _RefusedError("a request for more memory than the file has bytes")
        if operation.name in ("PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "NEXT_BUFFER"):
            raise _RefusedError("a reference to data outside of the file")


def _numbers(given: Any, left: list[int], depth: int) -> Any:
    """Return arrays and numbers in nested lists; `left` counts down the remaining allowance of numbers."""
    values = given.values if isinstance(given, _Array) else None
    if isinstance(given, _Array) and values is None:
        raise _RefusedError("an array without numbers")
    number = isinstance(given, int | float) and not isinstance(given, bool)
    if values is None and not number and not isinstance(given, list | tuple):
        raise _RefusedError(f"a {type(given).__name__.strip('_').lower()}")
    left[0] -= 1 if values is None else values.size
    if left[0] < 0:
        raise _RefusedError(TOO_MANY)
    if isinstance(given, list | tuple):
        if depth == 0:
            raise _RefusedError("lists nested too deeply")
        return [_numbers(each, left, depth - 1) for each in given]
    return float(given) if values is None else values.astype(float)
