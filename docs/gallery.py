"""Write docs/gallery.md: every short program of notebooks/examples, what it prints and a picture.

python docs/gallery.py
"""

import contextlib
import io
import os
import runpy
import tempfile
from pathlib import Path

from frames import few_colours
from PIL import Image

from cvqmpt_lab import draw

DOCS = Path(__file__).parent
DRAWN = ("solution", "problem", "robot", "panda")  # the first of these that a program has
HEAD = """# Gallery

Short programs, one for each use, with what they print and a picture (`cvqmpt_lab.draw`).
They are in `notebooks/examples`. This page is written by `python docs/gallery.py`.
"""


def main() -> None:
    """Run the programs in an empty folder, and write the page and its pictures."""
    parts, home = [HEAD], Path.cwd()
    (DOCS / "gallery").mkdir(exist_ok=True)
    for program in sorted((DOCS.parent / "notebooks" / "examples").glob("*.py")):
        said = io.StringIO()
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(said):
            os.chdir(folder)
            names = runpy.run_path(str(program))
            os.chdir(home)
        text = program.read_text(encoding="utf-8")
        docstring, _, code = text.partition('"""')[2].partition('"""')
        title, _, details = docstring.partition("\n")
        title, details, code = title.rstrip("."), details.strip(), code.strip()
        picture = DOCS / "gallery" / f"{program.stem}.png"
        if "planned" in names:
            names["solution"] = names["planned"].solution
        shown = next((names[name] for name in DRAWN if name in names), None)
        printed = said.getvalue().strip()
        parts += [f"## {title}\n", *([f"{details}\n"] if details else [])]
        parts.append(f"```python\n{code}\n```\n\n```text\n{printed}\n```\n")
        if shown is not None:
            several = names.get("solutions", (shown,))
            columns = min(3, len(several))
            across, high = (750, 500) if columns == 1 else (500, 380)
            drawn = [draw(each, size=(across, high)).convert("RGB") for each in several]
            image = drawn[0]  # a single one has its own size: that of a task is larger
            if len(drawn) > 1:
                whole = columns * across, -(-len(drawn) // columns) * high
                image = Image.new("RGB", whole, "white")
                for k, each in enumerate(drawn):
                    image.paste(each, (k % columns * across, k // columns * high))
            few_colours(image).save(picture, optimize=True)
            parts.append(f"![{title}](gallery/{picture.name})\n")
        print(f"{program.stem}: {'picture' if shown is not None else 'text'}")
    (DOCS / "gallery.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
