"""Write the API reference, one page a module, from the docstrings.

python scripts/api_docs.py [--out docs/api]
"""

import argparse
import pkgutil
from pathlib import Path

import pdoc

import ir_maniskill.assets
import ir_maniskill.tasks


def modules() -> list[str]:
    """Return the names of all modules of the package."""
    # tasks/ and assets/ are mapped into the package, so that walking it misses them.
    packages = [ir_maniskill, ir_maniskill.tasks, ir_maniskill.assets]
    names = {package.__name__ for package in packages}
    for package in packages:
        found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        names |= {module.name for module in found}
    return sorted(names)


def write(out: Path) -> None:
    """Write the pages into the folder `out`."""
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*modules(), output_directory=out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/api"))
    write(parser.parse_args().out)
