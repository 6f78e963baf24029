"""Import and export of campaign folders. An import checks everything before it stores anything; an export is renamed into place."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import CampaignRecord, ImportedRun, RunRecord
from abbe.service.domain.run import Run
from abbe.service.domain.run_file import ASSUMED_MODEL, CAMPAIGN_FORMAT, CampaignFile, ErrorsFile, RunEntry
from abbe.service.errors import FileFormatError, StoreError
from abbe.service.runs.checks import check, check_run, read_json
from abbe.service.runs.chunks import JSON_CODEC, encode_json
from abbe.service.runs.columns import pack_columns, run_document, single_run, whole_run
from abbe.service.storage.store import Store

CAMPAIGN_FILE = "campaign.json"

COMPLETE = "complete"
Images = Callable[[int], bytes | None]


def table_file(crc: int) -> str:
    """Return the name of the file that holds the image of a compensation table beside the runs that were measured with it."""
    return f"table-{crc:08X}.bin"


def no_image(crc: int) -> bytes | None:
    """Return None: no table is known."""
    return None


@dataclass(frozen=True, slots=True)
class FolderContent:
    """Content of a checked campaign folder: ``campaign.json``, its runs in order, and the errors file of its ``current_model``.

    ``run_files``: the documents of ``runs`` as they stand in the files, for an import that keeps unknown keys. ``tables``: images of the
    compensation tables that acted during the runs, by CRC, as far as the folder holds them.
    """

    campaign: Doc
    run_files: list[Doc]
    runs: list[Run]
    errors: Doc | None
    tables: dict[int, bytes]

    @property
    def name(self) -> str:
        """Name of the campaign."""
        return str(self.campaign["campaign"])

    @property
    def machine(self) -> Doc:
        """The machine object."""
        machine: Doc = self.campaign["machine"]
        return machine

    @property
    def machine_name(self) -> str:
        """Name of the machine, or of the campaign."""
        return self.machine.get("name") or self.name

    @property
    def entries(self) -> list[Doc]:
        """The entries of the runs (`RunEntry`), as they stand in the file."""
        entries: list[Doc] = self.campaign["runs"]
        return entries


def read_folder(folder: Path) -> FolderContent:
    """Read and check a folder with ``campaign.json`` and its run files.

    Raises
    ------
    FileFormatError
        A file has a mistake; the first one is reported.
    """
    head = folder / CAMPAIGN_FILE
    if folder.exists() and not folder.is_dir():
        raise FileFormatError(f"{folder} is a file, expected a folder", f"give the folder that holds {CAMPAIGN_FILE} and its run files")
    campaign = read_json(head)
    parsed = check(head, campaign, CampaignFile)
    files, runs = [], []
    for number, entry in enumerate(parsed.runs, start=1):
        path = folder / entry.file
        run = read_json(path)
        read = check_run(path, run)
        for key, wanted, got in (
            ("run_id", entry.run_id, read.run_id),
            ("test", entry.test, read.test),
            ("role", entry.role, read.role),
            ("campaign", parsed.campaign, read.campaign),
        ):
            if got != wanted:
                raise FileFormatError(f"{path}: {key}: expected {wanted!r} as in {CAMPAIGN_FILE}, runs[{number}], got {got!r}")
        files.append(run)
        runs.append(_parsed(path, run))
    errors = None
    if parsed.current_model.errors is not None:
        path = folder / parsed.current_model.errors
        errors = read_json(path)
        check(path, errors, ErrorsFile)
    return FolderContent(campaign, files, runs, errors, _tables(folder, runs))


def _tables(folder: Path, runs: list[Run]) -> dict[int, bytes]:
    """Read the images of the tables that acted during the runs, as far as the folder holds them."""
    found = {}
    for crc in _acting(runs):
        path = folder / table_file(crc)
        if not path.exists():
            continue
        image = path.read_bytes()
        if zlib.crc32(image) != crc:
            raise FileFormatError(
                f"{path}: the CRC of this table is {zlib.crc32(image):08X}", "export the campaign again, or remove the file"
            )
        found[crc] = image
    return found


def _acting(runs: list[Run]) -> list[int]:
    return sorted({run.table.acting_crc for run in runs if run.table.acting_crc is not None})


def _parsed(path: Path, run: Doc) -> Run:
    """Return the run of a checked file. Keys that only Abbe writes, such as ``table``, may still have another type."""
    try:
        return Run.from_document(run)
    except StoreError as err:
        raise FileFormatError(f"{path}: {err.detail}", "correct this key or leave it out: only Abbe writes it") from None


def import_folder(store: Store, folder: Path) -> int:
    """Store a campaign folder, completely or not at all, and return the id of the campaign.

    Raises
    ------
    FileFormatError
        A file has a mistake; the first one is reported.
    StoreError
        The store already has a campaign of this name.
    """
    return store_folder(store, read_folder(folder))


def store_folder(store: Store, content: FolderContent) -> int:
    """Store a checked campaign, completely or not at all, and return its id.

    Raises
    ------
    StoreError
        The store already has a campaign of this name.
    """
    imported = [_imported(*one) for one in zip(content.entries, content.run_files, content.runs, strict=True)]
    doc = {"imported": content.campaign, "errors": content.errors}
    return store.runs.import_campaign((content.machine_name, content.machine), (content.name, doc), imported, content.tables)


def export_folder(store: Store, name_or_id: str | int, target: Path, images: Images = no_image, *, csv: bool = False) -> Path:
    """Write a campaign as the folder ``target``, completely or not at all, and return the folder.

    ``images`` returns the image of a table by its CRC; the folder gets those that acted during the runs. ``csv``: also write the columns of
    each run as CSV, their units in the headings.

    Raises
    ------
    FileFormatError
        The target exists and is not an empty folder, or cannot be written.
    StoreError
        The store has no such campaign, or its samples are damaged.
    """
    record = store.campaigns.find(name_or_id)
    runs = store.runs.all(record.id)
    with _whole_folder(target) as folder:
        _write_folder(store, record, runs, folder, images, csv=csv)
    return target


def write_folder(campaign: Doc, runs: list[Run], tables: Mapping[int, bytes], errors: Doc | None, target: Path) -> Path:
    """Write runs and their campaign object as the folder ``target``, completely or not at all, and return the folder.

    ``errors``: content of the errors file that the campaign object names.

    Raises
    ------
    FileFormatError
        The target exists and is not an empty folder, or cannot be written.
    """
    entries, setups = list[Doc](), dict[str, Doc]()
    taken = {CAMPAIGN_FILE, str(campaign["current_model"]["errors"])}
    with _whole_folder(target) as folder:
        for run in runs:
            entry = {"run_id": run.run_id, "test": run.test, "role": run.role, "file": _free_name(run.run_id, taken)}
            entries.append(entry)
            setups.setdefault(run.setup.setup_id, {"kind": run.test.partition("_")[0], "t_set_s": run.setup.t_set_s})
            _write_json(folder / entry["file"], run.to_document())
        for crc, image in tables.items():
            _write_bytes(folder / table_file(crc), image)
        if errors is not None:
            _write_json(folder / str(campaign["current_model"]["errors"]), errors)
        _write_json(folder / CAMPAIGN_FILE, campaign | {"setups": setups | campaign.get("setups", {}), "runs": entries})
    return target


@contextmanager
def _whole_folder(target: Path) -> Iterator[Path]:
    """Yield a folder beside the target, and rename it into place at the end."""
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise FileFormatError(f"{target} exists and is not an empty folder: nothing was written", "give a new folder")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as err:
        raise FileFormatError(f"{target}: cannot be written: {err.strerror}", "give a writable folder") from None
    try:
        aside.chmod(0o755)  # mkdtemp creates private folders; other users may read an export
        yield aside
        if target.exists():
            target.rmdir()
        aside.rename(target)
    except OSError as err:
        raise FileFormatError(f"{target}: cannot be written: {err.strerror}", "free disk space or give another folder") from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _write_folder(store: Store, record: CampaignRecord, runs: list[RunRecord], folder: Path, images: Images, *, csv: bool) -> None:
    entries, setups, written = [], dict[str, Doc](), list[Run]()
    taken = {CAMPAIGN_FILE, *(str(RunEntry.read(run.start.entry).file) for run in runs if run.start.entry)}
    joined = {piece.run for run in runs if run.status == COMPLETE for piece in run.start.pieces}
    for run in runs:
        if run.id in joined:
            continue  # its readings are part of the resumed run: a measurement must not count twice
        chunks = store.chunks.of_run(run.id)
        read = whole_run(store, run) if run.status == COMPLETE else single_run(run, chunks)
        entry = run.start.entry or {"run_id": run.label, "test": run.test, "role": run.role, "file": _free_name(run.label, taken)}
        entries.append(entry)
        written.append(read)
        if read.setup.t_set_s is None:
            raise StoreError(
                f"run {run.campaign}/{run.label}: its set-up has no t_set_s",
                "Abbe did not write this, or the database is damaged: restore a backup",
            )
        setups.setdefault(read.setup.setup_id, {"kind": run.test.partition("_")[0], "t_set_s": read.setup.t_set_s})
        document, path = run_document(read, run, chunks), folder / RunEntry.read(entry).file
        _write_json(path, document)
        if csv:
            _write_csv(path.with_suffix(".csv"), read.columns.to_document())
    _write_json(folder / CAMPAIGN_FILE, _campaign_document(store, record, entries, setups))
    for crc in _acting(written):
        if (image := images(crc)) is not None:
            _write_bytes(folder / table_file(crc), image)
    if record.head.errors is not None and record.head.imported is not None:
        _write_json(folder / str(CampaignFile.read(record.head.imported).current_model.errors), record.head.errors)


def _campaign_document(store: Store, record: CampaignRecord, entries: list[Doc], setups: dict[str, Doc]) -> Doc:
    imported = record.head.imported
    if imported is not None:
        known: Doc = imported["setups"]
        return imported | {"runs": entries, "setups": known | {name: setup for name, setup in setups.items() if name not in known}}
    base = {"format": CAMPAIGN_FORMAT, "campaign": record.name, "machine": store.machines.get(record.machine_id).doc}
    assumed = {"current_model": {"includes": list(ASSUMED_MODEL), "errors": None}, "instruments": {}, "temperature_sensors": False}
    return base | assumed | record.doc | {"setups": setups, "runs": entries}


def _imported(entry: Doc, run: Doc, read: Run) -> ImportedRun:
    payload = encode_json(pack_columns(run["columns"]))
    start_doc = {"setup": read.setup.document, "machine": read.machine, "entry": entry, "imported": run | {"columns": None}}
    return ImportedRun(read.run_id, read.test, read.role, start_doc, len(read.columns), JSON_CODEC, payload)


def _free_name(label: str, taken: set[str]) -> str:
    """Return a file name for a run that none of the ``taken`` has, and add it to them."""
    safe = "".join(one if one.isalnum() or one in "-_." else "_" for one in label)
    name = next(name for k in count(1) if (name := f"{safe}{'' if k == 1 else f'-{k}'}.json") not in taken)
    taken.add(name)
    return name


def _write_bytes(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _write_json(path: Path, document: Doc) -> None:
    _write_bytes(path, json.dumps(document, ensure_ascii=False, allow_nan=False).encode())


def _write_csv(path: Path, columns: Doc) -> None:
    """Columns of a run with all digits; a column of withheld readings is left out."""
    known = {name: values for name, values in columns.items() if values is not None}
    rows = [",".join(known), *(",".join(map(repr, row)) for row in zip(*known.values(), strict=True))]
    _write_bytes(path, "\n".join([*rows, ""]).encode())
