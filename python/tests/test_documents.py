"""The example of the README and the notebook do what they say, and everything public is documented."""

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import eddy
import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent


def test_the_readme_s_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 1
    exec(compile(blocks[0], "README.md", "exec"), {})
    assert "[" in capsys.readouterr().out


#: Settings that make a training short.
QUICK = "windows.per_epoch = 16\nwindows.batch = 8\nvalidation.starts = 1\nunroll = [{ share = 1.0, frames = 2 }]\n"


def test_the_page_on_one_s_own_simulation_is_followed(tmp_path: Path) -> None:
    page = (ROOT.parent / "docs" / "src" / "own_simulation.md").read_text()
    here = re.escape('skip="python/tests/test_documents.py runs it"')
    blocks = re.findall(rf"^```(python (\S+)|sh {here})\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    programs = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    (tmp_path / "quick.toml").write_text(QUICK)
    ran = 0
    for _, file, text in blocks:
        if file:
            (tmp_path / file).write_text(text)
            continue
        for line in text.strip().splitlines():
            short = line.replace("eddy train", "eddy train --config quick.toml")
            subprocess.run(short, shell=True, check=True, cwd=tmp_path, env=environment, timeout=300)
            ran += 1
    assert ran == 6, blocks
    for bag in ("cloud", "cloud_unseen", "imported"):
        assert subprocess.run([programs / "eddy", "bag", "info", next((tmp_path / "bags" / bag).iterdir())]).returncode == 0
    assert (tmp_path / "reports" / "cloud" / "report.html").exists()


def test_the_notebook_runs() -> None:
    notebook = nbformat.read(ROOT / "examples" / "tutorial.ipynb", as_version=4)
    NotebookClient(notebook, timeout=600).execute()
    text = "".join(
        output.get("text", "") for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    )
    assert "skill at 1, 20 and 50 frames: 0." in text, text
    assert "Report(streams=" in text, text
    pages = [
        output.data["text/html"] for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
        if "text/html" in output.get("data", {})
    ]
    assert len(pages) == 1 and "<iframe srcdoc=" in pages[0], "the player"


def members() -> list[tuple[str, object]]:
    """Everything that `eddy` offers, and the public members of its classes."""
    found: list[tuple[str, object]] = [("eddy", eddy)]
    for name in eddy.__all__:
        item = getattr(eddy, name)
        found.append((name, item))
        if isinstance(item, type) and not issubclass(item, Exception):
            found += [(f"{name}.{member}", getattr(item, member)) for member in vars(item) if not member.startswith("_")]
    return found


@pytest.mark.parametrize(
    ("name", "item"), [(name, item) for name, item in members() if not isinstance(item, (str, tuple))]
)
def test_everything_public_has_a_docstring(name: str, item: object) -> None:
    text = item.__doc__
    assert text, name
    assert re.match(r"[`A-Z]", text) and text.rstrip()[-1] in ".:)", f"{name}: {text}"


@pytest.mark.parametrize("item", [item for _, item in members() if isinstance(item, type)])
def test_every_argument_of_a_constructor_is_described(item: type) -> None:
    """In the docstring of the class: the constructors of the extension module have none."""
    text = f"{item.__doc__} {item.__init__.__doc__}"
    try:
        arguments = inspect.signature(item).parameters.values()
    except ValueError:
        return  # made by eddy only
    named = [argument.name for argument in arguments if argument.kind is not argument.VAR_POSITIONAL]
    if not issubclass(item, Exception):
        assert [name for name in named if not re.search(rf"\b{name}\b", text)] == []


def test_the_page_names_everything_public() -> None:
    page = (ROOT.parent / "docs" / "src" / "how-to" / "python.md").read_text()
    main = [name for name in eddy.__all__ if not name.endswith("Error")]
    helpers = {"Frames", "Message", "Messages", "Report", "MATERIALS", "__version__"}
    assert [name for name in main if name not in helpers and f"`eddy.{name}`" not in page] == []
