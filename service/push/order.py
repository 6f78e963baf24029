"""The order of a push: one image, its semantic digest, and the rules. All of it goes into the first journal entry."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Doc


@dataclass(frozen=True, slots=True)
class OperationOrder:
    """A table to be pushed into a controller.

    Parameters
    ----------
    machine : str
        Name of the machine.
    image : bytes
        As the controller will hold it, with its CRC-32 ``crc``.
    meaning : str
        Semantic digest, computed from the tables and not from the image (`abbe.service.push.semantic_digest`).
    limits : str
        Digest of the limits that it was checked against.
    owner : int
        Owner id of the lease, u32, low 16 bits 0: those count the leases of one push.
    level : int
        Capability level of the controller (`abbe.service.push.levels`).
    attended : bool
        A person who may approve is at the machine.
    chunk_words : int
        Registers of one write, even.
    table : int
        Id of the table in the store; 0 if it is not stored.
    control : str
        Identity of the control (`abbe.service.devices.urls.control_of`); empty: unknown.
    process : dict
        The pushing process (`abbe.service.domain.owner.Owner`): while it lives, no other process recovers.
    """

    machine: str
    image: bytes
    crc: int
    meaning: str
    limits: str
    owner: int
    level: int = 3
    attended: bool = False
    chunk_words: int = 100
    table: int = 0
    control: str = ""
    process: Doc = field(default_factory=dict)

    def doc(self) -> Doc:
        """The document that the journal keeps."""
        return {
            "machine": self.machine,
            "image": self.image.hex(),
            "crc": self.crc,
            "meaning": self.meaning,
            "limits": self.limits,
            "owner": self.owner,
            "level": self.level,
            "attended": self.attended,
            "chunk_words": self.chunk_words,
            "table": self.table,
            "control": self.control,
            "process": self.process,
        }
