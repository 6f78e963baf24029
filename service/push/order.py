"""What a push is asked to do: one image, its independent meaning, and under which rules. All of it goes into the first journal entry."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Doc


@dataclass(frozen=True, slots=True)
class OperationOrder:
    """A table that shall be brought into a controller.

    Parameters
    ----------
    machine : str
        Which machine.
    image : bytes
        As the controller will hold it, with its CRC-32 ``crc``.
    meaning : str
        Digest of what the table means, computed from the tables and not from the image (`abbe.service.push.semantic_digest`).
    limits : str
        Digest of the limits that it was checked against.
    owner : int
        Owner id of the lease, u32, low 16 bits 0: those count the takings.
    level : int
        Capability level of the controller (`abbe.service.push.levels`).
    attended : bool
        A person who may approve is at the machine.
    chunk_words : int
        Registers of one write, even.
    table : int
        Number of the table in the store; 0 if it is not kept there.
    control : str
        Identity of the control (`abbe.service.devices.urls.control_of`); empty: not known.
    process : dict
        Which process pushes (`abbe.service.domain.owner.Owner`): no other process recovers while it lives.
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
        """What the journal keeps of it."""
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
