"""What commands read and write, checked before the work begins."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from servolens.errors import InputError, ServolensError
from servolens.results import STANDARD_OUTPUT, check_writable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from servolens.campaign import Log
    from servolens.commands.options import Recordings
    from servolens.findings import Finding
    from servolens.identification import Prior
    from servolens.model import Model
    from servolens.record import Record

__all__ = [
    "about",
    "check_apart",
    "check_outputs",
    "check_page",
    "load_logs",
    "load_models",
    "load_records",
    "priors_from",
    "quality_findings",
    "refusal",
    "same_file",
    "writing",
]


def check_outputs(outputs: Mapping[str, str | None], inputs: Sequence[str] = ()) -> None:
    """Refuse output files that cannot be written or would overwrite an input.

    Parameters
    ----------
    outputs : mapping of str to str or None
        Option to file; ``"-"`` is standard output.
    inputs : sequence of str
        Files that the command reads.

    Raises
    ------
    InputError
        Naming the file.
    """
    taken = list(inputs)
    for option, name in outputs.items():
        if name is None or name == STANDARD_OUTPUT:
            continue
        _check_output(option, name)
        for other in taken:
            if same_file(name, other):
                raise InputError(f"{name}: {option} would overwrite {other}; choose another file")
        taken.append(name)


def load_records(
    recordings: Recordings, outputs: Mapping[str, str | None], progress: Callable[[str, int, int], None]
) -> tuple[Record, ...]:
    """Read the records; refuse `outputs` that are one of their files, which a folder or a campaign may name."""
    from servolens.campaign import read_records

    check_outputs(outputs, _inputs(recordings))
    progress("Reading the logs", 0, 0)
    records = read_records(recordings.paths, **_options(recordings))
    check_outputs(outputs, [record.source for record in records if record.source])
    return records


def load_logs(
    recordings: Recordings, outputs: Mapping[str, str | None], progress: Callable[[str, int, int], None]
) -> tuple[Log, ...]:
    """Read the records and how they were found; otherwise as :func:`load_records`."""
    from servolens.campaign import read_logs

    check_outputs(outputs, _inputs(recordings))
    progress("Reading the logs", 0, 0)
    logs = read_logs(recordings.paths, **_options(recordings))
    check_outputs(outputs, [log.reading.record.source for log in logs])
    return logs


def _inputs(recordings: Recordings) -> list[str]:
    """Return the files that the command line names."""
    file = recordings.settings.get("reference_file")
    return [*recordings.paths, *([str(file)] if file else [])]


def _options(recordings: Recordings) -> dict[str, Any]:
    return {
        "settings": recordings.settings or None,
        "columns": recordings.columns or None,
        "units": recordings.units or None,
        "data_root": recordings.data_root,
    }


def check_apart(records: Sequence[Record], heldout: Sequence[Record]) -> None:
    """Refuse a file that is given both as training and as held out."""
    for record in heldout:
        if any(same_file(record.source, other.source) for other in records):
            raise InputError(f"{record.source}: is given both as training and as held out; keep one of the two")


def quality_findings(records: Sequence[Record]) -> tuple[Finding, ...]:
    """Return what a check has to say about the records."""
    from servolens.checking import check

    return check(records)


def refusal(findings: Sequence[Finding], *, force: bool) -> tuple[Finding, ...]:
    """Return why no model is written: nothing with `force`, or where no error makes every parameter wrong."""
    from servolens.findings import Finding
    from servolens.quality import against_model

    against = [finding for finding in against_model(findings) if finding.record]
    names = list(dict.fromkeys(finding.record for finding in against if finding.record))
    if force or not names:
        return ()
    whose = f"{', '.join(names[:3])}{' and others' if len(names) > 3 else ''}"
    is_wrapped = all(finding.code == "position_wraps" for finding in against)
    wrong = f"the position of {whose} jumps at each turn" if is_wrapped else f"a sign or a unit in {whose} is wrong"
    message = (
        f"no model is written: {wrong}, and with it every parameter is wrong; correct the records, or give --force if"
        " they are right."
    )
    return (Finding(code="model_refused", severity="error", message=message),)


def priors_from(given: Sequence[tuple[str, float, float]]) -> dict[str, Prior]:
    """Return data-sheet knowledge by parameter name.

    Raises
    ------
    InputError
        If a parameter is given twice.
    """
    from servolens.identification import Prior

    names = [name for name, _, _ in given]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"--prior gives {twice[:40]!r} twice; keep one")
    return {name: Prior(value=value, deviation=deviation) for name, value, deviation in given}


def load_models(files: Sequence[str]) -> list[Model]:
    """Read model files.

    Raises
    ------
    InputError
        Naming the file.
    """
    from servolens.model import read_model

    models = []
    for name in files:
        path = Path(name)
        if not name:
            raise click.UsageError("a model's file name is empty")
        if path.exists() and not path.is_file():
            raise InputError(f"{name}: is a folder or a device; give a file that `servolens identify --out` wrote")
        try:
            models.append(read_model(path))
        except (RecursionError, OverflowError):
            raise InputError(f"{name}: is not a model: it is nested too deeply or holds a number too large") from None
    return models


@contextmanager
def about(*files: str) -> Iterator[None]:
    """Let every refusal inside begin with the files it is about."""
    try:
        yield
    except ServolensError as error:
        shown = ", ".join(files) if len(files) <= 3 else f"{files[0]} and {len(files) - 1} more"
        said = f"{error}"
        if len(files) == 1:  # told by the reader, or of a record that is called like its file
            said = said.removeprefix(f"{shown}: ").removeprefix(f"{Path(shown).stem}: ")
        raise type(error)(f"{shown}: {said}") from error


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Turn what the system says about a file that cannot be written into a refusal."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({(error.strerror or 'unknown error').lower()})") from error


def same_file(first: str, second: str) -> bool:
    """Tell whether both paths lead to the same file; two devices are never the same."""
    if Path(first).exists() and not Path(first).is_file():
        return False  # a device takes everything
    try:
        return Path(first).samefile(second)
    except OSError:
        return Path(first).absolute() == Path(second).absolute()


def check_page(name: str | None) -> None:
    """Refuse a page's name that promises what cannot be written.

    Raises
    ------
    InputError
        Naming the file.
    """
    if name:
        from servolens.report.printing import checked_page

        checked_page(Path(name))


def _check_output(option: str, name: str) -> None:
    path = Path(name)
    if not name.strip():
        raise click.UsageError(f"{option} needs the name of a file, this name is empty")
    if path.is_dir():
        raise InputError(f"{name}: {option} needs the name of a file, this is a folder")
    check_writable(path)
