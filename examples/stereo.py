# %% [markdown]
# # Stereo
# Two images of one place from different directions, nine control points, sixty check points: the bundle adjustment, and
# the ground coordinates that the images give. The sample is a simulated CARTOSAT-1 pair with pixels of 76 m.

# %%
from pathlib import Path

import numpy as np

import ortho_pipeline as op

SAMPLE = Path(__file__).resolve().parent.parent / "sample_data" / "cartosat"
OUT = Path("out/stereo")

# %% [markdown]
# ## Images and points
# The file of points has one line for each measurement; points that lie in both images tie them together.

# %%
points = op.read_block_points(SAMPLE / "points.csv")
scenes = {name: op.open_scene(SAMPLE / name) for name in points.images}
print(f"{len(points)} points, {points.control.sum()} control and {points.check.sum()} check, in {', '.join(scenes)}")

# %% [markdown]
# ## Adjust: the vendor's RPCs, each with a shift

# %%
start = {
    name: op.ImageCorrection.identity(scene.model, "shift", (scene.width / 2, scene.height / 2))
    for name, scene in scenes.items()
}
block = op.adjust(start, points)
for name, model in block.models.items():
    print(name, dict(zip(model.param_names, np.round(model.params, 2).tolist(), strict=True)))
rms = block.object_rms("check")
print(f"sigma0 {block.sigma0:.2f} px; check points: {rms.plan:.0f} m in plan, {rms.h:.0f} m in height")
print(block.gauge)

# %% [markdown]
# ## Ground coordinates with their accuracy, from the adjusted models alone

# %%
ground = op.intersect(block.models, points)
lon, lat, height = ground.ground[0]
print(f"{points.ids[0]}: {lon:.5f}, {lat:.5f}, {height:.0f} m; sigmas {np.round(ground.sigmas[0]).tolist()} m")

# %% [markdown]
# ## Each adjusted model is written as RPC and as model file, and one image is orthorectified with it
# The model file also holds what the model was adjusted by, so that the report of the ortho can say how accurate it is.

# %%
(OUT / "adjusted").mkdir(parents=True, exist_ok=True)
record = block.to_json()
for name, model in block.models.items():
    adjusted = OUT / "adjusted" / Path(name).stem
    op.write_rpc_txt(op.export_rpc(model).rpc, f"{adjusted}_RPC.TXT")
    adjustment = {"gauge": block.gauge, "sigma0": block.sigma0, **record["images"][name]}
    op.save_model(model, f"{adjusted}_model.json", adjustment=adjustment)
result = op.rectify(
    SAMPLE / "BANDA.tif",
    OUT,
    scene=op.SceneOptions(model=OUT / "adjusted" / "BANDA_model.json"),
    surface=op.SurfaceOptions(dem=SAMPLE / "dem.tif"),
)
print(result.summary)
