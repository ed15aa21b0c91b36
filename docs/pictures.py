"""Make the pictures of the README: runs the demo and takes figures from its page (``make pictures``)."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from servolens.demo import run_demo

WANTED = {"damping-laws": "Figure 6", "settling-times": "Figure 10"}
NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
FIGURE = re.compile(r'<figure role="group" aria-label="([^"]+)">.*?(<svg.*?</svg>)', re.DOTALL)


def main() -> None:
    """Write ``docs/images/*.svg``."""
    folder = Path(__file__).with_name("images")
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        run_demo(Path(place))
        page = (Path(place) / "report.html").read_text(encoding="utf-8")
    drawn = dict(FIGURE.findall(page))
    for name, figure in WANTED.items():
        picture = drawn[figure].replace("<svg ", f"<svg {NAMESPACES} ", 1)
        background = '><rect width="100%" height="100%" fill="white"/>'
        (folder / f"{name}.svg").write_text(picture.replace(">", background, 1) + "\n", encoding="utf-8")
        print(f"docs/images/{name}.svg: {figure} of the demo's page")


if __name__ == "__main__":
    main()
