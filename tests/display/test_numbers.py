"""Numbers as people read them."""

from __future__ import annotations

import pytest

from ortho_pipeline.display.numbers import px, short, size_m


@pytest.mark.parametrize(
    ("value", "text"),
    [(5290.0, "+5,290"), (-5290.4, "−5,290"), (999.6, "+1,000"), (999.4, "+999"), (2.5034, "+2.5"), (0.0472, "+0.0472"),
     (1_234_567.0, "+1,234,567"), (0.0, "0"), (None, "–")],
)  # fmt: skip
def test_thousands_have_no_exponent(value, text):
    assert short(value, "+") == text


def test_sizes_have_two_digits():
    assert [size_m(value) for value in (2.503, 0.4794, 14.14, 0.0312, 1234.0)] == [
        "2.5 m", "0.48 m", "14 m", "0.031 m", "1,200 m",
    ]  # fmt: skip


def test_pixels_have_two_digits():
    """A report had 0.0758 px next to 0.28 px."""
    assert [px(value) for value in (12.345, 0.284, 0.0996, 0.0758, 0.00996, 0.00148, 0.0)] == [
        "12.35 px", "0.28 px", "0.10 px", "0.076 px", "0.010 px", "0.0015 px", "0.00 px",
    ]  # fmt: skip
