"""What is called printed stands in print, digit by digit."""

import re

import pytest

from abbe.service.reference.paper_results import results

FILES = {"pahk": "000_*.txt", "kwon": "001_*.txt", "yang": "002_*.txt", "wang": "004_*.txt"}


def plain(text: str) -> str:
    """Powers of ten and minus signs as a computer writes them; thousands, markup and spaces left alone."""
    text = text.replace("−", "-").replace("–", "-")
    text = re.sub(r"\s*(?:×|\\times)\s*10\s*\^?\s*\{?\s*(-?\d+)\s*\}?", r"e\1", text)
    return text.lower()


def stands(number: str, text: str) -> bool:
    """Whether the number stands there as a whole number of its own; a leading minus may be written apart from its digits."""
    number = number.lower().replace("e-0", "e-")
    text = text.replace("e-0", "e-")
    digits = re.escape(number.removeprefix("-"))
    return re.search(rf"(?<![\d.]){digits}(?![\de]|\.\d)", text) is not None


def test_a_number_that_is_not_printed_is_noticed():
    text = plain("λ=(0.4,1.1,1.7), −0.370, 4.240×10^{-2}, 82.")
    assert all(stands(n, text) for n in ("0.4", "1.7", "-0.370", "4.240e-2", "82"))
    assert not any(stands(n, text) for n in ("0.400000", "1.70", "0.37", "4.24e-2", "4.240", "2.0", "240e-2"))


@pytest.mark.parametrize("paper", list(FILES))
def test_every_printed_text_stands_in_its_source(shared, paper):
    (file,) = (shared / "papers").glob(FILES[paper])
    sources = {"paper": plain(file.read_text()), "math.md": plain((shared / "spec/math.md").read_text())}
    (found,) = results((paper,))
    missing = [(r.source, r.location, r.quantity, r.expected.text) for r in found.numbers if not stands(r.expected.text, sources[r.source])]
    assert not missing
