#!/usr/bin/env bash
# mcap-ros2-support 0.5.7 (mcap 1.2.2): Writer.write_message takes a message as dictionaries and
# writes the default for every field that it does not find. A name that the definition does not have
# is dropped without an error: ROS 1's time fields (secs, nsecs) give a stamp of 0, and a misspelled
# "piont" a point at the origin. The file is valid; a map from it has all scans in one place.
# Readers of such a file should treat a stamp of 0 with care; writers should check their names.
#
# Output seen: stamp 0.000000000, position 0.0 0.0 0.0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q mcap==1.2.2 mcap-ros2-support==0.5.7
"$folder/venv/bin/python" - <<'PYTHON'
import io

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

LINE = "\n" + "=" * 80 + "\n"
DEFINITION = LINE.join(
    [
        "std_msgs/Header header\ngeometry_msgs/Point point",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
        "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z",
    ]
)
file = io.BytesIO()
writer = Writer(file)
schema = writer.register_msgdef("geometry_msgs/msg/PointStamped", DEFINITION)
message = {
    "header": {"stamp": {"secs": 5, "nsecs": 7}, "frame_id": "map"},  # sec, nanosec in ROS 2
    "piont": {"x": 1.0, "y": 2.0, "z": 3.0},
}
writer.write_message("/point", schema, message, log_time=5_000_000_007)
writer.finish()
file.seek(0)
reader = make_reader(file, decoder_factories=[DecoderFactory()])
((_, _, _, read),) = reader.iter_decoded_messages()
stamp, at = read.header.stamp, read.point
seen = f"stamp {stamp.sec}.{stamp.nanosec:09d}, position {at.x} {at.y} {at.z}"
print(seen)
assert seen == "stamp 0.000000000, position 0.0 0.0 0.0", "the behavior has changed"
PYTHON
