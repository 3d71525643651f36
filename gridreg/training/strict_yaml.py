"""YAML without its traps: the scalars of YAML 1.2, no anchors, no duplicate keys, and the line of every key.

PyYAML follows YAML 1.1, where ``8e-5`` is text, ``off`` is a truth value, ``010`` is eight and ``12:30`` is
750. The loader here derives from PyYAML's ``SafeLoader`` (which builds plain data only and never runs
anything) and reads numbers, truth values and null as YAML 1.2 does; the dumper quotes whatever either version
would misread.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NoReturn

import yaml

from gridreg.errors import ConfigError, KeyPath
from gridreg.scenes.files import read_text

_RESOLVERS = [
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+(?:_[0-9]+)*|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", "-+."),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
]


@dataclass(frozen=True)
class Document:
    """Plain data, and where in its source each piece stands.

    Args:
        data: dicts, lists, text, numbers, ``None``.
        source: names the data in errors.
        lines: the line (from 1) of each key or list item, where the source has lines.
    """

    data: Any
    source: str = "config"
    lines: dict[KeyPath, int] = field(default_factory=dict)

    def where(self, path: KeyPath) -> str:
        """``source:line`` of what stands at ``path``, or of the nearest key above it.

        A key may itself be dotted: ``("set", "train", "rays")`` finds ``set: {train.rays: 512}``.
        """
        for length in range(len(path), -1, -1):
            dotted = (*path[:length], ".".join(map(str, path[length:])))
            for known in (dotted, path[:length]):
                if known in self.lines:
                    return f"{self.source}:{self.lines[known]}"
        return self.source

    def error(self, path: KeyPath, problem: str) -> ConfigError:
        """An error that names source, line and key."""
        return ConfigError(path, problem, self.where(path))

    @contextmanager
    def locating(self, *path: str | int) -> Iterator[None]:
        """Give an `InputError`, or another ``ValueError``, raised inside the place of ``path``.

        What a `ConfigError` says of keys below that place is kept.
        """
        try:
            yield
        except ConfigError as error:
            raise self.error((*path, *error.path), error.problem) from error
        except ValueError as error:
            raise self.error(path, str(error)) from error


def read_yaml(path: str | os.PathLike[str]) -> Document:
    """Read a YAML file; an empty one holds ``None``.

    Raises:
        InputError: if the file cannot be read, is not YAML, or uses what is refused here (anchors and
            aliases, tags, duplicate keys, keys that are not text); the text names file and line.
    """
    return parse_yaml(read_text(path, "YAML file"), os.fspath(path))


def parse_yaml(text: str, source: str = "YAML") -> Document:
    """Parse YAML text; ``source`` names it in errors.

    Raises:
        InputError: as ``read_yaml``.

    Example:
        >>> parse_yaml("weight: 8e-5\\nname: off").data
        {'weight': 8e-05, 'name': 'off'}
    """
    loader: _Loader | None = None
    try:
        # The constructor already looks at the characters, so it belongs inside.
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return Document(None, source)
        lines: dict[KeyPath, int] = {}
        _collect_lines(node, (), lines, source)
        return Document(loader.construct_document(node), source, lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{source}:{mark.line + 1}" if mark else source
        problem = " ".join(part for part in (error.context, error.problem) if part)
        raise ConfigError((), f"not valid YAML: {_flat(problem)}", where) from error
    except yaml.YAMLError as error:
        raise ConfigError((), f"not valid YAML: {_flat(str(error))}", source) from error
    except ConfigError:
        raise
    except ValueError as error:
        # Python refuses integers of more than some thousand digits.
        raise ConfigError((), f"not valid YAML: {_flat(str(error))}", source) from error
    except RecursionError:
        raise ConfigError((), "nested too deeply to be a configuration", source) from None
    finally:
        if loader is not None:
            loader.dispose()


def dump_yaml(data: Any) -> str:
    """Plain data (dict, list, tuple, text, numbers, ``None``) as YAML that ``parse_yaml`` reads back equal.

    Keys keep their order; tuples become lists; innermost lists and mappings stand on one line.

    Raises:
        yaml.representer.RepresenterError: if ``data`` holds anything that is not plain.
    """
    text: str = yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
    return text


class _Loader(yaml.SafeLoader):
    """SafeLoader with YAML 1.2 scalars and without aliases."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (PyYAML's own mechanism)

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """The next node; aliases, anchors and tags are refused."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            self._refuse("anchors and aliases (& and *) are not supported; write the value out", event)
        if getattr(event, "tag", None) not in (None, "!"):
            self._refuse(f"the tag {event.tag} is not supported; write plain values", event)
        return super().compose_node(parent, index)

    def _refuse(self, problem: str, event: Any) -> NoReturn:
        raise yaml.constructor.ConstructorError(None, None, problem, event.start_mark)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes what YAML 1.1 or 1.2 would read as something else, and writes no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write out what stands in several places."""
        return True

    def represent_text(self, data: str) -> yaml.ScalarNode:
        """The text as a scalar that reads back as it is."""
        # Only the double-quoted style keeps every line break (U+0085, U+2028) and control character.
        style = None if data.isprintable() else '"'
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=style)


_Dumper.add_representer(str, _Dumper.represent_text)


def _construct_int(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = str(loader.construct_scalar(node)).replace("_", "")
    return int(text, 0) if text[:2] in ("0o", "0x") else int(text, 10)


def _construct_float(loader: _Loader, node: yaml.ScalarNode) -> float:
    # ".inf" and ".nan" are Python's words but for the dot; "1." and ".5" are not affected.
    return float(re.sub(r"\.(?=[a-zA-Z])", "", str(loader.construct_scalar(node))))


for _tag, _pattern, _first in _RESOLVERS:
    for _class in (_Loader, _Dumper):
        _regexp = re.compile(f"^(?:{_pattern})$")
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _regexp, list(_first))
_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)


def _collect_lines(node: yaml.Node, path: KeyPath, lines: dict[KeyPath, int], source: str) -> None:
    """Fill ``lines`` and refuse keys that are not text or stand twice."""
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            _collect_lines(item, (*path, index), lines, source)
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.tag != "tag:yaml.org,2002:str":
                found = _flat(str(key.value)) if isinstance(key, yaml.ScalarNode) else "a list or mapping"
                problem = f"key {found}: expected text (quote it if it is meant so)"
                raise ConfigError(path, problem, f"{source}:{line}")
            inner = (*path, key.value)
            if inner in lines:
                problem = f"stands twice, first in line {lines[inner]}"
                raise ConfigError((*path, key.value), problem, f"{source}:{line}")
            lines[inner] = line
            _collect_lines(value, inner, lines, source)


def _flat(text: str) -> str:
    return " ".join(text.split())
