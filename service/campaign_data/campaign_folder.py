"""Load a campaign from the store, or read and check a folder with campaign.json; store its solutions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from abbe.service.campaign_data.provenance import machine_digest, run_digest
from abbe.service.domain.document import record
from abbe.service.domain.machine import DeviceUrls, machine_from_doc
from abbe.service.domain.measured import CampaignHead
from abbe.service.domain.run import Run
from abbe.service.domain.run_file import CAMPAIGN_FORMAT
from abbe.service.domain.solution_file import TableRemoval
from abbe.service.errors import CampaignRefused, Unusable
from abbe.service.runs.checks import read_json
from abbe.service.runs.columns import load_run
from abbe.service.runs.exchange import import_folder, read_folder, write_folder
from abbe.service.runs.observations import with_earliest_mounting
from abbe.service.site import Site
from abbe.service.storage.store import Store


@dataclass(frozen=True)
class Campaign:
    """A campaign for a solver. ``folder``: its source, None for a campaign of the store; ``doc``: its campaign object.

    ``removed``: the table whose side effects were subtracted from the readings, None if none was. ``tables``: images of the compensation
    tables that acted during the runs, by CRC, as far as the folder holds them; empty for a campaign of the store, which holds the images
    itself.
    """

    name: str
    site: Site
    runs: list[Run]
    folder: Path | None
    doc: dict[str, Any] = field(default_factory=dict)
    removed: TableRemoval | None = None
    tables: Mapping[int, bytes] = field(default_factory=dict, repr=False)

    @property
    def head(self) -> CampaignHead:
        """Facts known when the campaign began. Raises Unusable if a field has another type."""
        return record(CampaignHead, self.doc, f"campaign {self.name}")

    def without(self, labels: list[str]) -> Campaign:
        """Return the campaign without the named runs.

        Raises
        ------
        CampaignRefused
            The campaign has no such run.
        """
        names = [r.run_id for r in self.runs]
        missing = [n for n in labels if n not in names]
        if missing:
            raise CampaignRefused(f"campaign {self.name} has no run {missing[0]}", f"it has {', '.join(names)}")
        return replace(self, runs=[r for r in self.runs if r.run_id not in labels])

    def save(self, folder: str | Path) -> Path:
        """Write the campaign as a new folder, for the command line and for `read_campaign`, and return the folder.

        Raises
        ------
        FileFormatError
            The folder exists and is not empty, or cannot be written.
        Unusable
            The campaign comes from a database, and only the database holds its tables; or a table was subtracted from the readings.
        """
        errors = self.doc.get("current_model", {}).get("errors")
        acting = {run.table.acting_crc for run in self.runs if run.table.acting_crc is not None}
        if self.folder is None and (self.doc.get("format") != CAMPAIGN_FORMAT or errors is not None or not acting <= set(self.tables)):
            what = f"campaign {self.name} was read from a database and cannot be written as a folder without its tables"
            raise Unusable(what, f"write campaign and tables: abbe export {self.name} FOLDER")
        if self.removed is not None:
            what = f"campaign {self.name} cannot be written as a folder: a table was subtracted from its readings"
            raise Unusable(what, "write the campaign as it was read")
        known = None if errors is None or self.folder is None else read_json(self.folder / errors)
        return write_folder(self.doc, self.runs, self.tables, known, Path(folder))


def from_folder(folder: Path) -> Campaign:
    """Read and check a campaign folder.

    Raises
    ------
    FileFormatError
        A file has a mistake; the first one is reported.
    """
    content = read_folder(folder)
    return replace(_campaign(content.name, content.campaign, content.runs, folder), tables=content.tables)


def from_store(store: Store, name: str) -> Campaign:
    """Return a campaign of the store with its complete runs.

    Raises
    ------
    StoreError
        The store has no such campaign.
    """
    record = store.campaigns.find(name)
    runs = [load_run(store, r.id) for r in store.runs.all(record.id) if r.visible_status == "complete"]
    doc = record.known | {"campaign": record.name, "machine": store.machines.get(record.machine_id).doc}
    return _campaign(record.name, doc, runs, None)


def _campaign(name: str, doc: dict[str, Any], runs: list[Run], folder: Path | None) -> Campaign:
    machine = doc["machine"]
    site = Site(str(machine.get("name") or name), machine_from_doc(machine), machine, DeviceUrls())
    return Campaign(name, site, with_earliest_mounting([run.with_artefact(doc) for run in runs]), folder, doc)


def store_solution(store: Store, campaign: Campaign, doc: dict[str, Any]) -> dict[str, Any]:
    """Store a solution with its runs; a folder whose campaign is not stored yet is imported first.

    Returns
    -------
    dict
        New keys of the document: ``run_ids``, ``solution_id``, and ``same_as``: earlier solutions of the same readings and model.

    Raises
    ------
    StoreError
        The store cannot be written.
    CampaignRefused
        The store has another campaign of this name.
    """
    ids = ensure_stored(store, campaign)
    record = store.campaigns.find(campaign.name)
    used = [ids[label] for label in doc["inputs"]["runs"]]
    same = [s.id for s in store.solutions.all(record.id) if s.doc.get("inputs", {}).get("digest") == doc["inputs"]["digest"]]
    added = {"run_ids": used, "same_as": same}
    return added | {"solution_id": store.solutions.add(record.id, "joint", used, doc | added)}


def ensure_stored(store: Store, campaign: Campaign) -> dict[str, int]:
    """Import a campaign folder unless its campaign is stored already, and return the ids of the complete runs by label.

    Tables of the folder that the database lacks are added.

    Raises
    ------
    StoreError
        The store cannot be written.
    CampaignRefused
        The store has another campaign of this name.
    """
    if campaign.folder is not None and all(c.name != campaign.name for c in store.campaigns.all()):
        import_folder(store, campaign.folder)
    record = store.campaigns.find(campaign.name)
    ids = {r.label: r.id for r in store.runs.all(record.id) if r.visible_status == "complete"}
    if campaign.folder is not None:
        _check_same(store, campaign, store.machines.get(record.machine_id).doc, ids)
        store.tables.add_missing(record.machine_id, campaign.tables)
    return ids


def _check_same(store: Store, campaign: Campaign, machine: dict[str, Any], ids: dict[str, int]) -> None:
    """Refuse unless the stored campaign has the same machine, readings and set-ups, because solutions refer to its runs."""
    differs = None
    there = {r.run_id: r for r in with_earliest_mounting([load_run(store, number) for number in ids.values()])}
    if machine_digest(machine_from_doc(machine)) != machine_digest(campaign.site.machine):
        differs = "the machine (chain, strokes, pivots or tool)"
    for run in campaign.runs:
        if differs is None and run.identifies:
            stored = there.get(run.run_id)
            if stored is None:
                differs = f"run {run.run_id} is missing there"
            elif not stored.columns.equals(run.columns):
                differs = f"run {run.run_id}"
            elif run_digest(stored) != run_digest(run) or stored.role != run.role:
                differs = f"test, role or set-up of run {run.run_id}"
    if differs is not None:
        what = differs if differs.endswith("there") else f"{differs} differs"
        raise CampaignRefused(
            f"the store has a different campaign {campaign.name!r}: {what}", "rename the folder's campaign, or use another --db"
        )
