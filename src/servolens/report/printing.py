"""A page as PDF, printed by the Chromium or Chrome of the machine."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

from servolens.errors import InputError
from servolens.results import check_writable

__all__ = ["checked_page", "chromium", "printed"]

PAGE_ENDINGS, PDF = (".html", ".htm"), ".pdf"
CHOSEN = "SERVOLENS_CHROMIUM"
BROWSER_NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "msedge",
    "microsoft-edge",
)
BROWSER_PATHS = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
)
BROWSER_SECONDS = 120.0
"""Seconds after which a browser that does not end is given up."""


def checked_page(path: Path) -> None:
    """Make sure that a page can be written to a file of this name.

    Raises
    ------
    InputError
        If the name ends neither in .html nor in .pdf, or in .pdf and there is no browser to print it; or if the file
        cannot be written.
    """
    kind = path.suffix.lower()
    if kind == PDF:
        if chromium() is None:
            raise InputError(
                f"{path}: printing a PDF needs Chromium or Chrome, and none was found; install one, or name it in"
                f" {CHOSEN}, or write a .html file and print that from a browser"
            )
    elif kind not in PAGE_ENDINGS:
        raise InputError(f"{path}: a page is written as .html or .pdf; name such a file")
    check_writable(path)


def chromium() -> str | None:
    """Return the program of a Chromium: the one that ``SERVOLENS_CHROMIUM`` names, or one that is found."""
    chosen = os.environ.get(CHOSEN)
    if chosen:
        return shutil.which(chosen)
    found = (shutil.which(name) for name in BROWSER_NAMES)
    installed = (place for place in BROWSER_PATHS if Path(place).is_file())
    return next((program for program in (*found, *installed) if program), None)


def printed(html: str) -> bytes:
    """Return a page as PDF.

    Raises
    ------
    InputError
        If there is no browser, or it does not print.
    """
    program = chromium()
    if program is None:
        raise InputError(f"no Chromium or Chrome was found to print the page; install one, or name it in {CHOSEN}")
    try:
        with tempfile.TemporaryDirectory(prefix="servolens-") as folder:
            return _printed(program, html, folder)
    except OSError as error:
        where, why = tempfile.gettempdir(), (error.strerror or "unknown error").lower()
        raise InputError(f"the page cannot be printed: {why} where temporary files are kept ({where})") from None


def _printed(program: str, html: str, folder: str) -> bytes:
    page, target = Path(folder, "page.html"), Path(folder, "page.pdf")
    page.write_text(html, encoding="utf-8", errors="replace")
    command = [program, *_options(folder), f"--print-to-pdf={target}", page.as_uri()]
    with suppress(OSError, subprocess.TimeoutExpired):  # what it leaves tells
        subprocess.run(command, capture_output=True, timeout=BROWSER_SECONDS, check=False)
    if not target.is_file() or not target.read_bytes().startswith(b"%PDF"):
        raise InputError(f"{Path(program).name} did not print the page; write a .html file and print that instead")
    return target.read_bytes()


def _options(folder: str) -> list[str]:
    """Return how a browser is run for one page: without a window, with a profile of its own."""
    options = [
        "--headless",
        "--disable-gpu",
        "--no-first-run",
        "--no-pdf-header-footer",
        f"--user-data-dir={folder}/profile",
    ]
    is_root = hasattr(os, "geteuid") and os.geteuid() == 0
    return [*options, "--no-sandbox"] if is_root else options  # which Chromium does not offer to root
