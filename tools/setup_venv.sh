#!/usr/bin/env bash
# Makes or refreshes the virtual environment .venv for one purpose:
#   tools/setup_venv.sh lint|run|test|build
# A sourced ROS 2 is used as it is; without one, ROS 2 Jazzy comes from wheels. Needs nothing but Python.
set -euo pipefail
cd "$(dirname "$0")/.."
purpose=${1:?lint, run, test or build}
venv=.venv

fail() { printf 'finforce set-up: %s\n' "$*" >&2; exit 1; }
say() { printf 'finforce set-up: %s\n' "$*"; }
works() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; }

# Prints a Python, 3.10 or later. The wheels exist for 3.10 to 3.13; a sourced ROS 2 asks for its own.
choose_python() {
  local name
  if sourced_ros; then echo python3; return; fi
  for name in ${FINFORCE_PYTHON:-} python3 python3.12 python3.11 python3.10 python3.13; do
    if works "$name" && "$name" -c 'import sys; sys.exit(sys.version_info >= (3, 14))'; then
      command -v "$name"; return
    fi
  done
  fail "no Python from 3.10 to 3.13 is on the path, and there are ROS 2 wheels for no other." \
    "Install one (Debian, Ubuntu: sudo apt-get install python3 python3-venv) or set FINFORCE_PYTHON."
}

sourced_ros() { [ -n "${AMENT_PREFIX_PATH:-}" ] && python3 -c 'import rclpy' 2>/dev/null; }

# Installs Debian packages as root; else prints the one line that would do.
install_packages() {
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get install -y "$@" >/dev/null 2>&1 ||
      { apt-get update >/dev/null 2>&1 && apt-get install -y "$@" >/dev/null 2>&1; } && return 0
  fi
  say "please run: sudo apt-get install -y $*"
  return 1
}

make_venv() {
  local python version options=()
  python=$(choose_python)
  if sourced_ros; then
    options=(--system-site-packages)
    say "uses the sourced ROS 2 ${ROS_DISTRO:-}"
  fi
  version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    install_packages "python$version-venv" || fail "$python cannot make virtual environments yet"
  fi
  say "makes $venv with Python $version ($python)"
  "$python" -m venv --clear "${options[@]}" "$venv"
}

# What open3d loads when it is imported; a machine without a display often lacks them.
check_system_libraries() {
  local pair missing=()
  for pair in libgl1=libGL.so.1 libgomp1=libgomp.so.1 libx11-6=libX11.so.6; do
    { ldconfig -p 2>/dev/null || /sbin/ldconfig -p; } | grep -q "${pair#*=} " || missing+=("${pair%%=*}")
  done
  [ ${#missing[@]} = 0 ] || install_packages "${missing[@]}" ||
    say "goes on without ${missing[*]}: only the work with object meshes will miss them"
}

install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }

install_product() {
  local extras=${1:-}
  sourced_ros || extras="ros${extras:+,$extras}"
  install setuptools wheel
  install --no-build-isolation --editable ".${extras:+[$extras]}"
}

[ -x "$venv/bin/python" ] && works "$venv/bin/python" || make_venv
case $purpose in
  lint) install ruff ;;
  run) check_system_libraries; install_product ;;
  test) check_system_libraries; install_product test ;;
  build) install_product; install colcon-common-extensions ;;
  *) fail "unknown purpose $purpose" ;;
esac
touch "$venv/.$purpose"
