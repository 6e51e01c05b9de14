"""Fields of XML: numbers, sizes and times, and what is none of these."""

from __future__ import annotations

from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.xml_fields import MOST_TERMS, XmlFields


def fields(tmp_path: Path, text: str, **more: int) -> XmlFields:
    path = tmp_path / "scene.xml"
    path.write_text(f'<a:scene xmlns:a="urn:a">{text}</a:scene>')
    return XmlFields(path, **more)


def test_numbers_are_those_of_the_text(tmp_path: Path) -> None:
    found = fields(tmp_path, "<a:gain> 1.5 -2e-3 +.5 4. </a:gain><list><x>1</x><x>2</x></list><empty> </empty>")
    assert found.numbers("gain", 4) == found.numbers("gain", None) == [1.5, -0.002, 0.5, 4.0]
    assert [found.number(".", one) for one in found.all("list/x")] == [1.0, 2.0]
    assert [found.has(name) for name in ("gain", "list/x", "list/y")] == [True, True, False]
    assert (found.said("gain"), found.said("empty"), found.said("none")) == ("1.5 -2e-3 +.5 4.", None, None)
    assert len(found.all("list/x", most=2)) == 2
    with pytest.raises(InputError, match="too many"):
        found.all("list/x", most=1)
    for name, count in (("gain", 3), ("gain", 5), ("empty", 1), ("none", 1)):
        with pytest.raises(InputError):
            found.numbers(name, count)


@pytest.mark.parametrize("text", ["nan", "inf", "1,5", "0x1", "1e999", "1_0", "\u0661", f"{'1' * 60}e5"])
def test_what_is_no_finite_number_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        fields(tmp_path, f"<x>1 {text}</x>").numbers("x", 2)


def test_a_number_has_sixty_characters_at_most(tmp_path: Path) -> None:
    assert fields(tmp_path, f"<x>0.{'3' * 58}</x>").number("x") == pytest.approx(1 / 3, rel=1e-15)
    with pytest.raises(InputError, match="not a number"):
        fields(tmp_path, f"<x>0.{'3' * 56}e-1</x>").number("x")


def test_a_dtd_is_refused_and_an_error_has_the_remedy_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text("<!DOCTYPE a><a><b>x</b></a>")
    with pytest.raises(InputError, match="not well-formed"):
        XmlFields(path, remedy="order it again")
    path.write_text("<a><b>x</b></a>")
    with pytest.raises(InputError) as caught:
        XmlFields(path, remedy="order it again").number("b")
    assert (caught.value.field, caught.value.remedy) == ("b", "order it again")


def test_a_field_has_a_limited_number_of_numbers(tmp_path: Path) -> None:
    numbers = [float(k) for k in range(MOST_TERMS)]
    assert fields(tmp_path, f"<x>{' '.join(map(str, numbers))}</x>").numbers("x", None) == numbers
    with pytest.raises(InputError, match="numbers belong here"):
        fields(tmp_path, f"<x>{' '.join(map(str, numbers))} 1</x>").numbers("x", None)


@pytest.mark.parametrize(
    ("text", "size"),
    [("1", 1), ("12000.0", 12_000), ("10000000", 10_000_000), ("0", None), ("-5", None), ("10.5", None),
     ("10000001", None)],
)  # fmt: skip
def test_the_size_of_an_image_is_a_whole_number_of_pixels(tmp_path: Path, text: str, size: int | None) -> None:
    found = fields(tmp_path, f"<x>{text}</x>")
    if size is None:
        with pytest.raises(InputError, match="not an image size"):
            found.integer("x")
    else:
        assert found.integer("x") == size


def test_times_are_seconds_after_the_midnight_before_the_first(tmp_path: Path) -> None:
    """Through the next midnight, and before: 1 h, 1 min and 1.25 s are 3661.25 s."""
    names = {"a": "2024-02-28T01:01:01.25Z", "b": "2024-02-29T00:00:00.000001", "c": "2024-02-27T23:59:59Z"}
    found = fields(tmp_path, "".join(f"<{name}>{time}</{name}>" for name, time in names.items()))
    assert [found.time(name) for name in names] == [3661.25, 86_400.000001, -1.0]


@pytest.mark.parametrize("text", ["2024-02-30T00:00:00", "2024-02-28 01:01:01", "2024-02-28T24:00:01", "10:00:00"])
def test_what_is_no_time_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="not a time"):
        fields(tmp_path, f"<x>{text}</x>").time("x")


def test_a_file_is_as_large_as_its_limit_at_most(tmp_path: Path) -> None:
    size = len('<a:scene xmlns:a="urn:a"></a:scene>') + 10
    assert fields(tmp_path, "x" * 10, limit=size).root.text == "x" * 10
    with pytest.raises(InputError, match="this file has more than"):
        fields(tmp_path, "x" * 11, limit=size)
