"""`evlcp compare`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, LinkFiles, Overrides, console, echo, make_executor, progress_bar
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.cli._tables import print_table
from evlcp_sdk.errors import ConfigError, OutputError

_SQLITE = b"SQLite format 3\0"


def compare(
    recordings: Annotated[
        list[str], typer.Argument(metavar="REC...", help="Recordings, or the RESULTS of one evlcp sweep.")
    ],
    variants: Annotated[
        list[str] | None,
        typer.Option(
            "--variant",
            metavar="NAME:TABLE.KEY=VALUE,...",
            help="A variant; repeat it. NAME: alone is the link as it is.",
        ),
    ] = None,
    link_files: LinkFiles = None,
    overrides: Overrides = None,
    out: Annotated[
        list[Path] | None,
        typer.Option("-o", "--out", metavar="FILE", help="Also write .csv, .html or .json; repeat it."),
    ] = None,
    jobs: Annotated[
        int,
        typer.Option("-j", "--jobs", min=0, metavar="N", help="Processes for many recordings; 0: this one."),
    ] = 0,
    as_json: Json = False,
) -> None:
    """Run variants of the receiver on the same recordings, in tables.

    Two rangings:     [bold]evlcp compare REC.raw --variant paper: --variant joint:ranging.id=joint-scale[/]
    Several settings: [bold]--variant best:ranging.id=joint-scale,decoding.id=ml-soft,tracking.id=kalman[/]
    As a page:        [bold]evlcp compare *.raw --variant a: --variant b:ranging.id=centroid -o table.html[/]
    A campaign:       [bold]evlcp compare paper.sqlite[/] compares its links, a table per scene

    Truth is taken from REC.truth.json beside REC.raw; without it there is no BER and no distance error. -c
    and --set hold for all variants. The best of each column has a *. The last row is the Cramer-Rao bound of
    the frames' distances: no unbiased ranging from one frame can do better.
    """
    _check_outputs(out or [])
    if any(map(_is_campaign, recordings)):
        if variants or link_files or overrides or len(recordings) > 1:
            raise typer.BadParameter(
                "results of a campaign stand alone: their variants are the campaign's links",
                param_hint="REC...",
            )
        code, comparison = 0, _load_comparison(Path(recordings[0]))
    else:
        code, comparison = _compare_recordings(recordings, variants or [], link_files, overrides or [], jobs)
    if comparison.tables:
        _write(comparison, out or [])
        if as_json:
            echo(comparison.to_json(), nl=False)
        else:
            _print_comparison(comparison, out or [])
    raise typer.Exit(code)


def _check_outputs(out: Sequence[Path]) -> None:
    for path in out:
        if path.suffix not in (".csv", ".html", ".json"):
            raise typer.BadParameter(
                f"{path}: expected a name that ends in .csv, .html or .json", param_hint="-o"
            )
        if not path.parent.is_dir():
            raise OutputError(f"{path}: cannot be written: no folder {path.parent}")
        sdk.files.check_output(path, regular=False)


def _is_campaign(url: str) -> bool:
    path = Path(url)
    if path.suffix == ".toml":
        raise ConfigError(
            f"{url}: a campaign is compared by its results: evlcp sweep {url} -o R.sqlite,"
            " then evlcp compare R.sqlite"
        )
    if path.suffix == ".sqlite" or not path.is_file():
        return path.suffix == ".sqlite"
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


def _load_comparison(path: Path) -> sdk.comparison.Comparison:
    with sdk.store.Store(path) as store:
        return sdk.comparison.compare_links(sdk.summary.summarize(store))


def _compare_recordings(
    urls: Sequence[str],
    texts: Sequence[str],
    link_files: Sequence[str] | None,
    overrides: Sequence[str],
    workers: int,
) -> tuple[int, sdk.comparison.Comparison]:
    if not texts:
        raise typer.BadParameter("name at least one, e.g. --variant paper:", param_hint="--variant")
    if duplicates := {url for url in urls if urls.count(url) > 1}:
        raise typer.BadParameter(f"{min(duplicates)} is named twice", param_hint="REC...")
    variants = sdk.compare.load_variants(texts, link_files, overrides)
    in_process = not workers or len(urls) == 1
    executor = make_executor(0 if in_process else workers, None)
    tables: dict[str, sdk.comparison.Table] = {}
    code = 0
    for outcome in executor.run(partial(_compare_recording, variants=variants, in_process=in_process), urls):
        if outcome.value is not None:
            tables[outcome.job] = outcome.value
        elif outcome.fault is not None:
            print_stderr(outcome.fault.message)
            code = max(code, outcome.fault.exit_code)
    ordered = [tables[url] for url in urls if url in tables]
    return code, sdk.compare.comparison_of(ordered, variants, sdk.registry.Registry.load().versions())


def _compare_recording(
    url: str, *, variants: tuple[sdk.compare.Variant, ...], in_process: bool
) -> sdk.comparison.Table:
    with progress_bar(Path(url).name, by_bytes=True) if in_process else nullcontext() as advance:
        return sdk.compare.compare_recording(url, variants, advance=advance or (lambda _done, _of: None))


def _write(comparison: sdk.comparison.Comparison, paths: Sequence[Path]) -> None:
    texts = {".csv": comparison.to_csv, ".html": comparison.to_html, ".json": comparison.to_json}
    with sdk.files.Outputs() as outputs:
        for path in paths:
            outputs.write_text(texts[path.suffix](), path)


def _print_comparison(comparison: sdk.comparison.Comparison, paths: Sequence[Path]) -> None:
    out = console()
    for one in comparison.tables:
        out.print(one.name, style="bold")
        head, lines = one.format_rows()
        # The best end with a mark.
        print_table(
            out,
            head,
            [[t if best else f"{t} " for t, best in line] for line in lines],
            best=sdk.comparison.MARK,
        )
        out.print()
    for note in comparison.notes:
        out.print(note, style="yellow")
    out.print(comparison.legend, style="dim")
    if paths:
        out.print(f"written: {', '.join(map(str, paths))}", style="dim")
