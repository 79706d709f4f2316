"""Packages, executables and installed files; name and version stand in package.xml, too."""

import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "finforce"
# README outside the repository: without its pictures, and with the text alone of links to other files
README = re.sub(r"^!\[.*\n", "", Path("README.md").read_text(encoding="utf-8"), flags=re.M)
README = re.sub(r"(?<!!)\[([^\]\[]+)\]\((?!https?:|#)[^)]*\)", r"\1", README)

setup(
    name=NAME,
    version="0.1.0",
    description="Grasp force from the key points of fin-ray jaws, by a mechanical model of the jaw.",
    long_description=README,
    long_description_content_type="text/markdown",
    author="finforce developers",
    license="Apache-2.0",
    keywords=["robotics", "soft gripper", "fin-ray", "force estimation", "inverse finite elements", "ROS 2"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)),
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    python_requires=">=3.10",
    packages=find_packages(include=["finforce", "finforce.*", "finforce_*"]),
    package_data={
        "": ["py.typed", "*.pyi"],
        "finforce.ros": ["fastdds.xml"],
        "finforce_ifea.jaw": ["jaws/*", "calibrations/*"],
        "finforce_eval": ["data/*", "data/*/*", "data/*/*/*"],
        "finforce_keypoints": ["models/*/*"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*.yaml")),
        (f"share/{NAME}/config/ros2_control", glob("config/ros2_control/*")),
        (f"share/{NAME}/config/moveit", glob("config/moveit/*")),
        (f"share/{NAME}/config/grippers", glob("config/grippers/*")),
        (f"share/{NAME}/config/diagnostics", glob("config/diagnostics/*")),
        (f"share/{NAME}/examples", glob("examples/*.py")),
        (f"share/{NAME}/rviz", glob("rviz/*")),
        (f"share/{NAME}/urdf", glob("urdf/*")),
    ],
    zip_safe=False,
    install_requires=[
        "numpy",  # arrays
        "scipy",  # sparse matrices, factorisations, least squares
        "numba",  # compiles the element loops: a step in milliseconds
        "pyyaml",  # jaw files, calibrations
        "pydantic>=2",  # their form, checked with a message for every key
        "meshio",  # volume mesh files of jaws
        "pillow",  # picture files
        "rosbags>=0.11,<0.12",  # recordings, without ROS
        "mcap",  # recordings that were cut off, record by record
        "manifold3d",  # Boolean intersections and outlines of object meshes
        "trimesh",  # object mesh files, surfaces of fingers
        "shapely",  # polygons: sections of fingers, what lies in them, whether they are sound
        "onnxruntime",  # runs key point networks, without their makers' frameworks
        "opencv-contrib-python-headless",  # warps, resizes and decodes images; finds dots
        "pyserial",  # the serial port of the CAN adapter
        "matplotlib",  # pictures of the reports
        "tqdm",  # progress bars
        "pandas",  # tables of forces over time and of figures, with named columns
        "pyarrow",  # these tables in Parquet files
        "psutil",  # CPU time and memory of processes
    ],
    extras_require={
        # ROS 2 Jazzy for machines without it; Python 3.10 to 3.13 on x86_64
        "ros": [
            "ros-jazzy-rclpy[fastrtps]",
            "ros-jazzy-rmw-fastrtps-cpp",
            "ros-jazzy-common-interfaces",
            "ros-jazzy-ament-index-python",
        ],
        # ray casting, registration with scale, Poisson surfaces: the simulator, and meshes of objects that are tracked,
        # checked, reconstructed or decimated; 312 MB, and the build without CUDA is a quarter of the whole size
        "mesh": [
            "open3d-cpu; platform_machine == 'x86_64' and sys_platform == 'linux'",
            "open3d; platform_machine != 'x86_64' or sys_platform != 'linux'",
        ],
        "cad": ["cascadio", "ezdxf", "svgelements"],  # fingers from STEP, DXF and SVG files
        "can": ["python-can>=4.3"],  # other CAN adapters than SLCAN ones: SocketCAN and more
        "video": ["av"],  # no other wheel decodes video exactly frame by frame
        "lerobot": ["av"],  # whose datasets hold videos
        "zarr": ["numcodecs"],  # UMI's chunks; the library zarr itself takes a missing chunk for zeros, a force of none
        # many recordings on the workers of this machine or of a cluster, with its dashboard; TLS between the former
        "dask": ["dask[distributed,diagnostics]>=2025.1", "cryptography"],
        "completion": ["argcomplete"],  # of the command line, by the shell
        "view": ["rerun-sdk"],  # a viewer of pictures, shapes and curves over time
        # training of key point networks; without a GPU, torch's own index has a build of a tenth of the size
        "train": ["torch", "onnx"],
        "test": ["pytest", "pytest-xdist", "pytest-timeout", "hypothesis", "onnx", "python-can>=4.3,!=4.6.0", "xacro"]
        + ["cascadio", "ezdxf", "svgelements", "av", "rerun-sdk", "playwright", "argcomplete", "numcodecs"]
        + ["dask[distributed]>=2025.1", "cryptography"],
        "lint": ["ruff", "import-linter"],
    },
    entry_points={
        "console_scripts": [
            "finforce = finforce_eval.cli.main:main",
            # run by the name that they are called by
            "contact_estimator = finforce.ros.start:main",
            "emulated_gripper = finforce.ros.start:main",
            "gripper_driver = finforce.ros.start:main",
            "ifea_solver = finforce.ros.start:main",
            "keypoint_detector = finforce.ros.start:main",
            "finforce_pipeline = finforce.ros.start:main",
            "finforce_recording_player = finforce.ros.start:main",
            "twin_camera = finforce.ros.start:main",
        ],
    },
)
