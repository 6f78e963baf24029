"""Limits of texts and numbers in a record: the channel between the two processes refuses longer texts and larger numbers."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

WORD, TEXT = 200, 4000
Word = Annotated[str, Field(max_length=WORD)]
Text = Annotated[str, Field(max_length=TEXT)]
Number = Annotated[int, Field(ge=0, le=2**62)]
