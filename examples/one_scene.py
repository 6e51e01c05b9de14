# %% [markdown]
# # One scene
# From a raw satellite image with RPC to an orthoimage whose accuracy is known. Run it as a script, or cell by cell as a
# notebook.

# %%
from pathlib import Path

import ortho_pipeline as op

SAMPLE = Path(__file__).resolve().parent.parent / "sample_data"
OUT = Path("out/one_scene")

# %% [markdown]
# ## What is it?

# %%
scene = op.open_scene(SAMPLE / "scene.tif")
print(f"{scene.path.name}: {scene.sensor}, {scene.width} x {scene.height}, model from {Path(scene.model_source).name}")

# %% [markdown]
# ## Points: 12 control the adjustment, 6 check it

# %%
points = op.read_points(SAMPLE / "gcps.geojson")
print(points)
miss = points.image - scene.model.ground_to_image(points.ground)
print(f"As delivered, the model misses them by {miss.mean(axis=0).round(2)} pixels, all alike: a bias.")

# %% [markdown]
# ## Which correction do the points justify?

# %%
found = op.compare(
    points, ["rpc", "rpc+shift", "rpc+shift-drift", "rpc+affine", "affine3d"], own=scene.model,
    size=(scene.width, scene.height),
)  # fmt: skip
for row in found.rows:
    by_check = "-" if row.error else f"{row.rmse.check.total:.3f}"
    print(f"{row.model:16} {row.parameters:2} parameters   check points {by_check} px")
print(f"Recommended: {found.recommended}. {found.recommendation.reason}")

# %% [markdown]
# ## Adjust, and look at the fit (a notebook shows tables)

# %%
start = op.ImageCorrection.identity(scene.model, "shift", (scene.width / 2, scene.height / 2))
fit = op.fit(start, points)
fit  # noqa: B018
print(fit)

# %% [markdown]
# ## Orthorectify: the same adjustment, and everything is written to files

# %%
result = op.rectify(
    scene.path,
    OUT,
    points=op.PointOptions(gcps=SAMPLE / "gcps.geojson", correction="shift"),
    surface=op.SurfaceOptions(dem=SAMPLE / "dem.tif"),
)
print(result.summary)
result  # noqa: B018
