"""From JSON to frozen dataclasses. Fields that the client does not know stay in ``raw``: the contract only grows."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import types
import typing
from dataclasses import dataclass, field
from typing import Any, Self

from specimap_client._errors import UnexpectedAnswer


@dataclass(frozen=True, kw_only=True)
class Model:
    """Root of what the service answers; ``raw`` is the answer as it came."""

    raw: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, data: object) -> Self:
        """The model of a JSON object.

        Raises:
            UnexpectedAnswer: a field is absent or of another type.
        """
        if not isinstance(data, dict):
            raise UnexpectedAnswer(f"{cls.__name__}: the answer is no JSON object.")
        values: dict[str, Any] = {"raw": data}
        for name, (kind, required) in _fields(typing.cast(Any, cls)).items():
            if name in data:
                values[name] = _decoded(kind, data[name], f"{cls.__name__}.{name}")
            elif required:
                raise UnexpectedAnswer(f"{cls.__name__}: the answer has no {name}.")
        return cls(**values)


@functools.cache
def _fields(model: type[Any]) -> dict[str, tuple[Any, bool]]:
    """Type of each field, and whether it must be there."""
    hints = typing.get_type_hints(model)
    return {
        f.name: (hints[f.name], f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING)
        for f in dataclasses.fields(model)
        if f.name != "raw" and not f.name.startswith("_")
    }


def _decoded(kind: Any, value: Any, where: str) -> Any:
    if kind is Any:
        return value
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType or origin is typing.Union:
        if value is None:
            return None
        (kind,) = (a for a in arguments if a is not types.NoneType)
        return _decoded(kind, value, where)
    try:
        if origin is tuple:
            return tuple(_decoded(arguments[0], item, where) for item in value)
        if origin is dict:
            return {str(k): _decoded(arguments[1], v, where) for k, v in value.items()}
        if isinstance(kind, type) and issubclass(kind, Model):
            return kind.of(value)
        if kind is datetime.datetime:
            return datetime.datetime.fromisoformat(value)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            return float(value)
    except (TypeError, ValueError, AttributeError) as error:
        raise UnexpectedAnswer(f"{where}: {type(value).__name__} is not what was expected.") from error
    if not isinstance(value, kind):
        raise UnexpectedAnswer(f"{where}: {type(value).__name__} is not {kind.__name__}.")
    return value
