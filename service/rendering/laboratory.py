"""A report as a calibration certificate on paper: facts that ISO/IEC 17025 (7.8.2, 7.8.4) requires beside the results, and missing
facts."""

from __future__ import annotations

from typing import Any

from abbe.service.domain.machine import Issuer
from abbe.service.rendering.document import Document
from abbe.service.rendering.phrases import ENGLISH, phrase

TITLE = "Calibration certificate"
OF_MEASUREMENTS = ("run", "campaign", "verification")
WHOLE = "This certificate may be reproduced in full only, unless the laboratory has approved otherwise in writing."
ONLY = "The results relate only to the item identified above, as it was measured, at the place and on the days stated."
TRANSLATION = "This is a translation; the English certificate of the same number counts."
INTERVAL = "No calibration interval is recommended."
PLACES = {"laboratory": "in the laboratory", "customer": "at the customer's", "laboratoryBranch": "in a branch of the laboratory"}


def certificate_of(document: Document, digest: str) -> dict[str, Any] | None:
    """Return number, facts, statements and missing facts of a certificate; None without a laboratory or without a measurement.

    Values that Abbe writes are in the document's language; what people wrote stays as it is.
    ``digest``: SHA-256 of the report. The number is made from it, so equal results have the same number.
    """
    issuer = document.issuer
    if issuer is None or document.kind not in OF_MEASUREMENTS:
        return None
    number = issuer.prefix + "-".join(digest[k : k + 4] for k in (0, 4, 8))
    facts = {"Number": number, **_parties(document.lang, issuer), **_what(document, issuer), "Authorised by": issuer.person}
    pairs = [{"name": name, "value": value} for name, value in facts.items() if value]
    missing = _missing(document, issuer)
    return {
        "title": TITLE,
        "number": number,
        "facts": pairs,
        "statements": [_traceable(document), ONLY, INTERVAL, WHOLE, *([] if document.lang == ENGLISH else [TRANSLATION])],
        "missing": missing,
    }


def _parties(lang: str, issuer: Issuer) -> dict[str, str]:
    town = f"{issuer.city}, {issuer.country}"
    return {
        "Laboratory": ", ".join(one for one in (issuer.laboratory, issuer.address, town) if one),
        "Accreditation": issuer.accreditation or phrase(lang, "none is claimed"),
        "Customer": ", ".join(one for one in (issuer.customer or issuer.laboratory, issuer.customer_address) if one),
    }


def _what(document: Document, issuer: Issuer) -> dict[str, str]:
    item, days, lang = document.item, document.days, document.lang
    named = [document.about.get("Machine", "")]
    if item is not None:
        named += [item.maker, item.model, phrase(lang, "serial {n}").format(n=item.serial) if item.serial else ""]
    place = ", ".join(one for one in (phrase(lang, PLACES.get(issuer.place, "")), "" if item is None else item.place) if one)
    when = "" if days is None else days[0] if days[0] == days[1] else phrase(lang, f"{days[0]} to {days[1]}")
    methods = ", ".join(dict.fromkeys(phrase(lang, figure.method) for figure in document.figures if figure.method))
    return {
        "Item": ", ".join(one for one in named if one),
        "Place of calibration": place,
        "Calibrated on": when,
        "Issued on": document.issued,
        "Procedure": "; ".join(one for one in (issuer.procedure, methods) if one),
    }


def _missing(document: Document, issuer: Issuer) -> list[str]:
    """Facts that ISO/IEC 17025 requires and that are not stated."""
    item = document.item
    wanted = [
        (issuer.address, "address of the laboratory ([issuer] address)", "7.8.2.1 b"),
        (issuer.customer_address or not issuer.customer, "address of the customer ([issuer] customer_address)", "7.8.2.1 e"),
        (item is not None and item.serial, "serial number of the machine ([item] serial)", "7.8.2.1 g"),
        (document.days is not None, "day of the calibration (--measured-on)", "7.8.2.1 i"),
        (_identified(document), "serial and certificate of each instrument ([calibration] ballbar_is, laser_is)", "7.8.4.1 c"),
    ]
    return [f"{what}: {clause}" for there, what, clause in wanted if not there]


def _identified(document: Document) -> bool:
    return bool(document.instruments) and all(";" in one.certificate for one in document.instruments)


def _traceable(document: Document) -> str:
    if not _identified(document):
        return "Metrological traceability is not stated: not every instrument is identified with its certificate."
    text = "The results are traceable to the SI through the certificates of the instruments listed under Instruments"
    if any("not calibrated" in one.known for one in document.instruments):
        return f"{text}, except results that rest on a length listed as not calibrated."
    return f"{text}."
