"""What the box knows of its own samples: which number was sent, suppressed or corrupted. The oracle for whoever accounts for them."""

import json
from collections.abc import Sequence
from pathlib import Path

SENT, SUPPRESSED, CORRUPTED = "sent", "suppressed", "corrupted"


class BoxLedger:
    """Fates of sequence numbers, as runs of equal fate: (stream, first, last, fate). Streams count from 0 at the first START."""

    def __init__(self) -> None:
        self.runs: list[list[int | str]] = []
        self.stream = -1

    def start(self) -> None:
        """A new stream begins, numbered from 0."""
        self.stream += 1

    def note(self, seqs: Sequence[int], fate: str) -> None:
        """Successive numbers of the present stream have this fate."""
        if not len(seqs):
            return
        first, last = int(seqs[0]), int(seqs[-1])
        if self.runs and self.runs[-1][0] == self.stream and self.runs[-1][3] == fate and self.runs[-1][2] == first - 1:
            self.runs[-1][2] = last
        else:
            self.runs.append([self.stream, first, last, fate])

    def write(self, path: Path) -> None:
        """Write everything so far as JSON, in one step: a reader never sees half of it."""
        part = path.with_name(path.name + ".part")
        part.write_text(json.dumps(self.runs), encoding="ascii")
        part.replace(path)
