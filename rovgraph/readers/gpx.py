"""GPX tracks (https://www.topografix.com/GPX/1/1/): fixes of a receiver on a ship, a float or at the surface."""

from array import array
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.readers.ardupilot import NO_DILUTION, RANGE_SD_M, new_fixes
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording

UTC = "UTC of the receiver"


class Gpx:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "gpx"
    title = "GPX track"
    extra = "maps"

    def recognise(self, path: Path, head: bytes) -> float:
        return 0.95 if b"<gpx" in head[:2000] and head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<") else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        import gpxpy
        from gpxpy.gpx import GPXException

        try:
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                track = gpxpy.parse(file)
        except (GPXException, ValueError) as error:
            said = (str(error).splitlines() or ["damaged"])[0]
            raise InputError(f"{path}: is no whole GPX file ({said}); save it again") from None
        rows, timeless = array("d"), 0
        points = [point for line in track.tracks for segment in line.segments for point in segment.points]
        for point in points:
            if point.time is None:
                timeless += 1
                continue
            dop = point.horizontal_dilution
            sd = RANGE_SD_M * dop if dop is not None and 0.0 < dop < NO_DILUTION else np.nan
            rows.extend((point.time.timestamp(), point.latitude, point.longitude, sd))
        options.progress(1, 1)
        if not rows:
            raise InputError(f"{path}: {len(points)} points of a track, none with a time; export it with times")
        return _recording(path, self.name, rows, timeless)


FORMAT = Gpx()


def _recording(path: Path, format_: str, rows: "array[float]", timeless: int) -> Recording:
    table = np.frombuffer(rows).reshape(-1, 4)
    table = table[np.argsort(table[:, 0], kind="stable")]
    new = new_fixes(*table[:, :3].T)
    left = [
        Left("points", timeless, "no time"),
        Left("points", int((~new).sum()), "nowhere on Earth, or the one before repeated"),
    ]
    columns = dict(zip(("time", "fix_lat", "fix_lon", "fix_sd"), table[new].T, strict=True))
    warnings = ["a GPX track is often that of a ship or a float: see that its fixes are of the vehicle"]
    if not np.isfinite(table[:, 3]).any():
        warnings.append("no dilution of precision in the file: state fix.sd_m")
    return Recording(
        str(path),
        format_,
        (Channel("fix", columns, "trkpt", "", UTC),),
        {UTC: Clock(UTC, 0.0, 0.0, "its stamps are Unix time")},
        tuple(each for each in left if each.count),
        warnings=tuple(warnings),
    )
