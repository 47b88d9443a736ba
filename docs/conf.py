"""The site, made by Sphinx from the whole checkout, so that links in README and docs lead where
they do anywhere.
"""

import shutil
from pathlib import Path

from docutils.nodes import SkipNode
from docutils.utils.math.latex2mathml import tex2mathml

project = "cvqmpt_lab"
author = "cvqmpt_lab founders"
copyright = f"2026 {author}"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
include_patterns = [
    "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/*.md", "notebooks/*.ipynb",
    "paper_tables/README.md", "paper_tables/results/*/*.md", "cvqmpt_lab/weights/*/README.md",
]  # fmt: skip
exclude_patterns = [".*", "build", "runs", "data"]
root_doc = "docs/index"
templates_path = ["_templates"]
default_role = "code"

html_theme = "furo"
html_title = "cvqmpt_lab"
html_additional_pages = {"index": "to_docs.html"}
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"  # browsers draw it themselves; MathJax would come from a network

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
nb_render_markdown_format = "myst"  # tables and formulas in what cells show
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_numpy_docstring = False
napoleon_use_rtype = False


def setup(app):
    """Draw formulas as MathML; copy the pages of plans to where README's links lead."""

    def visit(writer, node, block):
        writer.body.append(tex2mathml(node.astext(), as_block=block))
        raise SkipNode

    app.add_html_math_renderer(
        "mathml",
        (lambda writer, node: visit(writer, node, False), None),
        (lambda writer, node: visit(writer, node, True), None),
    )

    def copy_pages(app, error):
        for page in Path(__file__).parent.glob("*.html"):
            shutil.copy(page, Path(app.outdir) / "docs" / page.name)

    app.connect("build-finished", copy_pages)
