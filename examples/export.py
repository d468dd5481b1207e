"""The trajectory in pandas, xarray and a GIS.

It needs pip install '.[examples]'. It writes track.geojson, which QGIS opens, and export.png.
"""

from pathlib import Path

import geopandas
import matplotlib.pyplot as plt

import rovgraph as rg

DIVE = Path(__file__).parents[1] / "data" / "falcon"
ORIGIN = 58.4, 14.6  # latitude and longitude [deg] of north = east = 0: a lake, chosen for the example

config = rg.load_config(DIVE / "config.yaml")
result = rg.smooth(rg.read_log(DIVE / "log.csv.gz", config), config)
track = result.smoothed.trajectory

# pandas: one row per keyframe, a _sd for each quantity
frame = track.to_frame()
print(frame[["time", "north", "north_sd", "yaw", "yaw_sd"]].iloc[::600].round(3))

# xarray: the same with time as its dimension, here in means of ten seconds
dataset = frame.set_index("time").to_xarray()
dataset["north"].attrs["units"] = dataset["east"].attrs["units"] = "m"
means = dataset.groupby(dataset["time"] // 10 * 10).mean()
print(means[["north", "east", "v_north"]])

# a GIS: points in WGS 84 with depth and sd as attributes
latitude, longitude = track.geodetic(ORIGIN)
points = geopandas.GeoDataFrame(
    frame[["time", "down", "north_sd", "east_sd"]],
    geometry=geopandas.points_from_xy(longitude, latitude),
    crs="EPSG:4326",
)
points.to_file("track.geojson", driver="GeoJSON")

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
points.plot("down", ax=axes, markersize=2, legend=True, legend_kwds={"label": "depth [m]"})
axes.set(xlabel="longitude [°]", ylabel="latitude [°]", title="track.geojson")
axes.ticklabel_format(useOffset=False)
axes.tick_params("x", rotation=30)
figure.savefig("export.png", dpi=150)
