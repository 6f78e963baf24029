"""Access to a vector file that records which numbers were read, to find those that no comparison uses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.service.errors import FileFormatError

Path = tuple[str | int, ...]
Shape = tuple[int | None, ...]


LAYOUT = "compare the file with the layout of the reference vectors"


class VectorResult(set[Path]):
    """Records which parts of a file were read: the paths of all numbers, and in ``last`` the path of the latest part, for messages."""

    last: Path = ()


class VectorCase:
    """One object, list or number of a vector file.

    Parameters
    ----------
    value : JSON value
    path : tuple of keys and indices from the top of the file, the file name first
    read : VectorResult, shared by all parts of a file
    """

    def __init__(self, value: Any, path: Path, read: VectorResult | None = None) -> None:
        self.value = value
        self.path = path
        self._read = VectorResult() if read is None else read

    @property
    def label(self) -> str:
        """Path of this part for messages."""
        return "/".join(str(p) for p in self.path)

    @property
    def last(self) -> str:
        """Path of the part of the file accessed last."""
        return "/".join(str(p) for p in self._read.last or self.path)

    def at(self, *keys: str | int) -> VectorCase:
        """Return the part under nested keys or indices; raises `FileFormatError` if it is missing."""
        here: Any = self.value
        for k, key in enumerate(keys):
            try:
                here = here[key]
            except (KeyError, IndexError, TypeError):
                inside = "/".join(str(p) for p in (*self.path, *keys[:k]))
                raise FileFormatError(f"{inside}: {key!r} is missing", LAYOUT) from None
        self._read.last = (*self.path, *keys)
        return VectorCase(here, (*self.path, *keys), self._read)

    def has(self, key: str) -> bool:
        """Return whether this part is an object that has ``key``."""
        return isinstance(self.value, dict) and key in self.value

    def keys(self) -> list[str]:
        """Return the keys of an object, in file order.

        Raises
        ------
        FileFormatError
            This part is not an object, or an empty one, for which the comparison would be skipped silently.
        """
        if not isinstance(self.value, dict):
            raise FileFormatError(f"{self.label}: expected an object, got {type(self.value).__name__}", LAYOUT)
        if not self.value:
            raise FileFormatError(f"{self.label}: the object is empty, expected at least one key", LAYOUT)
        return list(self.value)

    def items(self) -> Iterator[tuple[str, VectorCase]]:
        """Yield keys and parts of a non-empty object, in file order."""
        for key in self.keys():
            yield key, self.at(key)

    def named(self, *names: str) -> Iterator[tuple[str, VectorCase]]:
        """Yield keys and parts, in the order of ``names``, of an object that must have exactly these keys.

        Raises
        ------
        FileFormatError
            This part is not an object, or a key is missing or unknown.
        """
        unknown = [key for key in self.keys() if key not in names]
        if unknown:
            raise FileFormatError(f"{self.label}: key {unknown[0]!r} is unknown", f"known: {', '.join(names)}")
        for name in names:
            yield name, self.at(name)

    def parts(self, *, or_none: bool = False) -> list[VectorCase]:
        """Return the elements of a list.

        Raises
        ------
        FileFormatError
            This part is not a list, or (unless ``or_none``) an empty one, for which the comparison would be skipped silently.
        """
        if not isinstance(self.value, list):
            raise FileFormatError(f"{self.label}: expected a list, got {type(self.value).__name__}", LAYOUT)
        if not self.value and not or_none:
            raise FileFormatError(f"{self.label}: the list is empty, expected at least one element", LAYOUT)
        return [self.at(k) for k in range(len(self.value))]

    def number(self, *keys: str | int) -> float:
        """Return one finite number under nested keys; raises `FileFormatError` if it is missing or not finite."""
        part = self.at(*keys) if keys else self
        values = list(_leaves(part.value, part.path))
        if len(values) != 1 or isinstance(part.value, (list, dict)):
            raise FileFormatError(f"{part.label}: expected one number", LAYOUT)
        return float(part.array())

    def whole(self, *keys: str | int) -> int:
        """Return one whole number under nested keys; raises `FileFormatError` if it is missing or has a fraction."""
        part = self.at(*keys)
        value = part.number()
        if value != int(value):
            raise FileFormatError(f"{part.label}: expected a whole number, got {value!r}", LAYOUT)
        return int(value)

    def array(self, *keys: str | int, shape: Shape | None = None) -> F1:
        """Return the finite numbers of a (nested) list as an array of float64.

        Parameters
        ----------
        *keys : str or int
            Path of the list.
        shape : tuple, optional
            Required shape, with None for any length.

        Raises
        ------
        FileFormatError
            The list is missing, empty, ragged, of another shape, or holds something that is not a finite number.
        """
        part = self.at(*keys) if keys else self
        for path, value in _leaves(part.value, part.path):
            _demand_number(path, value)
            self._read.add(path)
        try:
            found = np.asarray(part.value, dtype=np.float64)
        except (TypeError, ValueError):
            raise FileFormatError(f"{part.label}: expected numbers in rows of equal length", LAYOUT) from None
        if not found.size:
            raise FileFormatError(f"{part.label}: expected at least one number, got none", LAYOUT)
        if shape is not None and (
            found.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, found.shape, strict=True))
        ):
            wanted = " x ".join("n" if n is None else str(n) for n in shape)
            raise FileFormatError(f"{part.label}: expected {wanted} numbers, got shape {found.shape}", LAYOUT)
        return found

    def text(self, *keys: str | int) -> str:
        """Return a string under nested keys; raises `FileFormatError` if it is missing or not a string."""
        part = self.at(*keys) if keys else self
        if not isinstance(part.value, str):
            raise FileFormatError(f"{part.label}: expected a text, got {type(part.value).__name__}", LAYOUT)
        return part.value

    def skip(self) -> int:
        """Mark all numbers of this part as read without a comparison, and return their count; only for `Checks.leave_out`.

        Raises
        ------
        FileFormatError
            A number is not finite.
        """
        numbers = [(path, value) for path, value in _leaves(self.value, self.path) if not isinstance(value, str | None)]
        if not numbers:
            raise FileFormatError(f"{self.label}: expected numbers", LAYOUT)
        for path, value in numbers:
            _demand_number(path, value)
            self._read.add(path)
        return len(numbers)

    def unread(self) -> list[str]:
        """Return the paths of the unread numbers of this part."""
        return [
            "/".join(map(str, path))
            for path, value in _leaves(self.value, self.path)
            if not isinstance(value, str | None) and path not in self._read
        ]


def _demand_number(path: Path, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise FileFormatError(f"{'/'.join(map(str, path))}: expected a finite number, got {value!r}", "restore the file")


def _leaves(value: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _leaves(part, (*path, key))
    elif isinstance(value, list):
        for k, part in enumerate(value):
            yield from _leaves(part, (*path, k))
    else:
        yield path, value
