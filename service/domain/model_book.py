"""The model book: versions of what is known of a machine beyond its 21 error motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from abbe.service.domain.finding import EffectSize, RefittedModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """The campaign in which an effect was found, and the discovery that found it; None: of a campaign that is not stored."""

    campaign: str
    discovery: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class BookEffect(EffectSize):
    """An effect that a model knows. ``rivals``: labels of what it could also have been; ``origin`` is ``from`` in JSON."""

    origin: Annotated[Origin, Field(alias="from")]
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance(Origin):
    """What brought a version: digests of the runs, versions of the programs."""

    runs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelBook:
    """The document of one version (``abbe-model/1``).

    ``parent``: the version that it was made on; ``machine_digest``: SHA-256 of the geometry that its effects are of; ``gone``: labels that
    added up to nothing and left the book; ``model``: the refitted model that the last finding brought.
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
    """One version of a machine's model. ``discovery_id``: what brought it, None for a person."""

    machine: str
    version: int
    discovery_id: int | None
    created_utc: str
    book: ModelBook
