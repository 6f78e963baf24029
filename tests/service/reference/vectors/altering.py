"""One number of a vector file changed in its eighth significant digit: does the reader notice?"""

import copy
import json
import random

from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import VectorCase
from abbe.service.reference.vector_results import READERS

FACTOR = 1 + 5e-8


def load(shared, name):
    return json.loads((shared / "vectors" / f"{name}.json").read_text())


def numbers(doc, path=()):
    """Paths of all numbers but zero, which no factor changes."""
    if isinstance(doc, dict | list):
        for key, part in doc.items() if isinstance(doc, dict) else enumerate(doc):
            yield from numbers(part, (*path, key))
    elif isinstance(doc, int | float) and not isinstance(doc, bool) and doc != 0:
        yield path


def value(doc, path):
    for key in path:
        doc = doc[key]
    return doc


def changed(doc, path, factor=FACTOR):
    out = copy.deepcopy(doc)
    value(out, path[:-1])[path[-1]] *= factor
    return out


def read(name, doc):
    """What the reader of a file says about such a document."""
    case, checks = VectorCase(doc, (name,)), Checks(name)
    READERS[f"{name}.json"](case, checks)
    checks.unread = case.unread()
    return checks


def noticed(name, doc) -> bool:
    try:
        return not read(name, doc).ok
    except FileFormatError:
        return True


def missed(shared, name, which, *, count, seed):
    """Paths of a random sample of the numbers that ``which`` accepts, whose alteration goes unnoticed; below 1e-12 all is rounding."""
    doc = load(shared, name)
    candidates = [p for p in numbers(doc) if which(p) and abs(value(doc, p)) > 1e-12 and "noise" not in str(p[-1])]
    drawn = random.Random(seed).sample(candidates, min(count, len(candidates)))
    return [path for path in drawn if not noticed(name, changed(doc, path))]
