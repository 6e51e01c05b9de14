"""Files of points: what is written is read back as it was, whatever the ids, or it is refused before it is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points, read_points, write_points

#: What ids of surveys, of other programs and of attackers are made of.
ODD = [
    "",
    " ",
    "a b",
    " a",
    "a\u00a0",
    "a\tb",
    "a\nb",
    "a\rb",
    "a\x85b",
    "a\u2028b",
    "a\x1fb",
    "\ufeffa",
    "#1",
    "#CRS: x",
]
ODD += [
    '"',
    'a"b',
    "'",
    "a,b",
    "a;b",
    "a|b",
    ",",
    "é",
    "点",
    "\U0001f6f0",
    "a\u0301",
    "1",
    "01",
    "1.0",
    "nan",
    "id",
    "null",
]
# The header of QGIS's files, which a line of CSV may begin with.
ODD += ["MAPX"]
ODD += ["\ud800", "a\x00b", "\x7f", "\x1b[31m", "=1+1", "p" * 3000]
IDS = st.lists(st.one_of(st.sampled_from(ODD), st.text(max_size=12)), min_size=1, max_size=6, unique=True)


def points_of(ids: list[str], seed: int, heights: float = 400.0) -> Points:
    """Return points of these ids somewhere in South Africa, with numbers of as many digits as there are."""
    random, count = np.random.default_rng(seed), len(ids)
    ground = np.column_stack(
        [random.uniform(20, 30, count), random.uniform(-34, -24, count), heights * random.random(count)]
    )
    return Points(
        ids=tuple(ids),
        image=random.uniform(-100, 1e5, (count, 2)),
        ground=ground,
        roles=random.choice(["control", "check", "tie"], count),
        sigma_image=random.uniform(0.01, 3, count),
        sigma_ground=np.repeat(random.uniform(0, 3, (count, 2)), (2, 1), axis=1),
        crs=pyproj.CRS(4326),
        source="made",
    )  # fmt: skip


def is_plain(name: str) -> bool:
    """Whether an id is text without blanks at its ends, or in a row, or anything that ends a line or a file."""
    return bool(name) and name == " ".join(name.split()) and not is_odd(name)


def is_odd(name: str) -> bool:
    """Whether an id cannot stand in a text file: it has a NUL or half of a surrogate pair."""
    return "\0" in name or any(0xD800 <= ord(letter) <= 0xDFFF for letter in name)


def same(one: Points, other: Points, image: float = 0.0) -> None:
    assert one.ids == other.ids
    assert one.roles.tolist() == other.roles.tolist()
    assert one.crs == other.crs
    np.testing.assert_allclose(one.image, other.image, rtol=0, atol=image)
    np.testing.assert_array_equal(one.ground, other.ground)
    np.testing.assert_array_equal(one.sigma_image, other.sigma_image)
    np.testing.assert_array_equal(one.sigma_ground, other.sigma_ground)


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".geojson"])
@given(ids=IDS, seed=st.integers(0, 1000))
@example(ids=ODD, seed=0)
@example(ids=[name for name in ODD if is_plain(name)], seed=0)
@example(ids=["MAPX"], seed=0)
def test_points_are_read_as_they_were_written(tmp_path: Path, suffix: str, ids: list[str], seed: int) -> None:
    points, path = points_of(ids, seed), tmp_path / f"points{suffix}"
    path.unlink(missing_ok=True)
    if all(map(is_plain, ids)):
        write_points(points, path)
        # GeoJSON counts pixels from the centre of the first one: half a pixel is taken away and added again.
        same(read_points(path), points, image=1e-10 if suffix == ".geojson" else 0.0)
    else:
        with pytest.raises(InputError) as caught:
            write_points(points, path)
        assert caught.value.field == "id"
        assert not path.exists()


@given(ids=IDS, seed=st.integers(0, 1000))
@example(ids=["a  b", "a b"], seed=0)
@example(ids=[b"\\ud800".decode("unicode_escape"), "a"], seed=0)
def test_ids_of_strangers_are_points_that_can_be_written(tmp_path: Path, ids: list[str], seed: int) -> None:
    """A GeoJSON with any ids has points that every format of ours keeps, or is refused with file and field."""
    path = tmp_path / "strange.geojson"
    features = points_of(ids, seed).__geo_interface__
    path.write_text(json.dumps(features))
    if any(is_odd(name) for name in ids):
        with pytest.raises(InputError, match=r"is not an id|two points have the id|is not JSON"):
            read_points(path)
        return
    names = [" ".join(name.split()) for name in ids]
    # A point without a name has the number of its place in the file.
    names = [name or str(count) for count, name in enumerate(names, start=1)]
    if len(set(names)) < len(names):
        with pytest.raises(InputError, match="two points have the id"):
            read_points(path)
        return
    points = read_points(path)
    assert points.ids == tuple(names)
    for suffix in (".csv", ".tsv", ".geojson"):
        write_points(points, tmp_path / f"again{suffix}")
        same(read_points(tmp_path / f"again{suffix}"), points, image=1e-10)
