#!/usr/bin/env bash
# Installs a wheel into an empty environment and uses it there, out of reach of the checkout:
#   tools/check_dist.sh PYTHON WHEEL
set -euo pipefail
python=${1:?a Python} wheel=$(realpath "${2:?a wheel}")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$python" -m venv "$folder/venv"
bin=$folder/venv/bin
"$bin/pip" install --quiet --disable-pip-version-check "$wheel[ros,mesh]"
cd "$folder"
unset PYTHONPATH
export OMP_NUM_THREADS=1
"$bin/finforce" --version
"$bin/finforce" launch robot sim:=true --show-args >arguments
"$bin/finforce" twin --help >help
"$bin/python" - <<'PY'
import sys

import finforce as ff

assert ff.__file__.startswith(sys.prefix), ff.__file__
recording = ff.read_recording(ff.DEMO)
force = ff.ForceEstimator("bench", calibration="bench")
poses, image = next(ff.iter_frames(recording, side="left"))
print(ff.ForceLoop(ff.ContactEstimator(force.jaw, mesh=ff.load_object_mesh(ff.find_mesh(recording))), force).update(image))
PY
steel=$("$bin/python" -c 'import finforce; print(finforce.DEMO.with_name("steel_r20"))')
"$bin/finforce" evaluate "$steel" --jaw steel --set automatic_tare=no | tail -n 2
