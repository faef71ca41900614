"""``streetfix loadtest``."""

import asyncio
import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from model_training.datasets.dataset import Dataset
from model_training.loadtest.drive import Load, drive
from model_training.loadtest.payloads import Payload, payloads
from model_training.loadtest.processes import Usage, usage
from model_training.loadtest.summary import Summary, summarise
from model_training.loadtest.targets import Grpc, Rest, Target
from service.cli.tls_options import Ca, Cert, Key
from service.client import Client, GrpcClient
from service.client.tls import ClientTls
from service.errors import RequestError, UnreachableError

LATE_MS = 10.0  # at p99; a report names a generator that sends later than this


def command(
    dataset: Annotated[Path, typer.Option(help="Dataset with the queries to send.")],
    url: Annotated[str, typer.Option(help="URL of the service.")] = "http://127.0.0.1:8000",
    grpc: Annotated[
        str | None, typer.Option(help="Address HOST:PORT. The requests then go over gRPC.", show_default=False)
    ] = None,
    queries: Annotated[str | None, typer.Option(help="Query set.  [default: the first with ground truth]")] = None,
    map_name: Annotated[str | None, typer.Option("--map", help="Name of the map, if the service has several.")] = None,
    rate: Annotated[
        list[float] | None,
        typer.Option(
            help="Requests per second. They arrive at random and do not wait for answers. Repeat for a curve."
        ),
    ] = None,
    concurrency: Annotated[
        list[int] | None,
        typer.Option(help="Clients that wait for each answer. Repeat for several.  [default: 1]", min=1),
    ] = None,
    duration: Annotated[float, typer.Option(help="Measured time of each run, seconds.", min=0.5)] = 20.0,
    warm_up: Annotated[float, typer.Option(help="Time before the measurement, seconds.", min=0.0)] = 3.0,
    timeout: Annotated[float, typer.Option(help="Time until the client gives up a request, seconds.", min=0.01)] = 30.0,
    pairs: Annotated[
        int, typer.Option(help="Largest number of different queries. The command sends them in turn.", min=1)
    ] = 50,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Request full answers. --no-refine requests retrieval alone.")
    ] = True,
    cheap_depth: Annotated[
        bool, typer.Option("--cheap-depth", help="Send depth as raw16+lz4, the cheapest format to decode.")
    ] = False,
    api_key: Annotated[
        str | None, typer.Option("--api-key", envvar="STREETFIX_API_KEY", help="API key, if the service requires one.")
    ] = None,
    ca: Ca = None,
    cert: Cert = None,
    key: Key = None,
    tls: Annotated[
        bool | None,
        typer.Option("--tls/--no-tls", help="TLS over gRPC.  [default: on with --ca or --cert]", show_default=False),
    ] = None,
    pid: Annotated[
        int | None,
        typer.Option(help="Process of a service on this machine. The command then counts its processor time."),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON file for all figures.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot of latency against rate, PNG or SVG.")] = None,
) -> None:
    """Load a running service with the queries of a dataset.

    Latency counts from the time at which a request was due.

    \b
    Example, a curve:
      streetfix loadtest --dataset data/small --rate 5 --rate 10 --rate 20 --json load.json --plot load.png
    """
    if rate and concurrency:
        raise RequestError("--rate and --concurrency: give one of them", field="rate")
    if any(each <= 0 for each in rate or ()):
        raise RequestError("--rate: it must be positive", field="rate")
    sent = payloads(Dataset(dataset), queries, map_name=map_name, refine=refine, most=pairs, cheap_depth=cheap_depth)
    load = Load(rate=None, warm_up_s=warm_up, duration_s=duration, timeout_s=timeout)
    runs = [replace(load, rate=each) for each in rate or ()] or [
        replace(load, concurrency=each) for each in concurrency or [1]
    ]
    if pid is not None:
        usage(pid)  # said before the load, not after it
    spoken = _tls_of(url, grpc, ca=ca, cert=cert, key=key, tls=tls, api_key=api_key)
    console = Console()
    found = []
    for run in runs:
        target: Target = Rest(url, key=api_key, tls=spoken) if grpc is None else Grpc(grpc, key=api_key, tls=spoken)
        found.append(asyncio.run(_run(target, sent, run, pid, console)))
    console.print(table_of(found))
    if json_file is not None:
        json_file.write_text(json.dumps([each.as_json() for each in found], indent=1) + "\n")
    if plot is not None:
        from model_training.loadtest.plot import draw

        draw(found, plot)
    if not any(each.answers for each in found):
        raise UnreachableError(f"{grpc or url}: no request was answered: {found[-1].errors}")


def _tls_of(
    url: str,
    address: str | None,
    *,
    ca: Path | None,
    cert: Path | None,
    key: Path | None,
    tls: bool | None,
    api_key: str | None,
) -> ClientTls | None:
    """Return the TLS settings; None without TLS. Try the handshake once, so that a failure is one error before the load.

    Raises:
        RequestError: TLS options are given for an address without TLS.
        HandshakeError: the handshake fails.
    """
    if address is None and tls is not None:
        raise RequestError("--tls: only for --grpc; for REST use an address such as https://HOST:PORT", field="tls")
    spoken = ClientTls.of(ca, cert, key)
    if address is None:
        with Client(url, api_key=api_key, ca=ca, cert=cert, key=key) as client:
            if not url.startswith("https:"):
                return None
            client.maps()
    else:
        with GrpcClient(address, api_key=api_key, ca=ca, cert=cert, key=key, tls=tls) as messages:
            if not (spoken.is_wanted if tls is None else tls):
                return None
            messages.maps()
    return spoken


async def _run(target: Target, sent: list[Payload], load: Load, pid: int | None, console: Console) -> Summary:
    what = f"{load.rate:g}/s" if load.rate is not None else f"{load.concurrency} at a time"
    columns = (TextColumn(what), BarColumn(), TimeRemainingColumn())
    before: Usage | None = None
    after: Usage | None = None
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(what, total=load.warm_up_s + load.duration_s)

        def tick(seconds: float) -> None:
            nonlocal before, after
            if pid is not None and seconds >= load.warm_up_s:
                after = usage(pid)
                before = after if before is None else before
            progress.update(task, completed=seconds)

        async with target:
            shots = await drive(target, sent, load, tick)
    return summarise(shots, sent, load, before, after)


def table_of(found: list[Summary]) -> Table:
    """Return the table to print."""
    watched = any(each.cpu_ms_per_answer is not None for each in found)
    table = Table(title="load", caption="right: LOCALIZED answers within 1 m of the truth")
    for name in (
        "load",
        "answered/s",
        "p50 ms",
        "p90 ms",
        "p99 ms",
        "refused",
        "right",
        *(("CPU ms",) if watched else ()),
    ):
        table.add_column(name, justify="right", no_wrap=True)
    for each in found:
        ms = each.answered_ms
        table.add_row(
            f"{each.rate:g}/s" if each.rate is not None else f"{each.concurrency} clients",
            f"{each.answered_per_s:.1f}",
            *(f"{ms[name]:.1f}" if ms else "-" for name in ("p50", "p90", "p99")),
            ", ".join(f"{count} x {code}" for code, count in sorted(each.errors.items())) or "none",
            "-" if each.right is None else f"{each.right:.1%}",
            *((f"{each.cpu_ms_per_answer:.1f}",) if each.cpu_ms_per_answer is not None else ()),
        )
    if wrong := sum(each.inconsistent for each in found):
        table.caption = f"{table.caption}; {wrong} answers differ from another answer to the same request"
    if (late_ms := max(each.late_ms.get("p99", 0.0) for each in found)) > LATE_MS:
        table.caption = (
            f"{table.caption}; the load generator sent requests late (p99 {late_ms:.0f} ms, included in all "
            "latencies): give it its own core, or reduce the load"
        )
    return table
