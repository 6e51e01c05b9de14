"""What to do about a notice, and how much it matters: the traffic lights of a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ortho_pipeline.options.texts import Setting, Text

Level = Literal["stop", "look", "know"]

_STOP: dict[str, str] = {
    "reference-displaced": Text(
        "Let the measured points control beside the matches (",
        Setting("match.gcps_as", "control"),
        "), and state how accurate the reference is (",
        Setting("match.reference_sigma"),
        ").",
    ),
    "heights-disagree": "Find out which height datum points and DEM have, state both, and make it again.",
    "model-elsewhere": "Check that image, points and their CRS belong together, and that columns and rows are not "
    "swapped.",
    "reference-made-of-scene": "Take another reference: one that was not made of this scene.",
    "unstable": "Add points, or take a correction with fewer parameters.",
    "checks-apart": "Measure those named again, in the image and at their source, before the model or the control is "
    "changed.",
    "undecided-contradiction": "Measure the points named again; one of them is wrong.",
    "only-a-start": "Add control points or a reference to match with before the ortho is used.",
    "rpc-elsewhere": "Check that the RPC belongs to this image, and is not that of a crop or of another scene.",
    "sparse-ortho": "Check the extent that was asked for and the validity mask of the image.",
    "metadata-contradict": "Find out which of the two is right before the ortho is used; ask who delivered the scene.",
}
_LOOK: dict[str, str] = {
    "reference-covers-part": "Add references or measured points in the rest of the scene, or do not use the "
    "ortho there.",
    "bands-disagree": Text(
        "Match again with bands that agree and look like the scene (",
        Setting("match.reference_bands"),
        "): visible bands for a panchromatic scene.",
    ),
    "ortho-tested-in-part": "Give references that show the rest, or do not use the ortho there.",
    "left-out": "Look at it in the image and at its coordinates: measure it again, or delete it from the file of "
    "points.",
    "more-left-out": "So many gross errors mean that the points or the model do not suit the scene: see both.",
    "contradicting-point": "Look at it in the image and at its coordinates, and measure it again; take it out only "
    "if its source is found wrong.",
    "no-projection": "Give the points a height, and check their CRS.",
    "takes-no-part": "Measure these points in one more image.",
    "outside-of-image": "Check whether these were measured in another image or in a crop of this one.",
    "one-mark-twice": "Keep one of each pair: they count as two proofs of the same thing.",
    "images-not-given": "Give these images too, or take them out of the file of points.",
    "no-intersection": "Measure these points again.",
    "few-check-points": "Keep more points apart as check points before accuracy is claimed to others.",
    "no-redundancy": "Add points: so far the residuals prove nothing.",
    "control-covers-part": "Add control points in the empty part, or do not rely on the ortho there.",
    "uncertain-at-edge": "Add control points near the corners, or take a correction with fewer parameters.",
    "inseparable-parameters": "Take a correction with fewer parameters, or let prune remove them.",
    "unsuited-model": "Take a model that the sensor suggests, unless you know better.",
    "search-by-default": "State how accurate the delivered model is, if you know it.",
    "points-cover-part": "Add ties there (they can be found by matching), and control near the corners of the block.",
    "block-in-parts": "Measure points that images of both parts show, or adjust the parts by themselves.",
    "few-ties": "Measure some ties by hand between these images.",
    "no-matches": "Give this image control points, or a reference that resembles it more.",
    "dem-datum-by-name": "State the height datum of the DEM, so that nothing rests on its name.",
    "dem-items-overlap": "Give a list of the items that shall count, if others than the latest ones are meant.",
    "dem-covers-part": "Give a DEM that covers the scene: what lies outside of it has no value or a guessed height.",
    "accuracy-in-part": "State the accuracy of what is named, so that the figures include it.",
    "memory-exceeded": "Allow more memory, or take the engine of ortho-pipeline.",
    "rpc-approximate": "Use the model file or the ortho, and not the RPC, where this error matters.",
    "maybe-a-crop": "If it is a crop, state the column and row of its corner in the original image.",
    "no-pushbroom": "Take the RPC, or ask for complete metadata.",
    "rpc-and-rigorous-differ": "Compare both at check points, and keep the better.",
    "bands-differ": "Rectify the bands one by one where this difference matters.",
    "unchecked-product": "Check the result at points that you know before you rely on it.",
    "rpc-not-used": "Repair or remove the RPC file beside the image.",
    "rpcs-differ": "Check which of the RPCs belongs to this image, and remove the other.",
    "damaged-metadata": "Ask for the metadata again.",
    "maybe-cut-off": "Copy the file again.",
    "processing-level": "Check that the product has not been resampled to a map before.",
    "from-sensor": "Read it before the ortho is used.",
}
_KNOW: dict[str, str] = {
    "control-without-height": "Nothing, if heights come from elsewhere; else give the points heights.",
    "unstated-sigma": "State how accurate the points are, if you know it.",
    "parameters-removed": "Nothing: what the points could not tell was left out.",
    "relative-to-reference": "Measure some check points if the position has to be right, and not only consistent.",
    "ortho-relative": Text("State how accurate the reference is (", Setting("match.reference_sigma"), ")."),
    "ortho-local-changes": "Look at the places that the file of displacements marks as local.",
    "dem-sigma-by-default": "State how accurate the DEM is, if you know it.",
    "correction-by-matches": "Nothing, unless you know which correction suits the sensor.",
    "dem-datum-overridden": "Make sure that the datum stated is the right one.",
    "no-rpc": "Use the ortho or the model file; programs that need an RPC cannot have one.",
    "crop-stated": "Nothing, if the offset is right.",
    "crop-noted": "Nothing.",
    "crop-kept": "Nothing.",
    "nothing-adjusted": "Adjust a correction, such as a shift.",
    "rigorous-left-out": "Nothing, if the RPC is the model that you want.",
    "part-left-out": "Rectify the other parts as scenes of their own.",
    "radar-on-a-plane": "Give a DEM.",
    "no-rpc-text": "Nothing.",
    "gcps-beside-rpc": "Tell users of other programs, which may prefer these points to the RPC.",
    "piece-left-out": "Nothing, if this piece is the one that you want.",
}
_LEVELS: tuple[tuple[Level, dict[str, str]], ...] = (("stop", _STOP), ("look", _LOOK), ("know", _KNOW))
#: Of a code that this version does not know.
_UNKNOWN = "Read it before the ortho is used."
#: The levels in words, the gravest first.
WORDS: dict[Level, str] = {"stop": "Settle this first", "look": "To look at", "know": "To know"}


@dataclass(frozen=True)
class Signal:
    """A notice as a page shows it: what it says, how much it matters, and what to do."""

    level: Level
    text: str
    to_do: str


#: Of a result that no point tests.
UNTESTED = Signal(
    "look",
    "Nothing tests how accurate this is.",
    "Give points of known ground that only check, or an orthoimage of the place to match with.",
)


def advised(code: str) -> tuple[Level, str]:
    """Return how much a notice of a code matters, and what to do about it."""
    for level, found in _LEVELS:
        if code in found:
            return level, found[code]
    return "look", _UNKNOWN


def signals(warnings: Sequence[str], notices: Sequence[Mapping[str, Any]], *, tested: bool = True) -> list[Signal]:
    """Return the notices of a document, the gravest first; of earlier versions, which have no codes, the texts.

    Of a result that is not `tested` that is the first thing to look at.
    """
    if not notices:
        notices = [{"code": "from-sensor", "text": text} for text in warnings]
    found = [Signal(*_of(one)) for one in notices]
    # No redundancy says it too, and why.
    if not tested and not any(one["code"] == "no-redundancy" for one in notices):
        found.insert(0, UNTESTED)
    order = list(WORDS)
    return sorted(found, key=lambda one: order.index(one.level))


def _about_checks(notice: Mapping[str, Any], to_do: str) -> str:
    """Return what to do about check points that contradict the control, by what their errors look like."""
    off, beyond = notice.get("off", 0), notice.get("beyond_control", 0)
    if off == 1:
        to_do = to_do.replace("those named", str(notice["points"][0])).replace("their source", "its source")
    if notice.get("alike"):
        to_do += " They are all off by about the same: check their CRS, their height datum and from where pixels count."
    elif off > 1:
        to_do += " They are off in different ways, as single mistakes are."
    if beyond:
        who = "It lies" if off == 1 else ("They lie" if beyond == off else f"{beyond} of them lie")
        to_do += f" {who} outside of the area of the control points, where the model may be poor: add control there."
    return to_do


def _of(notice: Mapping[str, Any]) -> tuple[Level, str, str]:
    level, to_do = advised(notice["code"])
    if notice["code"] == "few-check-points" and not notice.get("count", 1):
        to_do = to_do.replace("Keep more points", "Keep some points")
    if notice["code"] == "checks-apart":
        to_do = _about_checks(notice, to_do)
    text = str(notice["text"])
    return level, text[:1].upper() + text[1:], to_do
