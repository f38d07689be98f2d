"""`python -m sinew` runs the command line tool of this installation."""

from __future__ import annotations

import os
import sys
import sysconfig

MISSING = (
    "this installation of the package has no program {path}: it was built without the tools (maturin develop, or from a "
    "source distribution). Install a wheel that bindings/python/build-wheel has made, or run cargo build -p sinew-cli"
)


def main() -> None:
    """Becomes the program `sinew`, with the same arguments."""
    path = os.path.join(sysconfig.get_path("scripts"), "sinew")
    try:
        os.execv(path, [path, *sys.argv[1:]])
    except FileNotFoundError:
        sys.exit(MISSING.format(path=path))


if __name__ == "__main__":
    main()
