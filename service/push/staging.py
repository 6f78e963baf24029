"""Staging of an image in the inactive bank: write it chunk by chunk, seal it, read it back twice in full. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.drivers.api import BankState
from abbe.service.push.operations import Knowledge, Operation, OperationKind, Refused, Truth

BRACKETS = 4
REWRITES_PER_CHUNK = 2
REWRITES = 5
SEALS = 2


@dataclass(frozen=True, slots=True)
class Image:
    """An image to stage. ``gen``: generation when writing was permitted. ``in_force``: CRC of the table that stays active."""

    bank: int
    data: bytes
    crc: int
    semantic_digest: str
    owner: int
    gen: int
    boot: int
    in_force: int
    chunk_words: int


@dataclass(frozen=True, slots=True)
class Failed:
    """The reason why staging failed. ``foreign``: another program has written into the bank."""

    why: str
    foreign: bool = False


@dataclass(frozen=True, slots=True)
class Coherent:
    """A closed bracket of reads: nothing changed between its first look and its last, ``truth``."""

    truth: Truth


def bracket(known: Knowledge, bank: int, count: int, *, again: bool) -> Operation | Coherent | None:
    """Next operation of a full read between two looks; None: the looks differ, so something changed in between.

    ``count``: registers to read, 0 for the length in the image's header. ``again``: read a second time and decode independently.
    """
    if known.start is None:
        return Operation(OperationKind.LOOK, mark=True)
    if known.image is None:
        return Operation(OperationKind.READ, bank=bank, count=count)
    if again and known.decoded_digest is None:
        return Operation(OperationKind.READ_AGAIN, bank=bank, count=len(known.image) // 2)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    same = (known.start.boot, known.start.gen, known.start.active) == (known.truth.boot, known.truth.gen, known.truth.active)
    return Coherent(known.truth) if same else None


def stage(image: Image, known: Knowledge) -> Operation | Failed | Coherent:
    """Next operation of staging, or its end.

    Coherent: the bank is sealed, and both read-backs within one generation agree in bytes and in meaning.
    """
    if isinstance(known.verdict, Refused):
        return Failed(f"the controller refused: {known.verdict.text}")
    words = len(image.data) // 2
    if known.chunk * image.chunk_words < words:
        return _chunk(image, known)
    if not known.sealed:
        return Operation(OperationKind.SEAL, bank=image.bank, owner=image.owner)
    return _read_back(image, known, words)


def _chunk(image: Image, known: Knowledge) -> Operation | Failed:
    first = known.chunk * image.chunk_words
    data = image.data[2 * first : 2 * (first + image.chunk_words)]
    write = Operation(OperationKind.WRITE, bank=image.bank, first=first, count=len(data) // 2, data=data)
    if not known.wrote:
        return write
    if not known.differs:
        return Operation(OperationKind.READ_CHUNK, bank=image.bank, first=first, count=len(data) // 2, data=data)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    # Overwrite foreign content only while the generation proves that no other program has written.
    if (known.truth.boot, known.truth.gen) != (image.boot, image.gen + known.written):
        return Failed("another program wrote into the bank, or the controller restarted; the bank was left unchanged", foreign=True)
    if known.rewrites_here >= REWRITES_PER_CHUNK or known.rewrites >= REWRITES:
        return Failed(f"registers {first}.. do not hold what was written, also after {known.rewrites_here} repeats")
    return write


def _read_back(image: Image, known: Knowledge, words: int) -> Operation | Failed | Coherent:
    step = bracket(known, image.bank, words, again=True)
    if isinstance(step, Operation):
        return step
    if step is None:
        return _again(known, "the generation changed while the bank was read back")
    truth = step.truth
    if truth.boot != image.boot:
        return Failed("the controller restarted during staging")
    if truth.crc[1 - image.bank] != image.in_force or truth.active == image.bank:
        return Failed("the table in force changed during staging")
    if truth.states[image.bank] is not BankState.SEALED and known.sealed < SEALS:
        return Operation(OperationKind.SEAL, bank=image.bank, owner=image.owner)
    if known.image != image.data or known.decoded_digest != image.semantic_digest:
        what = "bytes" if known.image != image.data else "meaning (independent decoder)"
        return _again(known, f"the bank does not hold what was sent: {what}")
    if truth.states[image.bank] is not BankState.SEALED or truth.crc[image.bank] != image.crc:
        return Failed(f"sealed with CRC {truth.crc[image.bank]:08X}, sent {image.crc:08X}")
    return step


def _again(known: Knowledge, why: str) -> Operation | Failed:
    return Operation(OperationKind.LOOK, mark=True) if known.brackets < BRACKETS else Failed(why)
