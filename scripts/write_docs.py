"""Write a site to browse without a network: the pages, and the API from its docstrings.

python scripts/write_docs.py [--out docs/site]
"""

import argparse
import os
import pkgutil
import re
import sys
import warnings
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import pdoc

import ir_maniskill

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    ROOT / "README.md": "guide",
    **{path: f"guide.{path.stem}" for path in sorted(ROOT.glob("docs/*.md"))},
}
"""The pages, and the modules that pdoc takes them for: so they are in its search."""
LINK = re.compile(r"(?<=\]\()(?!http)([^)#]+)")
"""What a link or picture leads to in this repository."""


def specs() -> list[str]:
    """Return all modules; pdoc by itself passes over those missing in `__all__`."""
    warnings.filterwarnings("ignore", "The module specification", module="pdoc")
    inside = pkgutil.walk_packages(ir_maniskill.__path__, "ir_maniskill.")
    return ["ir_maniskill", *(module.name for module in inside)]


def write(out: Path) -> None:
    """Write the site into the folder `out`."""
    for page in PAGES:
        _add(page, out.resolve())
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*PAGES.values(), *specs(), output_directory=out)


def _add(page: Path, out: Path) -> None:
    """Make a module whose docstring is the page."""
    name = PAGES[page]
    here = _place(page, out).parent

    def moved(link: re.Match[str]) -> str:
        """Return the link as it is in the site."""
        target = (page.parent / link[1]).resolve()
        return os.path.relpath(_place(target, out), here)

    module = ModuleType(name, LINK.sub(moved, page.read_text()))
    module.__spec__ = ModuleSpec(name, None, is_package=name == "guide")
    module.__docformat__ = "markdown"  # type: ignore[attr-defined]
    sys.modules[name] = module
    if name != "guide":
        setattr(sys.modules["guide"], page.stem, module)


def _place(target: Path, out: Path) -> Path:
    """Return where the site has a file: pages become HTML, others stay."""
    if target not in PAGES:
        return target
    return out / (PAGES[target].replace(".", "/") + ".html")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/site"))
    write(parser.parse_args().out)
