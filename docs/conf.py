"""The documentation site: ``make docs`` builds it in docs/_build/html."""

import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import jupytext
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # the packages of this tree, also where others are installed

from docs.environment_pages import CONTROL_IDS, IDS, page_of  # noqa: E402

project = "sb3_lac"
author = "The sb3_lac contributors"
project_copyright = author
release = (ROOT / "sb3_lac" / "version.txt").read_text(encoding="utf-8").strip()

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_design",
]
myst_enable_extensions = ["colon_fence", "dollarmath"]
templates_path = ["_templates"]
exclude_patterns = ["_build", "results"]  # raw tables are files of the repository
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["plates.css"]
html_title = f"sb3_lac and battery_env {release}"

myst_heading_anchors = 4  # as on GitHub
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_type_aliases = {name: name for name in ("BoolArray", "FloatArray", "IntArray")}


# the pages below a page in the sidebar
BELOW = {
    "lac": ("how_lac_works", "custom_policy", "stability_metrics", "published_lac"),
    "own_problem": ("own_env",),
    "train_fast": ("zoo", "tensorboard", "onnx", "own_algorithm", "cluster"),
    "cost_environments": tuple(f"environments/{env_id}" for env_id in CONTROL_IDS),
    "real_cells": ("findings", "tester_files", "own_cell", "forecasts", "streaming", "pretrained"),
    "parameters": ("identifiability",),
    "battery_env": (
        "compare_calibrators",
        *dict.fromkeys(f"environments/{page_of(each)}" for each in IDS if each not in CONTROL_IDS),
    ),
    "results_at_a_glance": (
        *("reports/control_problems", "reports/certificates", "reports/designs", "reports/speed"),
        *("reports/real_cells", "reports/voltage", "reports/wrong_constants", "reports/full_state"),
    ),
}


def nest(app: Sphinx, docname: str, source: list[str]) -> None:
    """Hang pages below others, which a forge that shows the same files need not see."""
    if docname in BELOW:
        source[0] += "\n```{toctree}\n:hidden:\n\n" + "\n".join(f"/{name}" for name in BELOW[docname]) + "\n```\n"


# where words lead that are searched for: each page says something of them
SOUGHT = {
    "battery_env": ("Gymnasium",),
    "cell_life": ("capacity fade", "remaining useful life", "state of health, SOH"),
    "command_line": ("cut-off",),
    "cost_environments": ("disturbances",),
    "custom_policy": ("custom policy, features extractor",),
    "faq": ("LFP", "NMC", "pack, packs"),
    "forecasts": ("forecast", "end of discharge"),
    "judge_any_loop": ("stability", "certificate", "Lyapunov function"),
    "lac": ("save and load",),
    "onnx": ("ONNX", "deployment"),
    "own_env": ("gym.Env, own environment",),
    "own_problem": ("domain randomization",),
    "parameters": ("capacity", "DCIR, HPPC", "EIS, impedance", "internal resistance"),
    "real_cells": ("cut-off", "settled", '"not known to 2 %"'),
    "several_environments": ("several environments", "SubprocVecEnv, make_vec_env"),
    "streaming": ("BMS", "sample by sample"),
    "tensorboard": ("wandb, Weights & Biases",),
    "tester_files": ("Arbin, Maccor, Neware, BioLogic", "CSV, Excel, Parquet"),
    "train_fast": ("GPU",),
    "when_to_take_lac": ("SAC, TQC",),
    "zoo": ("hyperparameters", "RL Zoo"),
}


def lead_search(app: Sphinx, docname: str, source: list[str]) -> None:
    """Let the search find first what a word leads to: its entry in the index, below the title."""
    words = [word.strip() for entry in SOUGHT.get(docname, ()) for word in entry.split(",")]
    if words:
        title, newline, text = source[0].partition("\n")
        entries = "".join(f"   ! single: {word}\n" for word in words)
        source[0] = f"{title}{newline}\n```{{eval-rst}}\n.. index::\n{entries}```\n{text}"


def draw_formula(translator: Any, node: nodes.math | nodes.math_block) -> None:
    """A formula as MathML, which browsers draw by themselves, offline, too."""
    text = tex2mathml(re.sub(r"frac(\d)(\d)", r"frac{\1}{\2}", node.astext()))
    if isinstance(node, nodes.math_block):
        text = f'<div class="math">{text.replace("<math", """<math display="block" """, 1)}</div>'
    translator.body.append(text)
    raise nodes.SkipNode


# pages that can be downloaded as notebooks
TUTORIALS = ("first_controller", "first_discharge", "own_problem", "cell_life")


# without it a page that begins with a command becomes a notebook of commands
OF_PYTHON = """---
jupyter:
  kernelspec: {display_name: Python 3, language: python, name: python3}
---
"""


def notebook_of(page: str) -> Any:
    """
    The notebook of a page: Python as cells, commands as cells whose exit status stops nothing; of links and pictures, which
    lead to files of the site, the text.
    """
    text = re.sub(r"!?\[([^\]]*)\]\((?!http)[^)]*\)|<!--.*?-->", r"\1", page)
    notebook = jupytext.reads(OF_PYTHON + text, fmt="md")
    for cell in notebook.cells:
        cell.source = re.sub(r"\A%%bash$", "%%bash --no-raise-error", cell.source, flags=re.MULTILINE)
    return notebook


def offer_notebook(app: Sphinx, docname: str, source: list[str]) -> None:
    """Write a tutorial as a notebook, too, which its page leads to."""
    if docname in TUTORIALS:
        file = ROOT / "docs" / "_notebooks" / f"{docname}.ipynb"
        file.parent.mkdir(exist_ok=True)
        jupytext.write(notebook_of(source[0]), file)
        source[0] += f"\n[This page as a Jupyter notebook](_notebooks/{file.name})\n"


# the pages that include files of the root
INCLUDING = {ROOT / "README": "index", ROOT / "CONTRIBUTING": "contributing", ROOT / "CHANGELOG": "changelog"}


def lead_to_site(app: Sphinx, doctree: nodes.document) -> None:
    """Of what links lead to outside of the site, files are downloads, the README is the index, and folders stay text."""
    page = Path(app.env.doc2path(app.env.docname))
    for link in list(doctree.findall(addnodes.pending_xref)):
        target = link["reftarget"]
        if link["reftype"] != "myst" or target in app.env.found_docs:
            continue
        file = f"{target}.md" if link["refdomain"] == "doc" else target
        found = next(
            (path for folder in (page.parent, ROOT, ROOT / "docs") if (path := (folder / file).resolve()).exists()), None
        )
        outside = Path(file) if found is None else found
        if (including := INCLUDING.get(outside.with_suffix(""))) is not None:
            link["reftarget"] = including
        elif found is not None and (name := app.env.path2doc(found)) in app.env.found_docs:
            link.attributes |= {"refdomain": "doc", "reftarget": name, "reftargetid": None}  # and no name of the API
        elif found is not None and found.is_file():
            name = str(app.env.dlfiles.add_file(app.env.docname, str(found)))
            link.replace_self(addnodes.download_reference("", "", *link.children, filename=name, reftarget=str(found)))
        elif found is not None:
            link.replace_self(link.children)


def refer_to_page(app: Sphinx, what: str, name: str, documented: Any, options: Any, lines: list[str]) -> None:
    """The docstring of an environment is a page, in Markdown."""
    if what == "class" and lines[:1] == ["## Description"]:
        ends = f":{documented.__name__}"
        (spec,) = (spec for spec in gym.registry.values() if str(spec.kwargs.get("task", spec.entry_point)).endswith(ends))
        lines[:] = [f"See its page, :doc:`/environments/{spec.id}`."]


def setup(app: Sphinx) -> None:
    app.add_html_math_renderer("mathml", inline_renderers=(draw_formula, None), block_renderers=(draw_formula, None))
    app.connect("source-read", lead_search)
    app.connect("source-read", offer_notebook)
    app.connect("source-read", nest)
    app.connect("doctree-read", lead_to_site)
    app.connect("autodoc-process-docstring", refer_to_page)
