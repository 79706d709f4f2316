"""Settings of all tests."""

import os
from pathlib import Path

# Before numpy is imported: on small matrices a second thread of the linear algebra only gets in the way.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("FINFORCE_CACHE", str(Path(__file__).parent.parent / ".pytest_cache" / "finforce"))
