"""Settings in dataclasses whose fields state once which values are accepted.

    @dataclasses.dataclass(frozen=True)
    class BaseSource(ValidatedSettings):
        error = RecordingError

        topic: Annotated[str, LINE]
        height: Annotated[float, number(-10.0, 10.0, "m")] = 0.0

The statement, a `Rule` in the annotation, serves the check when settings are made, mappings and files, error
messages, and the JSON Schema. A field whose default is None may be None. Fields without a rule are not
checked, and those with `compare=False` are no settings: neither read nor written.
"""

from __future__ import annotations

import dataclasses
import fractions
import functools
import math
from collections.abc import Callable, Collection
from typing import Annotated, Any, ClassVar, NamedTuple, Self, get_origin, get_type_hints

from knode_cosserat._files.yaml_text import did_you_mean, excerpt


class Rule(NamedTuple):
    """Values that a setting accepts.

    Attributes:
        words: the accepted values, for the end of "allowed is …".
        read: function from a value to the value that is kept; None refuses it. It may also raise the error of
            settings within settings.
        schema: JSON Schema of the values in a file.
    """

    words: str
    read: Callable[[Any], Any]
    schema: dict[str, Any]


# rules


FLAG = Rule("true or false", lambda value: value if isinstance(value, bool) else None, {"type": "boolean"})
TEXT = Rule("text", lambda value: value if isinstance(value, str) else None, {"type": "string"})
LINE = Rule(
    "text on one line",
    lambda value: value if isinstance(value, str) and value.strip() and value.isprintable() else None,
    {"type": "string", "minLength": 1},
)


def choice(names: Collection[str]) -> Rule:
    """Return the rule of one of several names."""
    return Rule(
        " or ".join(names),
        lambda value: value if isinstance(value, str) and value in names else None,
        {"enum": list(names)},
    )


def number(low: float, high: float, unit: str = "") -> Rule:
    """Return the rule of a number in a range, also as a fraction in text, such as 3/9."""

    def read(value: Any) -> float | None:
        known = finite_number(value)
        return known if known is not None and low <= known <= high else None

    words = f"a number from {low:g} to {high:g} {unit}".strip()
    return Rule(words, read, {"type": ["number", "string"], "minimum": low, "maximum": high})


def numbers(count: int | None, words: str) -> Rule:
    """Return the rule of a list of numbers; None: any count of them."""

    def read(value: Any) -> tuple[float, ...] | None:
        known = [finite_number(one) for one in items(value)]
        is_whole = None not in known and len(known) == (count or len(known) or None)
        return tuple(known) if is_whole else None  # type: ignore[arg-type]

    size = {} if count is None else {"minItems": count, "maxItems": count}
    return Rule(words, read, {"type": "array", "items": {"type": ["number", "string"]}, **size})


def part(kind: type[ValidatedSettings]) -> Rule:
    """Return the rule of settings within settings, also as a mapping."""

    def read(value: Any) -> Any:
        return kind.from_dict(value) if isinstance(value, dict) else value if type(value) is kind else None

    keys = ", ".join(_defaults(kind))
    return Rule(f"a {kind.__name__}, or a mapping with {keys}", read, kind.json_schema())


def parts(kind: type[ValidatedSettings], words: str) -> Rule:
    """Return the rule of a list of settings within settings."""
    one = part(kind)

    def read(value: Any) -> tuple[Any, ...] | None:
        if not isinstance(value, list | tuple):
            return None
        return tuple(kind.accepted(f"number {k + 1}", entry, one) for k, entry in enumerate(value))

    return Rule(words, read, {"type": "array", "items": one.schema})


def finite_number(value: Any) -> float | None:
    """Return a finite number, also from text such as 3/9; None for anything else."""
    try:
        if isinstance(value, str) and value.count("/") == 1 and len(value) < 40:
            return float(fractions.Fraction(value.replace(" ", "")))
        if isinstance(value, bool | str) or value is None:
            return None
        known = float(value)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        return None
    return known if math.isfinite(known) else None


def items(value: Any) -> list[Any]:
    """Return the items of a list or tuple; none of anything else."""
    return list(value) if isinstance(value, list | tuple) else []


# settings


class ValidatedSettings:
    """Base of settings: a frozen dataclass whose fields are checked when it is made."""

    #: class of the errors; their message is one line
    error: ClassVar[type[Exception]] = ValueError
    #: settings that a mapping may leave out: they take the value of another one
    implied: ClassVar[dict[str, str]] = {}

    def __post_init__(self) -> None:
        for name, default in _defaults(type(self)).items():
            rule = _rules(type(self)).get(name)  # type: ignore[arg-type]
            if rule is not None and (getattr(self, name) is not None or default is not None):
                self.accept(name, rule)

    def accept(self, name: str, rule: Rule) -> None:
        """Store the value that a rule makes of a setting. Raises `error`."""
        object.__setattr__(self, name, self.accepted(name, getattr(self, name), rule))

    @classmethod
    def accepted(cls, name: str, value: Any, rule: Rule) -> Any:
        """Return the value that a rule keeps. Raises `error`."""
        try:
            kept = rule.read(value)
        except cls.error as error:
            raise cls.error(f"{name}: {error}") from None
        if kept is None:
            raise cls.refusal(name, value, rule.words)
        return kept

    @classmethod
    def refusal(cls, name: str, value: Any, words: str) -> Exception:
        """Return the error of a value that is not allowed; `words` are the allowed ones."""
        return cls.error(f"{name} is {excerpt(value)}; allowed is {words}")

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return settings from plain values; missing keys get defaults. Raises `error`."""
        cls.require_known(values)
        implied = {name: values[other] for name, other in cls.implied.items() if other in values}
        values = implied | values
        required = [name for name, default in _defaults(cls).items() if default is dataclasses.MISSING]
        missing = [name for name in required if values.get(name) is None]
        if missing:
            raise cls.error(f"the key {missing[0]} is missing; required is {', '.join(required)}")
        return cls(**values)

    @classmethod
    def require_known(cls, names: Collection[Any]) -> None:
        """Raise `error` if a name is no setting."""
        known = list(_defaults(cls))
        for name in names:
            if name not in known:
                raise cls.error(
                    f"the key {excerpt(name)} is unknown; allowed is {', '.join(known)}"
                    f"{did_you_mean(name, known)}"
                )

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some settings changed. Raises `error`."""
        self.require_known(changes)
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain values for JSON and YAML, without those that are None."""
        named = {name: plain(getattr(self, name)) for name in _defaults(type(self))}
        return {name: value for name, value in named.items() if value is not None}

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema of a mapping that `from_dict` reads."""
        properties, required = dict[str, Any](), []
        for name, default in _defaults(cls).items():
            rule = _rules(cls).get(name)  # type: ignore[arg-type]
            stated = {} if rule is None else rule.schema
            properties[name] = {"anyOf": [stated, {"type": "null"}]} if default is None else stated
            if default is dataclasses.MISSING and name not in cls.implied:
                required.append(name)
        return {
            "type": "object",
            "properties": properties,
            "required": required,
            "additionalProperties": False,
        }


def plain(value: Any) -> Any:
    """Return a setting as a plain value for JSON and YAML."""
    if isinstance(value, ValidatedSettings):
        return value.to_dict()
    return [plain(one) for one in value] if isinstance(value, tuple) else value


def _defaults(kind: Any) -> dict[str, Any]:
    """Return the defaults of all settings by name; `dataclasses.MISSING` for those that are required."""
    return {field.name: field.default for field in dataclasses.fields(kind) if field.compare}


@functools.cache
def _rules(kind: Any) -> dict[str, Rule]:
    hints = get_type_hints(kind, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if get_origin(hint) is Annotated}
