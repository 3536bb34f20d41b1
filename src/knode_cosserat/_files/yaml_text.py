"""YAML files of settings, read safely: scalars of YAML 1.2, no duplicate keys; and error texts."""

from __future__ import annotations

import difflib
import re
import reprlib
from pathlib import Path
from typing import Any

import yaml

from knode_cosserat._files.limits import MORE, LimitSettingError, scaled_limit
from knode_cosserat._files.reading import ReadError, read_text
from knode_cosserat.errors import KnodeCosseratError, first_line

#: largest text, and number of values in it with all aliases written out
MOST_CHARACTERS, MOST_VALUES = 2_000_000, 200_000


class YAMLTextError(KnodeCosseratError, ValueError):
    """A text is not YAML, or not a mapping; the message says why and names no file."""

    code = "yaml"


def read_yaml(path: str | Path) -> str:
    """Return the text of a YAML file that is not too large, in UTF-8. Raises `YAMLTextError`."""
    try:
        # a character has up to four bytes
        return read_text(path, 4 * MOST_CHARACTERS, "utf-8-sig")
    except ReadError as error:
        raise YAMLTextError(str(error)) from None


def mapping_of(text: str, keys: str) -> dict[Any, Any]:
    """Return the outermost mapping of a text; `keys` names some of its keys, for the error.

    Raises:
        YAMLTextError: the text is not YAML, or is not a mapping.
    """
    most = scaled_limit(MOST_CHARACTERS)
    if len(text) > most:
        raise YAMLTextError(f"the file has {len(text)} characters; allowed are {most}; {MORE}")
    try:
        content = _content(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" line {mark.line + 1}:" if mark else ""
        raise YAMLTextError(f"{line} not YAML: {error.problem}".strip()) from None
    except (YAMLTextError, LimitSettingError):
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise YAMLTextError(f"not YAML: {first_line(error)}") from None
    if not isinstance(content, dict):
        found = "empty" if content is None else excerpt(content)
        raise YAMLTextError(f"the file is {found}; allowed is a mapping with {keys}")
    return content


def _content(text: str) -> Any:
    """Return the content of a text; what its aliases (*name) repeat is counted before it is constructed."""
    loader = _Loader(text)
    try:
        root = loader.get_single_node()
        if root is None:
            return None
        count, most = _value_count(root, {}), scaled_limit(MOST_VALUES)
        if count > most:
            raise YAMLTextError(f"with its aliases it has {count:.3g} values; allowed are {most}; {MORE}")
        return loader.construct_document(root)
    finally:
        loader.dispose()


def _value_count(node: yaml.Node, known: dict[int, float]) -> float:
    """Return the number of values in a node with all aliases written out; infinite for one within itself."""
    if id(node) not in known:
        known[id(node)] = float("inf")
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        each = (part for pair in parts for part in (pair if isinstance(pair, tuple) else (pair,)))
        known[id(node)] = 1.0 + sum(_value_count(part, known) for part in each)
    return known[id(node)]


def flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    readable = not isinstance(value, str) or value.isprintable()
    listed = yaml.safe_dump([value], default_flow_style=True, width=float("inf"), allow_unicode=readable)
    return str(listed).strip()[1:-1]


def excerpt(value: Any) -> str:
    """Return a value in one line of bounded length: a file can hold very long values."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    short.maxlevel = 3
    text = short.repr(value)
    return text if len(text) <= 250 else text[:250] + "…"


#: end of an error about a name that no class has
UNKNOWN_HERE = "; one of your own is known once its file is imported (--import)"


def did_you_mean(given: Any, known: Any) -> str:
    """Return the hint of an error about an unknown name: the closest known name, or an empty string."""
    close = difflib.get_close_matches(str(given), list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


class _Loader(yaml.SafeLoader):
    """Safe loader with the scalars of YAML 1.2 and no duplicate keys."""

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (yaml.YAMLError, RecursionError):
            raise
        except Exception:  # PyYAML converts a scalar by its tag without checking the text
            problem = f"{excerpt(node.value)} cannot be read as !!{node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {excerpt(key.value)} is there twice", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _first)
