"""What a picture (.rrd) holds, read by Rerun's own reader: of each entity its rows, the first and last of them
by the data's time, and how far what it draws reaches along each axis; as JSON.

usage: picture.py FILE.rrd [PNG]

With PNG it is shown by Rerun's viewer without a screen, where that can draw (Vulkan, such as Debian's
mesa-vulkan-drivers), and kept there; `shown` says how many colours the picture has, null where nothing could
draw it. Needs PyPI's rerun-sdk of the version that wrote the file.
"""
import json
import os
import subprocess
import sys

from PIL import Image
from rerun.experimental import RrdReader

PLACES = ("Points3D:positions", "Ellipsoids3D:centers", "LineStrips3D:strips", "Arrows3D:origins",
          "Transform3D:translation", "GeoPoints:positions", "Mesh3D:vertex_positions")


def points(value):
    """All points of a value of nested lists."""
    if value is None:
        return
    if value and isinstance(value[0], (int, float)):
        yield value
    else:
        for part in value:
            yield from points(part)


def read(path):
    entities = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        entity = entities.setdefault(chunk.entity_path, {"rows": 0, "components": set(), "low": None, "high": None})
        entity["rows"] += batch.num_rows
        for name in batch.schema.names:
            if ":" not in name:
                continue
            entity["components"].add(name)
            if name in PLACES:
                for point in points(batch.column(name).to_pylist()):
                    low, high = entity["low"] or point, entity["high"] or point
                    entity["low"] = [min(a, b) for a, b in zip(low, point)]
                    entity["high"] = [max(a, b) for a, b in zip(high, point)]
    for entity in entities.values():
        entity["components"] = sorted(entity["components"])
    return entities


def shown(path, png):
    viewer = os.path.join(os.path.dirname(sys.executable), "rerun")
    command = [viewer, "--headless", "--bind", "127.0.0.1", "--port", "0", "--window-size", "1600x900",
               "--screenshot-to", png, path]
    try:
        # What it logs it shows as well, over the picture.
        quiet = dict(os.environ, RUST_LOG="off")
        subprocess.run(command, check=True, timeout=120, capture_output=True, env=quiet)
        return len(Image.open(png).convert("RGB").getcolors(1 << 24))
    except (OSError, subprocess.SubprocessError):
        return None


picture = {"entities": read(sys.argv[1])}
if len(sys.argv) > 2:
    picture["shown"] = shown(sys.argv[1], sys.argv[2])
json.dump(picture, sys.stdout)
