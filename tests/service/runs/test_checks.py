"""JSON that Python's own reader takes silently or ends in a traceback."""

from pathlib import Path

import pytest

from abbe.service.errors import FileFormatError
from abbe.service.runs.checks import strict_json

FILE = Path("a.json")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"a": {"b": 1, "b": 2}}', "key 'b' appears twice"),
        ("[" * 200_000, "nested too deeply"),
        ("9" * 6000, "an integer of 6000 digits"),
        ("-" + "9" * 309, "an integer of 309 digits"),
        ("[NaN]", "finite numbers, got NaN"),
        ("[-Infinity]", "got -Infinity"),
        ("[1e999]", "got 1e999"),
        ("{", "line 1, column 2: not JSON"),
    ],
)
def test_each_is_one_error_that_names_the_file(text, says):
    with pytest.raises(FileFormatError, match=says) as error:
        strict_json(text, FILE)
    assert str(error.value).startswith("a.json: ")
    assert "\n" not in str(error.value)


def test_what_is_allowed_comes_as_it_is():
    assert strict_json('{"b": [1, -2.5, null, true], "a": {"b": "c"}}', FILE) == {"b": [1, -2.5, None, True], "a": {"b": "c"}}
    assert strict_json("-" + "9" * 308, FILE) == -int("9" * 308)


def test_callers_that_say_themselves_where_a_number_is_not_finite():
    assert str(strict_json("[NaN, 1e999]", FILE, finite=False)) == "[nan, inf]"
