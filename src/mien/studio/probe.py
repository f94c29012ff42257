"""Prints width, height and seconds of a film as json, or fails: `python -m mien.studio.probe FILE`."""

import json
import sys
from pathlib import Path

from mien.media.video_file import open_video


def probe(path: Path) -> dict[str, float]:
    """Return the facts of a film whose first picture can be decoded. Other files raise an error of their reader."""
    with open_video(path) as (container, stream):
        frame = next(container.decode(stream))
        times = (packet.pts * packet.time_base for packet in container.demux(stream) if packet.pts and packet.time_base)
        seconds = max(map(float, times), default=0.0) - float(frame.time or 0.0)
        if seconds < 1:  # A picture has no duration.
            raise ValueError(f"{seconds:.1f} s of pictures are too few")
        return {"width": frame.width, "height": frame.height, "seconds": round(seconds, 1)}


if __name__ == "__main__":
    print(json.dumps(probe(Path(sys.argv[1]))))
