"""Write the API reference, one page a module, from the docstrings.

python scripts/api_docs.py [--out docs/api]
"""

import argparse
import pkgutil
from pathlib import Path

import pdoc

import ir_maniskill


def specs() -> list[str]:
    """Return all modules; pdoc by itself passes over those missing in `__all__`."""
    inside = pkgutil.walk_packages(ir_maniskill.__path__, "ir_maniskill.")
    return ["ir_maniskill", *(module.name for module in inside)]


def write(out: Path) -> None:
    """Write the pages into the folder `out`."""
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*specs(), output_directory=out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/api"))
    write(parser.parse_args().out)
