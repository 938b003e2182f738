"""The elevation model of this folder: made-up ground on a polar map, as agencies publish theirs.

python examples/ground/make_model.py examples/ground/rim.tif
"""

import sys

import numpy as np
import rasterio
from affine import Affine

from moonteam.terrain.site import make_site

PIXEL = 1.5  # m
CORNER = 12_000.0, -8_500.0  # m, of the map: 14.7 km from the south pole


def main(path):
    """Writes 40 by 40 pixels of a crater's rim, in whole centimetres."""
    site = make_site("crater_rim", 4, 39 * PIXEL, PIXEL)
    with rasterio.open(
            path, "w", driver="GTiff", width=40, height=40, count=1, dtype="int16",
            compress="deflate", nodata=-32768, crs="+proj=stere +lat_0=-90 +R=1737400 +units=m",
            transform=Affine(PIXEL, 0, CORNER[0], 0, -PIXEL, CORNER[1])) as out:
        out.write(np.round(100 * site.heights[::-1]).astype(np.int16), 1)
        out.scales = (0.01,)


if __name__ == "__main__":
    main(sys.argv[1])
