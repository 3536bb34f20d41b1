"""JSON texts: parsing without tracebacks, and checksums."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from knode_cosserat._files.reading import ReadError


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text. Raises `ReadError`."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ReadError("its JSON is nested too deeply") from None
    except ValueError:
        raise ReadError("not JSON") from None


def json_checksum(value: Any) -> str:
    """Return the SHA-256 of a value as JSON with sorted keys, in hexadecimal."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
