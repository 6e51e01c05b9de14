"""What is opened as a raster, and what is refused."""

from __future__ import annotations

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import open_dataset


def test_a_folder_without_a_product_is_no_image(tmp_path):
    with pytest.raises(InputError, match="this is a folder, not an image") as caught:
        open_dataset(tmp_path)
    assert "by name" in str(caught.value.remedy)
