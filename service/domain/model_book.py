"""The model book: versions of the known effects of a machine beyond its 21 error motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from abbe.service.domain.finding import EffectSize, RefittedModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """The campaign and the discovery that found an effect; ``discovery`` None: the campaign is not stored."""

    campaign: str
    discovery: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class BookEffect(EffectSize):
    """An effect in a model. ``rivals``: labels of effects that it could also be; ``origin`` is ``from`` in JSON."""

    origin: Annotated[Origin, Field(alias="from")]
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance(Origin):
    """Source of a version: digests of the runs, versions of the programs."""

    runs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelBook:
    """The document of one version (``abbe-model/1``).

    ``parent``: number of the previous version; ``machine_digest``: SHA-256 of the machine geometry for which the effects hold; ``gone``:
    labels of effects that summed to zero and were removed; ``model``: the refitted model of the last finding.
    """

    format: Literal["abbe-model/1"] = "abbe-model/1"
    parent: int | None = None
    why: str
    machine_digest: str
    effects: tuple[BookEffect, ...] = ()
    gone: tuple[str, ...] = ()
    model: RefittedModel | None = None
    provenance: Provenance | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelVersion:
    """One version of a machine's model. ``discovery_id``: its discovery, None if a person made it."""

    machine: str
    version: int
    discovery_id: int | None
    created_utc: str
    book: ModelBook
