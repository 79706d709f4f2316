"""Builds what is used of a message package, where ROS 2 comes from wheels, which lack it.

    python test/message_packages/build.py control_msgs|vision_msgs PREFIX

The wheels hold generators, headers and libraries, but name the folders of the machine on which they were made: a copy
of their share, in which these are put right, is what CMake reads. Needs CMake and a C++ compiler.
"""

import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy

HERE = Path(__file__).parent
# of the wheels' machine, in what CMake reads
PYTHON = re.compile(r"/opt/python/[^\"; ]*/include/python3\.\d+")
NUMPY = re.compile(r"/opt/python/[^\"; ]*/numpy/_?core/include")


def copy_prefix(venv: Path, prefix: Path) -> None:
    """Copy the share of the wheels with the folders of this machine; the rest is linked."""
    for share in (venv / "share", venv / "generators" / "share"):
        shutil.copytree(share, prefix / "share", dirs_exist_ok=True)
    for name in ("lib", "include"):
        if not (prefix / name).exists():
            (prefix / name).symlink_to(venv / name)
    include = sysconfig.get_path("include", vars={"base": sys.base_prefix, "installed_base": sys.base_prefix})
    for path in prefix.glob("share/*/cmake/*.cmake"):
        text = path.read_text()
        if "/opt/python" in text:
            path.write_text(NUMPY.sub(numpy.get_include(), PYTHON.sub(include, text)))


def build(package: str, target: Path) -> None:
    """Generate, compile and install a package into a folder.

    Raises:
        SystemExit: something of it fails, with what was printed.
    """
    prefix, work = target / "wheels", target / "build"
    prefix.mkdir(parents=True, exist_ok=True)
    copy_prefix(Path(sys.prefix), prefix)
    generators = Path(sys.prefix) / "generators" / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"
    environment = {
        "PYTHONPATH": str(generators),
        "PATH": f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin",
        "AMENT_PREFIX_PATH": str(prefix),
        "CMAKE_PREFIX_PATH": str(prefix),
    }
    options = [f"-DCMAKE_INSTALL_PREFIX={target}", f"-DPython3_EXECUTABLE={sys.executable}", "-DBUILD_TESTING=OFF"]
    for command in (
        ["cmake", "-S", str(HERE / package), "-B", str(work), *options],
        ["cmake", "--build", str(work), "-j2"],
        ["cmake", "--install", str(work)],
    ):
        done = subprocess.run(command, env=environment, check=False, text=True, capture_output=True)
        if done.returncode:
            sys.exit(f"{' '.join(command)}:\n{done.stdout[-3000:]}\n{done.stderr[-6000:]}")
    shutil.rmtree(work)
    shutil.rmtree(prefix)
    (target / "done").touch()


if __name__ == "__main__":
    build(sys.argv[1], Path(sys.argv[2]).resolve())
