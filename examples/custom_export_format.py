"""Write takes or variants in a format of your own: a JSON file each with named joints, beside licence and credits.

python examples/custom_export_format.py poses:duets --store store --out joints

To add the format to `pasdedeux export`, register it as described in docs/extending.md.
"""

import argparse
import json
from pathlib import Path

from flows.exports import EXPORT_FORMATS, export_reference
from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, ExportFormat
from storage_schema import Store


def write(export, out):
    """Write a file for each take or variant."""
    files = CastFiles(export, out, ("Positions are in metres, Y up: frame, person, joint, xyz.",))
    for cast in casts(export):
        path = files.path(cast, suffix=".json")
        names, positions_m = cast.skeleton.joint_names, cast.positions_m.round(4).tolist()
        path.write_text(json.dumps({"rate_hz": cast.rate_hz, "joints": names, "positions_m": positions_m}))
    return files.close()


FORMAT = ExportFormat(write, holds_poses, POSED, options=POSED_OPTIONS)

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("reference")
parser.add_argument("--store", default="store")
parser.add_argument("--out", default="joints")
options = parser.parse_args()

EXPORT_FORMATS["named_json"] = __name__  # the module that has FORMAT
Path(options.out).mkdir(parents=True, exist_ok=True)
for path in export_reference(Store(options.store), options.reference, "named_json", Path(options.out)):
    print(path)
