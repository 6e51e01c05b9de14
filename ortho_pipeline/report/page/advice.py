"""What to do about a notice, and how grave it is: an error, a warning or a note."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from ortho_pipeline.display.notices import FROM_SENSOR, Notice
from ortho_pipeline.errors.texts import Setting, Text

Level = Literal["stop", "look", "know"]

_STOP: dict[str, str] = {
    "reference-displaced": Text(
        "Use the measured points as control together with the matches (",
        Setting("match.gcps_as", "control"),
        "). State the accuracy of the reference (",
        Setting("match.reference_sigma"),
        ").",
    ),
    "heights-disagree": Text(
        "Find out the height datums of points and DEM. State both (",
        Setting("points.vertical"),
        ", ",
        Setting("surface.vertical"),
        ") and repeat the job.",
    ),
    "surface-not-ground": Text(
        "Use a DEM that covers the scene (",
        Setting("surface.dem"),
        "). Check its position, and the heights of the points.",
    ),
    "model-elsewhere": "Check image, points, CRS, and the order of columns and rows.",
    "reference-made-of-scene": "Use another reference, one that was not made from this scene.",
    "unstable": "Add points, or use a simpler correction.",
    "checks-apart": "Measure the named points again, in the image and at their source. Do this before you change "
    "model or control.",
    "undecided-contradiction": "Measure the named points again; one of them is wrong.",
    "only-a-start": "Add control points or a reference before you use the ortho.",
    "rpc-elsewhere": "Check that the RPC belongs to this image, and not to a crop or another scene.",
    "sparse-ortho": "Check the extent and the mask of the image.",
    "metadata-contradict": "Find out which one is right before you use the ortho. Ask the supplier of the scene.",
}
_LOOK: dict[str, str] = {
    "untested": "Add check points, or an orthoimage of the same place to match with.",
    "datum-unknown": Text(
        "State the height datum with ", Setting("scene.sensor_options", "DATUM", key="vertical"), "."
    ),
    "datum-doubtful": Text(
        "Check height datum and CRS of the points (",
        Setting("points.vertical"),
        ", ",
        Setting("points.crs"),
        "), of the cameras (",
        Setting("scene.sensor_options", "DATUM", key="vertical"),
        ") and of the DEM (",
        Setting("surface.vertical"),
        "), and the width of the sensor.",
    ),
    "poses-contradicted": Text(
        "Check the ties. If they are right, state the true accuracy of the poses with ",
        Setting("scene.sensor_options", "METRES,DEGREES", key="sigmas"),
        ".",
    ),
    "images-left-out": "If you need these images, repair what the message names.",
    "positions-differ": "If the position in use is wrong, remove it from the tags of the photo.",
    "reference-covers-part": "Add references or measured points in the rest of the scene, or do not use the ortho "
    "there.",
    "bands-disagree": Text(
        "From bands that agree, choose those that look like the scene (",
        Setting("match.reference_bands"),
        "): visible bands for a panchromatic scene.",
    ),
    "stack-not-connected": "Add dates between these and the others, or leave these out.",
    "stack-pairs-unmatched": Text("Give orthos with less cloud, or search farther with ", Setting("match.search"), "."),
    "stack-pairs-disagree": "Add dates, so that more loops test each pair.",
    "stack-step": "Check whether the processing of the orthos changed then. The stack corrects the step.",
    "stack-part-displaced": "Look at this date there: the stack does not correct it. If a tile of a mosaic or a cloud "
    "moved, leave the date out.",
    "stack-mostly-moving": "Check that the area has stable ground, or stack a larger area.",
    "ortho-part-displaced": "Find out which of the two is wrong there. If clouds or glaciers moved, leave them out "
    "with a mask.",
    "ortho-tested-in-part": "Add references that show the rest, or do not use the ortho there.",
    "left-out": "Check the point in the image and at its source. Measure it again or delete it. For a few automatic "
    "tie points there is nothing to do.",
    "more-left-out": "If these are many of the points, points and model do not belong together. A few percent of "
    "automatic tie points are usually wrong.",
    "contradicting-point": "Measure the point again. Delete it only if it is proven wrong.",
    "no-projection": "Add the heights of the points, and check their CRS.",
    "takes-no-part": "Measure these points in one more image.",
    "outside-of-image": "Check whether the points belong to another image or to a crop of this one.",
    "one-mark-twice": "Keep one of each pair.",
    "images-not-given": "Add these images, or remove their points.",
    "no-intersection": "Measure these points again.",
    "few-check-points": "Use at least 30 check points before you claim an accuracy class.",
    "no-redundancy": "Add points. Until then the residuals prove nothing.",
    "control-covers-part": "Add control points in the empty part, or do not use the ortho there.",
    "dem-shifted": Text(
        "Add control points: they show whether the DEM or the images are displaced. If neighbouring heights of the DEM "
        "have similar errors, state ",
        Setting("points.dem_correlation"),
        ".",
    ),
    "dem-sigma-contradicted": Text("State a larger accuracy with ", Setting("surface.sigma"), "."),
    "weak-join": Text(
        "Give control points, another view of the place, or a DEM (",
        Setting("surface.dem"),
        "), or a more accurate one. The report of a mosaic shows how well the orthos fit at the seams.",
    ),
    "uncertain-at-edge": "Add control points near the corners. With an RPC, a simpler correction helps, too.",
    "inseparable-parameters": "Use a simpler correction or model.",
    "unsuited-model": "Use a model that the sensor suggests.",
    "points-cover-part": "Add points in the empty parts: ties where images overlap, control elsewhere.",
    "block-in-parts": "Measure common points, or adjust the parts separately.",
    "crowded-ties": "Small images need few ties. More do not make the result more accurate.",
    "few-ties": "Measure some ties between these images (ortho measure): with few, a wrong one is hard to detect.",
    "no-matches": "Give this image control points or a more similar reference.",
    "dem-datum-by-name": Text("State the height datum of the DEM with ", Setting("surface.vertical"), "."),
    "dem-items-overlap": "To use other items, list them in a file.",
    "dem-covers-part": "Use a larger DEM if you need the rest.",
    "accuracy-in-part": "State the missing accuracies, so that the figures include them.",
    "doubtful-alpha": "If the band has data, remove the mark, and make the ortho again.",
    "memory-exceeded": Text("Increase ", Setting("output.memory"), ", or use ", Setting("output.engine", "ortho"), "."),
    "rpc-approximate": "Use the model file or the ortho where this error matters.",
    "maybe-a-crop": Text(
        "If it is a crop, state the column and row of its first pixel with ", Setting("scene.crop_offset"), "."
    ),
    "no-pushbroom": "Use the RPC, or get complete metadata.",
    "rpc-and-rigorous-differ": "Compare both at check points, and use the better one.",
    "bands-differ": "Rectify the bands separately if this difference matters.",
    "unchecked-product": "Check the result at known points.",
    "rpc-not-used": "Repair or delete the RPC file.",
    "rpcs-differ": "Find the RPC that belongs to this image, and remove the other one.",
    "damaged-metadata": "Get the metadata again.",
    "maybe-cut-off": "Copy the file again.",
    "processing-level": "Check that the product was not resampled to a map.",
    "from-sensor": "Read this before you use the ortho.",
    "sharpen-displaced": "Align the multispectral ortho, then sharpen it again.",
    "sharpen-not-matched": "Compare both orthos on screen.",
    "sharpen-unlike": "Check that both orthos are of one acquisition.",
    "sharpen-no-gain": "Check the registration of the bands, and use the multispectral ortho.",
}
_KNOW: dict[str, str] = {
    "search-by-default": Text("If matching fails, change the radius with ", Setting("match.search"), "."),
    "control-without-height": "Add heights if you have them.",
    "unstated-sigma": Text("State the accuracy of the points with ", Setting("points.ground_sigma"), "."),
    "parameters-not-justified": Text("Remove them with ", Setting("points.prune"), "."),
    "parameters-removed": "Nothing to do: the points did not justify these parameters.",
    "relative-to-reference": "Measure check points if the absolute position matters.",
    "ortho-relative": Text(
        "State the accuracy of the reference with ",
        Setting("match.reference_sigma"),
        ", or measure surveyed points in the ortho (ortho measure --ortho) and give them to ortho verify --gcps.",
    ),
    "ortho-local-changes": "Check the places that the file of displacements marks as local.",
    "dem-sigma-by-default": Text("State the accuracy of the DEM with ", Setting("surface.sigma"), "."),
    "spot-heights-left-out": "Nothing to do: a laser may hit a cloud or a tree.",
    "dem-sigma-enlarged": Text(
        "Use a DEM of the surface that the images show, or state a larger accuracy with ", Setting("surface.sigma"), "."
    ),
    "dem-sigma-estimated": Text("If you know the accuracy of the DEM, state it with ", Setting("surface.sigma"), "."),
    "heights-left-out": "Nothing to do: a DEM of the bare ground does not show roofs and trees.",
    "systematic-errors": "If the accuracy at check points suffices, nothing. If not, use more or better control "
    "points, a model with more parameters, or a better DEM if you used one.",
    "adjusted-again": Text(
        "If another program has adjusted these poses, keep them with ", Setting("points.correction", "none"), "."
    ),
    "correction-by-matches": "Nothing to do, unless you know a better correction.",
    "dem-datum-overridden": "Check that your datum is right.",
    "no-rpc": "Nothing to do here. Give other programs the ortho or the model file.",
    "crop-stated": "Check the offset.",
    "crop-noted": "Nothing to do.",
    "crop-kept": "Nothing to do.",
    "nothing-adjusted": Text("Choose a correction, such as ", Setting("points.correction", "shift"), "."),
    "rigorous-left-out": "Nothing to do, if you want the RPC.",
    "part-left-out": "Rectify the other parts separately.",
    "radar-on-a-plane": Text("Give a DEM (", Setting("surface.dem"), ")."),
    "no-rpc-text": "Nothing to do.",
    "gcps-beside-rpc": "Nothing to do here. Other programs may use the GCPs instead of the RPC.",
    "piece-left-out": "Nothing to do, unless you have points in that file.",
}
_LEVELS: tuple[tuple[Level, dict[str, str]], ...] = (("stop", _STOP), ("look", _LOOK), ("know", _KNOW))
_NOTHING = "Nothing to do"
#: Notices of one code that the terminal shows; it counts the others.
_SHOWN = 3
#: Of a code that this version does not know.
_UNKNOWN = "Read this before you use the ortho."
#: The levels in words, the gravest first.
WORDS: dict[Level, str] = {"stop": "Error", "look": "Warning", "know": "Note"}


@dataclass(frozen=True)
class Signal:
    """A notice as people read it: how grave it is, its code (docs/notices.md), its text, and what to do."""

    level: Level
    code: str
    text: str
    to_do: str


#: Of a result that no point tests.
UNTESTED = Notice("untested", "no point tests the accuracy of this result")


def advised(code: str) -> tuple[Level, str]:
    """Return how grave a notice of a code is, and what to do about it."""
    for level, remedies in _LEVELS:
        if code in remedies:
            return level, remedies[code]
    return "look", _UNKNOWN


def signals(warnings: Sequence[str], notices: Sequence[Mapping[str, Any]], *, tested: bool = True) -> list[Signal]:
    """Return the notices of a document, the gravest first; of earlier versions, which have no codes, the texts.

    If the result is not `tested`, that is the first warning.
    """
    if not notices:
        notices = [{"code": "from-sensor", "text": text} for text in warnings]
    found = [Signal(*_signal(one)) for one in notices]
    # These notices say it too, and why.
    codes = {one["code"] for one in notices}
    if not tested and not codes & {"no-redundancy"}:
        found.insert(0, Signal(*_signal(UNTESTED.to_json())))
    order = list(WORDS)
    return sorted(found, key=lambda one: order.index(one.level))


def signal_lines(found: Sequence[Signal]) -> list[Text]:
    """Return notices as lines for the terminal, those of a code together.

    Of more than a few of one code, the others are counted. What several have to do stands once, below the last.
    """
    lines: list[Text] = []
    shown = shortened(found)
    for number, one in enumerate(shown):
        lines.append(Text(f"{WORDS[one.level]}: ", one.text, f" [{one.code}]"))
        if one.to_do not in [other.to_do for other in shown[number + 1 : number + 2]]:
            lines += [] if one.to_do.startswith(_NOTHING) else [Text("  Remedy: ", one.to_do)]
    return lines


def shortened(found: Sequence[Signal], *codes: str) -> list[Signal]:
    """Return the first signals of each code (or of these codes), and one that counts the others.

    Texts without a code of their own stay.
    """
    kinds: dict[str, list[Signal]] = {}
    for one in found:
        kinds.setdefault(one.text if one.code == FROM_SENSOR else one.code, []).append(one)
    shown: list[Signal] = []
    for alike in kinds.values():
        more = 0 if codes and alike[0].code not in codes else len(alike) - _SHOWN
        shown += alike[:_SHOWN] if more > 1 else alike
        if more > 1:
            shown.append(replace(alike[-1], text=f"{more} more of this kind"))
    return shown


def _signal(notice: Mapping[str, Any]) -> tuple[Level, str, str, str]:
    level, to_do = advised(notice["code"])
    if notice["code"] == "few-check-points" and not notice.get("count", 1):
        to_do = "Reserve some check points: with 30 you can claim an accuracy class."
    if notice["code"] == "checks-apart":
        to_do = _about_checks(notice, to_do)
    if notice["code"] == "weak-join" and notice.get("dem_unused"):
        to_do = Text("Use the heights of the DEM (", Setting("points.dem_heights", "on"), "), or give control points.")
    return level, notice["code"], _sentence(notice["text"]), to_do


def _about_checks(notice: Mapping[str, Any], to_do: str) -> str:
    """Return what to do about check points that contradict the control, by what their errors look like."""
    off, beyond = notice.get("off", 0), notice.get("beyond_control", 0)
    if off == 1:
        to_do = to_do.replace("the named points", str(notice["points"][0])).replace("their source", "its source")
    if notice.get("alike"):
        to_do += " All have about the same error: check their CRS, height datum and pixel origin."
    elif off > 1:
        to_do += " Their errors differ, so they are probably single mistakes."
    if beyond:
        who = "It is" if off == 1 else ("They are" if beyond == off else f"{beyond} of them are")
        to_do += f" {who} outside the area of the control points, where the model may be poor: add control there."
    return to_do


def _sentence(text: str) -> Text:
    """Return a text with a capital, unless it begins with a name; the options that it names stay known."""
    whole = Text(text)
    first, *rest = whole.parts or ("",)
    if isinstance(first, str) and first.split(" ")[0].isalpha():
        return Text(first[:1].upper() + first[1:], *rest)
    return whole
