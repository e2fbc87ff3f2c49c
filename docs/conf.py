"""How Sphinx makes the site: MyST pages, notebooks that are executed, formulas as MathML, nothing from elsewhere."""

import hashlib
import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE), str(HERE / "_extensions")]

import codegen  # noqa: E402  found by the line above

# What kernels inherit: this checkout, one thread of linear algebra, figures without a display.
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["MPLBACKEND"] = "Agg"
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
os.environ["PYDEVD_DISABLE_FILE_VALIDATION"] = "1"


def _package_digest() -> str:
    """Notebooks are executed anew when the package or a problem changes, not only when their own cells do."""
    found = hashlib.sha256()
    for folder in ("codegen", "problems"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".jinja", ".csv"):
                found.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:12]


project = "codegen"
version = release = codegen.__version__
copyright = "the authors of codegen, BSD-3-Clause"
language = "en"
extensions = ["myst_nb", "mathml", "signature", "pages", "downloads"]
exclude_patterns = ["_build", "README.md", "_extensions"]
html_math_renderer = "mathml"
html_theme = "furo"
html_title = "codegen"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"source_repository": "", "navigation_with_keys": True}
nitpicky = True
pygments_style, pygments_dark_style = "friendly", "github-dark"
myst_enable_extensions = ["amsmath", "attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / "executed" / _package_digest())
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_output_stderr = "remove"
nb_render_markdown_format = "myst"  # formulas in what cells show, as derived equations do
nb_mime_priority_overrides = [("html", "text/markdown", 0), ("html", "text/latex", 1)]
