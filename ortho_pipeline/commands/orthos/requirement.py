"""Requirements of an ortho: ``ce90<5``, ``bias<=0.5px``, ``absolute.rmse<2``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text

_FORM = re.compile(
    r"\s*(?:(?P<of>relative|absolute|points)\.)?(?P<name>bias|rmse|ce90)\s*<=?\s*(?P<limit>[0-9.eE+-]+)\s*(?P<unit>m|px)?\s*"
)


@dataclass(frozen=True)
class Requirement:
    """A limit of a statistic.

    Parameters
    ----------
    text : str
        As the user wrote it.
    of : str
        relative, absolute or points.
    name : str
        Of the statistic, with its unit, such as ``ce90_m``.
    limit : float
    """

    text: str
    of: str
    name: str
    limit: float

    @classmethod
    def parse(cls, text: str) -> Requirement:
        """Return the requirement that a text states.

        Raises
        ------
        InputError
            If the text is not a requirement.
        """
        found = _FORM.fullmatch(text)
        try:
            limit = float(found["limit"]) if found else -1.0
        except ValueError:
            limit = -1.0
        if found is None or not limit > 0:
            raise InputError(
                f"{text!r} is not a requirement",
                field="require",
                remedy="give bias, rmse or ce90 and a limit in metres or px, such as 'ce90<5' or 'absolute.rmse<2px'",
            )
        return cls(text.strip(), found["of"] or "relative", f"{found['name']}_{found['unit'] or 'm'}", limit)

    def judged(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Return whether a document of `ortho verify` meets it: the whole 95 % interval must be below the limit.

        Raises
        ------
        InputError
            If the document has no such statistic.
        """
        part = document[self.of]
        if part is None:
            raise InputError(
                f"cannot test the requirement {self.text!r}: the {self.of} accuracy is not known",
                field="require",
                remedy=Text(
                    "give points (",
                    Setting("points.gcps"),
                    "), or state the accuracy of the reference (",
                    Setting("match.reference_sigma"),
                    ")",
                ),
            )
        estimate = part[self.name]
        return {
            "requirement": self.text,
            "value": estimate["value"],
            "upper": estimate["high"],
            "limit": self.limit,
            "met": estimate["high"] < self.limit,
        }
