"""Pictures of rasters."""

import numpy as np

from ortho_pipeline.raster.quicklook import percentile


def test_percentiles_are_those_of_numpy_to_the_last_bit() -> None:
    random = np.random.default_rng(0)
    for count in [*range(1, 60), 1000, 100_001]:
        for values in (random.normal(300, 10 ** random.uniform(-3, 5), count), random.integers(0, 5, count) * 1.0):
            for percent in (0.0, 1.0, 50.0, 99.0, 100.0):
                assert percentile(values, percent) == np.percentile(values, percent)
