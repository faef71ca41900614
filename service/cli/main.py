"""The command ``streetfix``: commands of the service, and commands of other packages by entry point."""

import functools
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint, entry_points
from importlib.metadata import version as installed_version
from importlib.util import find_spec
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from service.cli import bridge, doctor, health, keys, localize, serve
from service.cli.extras import EXTRA_OF_PACKAGE, package_of
from service.errors import ExtraMissingError, StreetfixError, how_to_install

GROUP = "streetfix.commands"
#: One line per command for ``--help``, which must not import the commands, and the extra that installs the packages of the command.
_KNOWN = {
    "simulate": ("Simulate a city, its LiDAR survey and its query traversals.", "mapping"),
    "import": ("Import a recording into a dataset folder.", "mapping"),
    "record": ("Record a traversal from a running simulator.", "mapping"),
    "convert": ("Write a dataset as a ROS bag or in KITTI's layout.", "mapping"),
    "streets": ("Import named streets from GeoJSON, OpenDRIVE or OpenStreetMap.", "mapping"),
    "build-map": ("Build a map bundle from a dataset's survey.", "mapping"),
    "map": ("Maintain map bundles: info, verify, diff, merge, update, push, pull.", "mapping"),
    "calibrate": ("Fit the confidence of an encoder on calibration cities.", "mapping"),
    "evaluate": ("Measure the answers of a map against ground truth.", "mapping"),
    "compare": ("Compare two runs over the same queries.", "mapping"),
    "view": ("Show data, maps or answers in Rerun, Foxglove or Lichtblick.", "view"),
    "loadtest": ("Load a running service with the queries of a dataset.", "mapping"),
    "demo": ("Build a map, serve it and compare answers with ground truth.", "mapping"),
    "simulate-training": ("Simulate the cities of a training for other machines.", "mapping"),
    "train": ("Train an encoder on simulated cities.", "training"),
    "average": ("Average the weights of two training runs.", "training"),
    "export": ("Export a trained encoder to ONNX.", "training"),
    "train-verifier": ("Train the network that compares a pose with the map.", "training"),
    "quantize": ("Quantise an encoder to 8 bits: smaller, faster, nearly equal.", "training"),
}
#: Packages without a wheel for every supported platform, as in the markers of ``pyproject.toml``.
_NOT_EVERYWHERE = {
    "embreex": "for x86-64 and macOS",
    "carla": "for Python before 3.13 on x86-64",
    "cyclonedds": "for Python before 3.14 on x86-64 and macOS",
    "kiss_icp": "for Python before 3.14",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    Exit codes: 0 done, 1 refused with a message, 2 wrong usage. A command may have further codes.

    Args:
        arguments: of the command line; None takes those of the process.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _run(given)
    except StreetfixError as error:
        typer.echo(f"streetfix: {error.message}", err=True)
        sys.exit(1)
    except ValidationError as error:  # invalid settings of a command: name the option, not the model
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        typer.echo(f"streetfix: {where}: {first['msg']} (given: {first.get('input')!r})", err=True)
        sys.exit(2)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)
    except OSError as error:
        if error.errno is None:  # not from the system: a defect, so show the traceback
            raise
        typer.echo(f"streetfix: {_told_by_system(error)}", err=True)
        sys.exit(1)


def _told_by_system(error: OSError) -> str:
    """Return one line for a system error: a file is missing or unreadable, or the disk is full or fails."""
    files = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
    return f"{files or 'a file'}: {error.strerror}; check the file, its folder and the disk, and start again"


def _run(arguments: list[str]) -> None:
    """Run a command. If a package of a service command is missing, report the extra that installs it."""
    try:
        app_for(arguments)(arguments, prog_name="streetfix")
    except ModuleNotFoundError as error:
        if package_of(error) not in EXTRA_OF_PACKAGE:
            raise
        raise _extra_missing(" ".join(arguments[:1]), None, error) from error


def app_for(arguments: Sequence[str]) -> typer.Typer:
    """Build the application. Of the commands of other packages, it imports only the called one.

    Args:
        arguments: of the command line.
    """
    called = next((argument for argument in arguments if not argument.startswith("-")), None)
    app = typer.Typer(
        add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False, help=_HELP
    )
    app.callback()(_global_options)
    app.command("serve")(serve.command)
    app.command("localize")(localize.command)
    app.command("keys")(keys.command)
    app.command("health")(health.command)
    app.command("doctor")(doctor.command)
    app.add_typer(bridge.app, name="bridge")
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        summary, extra = _KNOWN.get(point.name, (f"From the package {point.dist.name if point.dist else '?'}.", None))
        if point.name != called:
            if _is_installed(point):
                app.command(point.name, help=summary)(_not_called)
            continue
        loaded = _load(point, extra)
        if isinstance(loaded, typer.Typer):
            app.add_typer(loaded, name=point.name)
        else:
            app.command(point.name)(loaded)
    return app


_HELP = "Find the street and the pose of a robot in a LiDAR map from one RGB image and one depth image."


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"streetfix {installed_version('streetfix')}")
        raise typer.Exit


def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    del version  # its callback has done the work


def _not_called() -> None:
    """Placeholder in the list of commands for a command that is not imported."""


def _is_installed(point: EntryPoint) -> bool:
    """Whether a command is installed. The container image omits the package that builds maps and encoders."""
    return find_spec(point.module.partition(".")[0]) is not None


def _load(point: EntryPoint, extra: str | None) -> Callable[..., Any] | typer.Typer:
    """Load the function of a command, or its application if it has subcommands.

    A missing package is reported as a missing extra, now or when the command runs.
    """
    if not _is_installed(point):
        raise ExtraMissingError(
            f"the command {point.name!r} is not part of this installation, which has only the service (as in its "
            f"container image): to get the command, {how_to_install(extra)}",
            field=point.name,
        )
    try:
        loaded: Callable[..., Any] | typer.Typer = point.load()
    except ModuleNotFoundError as error:
        raise _extra_missing(point.name, extra, error) from error
    if isinstance(loaded, typer.Typer):
        for info in loaded.registered_commands:
            if info.callback is not None:
                info.callback = _telling_extras(point, extra, info.callback)
        return loaded
    return _telling_extras(point, extra, loaded)


def _telling_extras(point: EntryPoint, extra: str | None, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def run(*args: object, **kwargs: object) -> object:
        try:
            return function(*args, **kwargs)
        except ModuleNotFoundError as error:
            raise _extra_missing(point.name, extra, error) from error

    return run


def _extra_missing(command: str, extra: str | None, error: ModuleNotFoundError) -> ExtraMissingError:
    needed = EXTRA_OF_PACKAGE.get(package_of(error))
    # The extra of a command contains that of the server.
    if needed is not None and (extra is None or needed != "server"):
        extra = needed
    remedy = how_to_install(extra) if extra else "install the packages that it needs"
    if package_of(error) in _NOT_EVERYWHERE:
        remedy = f"{remedy} (the package is available only {_NOT_EVERYWHERE[package_of(error)]})"
    return ExtraMissingError(f"the command {command!r} needs the package {error.name!r}: {remedy}", field=command)
