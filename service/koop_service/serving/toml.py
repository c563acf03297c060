"""Configuration files: TOML tables into the settings of `config.py`, and the settings as TOML."""

from __future__ import annotations

import dataclasses
import json
import tomllib
import types
import typing
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from koop_service.encoding.catalogue import bundled_or_own
from koop_service.serving.config import ModelRule, ServiceConfig

T = TypeVar("T")


def load_config(path: Path) -> ServiceConfig:
    """The settings in a TOML file; what it leaves out keeps its default.

    Raises ValueError for a file that cannot be read, unknown keys and unfitting values.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} cannot be read as TOML: {error}") from error
    try:
        return _settings(ServiceConfig, tables, "", path.parent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def parse_config(text: str) -> ServiceConfig:
    """The settings that `dump_config` wrote."""
    return _settings(ServiceConfig, tomllib.loads(text), "", Path("/"))


def dump_config(config: ServiceConfig) -> str:
    """The settings as a TOML file for `load_config` in whatever folder; paths become absolute."""
    return "\n".join(_lines(config, "")) + "\n"


def _lines(settings: Any, table: str) -> list[str]:
    """`name = value` of all that is set, then the tables inside; `table` is the heading above."""
    plain: list[str] = [table] if table else []
    tables: list[str] = []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            tables += _lines(value, f"[{field.name}]")
        elif isinstance(value, tuple) and any(map(dataclasses.is_dataclass, value)):
            tables += [line for item in value for line in _lines(item, f"[[{field.name}]]")]
        elif value is not None:
            plain.append(f"{field.name} = {_text(value)}")
    return plain + tables


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, Path):
        value = str(value.absolute())
    # JSON's strings, numbers and booleans are TOML's, but for this one character.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _settings(type_: type[T], table: dict[str, Any], where: str, folder: Path) -> T:
    """An instance of a settings dataclass out of a TOML table."""
    hints = typing.get_type_hints(type_)
    for key in table:
        if key not in hints:
            raise ValueError(_unknown(where + key, key, hints))
    given = {key: _value(hints[key], table[key], where + key, folder) for key in table}
    if typing.cast(object, type_) is ModelRule and "path" in given:
        given["path"] = bundled_or_own(Path(table["path"]), folder)
    try:
        return type_(**given)
    except TypeError:
        fields = dataclasses.fields(typing.cast(Any, type_))
        missing = [f.name for f in fields if f.default is f.default_factory and f.name not in given]
        raise ValueError(f"{where.rstrip('.')} lacks {', '.join(missing)}") from None


def _value(hint: object, value: object, where: str, folder: Path) -> object:
    """`value` as the field's type; paths are relative to the file that names them."""
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for option in options:
        if dataclasses.is_dataclass(option) and isinstance(option, type):
            return _settings(option, _table(value, where), where + ".", folder)
        if option is Path and isinstance(value, str):
            return folder / value
        if typing.get_origin(option) is tuple and isinstance(value, list):
            item = typing.get_args(option)[0]
            return tuple(_value(item, v, f"{where}[{i}]", folder) for i, v in enumerate(value))
        if option is float and type(value) in (int, float):
            return float(typing.cast(float, value))
        if option is type(value) or typing.get_origin(option) is typing.Literal:
            return value
    raise ValueError(f"{where} is {value!r}; expected {_described(options)}")


def _table(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {value!r}; expected a table")
    return value


def _unknown(where: str, key: str, known: dict[str, Any]) -> str:
    close = get_close_matches(key, known, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"known here are {', '.join(known)}"
    return f"unknown key {where!r}; {hint}"


def _described(options: tuple[object, ...]) -> str:
    words = {Path: "a path", int: "a whole number", float: "a number", str: "text", bool: "a bool"}
    names = [
        words.get(option, "a list" if typing.get_origin(option) is tuple else str(option))  # type: ignore[call-overload]
        for option in options
        if option is not type(None)
    ]
    return " or ".join(names)
