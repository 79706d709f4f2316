"""Topics of a camera as realsense2_camera names them, and what image_transport calls compressed images."""

# the colour images of a D405 have had both names
CAMERA = "/camera/camera"
COLOR_TOPIC, OLD_COLOR_TOPIC = f"{CAMERA}/color/image_raw", f"{CAMERA}/color/image_rect_raw"
DEPTH_TOPIC = f"{CAMERA}/aligned_depth_to_color/image_raw"
INFO_TOPIC = f"{CAMERA}/color/camera_info"
TRANSPORTS = RAW, COMPRESSED, AUTO = ("raw", "compressed", "auto")
ENDS = COMPRESSED_COLOR, COMPRESSED_DEPTH = ("/compressed", "/compressedDepth")
