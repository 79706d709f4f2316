"""Topics of a camera as realsense2_camera names them, and what image_transport calls compressed images.

Recordings have them as they stand here, nodes in their own namespace: see `relative`.
"""

# the colour images of a D405 have had both names
CAMERA = "/camera/camera"
COLOR_TOPIC, OLD_COLOR_TOPIC = f"{CAMERA}/color/image_raw", f"{CAMERA}/color/image_rect_raw"
DEPTH_TOPIC = f"{CAMERA}/aligned_depth_to_color/image_raw"
INFO_TOPIC = f"{CAMERA}/color/camera_info"
TRANSPORTS = RAW, COMPRESSED, AUTO = ("raw", "compressed", "auto")
ENDS = COMPRESSED_COLOR, COMPRESSED_DEPTH = ("/compressed", "/compressedDepth")
GLOBAL = ("/tf", "/tf_static", "/clock", "/diagnostics")  # one for all robots of a domain


def relative(topic: str) -> str:
    """Return the name of a recorded topic in a node's own namespace; topics that all robots share stay."""
    return topic if topic in GLOBAL else topic.lstrip("/")
