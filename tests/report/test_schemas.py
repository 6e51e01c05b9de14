"""The published schemas of the reports: made from their records, and true of what commands write.

`python tests/report/test_schemas.py` writes them.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from ortho_pipeline import commands
from ortho_pipeline.commands import block as blocks
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.options import BlockOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.report.block_records import BlockReport
from ortho_pipeline.report.records import SceneReport
from ortho_pipeline.report.stack.records import StackRecord

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
SCHEMAS: dict[str, tuple[type[Record], str]] = {
    "report.schema.json": (SceneReport, "Accuracy report of ortho-pipeline, schema version 1"),
    "block_report.schema.json": (BlockReport, "Block report of ortho-pipeline, schema version 1"),
    "stack.schema.json": (StackRecord, "Stack of ortho-pipeline, schema version 1"),
}


def text_of(name: str) -> str:
    """Return what the file of a schema holds."""
    return json.dumps(SCHEMAS[name][0].schema_of(SCHEMAS[name][1]), indent=1) + "\n"


@pytest.fixture(scope="module")
def reports(tmp_path_factory, sample) -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the schema and the document of real reports, by what they are of."""
    folder = tmp_path_factory.mktemp("schemas")
    plain = OutputOptions(format="GTiff")
    flat, dem = SurfaceOptions(height=1000.0), SurfaceOptions(dem=sample / "dem.tif")
    points = PointOptions(gcps=sample / "gcps.geojson")
    image = sample / "scene.tif"
    adjusted = commands.rectify(image, folder / "points", points=points, surface=dem, output=plain)
    saved = SceneOptions(model=adjusted.files["model"])
    made = {
        "scene with points": adjusted,
        "scene without points": commands.rectify(image, folder / "bare", surface=flat, output=plain),
        "delivered model": commands.rectify(image, folder / "again", scene=saved, surface=dem, output=plain),
        "comparison": commands.compare(image, points, folder=folder / "compare", surface=dem),
    }
    pair = [sample / "cartosat" / name for name in ("BANDF.tif", "BANDA.tif")]
    options = BlockOptions(points=sample / "cartosat" / "points.csv")
    made["stereo block"] = blocks.adjust(pair, folder / "block", options)
    made["held block"] = blocks.adjust(pair, folder / "held", BlockOptions(points=options.points, hold=5.0))
    kinds = {True: "block_report.schema.json", False: "report.schema.json"}
    return {
        name: (kinds["block" in name], json.loads(result.files["report"].read_text()))
        for name, result in made.items()
    }  # fmt: skip


OF = ["scene with points", "scene without points", "delivered model", "comparison", "stereo block", "held block"]


@pytest.mark.parametrize("name", SCHEMAS)
def test_published_schemas_are_those_of_the_records(name):
    schema = json.loads((DOCS / name).read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema == SCHEMAS[name][0].schema_of(SCHEMAS[name][1]), (
        "write them again: python tests/report/test_schemas.py"
    )


@pytest.mark.parametrize("of", OF)
def test_real_reports_hold_what_their_schema_says(reports, of):
    name, document = reports[of]
    jsonschema.validate(document, json.loads((DOCS / name).read_text()), cls=jsonschema.Draft202012Validator)
    assert SCHEMAS[name][0].read(document).to_json() == document


def test_errors_that_points_share_are_in_the_schema(reports):
    name, document = copy.deepcopy(reports["scene with points"])
    shared = {"points": 4, "groups": 2, "effective_points": 3.1, "noise": None, "shared": [0.5, 0.25], "range_px": None}
    document["adjustment"]["statistics"]["shared_errors"] = shared
    validator = jsonschema.Draft202012Validator(json.loads((DOCS / name).read_text()))
    assert validator.is_valid(document)
    assert SceneReport.read(document).to_json() == document
    shared["surplus"] = 1
    assert not validator.is_valid(document)


#: Objects whose members have names of their own: facts, options, parameters, files.
OPEN = {
    "facts", "files", "images", "notices", "options", "p", "parameters", "points", "software", "surface", "t",
    "total_correlation",
}  # fmt: skip


def objects(value: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the objects of a document whose members are known, with the name that each has."""
    if isinstance(value, list):
        for item in value[:1]:
            yield from objects(item, name)
    elif isinstance(value, dict):
        if name not in OPEN or (name == "points" and "id" in value) or (name == "surface" and "coverage" in value):
            yield name, value
        for key, item in value.items():
            if not (name == "options" or key == "options"):
                yield from objects(item, key)


@pytest.mark.parametrize("of", ["scene with points", "comparison", "stereo block"])
@pytest.mark.parametrize("fault", [lambda one: one.update(surplus=1), lambda one: one.pop(next(iter(one)))])
def test_a_member_too_much_or_too_few_is_refused_everywhere(reports, of: str, fault: Callable[[Any], Any]):
    name, document = reports[of]
    validator = jsonschema.Draft202012Validator(json.loads((DOCS / name).read_text()))
    wrong = copy.deepcopy(document)
    places = list(objects(wrong))
    assert len(places) > 20
    for place, found in places:
        kept = dict(found)
        fault(found)
        assert not validator.is_valid(wrong), f"{place} of {of}"
        found.clear()
        found.update(kept)
    assert validator.is_valid(wrong)


if __name__ == "__main__":
    for schema_name in SCHEMAS:
        (DOCS / schema_name).write_text(text_of(schema_name))
