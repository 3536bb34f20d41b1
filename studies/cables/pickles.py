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
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.limits import MORE, LimitSettingError, allowed
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.recordings.findings import RecordingError

#: largest size of a file (bytes), and largest count of numbers in it
LARGEST_FILE, MOST_NUMBERS = 1 << 28, 1 << 27
#: largest depth of nested lists
DEEPEST = 6
#: number formats of arrays, as NumPy's pickles name them
FORMATS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
#: memory slots that a pickle may use beyond its own size
SPARE_PLACES = 1 << 16


class _RefusedError(KnodeCosseratError):
    """Error for content that is not an array of numbers."""

    code = "pickle"


class _TooManyError(_RefusedError):
    """Error for more numbers than a limit allows."""

    code = "pickle-size"


class _Format:
    """Stand-in for `numpy.dtype`: a number format."""

    def __init__(self, code: Any, align: Any = False, copy: Any = True):
        if code not in FORMATS:
            raise _RefusedError(f"an array of format {code!r}; accepted are {', '.join(FORMATS)}")
        self.code, self.order = str(code), "<"

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
            raise _RefusedError("a number format with an unknown state")
        if any(part is not None for part in state[2:5]):
            raise _RefusedError("an array of records")
        self.order = str(state[1])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Number format as a NumPy dtype."""
        return np.dtype(self.order.replace("|", "<") + self.code)


class _ArrayClass:
    """Stand-in for the class `numpy.ndarray`; pickles name it but do not call it."""

    def __init__(self, *_: Any):
        raise _RefusedError("an array made by its class")

    def __setstate__(self, state: Any) -> None:
        raise _RefusedError("an array made by its class")


class _Array:
    """Stand-in for `numpy.core.multiarray._reconstruct`: an array filled by its state."""

    values: np.ndarray[Any, Any] | None = None

    def __init__(self, kind: Any, shape: Any = (0,), code: Any = b"b"):
        if kind is not _ArrayClass:
            raise _RefusedError("an array of another class than numpy.ndarray")

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise _RefusedError("an array with an unknown state")
        _, shape, kind, fortran, raw = state
        self.values = _filled(raw, kind, shape, "F" if fortran else "C")


class _Buffer:
    """Stand-in for `numpy.core.numeric._frombuffer`: an array of protocol 5."""

    def __init__(self, raw: Any, kind: Any, shape: Any, order: Any = "C", *_: Any):
        self.values = _filled(raw, kind, shape, "F" if order == "F" else "C")

    def __setstate__(self, state: Any) -> None:
        raise _RefusedError("an array with a second state")


class _Encoded(bytes):
    """Stand-in for `_codecs.encode`: old protocols write bytes as text."""

    def __new__(cls, text: Any, encoding: Any = "latin1") -> _Encoded:
        if not isinstance(text, str) or encoding != "latin1":
            raise _RefusedError("a text that does not stand for bytes")
        return super().__new__(cls, text.encode("latin1"))

    def __setstate__(self, state: Any) -> None:
        raise _RefusedError("bytes with a state")


_NAMES: dict[tuple[str, str], type] = {
    ("numpy", "ndarray"): _ArrayClass,
    ("numpy", "dtype"): _Format,
    ("_codecs", "encode"): _Encoded,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Array for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _Buffer for core in ("core", "_core")},
}


class _Reader(pickle.Unpickler):
    """Unpickler restricted to the names in the table."""

    def find_class(self, module: str, name: str) -> Any:
        found = _NAMES.get((module, name))
        if found is None:
            raise _RefusedError(f"the name {module}.{name}")
        return found


def read_pickled_array(path: str | Path) -> Float[np.ndarray, "..."]:
    """Return the numbers of a pickle as one array, without running any code of the file.

    Arrays of real numbers are accepted, and lists or tuples (nested up to 6 deep) of arrays or numbers that
    form one array, in any protocol.

    Raises:
        RecordingError: the file cannot be read, or is not such a pickle; one line with the reason.
    """
    path = Path(path)
    try:
        data = read_bytes(path, LARGEST_FILE)
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None
    accepted = "accepted are NumPy arrays of numbers, and lists of them"
    try:
        _scan(data)
        values = _numbers(_Reader(io.BytesIO(data)).load(), [allowed(MOST_NUMBERS)], DEEPEST)
        return np.asarray(values, dtype=float)
    except LimitSettingError:
        raise
    except _RefusedError as error:
        more = f"; {MORE}" if isinstance(error, _TooManyError) else ""
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


def _filled(raw: Any, kind: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    """Return an array from its bytes after checking their number against shape and format."""
    if not isinstance(raw, bytes | bytearray) or not isinstance(kind, _Format):
        raise _RefusedError("an array of objects")
    if isinstance(shape, int):
        shape = (shape,)
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise _RefusedError("an array with an impossible shape")
    if max(shape, default=0) > allowed(MOST_NUMBERS):
        raise _TooManyError("too many numbers")
    count = 1
    for n in shape:
        count *= n
    if len(shape) > DEEPEST or count * kind.dtype.itemsize != len(raw):
        raise _RefusedError("an array with more or fewer bytes than its shape says")
    return np.frombuffer(bytes(raw), kind.dtype).reshape(shape, order=order)


def _numbers(given: Any, left: list[int], depth: int) -> Any:
    """Return arrays and numbers in nested lists; `left` counts down the remaining allowance of numbers."""
    values: np.ndarray[Any, Any] | None = None
    if isinstance(given, _Array | _Buffer):
        values = given.values
        if values is None:
            raise _RefusedError("an array without numbers")
        left[0] -= values.size
    elif isinstance(given, int | float) and not isinstance(given, bool):
        left[0] -= 1
    elif isinstance(given, list | tuple):
        if depth == 0:
            raise _RefusedError("lists nested too deeply")
        left[0] -= 1
        if left[0] >= 0:
            return [_numbers(each, left, depth - 1) for each in given]
    else:
        raise _RefusedError(f"a {type(given).__name__.strip('_').lower()}")
    if left[0] < 0:
        raise _TooManyError("too many numbers")
    return float(given) if values is None else values.astype(float)
