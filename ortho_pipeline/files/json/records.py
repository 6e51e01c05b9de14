"""Records: what documents hold, as pydantic's models, which check, write, read and publish them.

A number in a record is never NaN or infinite. A member with a default may be missing in documents of earlier versions,
and is in all that are written.
"""

from __future__ import annotations

from typing import Annotated, Any, Self

import pydantic
from pydantic.json_schema import GenerateJsonSchema


def _as_it_is(text: object) -> str:
    if not isinstance(text, str):
        raise ValueError("Input should be a valid string")
    return text


#: A text for people: one that knows which options it names (`errors.texts.Text`) stays so.
Words = Annotated[str, pydantic.PlainValidator(_as_it_is), pydantic.WithJsonSchema({"type": "string"})]


Count = Annotated[int, pydantic.Field(ge=0)]
Pair = tuple[float, float]


class DocumentError(ValueError):
    """A document that is not the one of a record: `place` is the first member that is wrong, `fault` how."""

    def __init__(self, place: str, fault: str) -> None:
        super().__init__(f"{place}: {fault}")
        self.place, self.fault = place, fault


class Record(pydantic.BaseModel):
    """A record, which does not change and refuses members that it does not know."""

    model_config = pydantic.ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        protected_namespaces=(),
        defer_build=True,
        json_schema_serialization_defaults_required=True,
    )

    def to_json(self) -> dict[str, Any]:
        """Return the document of the record, as JSON values."""
        return self.model_dump(mode="json")

    def given(self) -> dict[str, Any]:
        """Return the document of the members that were given: no other has its default."""
        return self.model_dump(mode="json", exclude_unset=True)

    def replaced(self, **members: Any) -> Self:
        """Return this record with other members."""
        return self.model_copy(update=members)

    @classmethod
    def read(cls, document: Any) -> Self:
        """Return a document as the record that it was written from.

        Raises
        ------
        DocumentError
            If a member is missing, too much, or of a wrong type.
        """
        try:
            return cls.model_validate(document)
        except pydantic.ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            place = ".".join(str(part) or "''" for part in first["loc"])  # a member's name may be empty
            raise DocumentError(place[:200], first["msg"][:200]) from error

    @classmethod
    def schema_of(cls, title: str) -> dict[str, Any]:
        """Return the JSON Schema of the documents that are written from such records."""
        found = cls.model_json_schema(mode="serialization", schema_generator=_WithoutTitles)
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **found, "title": title}


class _WithoutTitles(GenerateJsonSchema):
    """Leave out the titles of members, which only repeat their names."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False
