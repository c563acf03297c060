"""What a snapshot holds, checked before a state is built of it.

A snapshot comes off a disk, and what is built of it folds together with other trajectories: one
NaN, or one code of another size, would be refused with everybody's measurements at each fold.
"""

from typing import Any

import numpy as np

from .compiled import Array
from .factor import LARGEST


def whole(name: str, value: Any) -> int:
    """A number, 0 or more."""
    if type(value) is not int or value < 0:
        raise ValueError(f"the snapshot's {name} is {value!r}; expected a whole number, 0 or more")
    return value


def wholes(name: str, values: Any, most: int) -> list[int]:
    """At most `most` different numbers, 0 or more."""
    numbers = [whole(name, value) for value in _list(name, values)]
    if len(numbers) > most or len(set(numbers)) < len(numbers):
        raise ValueError(
            f"the snapshot's {name} are {len(numbers)}, some twice or too many;"
            f" expected {most} different ones at most"
        )
    return numbers


def vectors(name: str, values: Any, *shape: int) -> list[Array]:
    """Copies of arrays of this shape, with numbers that an estimator takes."""
    arrays = [np.array(value, dtype=np.float64) for value in _list(name, values)]
    if not all(array.shape == shape and (np.abs(array) <= LARGEST).all() for array in arrays):
        raise ValueError(
            f"the snapshot's {name} are not all of shape {shape} and at most {LARGEST:g} in size"
        )
    return arrays


def texts(name: str, values: Any) -> list[str]:
    """Strings."""
    found = _list(name, values)
    if not all(isinstance(value, str) for value in found):
        raise ValueError(f"the snapshot's {name} are {found!r}; expected texts")
    return found


def _list(name: str, values: Any) -> list[Any]:
    if not isinstance(values, list | tuple):
        raise ValueError(f"the snapshot's {name} are {values!r}; expected a list")
    return list(values)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
