"""A report as HTML page, PDF, CSV, JSON, DCC, AQDEF or QIF. Page and PDF print the same text (`document_data.shown`) and pictures."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.errors import FileFormatError
from abbe.service.files import write_page
from abbe.service.rendering.aqdef import document_dfq
from abbe.service.rendering.certificate import document_dcc
from abbe.service.rendering.document import Document
from abbe.service.rendering.document_data import document_csv, document_json, shown
from abbe.service.rendering.numbers import printable
from abbe.service.rendering.palette import paper_rules, style_rules
from abbe.service.rendering.phrases import ENGLISH, LANGUAGES, phrase
from abbe.service.rendering.qif import document_qif

_MARKS = {"ok": "✔", "open": "◐", "bad": "✖"}
FONT = "Libertinus Serif"
"""The font comes with the typesetter, so that a report looks the same on every computer."""


FONTS_OF = {
    "ja": (("*CJK*", "MPLUS1p*"), ("Noto Sans CJK JP", "M PLUS 1p")),
    "ko": (("*CJK*", "NanumGothic*"), ("Noto Sans CJK KR", "NanumGothic")),
}
"""Files that hold letters of a language, and the fonts' names in them."""
FONTS = (
    "/usr/share/fonts/opentype/noto", "/usr/share/fonts/truetype/noto", "/usr/local/share/fonts", str(Path(__file__).parent / "fonts"),
)  # fmt: skip
"""Folders into which Debian's `fonts-noto-cjk`, people and `deploy/npm_files.py` put such fonts; `ABBE_FONTS` names another folder."""
NO_FONT = "Letters of this report have no font on this computer: install fonts-noto-cjk, or name a folder in ABBE_FONTS."
NOT_KEPT = "This PDF is neither PDF/A (for archives) nor PDF/UA (accessible): {cause}"
IN_ENGLISH = (
    "This report is in English: its language ({lang}) has no font on this computer. Install fonts-noto-cjk, or run deploy/npm_files.py."
)
_EAST = re.compile("[\u1100-\u11ff\u2e80-\ua4cf\uac00-\ud7ff\uf900-\ufaff\uff00-\uffef]")
_OWN = {
    "ja": re.compile("[\u3040-\u30ff\u31f0-\u31ff\uff66-\uff9f]"),
    "ko": re.compile("[\u1100-\u11ff\u3130-\u318f\ua960-\ua97f\uac00-\ud7ff]"),
}
"""Letters that only the fonts of a language hold: kana and Hangul; Chinese characters are in either."""


def document_html(document: Document) -> str:
    """Self-contained page without scripts or requests. Equal reports give equal bytes."""
    mark = "" if document.verdict is None else _MARKS[document.verdict[0]]
    style = Markup(style_rules())  # noqa: S704 - our own constants
    return printable(_environment().get_template("document.html").render(doc=shown(document), mark=mark, style=style))


def document_pdf(document: Document) -> bytes:
    """The report as PDF (A4), set by typst with its bundled fonts, without clock or network. Equal reports give equal bytes.

    It conforms to PDF/UA-1 (ISO 14289-1) and, if a day of measurement is on record, to PDF/A-2a (ISO 19005-2); typst checks both. Where
    that cannot be, as with a letter that no font prints, a remark says why.
    Chinese, Japanese and Korean letters need a font of the computer. Without such a font the report is in English and says
    so; it also says which names it cannot print.
    """
    import typst

    known, remark = {lang: font_folders(lang) for lang in FONTS_OF}, ""
    if document.lang in known and not known[document.lang]:
        remark, document = IN_ENGLISH.format(lang=document.lang), replace(document, lang=ENGLISH)
    data: dict[str, Any] = shown(document, standalone) | {"font": FONT, "day": _day(document)}
    folders = [*dict.fromkeys(folder for found in known.values() for folder in found)]
    text = json.dumps(data, ensure_ascii=False)
    if _EAST.search(text):
        first = sorted(FONTS_OF, key=lambda lang: lang != document.lang)
        data |= {"font": [FONT, *(name for lang in first for name in FONTS_OF[lang][1]), "Noto Sans CJK SC"]}
        remark = remark or ("" if _printable(text, known) else phrase(document.lang, NO_FONT))
    else:
        folders = []
    data["remarks"] = [*filter(None, [remark]), *data["remarks"]]
    template = files("abbe.service.rendering").joinpath("templates", "document.typ").read_bytes()
    inputs = {"data": json.dumps(data, ensure_ascii=False)}
    fonts = typst.Fonts(include_system_fonts=False, font_paths=folders)
    set_by = partial(typst.compile, template, format="pdf", font_paths=fonts, sys_inputs=inputs)
    try:
        made = set_by(pdf_standards=["a-2a", "ua-1"] if data["day"] else ["ua-1"])
    except typst.TypstError as err:
        data["remarks"] = [*data["remarks"], phrase(document.lang, NOT_KEPT).format(cause=str(err).partition("\n")[0])]
        made = set_by(sys_inputs={"data": json.dumps(data, ensure_ascii=False)})
    assert isinstance(made, bytes)  # one document, not one file for each page
    return made


def _day(document: Document) -> str:
    """Last day of the measurement, else the day of a certificate's issue: never the day on which a report is printed again."""
    return document.days[-1] if document.days else document.issued if document.issuer else ""


def _printable(text: str, known: Mapping[str, list[str]]) -> bool:
    """Whether the fonts of these languages hold the East Asian letters of a text."""
    return any(known.values()) and all(known[lang] or not own.search(text) for lang, own in _OWN.items())


def font_folders(lang: str) -> list[str]:
    """Folders of this computer with a font for a language of `FONTS_OF`."""
    named = [folder for folder in (os.environ.get("ABBE_FONTS", ""), *FONTS) if folder]
    return [one for one in named if any(next(Path(one).rglob(pattern), None) is not None for pattern in FONTS_OF[lang][0])]


def standalone(svg: str) -> str:
    """A stand-alone picture: with its XML namespace and fixed colours instead of the page's CSS variables."""
    head, _, rest = svg.partition(">")
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{paper_rules(FONT)}</style>{rest}'


@cache
def _environment() -> Environment:
    loader = PackageLoader("abbe.service.rendering")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    environment.filters["svg"] = Markup
    return environment


FORMS: dict[str, Callable[[Document], str | bytes]] = {
    ".pdf": document_pdf,
    ".html": document_html,
    ".csv": document_csv,
    ".json": document_json,
    ".xml": document_dcc,
    ".dfq": document_dfq,
    ".qif": document_qif,
}
"""Writer of each file extension."""


def default_name(document: Document) -> str:
    """Default file name of a report: its title in letters, digits and dashes."""
    return re.sub(r"[^A-Za-z0-9]+", "-", document.title).strip("-").lower()[:60] + ".pdf"


def form_of(target: Path) -> Callable[[Document], str | bytes]:
    """Return the writer for the extension of a file name.

    Raises
    ------
    FileFormatError
        The extension is not supported.
    """
    try:
        return FORMS[target.suffix.lower()]
    except KeyError:
        raise FileFormatError(f"{target}: a report is written as {', '.join(FORMS)}", "give a file with one of these endings") from None


def write_document(document: Document, target: Path) -> None:
    """Write a report atomically, in the format of the file's extension, and in the language that ``ABBE_LANGUAGE`` names.

    Raises
    ------
    FileFormatError
        The extension or the language is not supported, or the file cannot be written.
    """
    lang = os.environ.get("ABBE_LANGUAGE") or document.lang
    if lang not in LANGUAGES:
        raise FileFormatError(f"ABBE_LANGUAGE: no language {lang!r}", f"give one of {', '.join(LANGUAGES)}")
    write_page(form_of(target)(replace(document, lang=lang)), target)
