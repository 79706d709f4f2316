#!/usr/bin/env python3
"""Imports every module of finforce that is installed, and names those that cannot be: `tools/check_imports.py`."""

import importlib
import pkgutil
import sys

PACKAGES = (
    "finforce", "finforce_ifea", "finforce_contact", "finforce_keypoints", "finforce_driver", "finforce_eval",
    "finforce_sim",
)  # fmt: skip


def main() -> int:
    """Import all; return 1 where one fails."""
    failed = []
    optional = importlib.import_module("finforce.errors").MissingDependencyError  # of adapters to what others install
    for package in PACKAGES:
        module = importlib.import_module(package)
        for entry in pkgutil.walk_packages(module.__path__, f"{package}."):
            if entry.name.endswith("__main__"):
                continue
            try:
                importlib.import_module(entry.name)
            except optional as error:
                print(f"left out: {entry.name}: {error}")
            except Exception as error:  # whatever it is: it cannot be imported
                failed.append(f"{entry.name}: {type(error).__name__}: {error}")
    print("\n".join(failed) or "every module can be imported")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
